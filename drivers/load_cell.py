"""The load cell of the torque rig: an HX711 on an Arduino Uno, one decimal per line, 115200 baud, 10.9 Hz.

A lever arm on the tool's shaft presses on the cell; force times lever arm is the torque (Trehan et al. 2025, section
2). Our sketch (`firmware/hx711_torque`) sends raw counts, the paper's sent N·m. One linear calibration covers both.
With its RATE pin high an HX711 converts eight times as often; the configuration gives the rate.
"""

import re
import time
from dataclasses import dataclass
from typing import Literal, Self

from shearloop.drivers import serial_sensor
from shearloop.drivers.calibration_files import CalibrationModel, Finite, Positive
from shearloop.drivers.connection import Diagnostics, Link
from shearloop.drivers.defaults import LOAD_CELL_RATE_HZ
from shearloop.drivers.line_parser import LineParser, TimedLine
from shearloop.errors import Hint

BAUD_RATE = 115200
# The ends of the converter's range (HX711 data sheet, "Output data": 24 bits, two's complement).
COUNTS_MAX, COUNTS_MIN = 8388607, -8388608
# "-8388608" has 8 characters, a float printed by an Uno at most 15.
MAX_LINE_BYTES = 32
# No value stood more than three times in a row in 10 274 real ones.
STUCK_AFTER = 20
# A 5 kg cell at 35 mm; larger values are corrupted.
CAPACITY_NM = 1.75
# More than twice the fastest change in the paper's recordings (0.76 N·m/s, a 10 mm cylinder slipping free).
SLEW_NM_PER_S = 2.0
# A calibration with more raw units in the capacity than this is of converter counts: it has millions of them, and grams
# would be five thousand.
_MAX_UNITS = 10_000
# Why a line has another unit than the calibration, and the cure.
COUNTS_REASON = Hint(
    "the board sends counts and has no calibration",
    "run `shearloop calibrate load` and name its file as `load_cell.calibration`",
)
COUNTS_FOR_TORQUES = Hint(
    "the board sends counts, and `load_cell.calibration` is of a board that sends torques or weights",
    "run `shearloop calibrate load` with this board",
)
TORQUES_FOR_COUNTS = Hint(
    "the board sends N·m, and `load_cell.calibration` is of a board that sends counts",
    "take the key `calibration` out of the configuration, or run `shearloop calibrate load` with this board",
)

_DECIMAL = re.compile(rb"[+-]?[0-9]{1,15}(\.[0-9]{1,15})?")

# Of the paper's rig.
LEVER_ARM_M = 0.035


class LoadCalibration(CalibrationModel):
    """Converts a line's decimal to a torque: sign × lever_arm_m × scale_n_per_count × (raw − tare_counts).

    With our sketch a count is a converter count. With a board that sends N·m, `of_torque_lines` gives the scale
    (1 / lever arm) that keeps its values; the tare is then in N·m.
    """

    tare_counts: Finite
    # The sign of the wiring, measured with a mass. `sign` chooses the positive direction.
    scale_n_per_count: Finite
    lever_arm_m: Positive = LEVER_ARM_M
    sign: Literal[-1, 1] = 1

    @classmethod
    def of_torque_lines(cls) -> Self:
        """Return the calibration of a board that sends N·m, as in the paper's recordings."""
        return cls(tare_counts=0.0, scale_n_per_count=1 / LEVER_ARM_M)

    @property
    def takes_torque(self) -> bool:
        """Whether a line's decimal is a torque in N·m already."""
        return abs(self.nm_per_count) == 1.0

    @property
    def takes_counts(self) -> bool:
        """Whether a line's decimal is a number of the converter's counts."""
        return abs(self.nm_per_count) * _MAX_UNITS < CAPACITY_NM

    @property
    def nm_per_count(self) -> float:
        """The torque of one count, N·m."""
        return self.sign * self.lever_arm_m * self.scale_n_per_count

    def torque_nm(self, raw: float) -> float:
        """Return the torque of a line's decimal, N·m."""
        return (raw - self.tare_counts) * self.nm_per_count

    def tared(self, raw_at_rest: float) -> Self:
        """Return this calibration with its zero at the given raw value."""
        return self.model_copy(update={"tare_counts": raw_at_rest})


@dataclass(frozen=True, slots=True)
class LoadSample:
    """One line of the board; flags mark values that are not to be trusted.

    raw: the decimal as sent; torque_nm: calibrated; t_mid_ns: the middle of the conversion, t_arrival_ns: the line's
    arrival (both monotonic). `saturated`: at an end of the converter's range. `spike`: beyond
    the cell's capacity, or further from the last good value than the rig can move. `stuck`: the same value for two
    seconds. `partial`: the first line after opening, which may lack its beginning. `other_unit`: why the line is not in
    the calibration's unit, with the cure; empty where it is.
    """

    raw: float
    torque_nm: float
    t_mid_ns: int
    t_arrival_ns: int
    saturated: bool = False
    spike: bool = False
    stuck: bool = False
    partial: bool = False
    other_unit: Hint | None = None

    @property
    def trusted(self) -> bool:
        """Whether no flag is set."""
        return not (self.saturated or self.spike or self.stuck or self.partial or self.other_unit)

    @property
    def overloaded(self) -> bool:
        """Whether the load is too large for a torque: at an end of the range, or beyond the cell's capacity."""
        beyond = abs(self.torque_nm) > CAPACITY_NM and not (self.partial or self.other_unit)
        return self.saturated or beyond


