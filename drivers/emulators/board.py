"""What all played boards have in common: a pseudo-terminal, a pace, and faults that wait for their turn."""

import asyncio
from collections import deque
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Generic, TypeVar

from shearloop.drivers.emulators.pty_port import PtyPort

FaultT = TypeVar("FaultT")


class PlayedBoard(Generic[FaultT]):
    """One board at a port; what it sends, and when, is its own module's business.

    `on_port` hears the port's path whenever it appears. `sent` counts the lines that went out sound.
    """

    def __init__(
        self,
        period_s: float,
        link: Path | None,
        on_port: Callable[[str], None],
        seed: int,
        on_bytes: Callable[[bytes], None] = lambda _: None,
    ) -> None:
        self._period_s = period_s
        self._on_port = on_port
        self._random = Random(seed)
        self._port = PtyPort(on_bytes, link)
        self._injected: deque[FaultT] = deque()
        self.sent = 0

    @property
    def path(self) -> str:
        """Where the port is now."""
        return self._port.path

    @property
    def held_up(self) -> asyncio.Event:
        """Set while what it sends waits for a reader."""
        return self._port.held_up

    def inject(self, fault: FaultT) -> None:
        """Let a fault befall what comes next; several befall one each, in order."""
        self._injected.append(fault)

    def _plug(self) -> None:
        self._port.plug()
        self._on_port(self.path)

    def _garbage(self, count: int) -> bytes:
        return bytes(self._random.choices(range(128, 256), k=count))
