"""The EIT-kit, played: frames as the board's own lines through a pseudo-terminal, at its pace or a multiple.

The board waits for a `y`, then acquires frame after frame and sends each as a line: 1024 values in volts with four
decimals, each followed by `, `, then a newline. A reader that is slow slows the board; only a board that loses its
power loses a frame.
"""

import asyncio
import itertools
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from shearloop.drivers.eit_format import FRAME_PERIOD_S
from shearloop.drivers.emulators.board import PlayedBoard
from shearloop.drivers.emulators.outage import Outage

N_VALUES = 1024
FLOOD_BYTES = 100_000
# Lateness of this process that it makes up for, so that a fast pace is kept on the average.
CATCH_UP_S = 0.05


def format_line(values: NDArray[np.float64]) -> bytes:
    """Return the line that the board sends for (1024,) values in volts."""
    return ("%.4f, " * N_VALUES % tuple(values.tolist()) + "\n").encode()


class FaultKind(Enum):
    """What can go wrong; the value is the name on the command line."""

    # The next line arrives broken, and its frame is lost.
    CUT_LINE = "cut-line"
    WRONG_COUNT = "wrong-count"
    NOT_A_NUMBER = "not-a-number"
    NAN = "nan"
    NEGATIVE = "negative"
    ZERO = "zero"
    # The next line comes after something else; no frame is lost.
    GARBAGE = "garbage"
    FLOOD = "flood"
    # The next line comes, and another time.
    REPEAT = "repeat"
    # The next line is late: by so many seconds, or without a number until the board is started again.
    SILENCE = "silence"
    # The port disappears in the middle of the next line, for so many seconds (1), and the line is lost; then the board
    # waits for its start.
    UNPLUG = "unplug"


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault, and how long it lasts where that matters."""

    kind: FaultKind
    seconds: float | None = None


def read_fault(text: str) -> Fault:
    """Return the fault that `NAME`, `NAME:SECONDS` or `NAME SECONDS` means; raises ValueError with a sentence."""
    name, _, seconds = text.strip().replace(" ", ":").partition(":")
    try:
        kind = FaultKind(name)
    except ValueError:
        names = ", ".join(kind.value for kind in FaultKind)
        raise ValueError(f"there is no fault {name!r}; there are {names}") from None
    if not seconds:
        return Fault(kind)
    if kind not in (FaultKind.SILENCE, FaultKind.UNPLUG):
        raise ValueError(f"{name} has no duration; write {name} alone")
    try:
        duration_s = float(seconds)
    except ValueError:
        duration_s = -1.0
    if not 0 <= duration_s < float("inf"):
        raise ValueError(f"{seconds!r} is no duration in seconds; write for instance {name}:3")
    return Fault(kind, duration_s)


class EitKitBoard(PlayedBoard[Fault]):
    """One board: sends `frames` (1024 values in volts each) and then is silent.

    A frame is asked for when its acquisition is over, so that an iterator can make it from what has happened by then.
    `faults` maps the number of a frame, counted from 0, to what befalls it; `inject` makes faults befall the next ones.
    `on_port` hears the port's path whenever it appears. `sent` counts the frames that went out sound.
    """

    def __init__(
        self,
        frames: Iterable[NDArray[np.float64]],
        *,
        period_s: float = FRAME_PERIOD_S,
        link: Path | None = None,
        faults: Mapping[int, Fault] | None = None,
        on_port: Callable[[str], None] = lambda _: None,
        seed: int = 0,
    ) -> None:
        super().__init__(period_s, link, on_port, seed, self._received)
        self._frames = frames
        self._faults = dict(faults or {})
        self._started = asyncio.Event()
        self._outage = Outage()
        self._waits_for_restart = False
        self.finished = asyncio.Event()

    def recover(self) -> None:
        """End every fault that lasts or awaits a frame; a port that was unplugged is plugged in again."""
        self._injected.clear()
        self._outage.end()
        if self._waits_for_restart:
            self._started.set()

    async def run(self) -> None:
        """Play until cancelled; after the last frame the board stays plugged in and silent, and `finished` is set."""
        loop = asyncio.get_running_loop()
        with self._port:
            self._on_port(self.path)
            due_s = 0.0
            frames = iter(self._frames)
            for number in itertools.count():
                if not self._started.is_set():
                    await self._started.wait()
                    due_s = loop.time()
                due_s += self._period_s
                await asyncio.sleep(due_s - loop.time())
                fault = self._faults.pop(number, None) or (self._injected.popleft() if self._injected else None)
                if fault is not None and fault.kind is FaultKind.SILENCE:
                    await self._fall_silent(fault.seconds)
                    fault = None
                values = next(frames, None)
                if values is None:
                    break
                await self._send(format_line(values), fault)
                if loop.time() - due_s > CATCH_UP_S:
                    # Held up by the reader or a fault: the next frame takes a whole period from here.
                    due_s = loop.time()
            self.finished.set()
            await loop.create_future()

    def _received(self, data: bytes) -> None:
        if b"y" in data:
            self._started.set()

    async def _send(self, line: bytes, fault: Fault | None) -> None:
        match fault:
            case None:
                pass
            case Fault(FaultKind.UNPLUG, seconds):
                await self._unplug(line, 1.0 if seconds is None else seconds)
                return
            case Fault(FaultKind.GARBAGE):
                await self._port.write(self._garbage(700) + b"\n")
            case Fault(FaultKind.FLOOD):
                await self._port.write(bytes(self._random.choices(b"0123456789., ", k=FLOOD_BYTES)) + b"\n")
            case Fault(FaultKind.REPEAT):
                await self._port.write(line)
                self.sent += 1
            case Fault(kind):
                await self._port.write(self._broken(line, kind))
                return
        await self._port.write(line)
        self.sent += 1

    def _broken(self, line: bytes, kind: FaultKind) -> bytes:
        if kind is FaultKind.CUT_LINE:
            return line[: self._random.randrange(len(line) // 10, len(line) - 10)] + b"\n"
        values = line.split(b", ")
        position = self._random.choice([n for n, value in enumerate(values[:-1]) if float(value)])
        if kind is FaultKind.WRONG_COUNT:
            del values[position]
        else:
            value = values[position]
            values[position] = {
                FaultKind.NOT_A_NUMBER: b"0.1x34",
                FaultKind.NAN: b"nan",
                FaultKind.NEGATIVE: b"-" + value,
                FaultKind.ZERO: b"0.0000",
            }[kind]
        return b", ".join(values)

    async def _fall_silent(self, seconds: float | None) -> None:
        if seconds is not None:
            await self._outage.last(seconds)
        else:
            self._started.clear()
            self._waits_for_restart = True
            await self._started.wait()
            self._waits_for_restart = False

    async def _unplug(self, line: bytes, seconds: float) -> None:
        await self._port.write(line[: len(line) // 2])
        await self._port.break_off()
        # Without power the board forgets that it was started.
        self._started.clear()
        await self._outage.last(seconds)
        self._plug()
