"""Classes of values: frozen to whoever writes code with them, and cheap to make a hundred times a second."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

__all__ = ["value"]

T = TypeVar("T")

if TYPE_CHECKING:
    # To mypy it is the usual decorator, so that whoever sets a field is told before anything runs.
    from dataclasses import dataclass as value
else:

    def value(*, frozen: bool, slots: bool, kw_only: bool = False) -> Callable[[type[T]], type[T]]:
        """Make a dataclass of a class as `dataclass` would, hashable and with slots, but without a guard when it runs.

        The guard sets each field by a call of `object.__setattr__`, which makes a value ten times as dear: of the 25
        fields of a robot's state, 125 times a second and after 8 ms in which others had the processor's caches, that is
        no small part of all that the loop costs.
        """
        if not (frozen and slots):
            raise TypeError("a value is frozen, and has slots")
        return dataclass(slots=True, unsafe_hash=True, kw_only=kw_only)
