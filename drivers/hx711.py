"""The load cell of the torque rig: an HX711 on an Arduino Uno, one decimal a line, 115200 baud, 10.9 Hz.

With its RATE pin high an HX711 converts eight times as often: whoever reads it says how often.

A lever arm on the tool's shaft presses on the load cell; force times lever arm is the torque (Trehan et al. 2025,
section 2). What the decimal means depends on the sketch: ours (`firmware/hx711_torque`) sends raw counts, the paper's
sent N·m worked out on the board. One linear calibration covers both, see `LoadCalibration`.

Nothing here reads a clock or a port: `LoadParser` is fed with bytes and the time of their arrival.
"""

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Self

from shearloop.drivers.calibration_file import CalibrationModel, Finite, Positive
from shearloop.drivers.line_splitter import LineSplitter, transfer_ns
from shearloop.drivers.raw_event import InputKind, RawEvent

BAUD_RATE = 115200
# Measured on the paper's rig (4882 lines in 447 s); the data sheet says 10 samples a second, nominally.
RATE_HZ = 10.9
PERIOD_NS = round(1e9 / RATE_HZ)
# The converter's ends of range (HX711 data sheet, "Output data": 24 bits, two's complement).
COUNTS_MAX, COUNTS_MIN = 8388607, -8388608
# "-8388608" is 8 characters and a float printed by an Uno at most 15; anything longer is several lines run together.
MAX_LINE_BYTES = 32
# Its own noise moves a live converter: no value stood more than three times in a row in 10 274 real ones.
STUCK_AFTER = 20

_DECIMAL = re.compile(rb"[+-]?[0-9]{1,15}(\.[0-9]{1,15})?")


class LoadCalibration(CalibrationModel):
    """From a line's decimal to a torque: sign × lever_arm_m × scale_n_per_count × (raw − tare_counts).

    With our sketch a count is a count. With a board that sends N·m itself, `of_torque_lines` gives the scale
    (1 / lever arm) that leaves its values as they are; a tare then stands in N·m.
    """

    tare_counts: Finite
    # Signed: the sign of the wiring, as measured with a mass. `sign` is the choice which turn counts as positive.
    scale_n_per_count: Finite
    lever_arm_m: Positive = 0.035
    sign: Literal[-1, 1] = 1

    @classmethod
    def of_torque_lines(cls) -> Self:
        """Return the calibration for a board whose lines are N·m already, like those of the paper's recordings."""
        return cls(tare_counts=0.0, scale_n_per_count=1 / 0.035, lever_arm_m=0.035)

    @property
    def nm_per_count(self) -> float:
        """The torque of one count, N·m."""
        return self.sign * self.lever_arm_m * self.scale_n_per_count

    def torque_nm(self, raw: float) -> float:
        """Return the torque of a line's decimal, N·m."""
        return (raw - self.tare_counts) * self.nm_per_count

    def raw(self, torque_nm: float) -> float:
        """Return the decimal that stands for a torque: the inverse of `torque_nm`."""
        return torque_nm / self.nm_per_count + self.tare_counts

    def tared(self, raw_at_rest: float) -> Self:
        """Return this calibration with its zero at the given raw value."""
        return self.model_copy(update={"tare_counts": raw_at_rest})


@dataclass(frozen=True, slots=True)
class LoadLimits:
    """What this rig can physically do; a value beyond it is not the load's.

    The defaults are a 5 kg cell at 35 mm, and more than twice the fastest change in the paper's recordings
    (0.52 N·m and 0.76 N·m/s, a 10 mm cylinder slipping free).
    """

    capacity_nm: float = 1.75
    slew_nm_per_s: float = 2.0
    # So many values in a row that agree with each other are a new level, however far from the old one.
    settle_samples: int = 3


@dataclass(frozen=True, slots=True)
class LoadSample:
    """One line of the board. Every decimal becomes one, flagged where it is not to be believed.

    raw: the decimal as sent; torque_nm: calibrated; t_mid_ns: the middle of the conversion, t_arrival_ns: of the
    line's arrival (both CLOCK_MONOTONIC); seq counts the samples since the parser was made. Flags: `saturated` (the
    converter is at an end of its range), `spike` (beyond the cell's capacity, or further from the last good value
    than the rig can move), `stuck` (the same value for two seconds), `partial` (the first line after opening, whose
    beginning may have been lost).
    """

    raw: float
    torque_nm: float
    t_mid_ns: int
    t_arrival_ns: int
    seq: int
    saturated: bool = False
    spike: bool = False
    stuck: bool = False
    partial: bool = False

    @property
    def trusted(self) -> bool:
        """Whether nothing speaks against the value."""
        return not (self.saturated or self.spike or self.stuck or self.partial)


REFUSED_LINES = {
    "not_decimal": "The load cell's board sent a line that is no decimal number; check the baud rate and the sketch.",
    "too_long": f"The load cell's board sent more than {MAX_LINE_BYTES} bytes without a line end; check the baud rate.",
    "empty": "The load cell's board sent an empty line; bytes were lost on the way, check the cable.",
    "unfinished": "The load cell's board broke off in the middle of a line; check its plug and its power.",
}


