"""The boards that send lines over a pseudo-terminal, emulated byte for byte: EIT-kit and load cell."""

import asyncio
import contextlib
import math
from collections import deque
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from shearloop.emulators.numbers import number_between
from shearloop.emulators.ports import PtyPort

# Lateness that is made up for, in periods, and at least: a real board does not wait for a busy computer, and fast rates
# are kept on average. Lines that are late hold what is measured as they are sent. After a longer standstill, or a wait
# for a reader, the lines in between are left out: a board measures on meanwhile, and sends no old lines in a row.
CATCH_UP_PERIODS, CATCH_UP_S = 9, 0.05
# The mean over 4882 lines of the paper's rig.
LOAD_PERIOD_S = 1 / 10.9
# A line of the paper's board without its beginning, "0.0000": 38 µN·m became 38 MN·m.
CORRUPTED = 38399996
# The ends of the HX711's 24 bits.
COUNTS_MIN, COUNTS_MAX = -(1 << 23), (1 << 23) - 1
TIMED_FAULTS = ("silence", "saturation", "stuck", "unplug", "zero-channel")


# A fault of the next line, or one that lasts for some seconds, without an end if infinite.
BoardFault: TypeAlias = tuple[str, float]


def parse_fault(text: str, names: Collection[str]) -> BoardFault:
    """Return the fault `NAME`, `NAME:SECONDS` or `NAME SECONDS`; raises ValueError with a sentence."""
    name, _, seconds = text.strip().replace(" ", ":").partition(":")
    if name not in names:
        raise ValueError(f"there is no fault {name!r}; there are {', '.join(names)}")
    if not seconds:
        return name, math.inf
    if name not in TIMED_FAULTS:
        raise ValueError(f"{name} has no duration; write {name} alone")
    no_duration = f"no duration in seconds; write for instance {name}:3"
    return name, number_between(seconds, 0.0, 1e9, no_duration)


