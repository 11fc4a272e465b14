"""The boards that send lines over a pseudo-terminal, emulated byte for byte: EIT-kit and load cell."""

import asyncio
import contextlib
import itertools
import math
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from random import Random

import numpy as np
from numpy.typing import NDArray

from shearloop.drivers.defaults import FRAME_PERIOD_S
from shearloop.drivers.emulators import number_between
from shearloop.drivers.emulators.ports import PtyPort

# Lateness of this process that is made up for, so that fast rates are kept on average.
CATCH_UP_S = 0.05
# The mean over 4882 lines of the paper's rig.
LOAD_PERIOD_S = 1 / 10.9
# A line of the paper's board without its beginning, "0.0000": 38 µN·m became 38 MN·m.
CORRUPTED = 38399996
# The ends of the HX711's 24 bits.
COUNTS_MIN, COUNTS_MAX = -(1 << 23), (1 << 23) - 1
TIMED_FAULTS = ("silence", "saturation", "stuck", "unplug")


@dataclass(frozen=True, slots=True)
class BoardFault:
    """One fault of the next line, or one that lasts for some seconds; None without an end."""

    name: str
    seconds: float | None = None


def parse_fault(text: str, names: Collection[str]) -> BoardFault:
    """Return the fault `NAME`, `NAME:SECONDS` or `NAME SECONDS`; raises ValueError with a sentence."""
    name, _, seconds = text.strip().replace(" ", ":").partition(":")
    if name not in names:
        raise ValueError(f"there is no fault {name!r}; there are {', '.join(names)}")
    if not seconds:
        return BoardFault(name)
    if name not in TIMED_FAULTS:
        raise ValueError(f"{name} has no duration; write {name} alone")
    no_duration = f"no duration in seconds; write for instance {name}:3"
    return BoardFault(name, number_between(seconds, 0.0, 1e9, no_duration))


class EmulatedBoard(ABC):
    """An emulated board on a pseudo-terminal.

    Without a reader the terminal fills up; then the board waits and `port.held_up` is set.
    """

    faults: Collection[str]

    def __init__(self, period_s: float, link: Path | None, seed: int) -> None:
        self.port = PtyPort(link)
        self._period_s = period_s
        self._random = Random(seed)
        self._injected: deque[BoardFault] = deque()

    @abstractmethod
    async def run(self) -> None:
        """Play until cancelled; at the end of the data the board stays plugged in."""

    @abstractmethod
    def recover(self) -> None:
        """End every fault and plug the port in."""

    def command(self, text: str) -> None:
        """Apply a fault to the next line, or recover on `normal`; ValueError, with a sentence, for other text.

        Several faults apply to one line each, in order.
        """
        if text.strip() == "normal":
            self.recover()
        else:
            self._injected.append(parse_fault(text, self.faults))

    def _garbage(self, count: int) -> bytes:
        return bytes(self._random.choices(range(128, 256), k=count))


def format_line(values: NDArray[np.float64]) -> bytes:
    """Return the line of the EIT-kit for (v,) values in volts."""
    return ("".join(f"{value:.4f}, " for value in values.tolist()) + "\n").encode()


