"""The load cell's board, played: a line for each conversion through a pseudo-terminal, at its pace or a multiple."""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

from shearloop.drivers.emulators.board import PlayedBoard

# The mean over 4882 lines of the paper's rig.
PERIOD_S = 1 / 10.9
COUNTS_MAX, COUNTS_MIN = 8388607, -8388608
# A line of the paper's board that lost its beginning, "0.0000", on the way: 38 µN·m became 38 MN·m.
CORRUPTED = 38399996
# Lateness of this process that it makes up for, so that a fast pace is kept on the average.
CATCH_UP_S = 0.05


@dataclass(frozen=True, slots=True)
class Sketch:
    """What the board makes of a torque: counts_per_nm × torque + tare_counts, with noise, in so many decimals.

    The default is our sketch with a 5 kg cell of 1 mV/V on a 35 mm lever arm: 420 counts a gram.
    """

    counts_per_nm: float = 420e3 / (9.80665 * 0.035)
    tare_counts: float = 81_250.0
    noise_counts: float = 120.0
    decimals: int = 0


# The sketch of the paper's authors sends N·m; its noise is that of their recordings.
PAPER_SKETCH = Sketch(counts_per_nm=1.0, tare_counts=0.0, noise_counts=2e-5, decimals=12)


class FaultKind(Enum):
    """What can go wrong; the value is the name on the command line."""

    # The next line only.
    GARBAGE = "garbage"
    SPIKE = "spike"
    TORN = "torn"
    # For so many seconds; without a number, until the next fault.
    SILENCE = "silence"
    SATURATION = "saturation"
    STUCK = "stuck"
    UNPLUG = "unplug"
    # From now on the torque is higher by so many N·m: something pushes the lever.
    JUMP = "jump"


TIMED = (FaultKind.SILENCE, FaultKind.SATURATION, FaultKind.STUCK, FaultKind.UNPLUG)


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault, and its seconds or N·m where it has some."""

    kind: FaultKind
    amount: float | None = None


def read_fault(text: str) -> Fault:
    """Return the fault that `NAME`, `NAME:AMOUNT` or `NAME AMOUNT` means; raises ValueError with a sentence."""
    name, _, amount = text.strip().replace(" ", ":").partition(":")
    try:
        kind = FaultKind(name)
    except ValueError:
        raise ValueError(f"there is no fault {name!r}; there are {', '.join(k.value for k in FaultKind)}") from None
    if not amount:
        if kind is FaultKind.JUMP:
            raise ValueError("a jump needs its height in N·m; write for instance jump:0.05")
        return Fault(kind)
    try:
        value = float(amount)
    except ValueError:
        value = float("nan")
    if kind in TIMED and 0 <= value < float("inf"):
        return Fault(kind, value)
    if kind is FaultKind.JUMP and abs(value) < float("inf"):
        return Fault(kind, value)
    raise ValueError(f"{name} does not take {amount!r}; write {name}, {name}:SECONDS for a lasting fault, or jump:NM")


class Hx711Board(PlayedBoard[Fault]):
    """One board: converts what `torque_nm` returns, until it raises StopIteration; then it stays plugged in and silent.

    `inject` makes a fault befall what comes next. `on_port` hears the port's path whenever it appears. `sent` counts
    the lines. While nobody reads, the terminal fills up and then the board waits.
    """

    def __init__(
        self,
        torque_nm: Callable[[], float],
        sketch: Sketch | None = None,
        *,
        period_s: float = PERIOD_S,
        link: Path | None = None,
        on_port: Callable[[str], None] = lambda _: None,
        seed: int = 0,
    ) -> None:
        super().__init__(period_s, link, on_port, seed)
        self._torque_nm = torque_nm
        self._sketch = sketch or Sketch()
        self._lasting: FaultKind | None = None
        self._lasts_until_s = 0.0
        self._frozen = b""
        self._offset_nm = 0.0
        self.finished = asyncio.Event()

    def recover(self) -> None:
        """End every fault that lasts or awaits a line; a port that was unplugged is plugged in again."""
        self._injected.clear()
        self._offset_nm = 0.0
        self._end_lasting()

    async def run(self) -> None:
        """Play until cancelled; `finished` is set when the torque has come to its end."""
        loop = asyncio.get_running_loop()
        due_s = loop.time()
        with self._port:
            self._on_port(self.path)
            while True:
                due_s = max(due_s + self._period_s, loop.time() - CATCH_UP_S)
                await asyncio.sleep(due_s - loop.time())
                try:
                    torque_nm = self._torque_nm()
                except StopIteration:
                    break
                await self._convert(torque_nm, loop.time())
            self.finished.set()
            await loop.create_future()

    async def _convert(self, torque_nm: float, now_s: float) -> None:
        line = self._line(torque_nm)
        if self._injected:
            line = self._befall(self._injected.popleft(), line, now_s)
        elif self._lasting is not None and now_s >= self._lasts_until_s:
            self._end_lasting()
        match self._lasting:
            case FaultKind.SILENCE | FaultKind.UNPLUG:
                return
            case FaultKind.SATURATION | FaultKind.STUCK:
                line = self._frozen
        self._frozen = line
        await self._port.write(line)
        self.sent += 1

    def _line(self, torque_nm: float) -> bytes:
        sketch = self._sketch
        counts = sketch.tare_counts + sketch.counts_per_nm * (torque_nm + self._offset_nm)
        counts += self._random.gauss(0.0, sketch.noise_counts)
        return f"{min(max(counts, COUNTS_MIN), COUNTS_MAX):.{sketch.decimals}f}\r\n".encode()

    def _befall(self, fault: Fault, line: bytes, now_s: float) -> bytes:
        match fault.kind:
            case FaultKind.GARBAGE:
                return self._garbage(12) + b"\r\n"
            case FaultKind.SPIKE:
                return b"%d\r\n" % CORRUPTED
            case FaultKind.TORN:
                return line[len(line) // 2 :]
            case FaultKind.JUMP:
                self._offset_nm += fault.amount or 0.0
            case kind:
                self._end_lasting()
                self._lasting = kind
                self._lasts_until_s = float("inf") if fault.amount is None else now_s + fault.amount
                if kind is FaultKind.UNPLUG:
                    self._port.unplug()
                elif kind is FaultKind.SATURATION:
                    self._frozen = b"%d\r\n" % COUNTS_MAX
        return line

    def _end_lasting(self) -> None:
        if self._lasting is FaultKind.UNPLUG:
            self._plug()
        self._lasting = None