class LoadParser(LineParser[LoadSample]):
    """Turns the board's bytes into samples."""

    board = "load cell"

    def __init__(self, calibration: LoadCalibration, rate_hz: float = LOAD_CELL_RATE_HZ) -> None:
        super().__init__(_DECIMAL, MAX_LINE_BYTES, BAUD_RATE, rate_hz)
        self._stuck_after = max(STUCK_AFTER, round(STUCK_AFTER * rate_hz / LOAD_CELL_RATE_HZ))
        self.flagged = 0
        self.calibration = calibration
        self.restart()

    def handle(self, event: serial_sensor.RawEvent) -> list[LoadSample]:
        """Process a live or recorded event; return the samples that it completes."""
        if event.kind is serial_sensor.InputKind.TARE:
            self.calibration = self.calibration.tared(float(event.data))
            self._levels = serial_sensor.StepFilter[tuple[float, int]]()
        return super().handle(event)

    def restart(self) -> None:
        """Forget everything but counters and calibration: the port was (re)opened."""
        super().restart()
        self._last_raw: float | None = None
        self._repeats = 0
        # Whether no line since then had a decimal point, and whether one was within the capacity.
        self._whole_numbers, self._fits = True, False
        self._levels = serial_sensor.StepFilter[tuple[float, int]]()

    def _value(self, line: TimedLine) -> LoadSample:
        raw = float(line.text)
        self._whole_numbers = self._whole_numbers and b"." not in line.text
        torque_nm = self.calibration.torque_nm(raw)
        self._repeats = self._repeats + 1 if raw == self._last_raw else 1
        self._last_raw = raw
        saturated, spike = raw in (COUNTS_MAX, COUNTS_MIN), abs(torque_nm) > CAPACITY_NM
        self._fits = self._fits or not (spike or line.partial)
        # An unreliable value is not a level to judge the next one by.
        if not (saturated or line.partial):
            if spike:
                self._levels.restart_step()
            else:
                spike = self._levels.is_spike((torque_nm, line.t_arrival_ns), self._is_reachable)
        sample = LoadSample(
            raw=raw,
            torque_nm=torque_nm,
            t_mid_ns=line.t_mid_ns,
            t_arrival_ns=line.t_arrival_ns,
            saturated=saturated,
            spike=spike,
            stuck=self._repeats >= self._stuck_after,
            partial=line.partial,
            other_unit=None if saturated or line.partial else self._other_unit(raw, line.text, spike=spike),
        )
        self.flagged += not sample.trusted
        return sample

    def _other_unit(self, raw: float, text: bytes, *, spike: bool) -> Hint | None:
        if self.calibration.takes_counts:
            return TORQUES_FOR_COUNTS if b"." in text and abs(raw) <= CAPACITY_NM else None
        # A board of torques has a line within its capacity before one that is corrupted.
        if spike and (self._whole_numbers or not self._fits):
            return COUNTS_REASON if self.calibration.takes_torque else COUNTS_FOR_TORQUES
        return None

    def _is_reachable(self, before: tuple[float, int], after: tuple[float, int]) -> bool:
        # By the arrival: before a late line others may be missing. No interval counts as shorter than a period.
        (before_nm, before_ns), (after_nm, after_ns) = before, after
        elapsed_s = max(after_ns - before_ns, self._period_ns) * 1e-9
        return abs(after_nm - before_nm) <= SLEW_NM_PER_S * elapsed_s


class LoadCell(serial_sensor.SerialSensor[LoadSample]):
    """One board; it only sends."""

    silence_hint = "check that it is the load cell's board and that the HX711 has power and its DT and SCK wires."

    def __init__(
        self,
        link: Link,
        calibration: LoadCalibration,
        rate_hz: float = LOAD_CELL_RATE_HZ,
        inputs: serial_sensor.InputRecorder | None = None,
        patience: float = 1.0,
    ) -> None:
        self._load_parser = LoadParser(calibration, rate_hz)
        # A fast board may seem silent to a busy computer; reopening would reset it.
        super().__init__(link, 1.0 / min(rate_hz, LOAD_CELL_RATE_HZ), self._load_parser, inputs, patience)

    @property
    def calibration(self) -> LoadCalibration:
        """The present calibration, with the zero of the latest tare."""
        return self._load_parser.calibration

    def tare(self, raw_at_rest: float) -> None:
        """Make a raw value the zero of the samples to come."""
        self._dispatch(serial_sensor.InputKind.TARE, time.monotonic_ns(), repr(raw_at_rest).encode())

    def diagnostics(self) -> Diagnostics:
        """Return the board's values for `health`; counts are since the process began."""
        parser = self._load_parser
        counts = {"samples": parser.count, "flagged": parser.flagged}
        return {**super().diagnostics(), **counts, "errors": dict(parser.errors)}
