"""A context for opened devices: it leaves none of them open, even if the opening of one fails."""

from abc import ABC, abstractmethod
from types import TracebackType
from typing import Self


class Opened(ABC):
    """A device or a process that a stage uses for a while."""

    @abstractmethod
    def open(self) -> None:
        """Open it; raises what keeps it from being opened."""

    @abstractmethod
    def close(self) -> None:
        """Close it, or what of it was opened."""

    def __enter__(self) -> Self:
        """Open it."""
        try:
            self.open()
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(
        self, _kind: type[BaseException] | None, _error: BaseException | None, _trace: TracebackType | None
    ) -> None:
        """Close it."""
        self.close()