class EmulatedBoard:
    """A board on a pseudo-terminal that sends the next of `lines` each period, whether or not anyone listens.

    A line is requested from the iterator when it is due; a silent or unplugged board requests none. Without a reader
    the terminal fills up; then the board waits and `port.held_up` is set. Timed faults without a duration last until
    the next one or `normal`.
    """

    faults: Collection[str]

    def __init__(self, lines: Iterable[bytes], *, period_s: float, link: Path | None = None, seed: int = 0) -> None:
        self.port = PtyPort(link)
        self._lines = iter(lines)
        self._period_s = period_s
        self._random = Random(seed)
        self._injected: deque[BoardFault] = deque()
        self._lasting: str | None = None
        self._lasts_until_s = math.inf
        self._last_line = b""
        # A fault: each line is sent this many lines late, and the lines that wait.
        self._late, self._waiting = 0, deque[bytes]()

    async def _wait_for_start(self) -> bool:
        """Wait until the board is started; return whether that took time."""
        return False

    async def run(self) -> None:
        """Play until cancelled; at the end of the data the board stays plugged in."""
        loop = asyncio.get_running_loop()
        catch_up_s = max(CATCH_UP_S, CATCH_UP_PERIODS * self._period_s)
        with self.port:
            await self._wait_for_start()
            due_s = loop.time()
            while True:
                if loop.time() - due_s > catch_up_s:
                    due_s = loop.time()
                due_s += self._period_s
                await asyncio.sleep(due_s - loop.time())
                if loop.time() >= self._lasts_until_s:
                    self._end_lasting()
                if await self._wait_for_start():
                    due_s = loop.time()
                    continue
                try:
                    line = self.next_line(loop.time())
                except StopIteration:
                    break
                written_s = loop.time()
                with contextlib.suppress(ConnectionError):  # unplugged while the line waited for a reader
                    await self.port.write(line)
                if loop.time() - written_s > self._period_s:
                    due_s = loop.time()
            await loop.create_future()

    def command(self, text: str) -> None:
        """Apply a fault to the next line, or end all on `normal`; ValueError, with a sentence, for other text.

        Several faults apply to one line each, in order.
        """
        match text.split():
            case ["normal"]:
                self._injected.clear()
                self._end_lasting()
                self._late, self._waiting = 0, deque()
            case ["late", *lines]:
                refusal = "no number of lines from 0 to 100; write for instance late 1"
                self._late = int(number_between(" ".join(lines), 0, 100, refusal))
            case _:
                self._injected.append(parse_fault(text, self.faults))

    def next_line(self, now_s: float) -> bytes:
        """Return the line that is due now, with its faults, or nothing; StopIteration at the end of the data."""
        fault, seconds = self._injected.popleft() if self._injected else ("", 0.0)
        if fault in TIMED_FAULTS:
            self._end_lasting()
            self._lasting, self._lasts_until_s = fault, now_s + seconds
            if fault == "unplug":
                self.port.unplug()
        match self._lasting:
            case "silence" | "unplug":
                return b""
            case "stuck" if self._last_line:
                return self._last_line
            case "saturation":
                return b"%d\r\n" % COUNTS_MAX
        self._waiting.append(next(self._lines))
        if len(self._waiting) <= self._late:
            return b""
        self._last_line = self._waiting.popleft()
        return self._changed(fault, self._last_line) if fault else self._last_line

    def _changed(self, fault: str, line: bytes) -> bytes:
        """Return a line with a fault of its own."""
        match fault:
            case "garbage":
                return self._garbage(12) + b"\r\n"
            case "spike":
                return b"%d\r\n" % CORRUPTED
            case "torn":
                return line[len(line) // 2 :]
            case "missing":
                return b""
        return line

    def _end_lasting(self) -> None:
        if self._lasting == "unplug":
            self.port.plug()
        self._lasting, self._lasts_until_s = None, math.inf

    def _garbage(self, count: int) -> bytes:
        return bytes(self._random.choices(range(128, 256), k=count))


def format_line(values: NDArray[np.float64]) -> bytes:
    """Return the line of the EIT-kit for (v,) values in volts."""
    # One format of all values takes less time than one for each.
    return (b"%.4f, " * len(values) + b"\n") % tuple(values.tolist())


class EitKitBoard(EmulatedBoard):
    """An EIT-kit: waits for a `y`, then sends its lines, and then is silent.

    A `y` ends a silence without a duration.
    """

    faults = ("cut-line", "wrong-count", "nan", "garbage", "silence", "unplug", "zero-channel", "late")
    _started = False

    def next_line(self, now_s: float) -> bytes:
        """Return the line that is due now, with its faults, or nothing; StopIteration at the end of the data."""
        line = super().next_line(now_s)
        if self._lasting != "zero-channel" or not line:
            return line
        # An open electrode.
        values = line.split(b", ")
        first = next(number for number, value in enumerate(values) if value.strip() and float(value))
        return b", ".join([*values[:first], b"0.0000", *values[first + 1 :]])

    async def _wait_for_start(self) -> bool:
        """Wait for the first `y`; without power, when it was unplugged, the board has forgotten it.

        The frame after a `y` that ended a silence takes a whole period too.
        """
        started_before = self._started
        while not self._started or not self.port.received.empty():
            if b"y" in await self.port.received.get():
                self._started = True
                if self._lasting == "silence" and self._lasts_until_s == math.inf:
                    self._end_lasting()
                    started_before = False
        return not started_before

    def _end_lasting(self) -> None:
        self._started = self._started and self._lasting != "unplug"
        super()._end_lasting()

    def _changed(self, fault: str, line: bytes) -> bytes:
        match fault:
            case "garbage":
                return self._garbage(700) + b"\n" + line
            case "cut-line":
                return line[: self._random.randrange(len(line) // 10, len(line) - 10)] + b"\n"
        values = line.split(b", ")
        position = self._random.choice([n for n, value in enumerate(values[:-1]) if float(value)])
        values[position : position + 1] = [b"nan"] if fault == "nan" else []
        return b", ".join(values)


@dataclass(frozen=True, slots=True)
class Sketch:
    """The board's conversion: counts_per_nm × torque + tare_counts, plus noise, with `decimals` places.

    The default is our sketch with a 5 kg cell of 1 mV/V on a 35 mm lever arm: 420 counts a gram.
    """

    counts_per_nm: float = 420e3 / (9.80665 * 0.035)
    tare_counts: float = 81_250.0
    noise_counts: float = 120.0
    decimals: int = 0

    def lines(self, torques_nm: Iterable[float], seed: int = 0) -> Iterator[bytes]:
        """Yield the line of each torque, requested at the end of its conversion."""
        random = Random(seed)
        for torque_nm in torques_nm:
            counts = self.tare_counts + self.counts_per_nm * torque_nm + random.gauss(0.0, self.noise_counts)
            yield f"{min(max(counts, COUNTS_MIN), COUNTS_MAX):.{self.decimals}f}\r\n".encode()


# The paper's sketch sends N·m, with the noise of its recordings.
PAPER_SKETCH = Sketch(counts_per_nm=1.0, tare_counts=0.0, noise_counts=2e-5, decimals=12)


class Hx711Board(EmulatedBoard):
    """The load cell's board."""

    faults = ("garbage", "spike", "torn", "silence", "saturation", "stuck", "unplug", "late")
