"""A mark in the service's runtime folder while an experiment may have moved something: it outlives a crash.

A service manager starts a daemon that died again, and with it the configured experiment. But what the operator, or the
safety table, had said to the one before died with it: the arm stands until somebody says `start`.
"""

import os
from collections.abc import Mapping
from pathlib import Path

import structlog

_NAME = "begun"


class CrashMarker:
    """The mark of one daemon; without a runtime folder, as at a terminal, where somebody sits, there is none."""

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        """Look whether the daemon before has left its mark."""
        # systemd separates several by colons; ours is one.
        folder = environment.get("RUNTIME_DIRECTORY", "").partition(":")[0]
        self._path = Path(folder) / _NAME if folder else None
        self.left_behind = self._path is not None and self._path.exists()

    def set(self) -> None:
        """Note that an experiment has begun."""
        if self._path is None:
            return
        try:
            self._path.touch()
        except OSError as error:
            structlog.get_logger().warning(
                "a daemon started again after a crash would begin its experiment anew: there is no mark of this one",
                path=str(self._path),
                why=error.strerror,
            )

    def clear(self) -> None:
        """Note that the daemon ends in good order."""
        if self._path is not None:
            self._path.unlink(missing_ok=True)