class EitKitBoard(EmulatedBoard):
    """An EIT-kit: waits for a `y`, then sends `frames` ((v,) values in volts each), and then is silent.

    A frame is requested from the iterator at the end of its acquisition. `fault_at` maps frame numbers, from 0, to
    faults. Only an unplugged board loses a frame; a silence without a duration lasts until the next `y`.
    """

    faults = ("cut-line", "wrong-count", "nan", "garbage", "silence", "unplug")

    def __init__(
        self,
        frames: Iterable[NDArray[np.float64]],
        *,
        period_s: float = FRAME_PERIOD_S,
        link: Path | None = None,
        fault_at: Mapping[int, BoardFault] | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__(period_s, link, seed)
        self._frames = frames
        self._fault_at = dict(fault_at or {})
        self._recovered = asyncio.Event()
        self._silent = False

    def recover(self) -> None:
        """End every fault and plug the port in."""
        self._injected.clear()
        self._recovered.set()
        if self._silent:
            self.port.received.put_nowait(b"y")

    async def run(self) -> None:
        """Play until cancelled; at the end of the frames the board stays plugged in."""
        loop = asyncio.get_running_loop()
        with self.port:
            await self._wait_for_start()
            due_s = loop.time()
            frames = iter(self._frames)
            for number in itertools.count():
                due_s += self._period_s
                await asyncio.sleep(due_s - loop.time())
                fault = self._fault_at.pop(number, None) or (self._injected.popleft() if self._injected else None)
                if fault is not None and fault.name == "silence":
                    self._silent = fault.seconds is None
                    await (self._wait_for_start() if fault.seconds is None else self._pause(fault.seconds))
                    self._silent, fault = False, None
                values = next(frames, None)
                if values is None:
                    break
                await self._send(format_line(values), fault)
                if loop.time() - due_s > CATCH_UP_S:
                    # Held up by the reader or a fault: the next frame takes a whole period from here.
                    due_s = loop.time()
            await loop.create_future()

    async def _send(self, line: bytes, fault: BoardFault | None) -> None:
        match None if fault is None else fault.name:
            case "unplug":
                await self.port.write(line[: len(line) // 2])
                await self.port.break_off()
                await self._pause(None if fault is None else fault.seconds)
                self.port.plug()
                # Without power the board has forgotten its start.
                await self._wait_for_start()
                return
            case "garbage":
                await self.port.write(self._garbage(700) + b"\n")
            case "cut-line":
                line = line[: self._random.randrange(len(line) // 10, len(line) - 10)] + b"\n"
            case "wrong-count" | "nan" as kind:
                values = line.split(b", ")
                position = self._random.choice([n for n, value in enumerate(values[:-1]) if float(value)])
                values[position : position + 1] = [b"nan"] if kind == "nan" else []
                line = b", ".join(values)
        await self.port.write(line)

    async def _wait_for_start(self) -> None:
        while not self.port.received.empty():
            self.port.received.get_nowait()
        while b"y" not in await self.port.received.get():
            continue

    async def _pause(self, seconds: float | None) -> None:
        self._recovered.clear()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                await self._recovered.wait()


class ConverterBoard(EmulatedBoard):
    """A board that sends a line for each conversion, whether or not anyone listens.

    Timed faults without a duration last until the next one or `recover`.
    """

    def __init__(self, period_s: float, link: Path | None = None, seed: int = 0) -> None:
        super().__init__(period_s, link, seed)
        self._lasting: str | None = None
        self._lasts_until_s = 0.0
        self._last_line = b""

    @abstractmethod
    def _convert(self) -> bytes:
        """Return the line of one conversion; StopIteration at the end of the data."""

    def recover(self) -> None:
        """End every fault and plug the port in."""
        self._injected.clear()
        self._end_lasting()

    async def run(self) -> None:
        """Play until cancelled; at the end of the data the board stays plugged in."""
        loop = asyncio.get_running_loop()
        due_s = loop.time()
        with self.port:
            while True:
                due_s = max(due_s + self._period_s, loop.time() - CATCH_UP_S)
                await asyncio.sleep(due_s - loop.time())
                try:
                    line = self._convert()
                except StopIteration:
                    break
                line = self._with_faults(line, loop.time())
                with contextlib.suppress(ConnectionError):  # unplugged while the line waited for a reader
                    await self.port.write(line)
            await loop.create_future()

    def _with_faults(self, line: bytes, now_s: float) -> bytes:
        if self._injected:
            line = self._apply(self._injected.popleft(), line, now_s)
        elif self._lasting is not None and now_s >= self._lasts_until_s:
            self._end_lasting()
        match self._lasting:
            case "silence" | "unplug":
                return b""
            case "stuck":
                line = self._last_line or line
            case "saturation":
                line = b"%d\r\n" % COUNTS_MAX
        self._last_line = line
        return line

    def _apply(self, fault: BoardFault, line: bytes, now_s: float) -> bytes:
        match fault.name:
            case "garbage":
                return self._garbage(12) + b"\r\n"
            case "spike":
                return b"%d\r\n" % CORRUPTED
            case "torn":
                return line[len(line) // 2 :]
            case "missing":
                return b""
            case kind:
                self._end_lasting()
                self._lasting = kind
                self._lasts_until_s = math.inf if fault.seconds is None else now_s + fault.seconds
                if kind == "unplug":
                    self.port.unplug()
        return line

    def _end_lasting(self) -> None:
        if self._lasting == "unplug":
            self.port.plug()
        self._lasting = None


@dataclass(frozen=True, slots=True)
class Sketch:
    """The board's conversion: counts_per_nm × torque + tare_counts, plus noise, with `decimals` places.

    The default is our sketch with a 5 kg cell of 1 mV/V on a 35 mm lever arm: 420 counts a gram.
    """

    counts_per_nm: float = 420e3 / (9.80665 * 0.035)
    tare_counts: float = 81_250.0
    noise_counts: float = 120.0
    decimals: int = 0


# The paper's sketch sends N·m, with the noise of its recordings.
PAPER_SKETCH = Sketch(counts_per_nm=1.0, tare_counts=0.0, noise_counts=2e-5, decimals=12)


class Hx711Board(ConverterBoard):
    """The load cell's board: converts each of `torques_nm`, requested at the end of its conversion."""

    faults = ("garbage", "spike", "torn", "silence", "saturation", "stuck", "unplug")

    def __init__(
        self,
        torques_nm: Iterable[float],
        sketch: Sketch | None = None,
        *,
        period_s: float = LOAD_PERIOD_S,
        link: Path | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__(period_s, link, seed)
        self._torques_nm = iter(torques_nm)
        self._sketch = sketch or Sketch()

    def _convert(self) -> bytes:
        sketch = self._sketch
        counts = sketch.tare_counts + sketch.counts_per_nm * next(self._torques_nm)
        counts += self._random.gauss(0.0, sketch.noise_counts)
        return f"{min(max(counts, COUNTS_MIN), COUNTS_MAX):.{sketch.decimals}f}\r\n".encode()