class Despiker:
    """Tells a corrupted value from a load, from the past alone.

    A value is a spike when it lies beyond the cell's capacity, or further from the last good one than the rig can
    move in the time between them. A real step looks like that too, so `settle_samples` values in a row that agree
    with each other become the new level: the first of them stay flagged, and no step is flagged for ever.
    """

    def __init__(self, limits: LoadLimits, period_ns: int = PERIOD_NS) -> None:
        """Know no value yet, of a board that sends one each `period_ns`: the first within the capacity is believed."""
        self._limits = limits
        self._period_ns = period_ns
        self._good: tuple[float, int] | None = None
        self._candidates: list[tuple[float, int]] = []

    def is_spike(self, torque_nm: float, t_ns: int) -> bool:
        """Judge the next value; calls must be in order of time."""
        if abs(torque_nm) > self._limits.capacity_nm:
            self._candidates.clear()
            return True
        value = (torque_nm, t_ns)
        if self._good is None or self._reachable(self._good, value):
            self._accept(value)
            return False
        if self._candidates and not self._reachable(self._candidates[-1], value):
            self._candidates.clear()
        self._candidates.append(value)
        if len(self._candidates) < self._limits.settle_samples:
            return True
        self._accept(value)
        return False

    def _accept(self, value: tuple[float, int]) -> None:
        self._good = value
        self._candidates.clear()

    def _reachable(self, before: tuple[float, int], after: tuple[float, int]) -> bool:
        # Arrival stamps bunch when the host was busy: no less than a usual period is believed of them.
        elapsed_s = max(after[1] - before[1], self._period_ns) * 1e-9
        return abs(after[0] - before[0]) <= self._limits.slew_nm_per_s * elapsed_s


class LoadParser:
    """Turns the board's bytes, in whatever slices they come, into samples; counts by kind what it refuses."""

    def __init__(self, calibration: LoadCalibration, rate_hz: float = RATE_HZ) -> None:
        """Start before the first byte after the port was opened, of a board that sends so many lines a second."""
        self._limits = LoadLimits()
        self._period_ns = round(1e9 / rate_hz)
        # As long as that takes at the usual rate, and no fewer.
        self._stuck_after = max(STUCK_AFTER, round(STUCK_AFTER * rate_hz / RATE_HZ))
        self._lines = LineSplitter(MAX_LINE_BYTES)
        self._refused: Counter[str] = Counter()
        self._seq = 0
        self._last_mid_ns: int | None = None
        self.calibration = calibration
        self.restart()

    def take(self, told: RawEvent) -> list[LoadSample]:
        """Do what an input says, live or recorded; return the samples that it completes. A tare brings its raw zero."""
        match told.kind:
            case InputKind.OPENED:
                self.restart()
            case InputKind.TARE:
                self.calibration = self.calibration.tared(float(told.data))
            case InputKind.DATA:
                return self.feed(told.data, told.t_ns)
            case InputKind.STARTED:
                pass
        return []

    def restart(self) -> None:
        """Forget everything but the counters: the port was opened (again), and bytes before that are lost."""
        self._lines.restart()
        self._first_line = True
        self._last_raw: float | None = None
        self._repeats = 0
        self._despiker = Despiker(self._limits, self._period_ns)

    @property
    def refused(self) -> Counter[str]:
        """What was not made a sample, by kind."""
        return self._refused + Counter(too_long=self._lines.too_long, unfinished=self._lines.unfinished)

    @property
    def calibration(self) -> LoadCalibration:
        """The calibration of the samples to come; a new one forgets the level that spikes are judged by."""
        return self._calibration

    @calibration.setter
    def calibration(self, calibration: LoadCalibration) -> None:
        self._calibration = calibration
        self._despiker = Despiker(self._limits, self._period_ns)

    def feed(self, data: bytes, t_arrival_ns: int) -> list[LoadSample]:
        """Return the samples that `data` completes. Of several lines at once, the earlier are a period older each."""
        lines = self._lines.feed(data)
        samples = []
        for age, line in zip(range(len(lines) - 1, -1, -1), lines, strict=True):
            value = None if line is None else self._value(line)
            partial, self._first_line = self._first_line, False
            if line is not None and value is not None:
                samples.append(
                    self._sample(value, len(line) + 1, t_arrival_ns - age * self._period_ns, partial=partial)
                )
        return samples

    def _value(self, line: bytes) -> float | None:
        text = line.strip(b"\r")
        if not _DECIMAL.fullmatch(text):
            self._refused["not_decimal" if text else "empty"] += 1
            return None
        return float(text)

    def _sample(self, raw: float, n_bytes: int, t_arrival_ns: int, *, partial: bool) -> LoadSample:
        torque_nm = self._calibration.torque_nm(raw)
        t_mid_ns = t_arrival_ns - transfer_ns(n_bytes, BAUD_RATE) - self._period_ns // 2
        if self._last_mid_ns is not None:
            t_mid_ns = max(t_mid_ns, self._last_mid_ns + 1)
        self._last_mid_ns = t_mid_ns
        self._repeats = self._repeats + 1 if raw == self._last_raw else 1
        self._last_raw = raw
        saturated = raw in (COUNTS_MAX, COUNTS_MIN)
        sample = LoadSample(
            raw=raw,
            torque_nm=torque_nm,
            t_mid_ns=t_mid_ns,
            t_arrival_ns=t_arrival_ns,
            seq=self._seq,
            saturated=saturated,
            spike=self._is_spike(torque_nm, t_mid_ns, unreliable=saturated or partial),
            stuck=self._repeats >= self._stuck_after,
            partial=partial,
        )
        self._seq += 1
        return sample

    def _is_spike(self, torque_nm: float, t_ns: int, *, unreliable: bool) -> bool:
        if unreliable:
            # Not a level to judge the next value by.
            return abs(torque_nm) > self._limits.capacity_nm
        return self._despiker.is_spike(torque_nm, t_ns)


def refusals(parser: LoadParser) -> Sequence[str]:
    """Return one sentence with its count for every kind of line that the parser has refused."""
    return [f"{REFUSED_LINES[kind]} ({count} times)" for kind, count in sorted(parser.refused.items())]
