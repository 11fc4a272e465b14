"""A pseudo-terminal as a serial port that can be unplugged and plugged in again."""

import asyncio
import contextlib
import os
import select
import tty
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Self

READ_BYTES = 4096
# Whoever reads a part of much makes room first, and is given the rest then: one look between finds nothing. Of 150 000
# times 40 kB, two in a row never did.
EMPTY_LOOKS = 3
# How long a port that is about to hang up waits for a reader that may not be there.
UNREAD_S = 0.5


class PtyPort:
    """The device's end of a serial port; as a context it is plugged in, and unplugged at the end.

    `on_bytes` is given what the other side writes. With `link`, a symbolic link of that name leads to the port while it
    is plugged in, whatever number the terminal has: what udev's links are to a real device. All of it belongs to the
    event loop that runs when it is plugged in.
    """

    def __init__(self, on_bytes: Callable[[bytes], None], link: Path | None = None) -> None:
        self._on_bytes = on_bytes
        self._link = link
        self._master: int | None = None
        # Held open, so that the port outlives the programs that open and close it, as a device does.
        self._slave = -1
        self._terminal = ""
        self._room = asyncio.Event()
        # Set while what is being written waits for the other side to read.
        self.held_up = asyncio.Event()

    @property
    def path(self) -> str:
        """Where the other side opens the port."""
        return self._terminal if self._link is None else str(self._link)

    def __enter__(self) -> Self:
        """Plug the port in."""
        self.plug()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Unplug the port, if it is not."""
        self.unplug()

    def plug(self) -> None:
        """Make the port appear, under a new terminal."""
        if self._master is not None:
            return
        self._master, self._slave = os.openpty()
        # Bytes pass as they are, also before anybody has configured the port.
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self._terminal = os.ttyname(self._slave)
        if self._link is not None:
            fresh = self._link.with_name(f".{self._link.name}.{os.getpid()}")
            fresh.symlink_to(self._terminal)
            fresh.replace(self._link)
        asyncio.get_running_loop().add_reader(self._master, self._receive, self._master)

    def unplug(self) -> None:
        """Make the port disappear; whoever has it open is hung up on, and what was not yet read is lost."""
        if self._master is None:
            return
        loop = asyncio.get_running_loop()
        loop.remove_reader(self._master)
        loop.remove_writer(self._master)
        if self._link is not None and self._link.is_symlink() and os.readlink(self._link) == self._terminal:
            self._link.unlink()
        os.close(self._master)
        os.close(self._slave)
        self._master = None
        self._room.set()

    def _receive(self, master: int) -> None:
        with contextlib.suppress(BlockingIOError):
            self._on_bytes(os.read(master, READ_BYTES))

    @property
    def unread(self) -> bool:
        """Whether the other side has not read all of what was written."""
        if self._master is None:
            return False
        # The kernel hands over later what was written, on a busy machine by 0.1 s. FIONREAD does not know of that; poll
        # waits for it (n_tty_poll).
        looks = select.poll()
        looks.register(self._slave, select.POLLIN)
        return bool(looks.poll(0))

    async def write(self, data: bytes) -> None:
        """Write all of `data`, waiting while the other side does not read; raises ConnectionError when unplugged."""
        while data:
            if self._master is None:
                raise ConnectionError("the port is unplugged")
            try:
                data = data[os.write(self._master, data) :]
            except BlockingIOError:
                self._room.clear()
                asyncio.get_running_loop().add_writer(self._master, self._room_again, self._master)
                self.held_up.set()
                await self._room.wait()
                self.held_up.clear()

    async def drained(self, timeout_s: float) -> None:
        """Wait until the other side has read what was written, or for so long."""
        loop = asyncio.get_running_loop()
        end_s = loop.time() + timeout_s
        empty_looks = 0
        # No event tells that a terminal's buffer has been read.
        while empty_looks < EMPTY_LOOKS and loop.time() < end_s:
            await asyncio.sleep(0.001)
            empty_looks = 0 if self.unread else empty_looks + 1

    async def break_off(self) -> None:
        """Hang up once the other side has read what was written; a pseudo-terminal would take it back."""
        await self.drained(UNREAD_S)
        self.unplug()

    def _room_again(self, master: int) -> None:
        asyncio.get_running_loop().remove_writer(master)
        self._room.set()
