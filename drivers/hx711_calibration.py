"""The guided calibration of the load cell: rest, then known masses, then a straight line, or a reason why not.

`LoadCalibrator` decides and speaks but reads nothing: it is fed with samples and told when the operator is ready.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from shearloop.drivers.calibration_file import CalibrationError
from shearloop.drivers.hx711 import LoadCalibration, LoadSample

STANDARD_GRAVITY = 9.80665
# Before the scale is known, no value can be told from a load by its size: only by the noise that it adds.
UNCALIBRATED = LoadCalibration(tare_counts=0.0, scale_n_per_count=1e-9)


@dataclass(frozen=True, slots=True)
class CalibrationBounds:
    """What a signal must be like to be calibrated on."""

    samples_per_step: int = 30
    # The converter needs four conversions to settle after a change (HX711 data sheet), the mass as long to hang still.
    skip_samples: int = 8
    # A quiet HX711 at gain 128 shows some hundred counts; ten times that is a loose wire or a swinging mass.
    noise_max_counts: float = 5000.0
    # …and by the size of what is measured, which also covers boards that send N·m.
    noise_max_fraction: float = 0.05
    residual_max_fraction: float = 0.02


@dataclass(frozen=True, slots=True)
class Level:
    """The reading at rest under one load: mean and standard deviation of the raw values, and their number."""

    mass_g: float
    mean: float
    std: float
    n: int


@dataclass(frozen=True, slots=True)
class LoadCalibrationResult:
    """A calibration, the levels it was made from, and the largest distance of one from the line, as a torque in N·m."""

    calibration: LoadCalibration
    levels: tuple[Level, ...]
    residual_nm: float
    sentences: tuple[str, ...]


def level_of(samples: Sequence[LoadSample], mass_g: float, bounds: CalibrationBounds) -> Level:
    """Return the level that samples under an unchanging load stand at.

    Raises CalibrationError, with the cause, when they are too few, saturated, flat, corrupted or noisy. Corrupted
    values (spikes) are left out, but if more than a tenth are, the line is not fit to calibrate on.
    """
    if any(sample.saturated for sample in samples):
        raise CalibrationError(
            "The load cell's converter is at the end of its range: take load off the cell, and check that none of "
            "its four wires is loose."
        )
    good = [sample.raw for sample in samples if not sample.spike and not sample.partial]
    if len(samples) < bounds.samples_per_step or len(good) < 0.9 * len(samples):
        raise CalibrationError(
            f"Only {len(good)} of the {bounds.samples_per_step} readings needed were good: check the cable, and that "
            "the board sends about 11 lines a second, then measure again."
        )
    mean, std = float(np.mean(good)), float(np.std(good, ddof=1))
    if min(good) == max(good):
        raise CalibrationError(
            f"All {len(good)} readings are exactly {mean:g}: a live converter is never that still. "
            "Check that the HX711 has power and that its DT and SCK wires are on the pins named in the sketch."
        )
    if std > bounds.noise_max_counts:
        raise CalibrationError(
            f"The readings scatter by {std:.0f} counts, more than {bounds.noise_max_counts:.0f}: let the mass hang "
            "still, keep the robot off the arm, and check the cell's wires and their shield."
        )
    return Level(mass_g, mean, std, len(good))


def tare(calibration: LoadCalibration, samples: Sequence[LoadSample], bounds: CalibrationBounds) -> LoadCalibration:
    """Return the calibration with its zero at the unloaded cell's reading; CalibrationError as `level_of`."""
    return calibration.tared(level_of(samples, 0.0, bounds).mean)


def fit_levels(
    levels: Sequence[Level], lever_arm_m: float, sign: int, bounds: CalibrationBounds
) -> LoadCalibrationResult:
    """Return the straight line through the levels, raw against force; CalibrationError when there is none.

    The line is fitted by least squares, every level with the same weight: what spoils a calibration is how a mass
    hangs, not the converter's noise.
    """
    forces_n = np.array([level.mass_g for level in levels]) * 1e-3 * STANDARD_GRAVITY
    means = np.array([level.mean for level in levels])
    _check_levels(levels, bounds)
    counts_per_n, tare_counts = (float(value) for value in np.polyfit(forces_n, means, 1))
    calibration = LoadCalibration(
        tare_counts=tare_counts,
        scale_n_per_count=1 / counts_per_n,
        lever_arm_m=lever_arm_m,
        sign=-1 if sign < 0 else 1,
    )
    residuals = means - (tare_counts + counts_per_n * forces_n)
    worst = int(np.argmax(np.abs(residuals)))
    span = float(np.ptp(means))
    if abs(residuals[worst]) > bounds.residual_max_fraction * span:
        raise CalibrationError(
            f"The masses do not lie on a straight line: with {levels[worst].mass_g:g} g the reading is off by "
            f"{abs(residuals[worst]) / abs(counts_per_n) / STANDARD_GRAVITY * 1e3:.1f} g. Check the masses that were "
            "given and that each pressed on the cell alone, at the lever arm's place."
        )
    residual_nm = float(abs(residuals[worst] * calibration.nm_per_count))
    noise_nm = max(level.std for level in levels) * abs(calibration.nm_per_count)
    return LoadCalibrationResult(
        calibration,
        tuple(levels),
        residual_nm,
        (
            f"One count is {calibration.nm_per_count:.3e} N·m at a lever arm of {lever_arm_m * 1e3:g} mm.",
            f"The cell at rest reads {tare_counts:.6g}.",
            f"The noise is {noise_nm:.1e} N·m, the worst distance from the straight line {residual_nm:.1e} N·m.",
        ),
    )


def _check_levels(levels: Sequence[Level], bounds: CalibrationBounds) -> None:
    empty, *loaded = levels
    for level in loaded:
        shift, noise = abs(level.mean - empty.mean), math.hypot(level.std, empty.std)
        if shift < 5 * noise:
            raise CalibrationError(
                f"The reading did not change with {level.mass_g:g} g on the cell (by {shift:.3g}, with a noise of "
                f"{noise:.3g}): check that the mass presses on the cell and that the cell's signal wires are connected."
            )
        if noise > bounds.noise_max_fraction * shift:
            raise CalibrationError(
                f"The readings scatter by {noise / shift:.0%} of what {level.mass_g:g} g change them by, more than "
                f"{bounds.noise_max_fraction:.0%}: let the mass hang still, or use a larger one."
            )
    directions = {np.sign(b.mean - a.mean) for a, b in pairwise(sorted(levels, key=lambda level: level.mass_g))}
    if len(directions) > 1:
        raise CalibrationError(
            "The reading does not change steadily in one direction as the mass grows: "
            "were the masses put on in the order given?"
        )


@dataclass(slots=True)
class LoadCalibrator:
    """The guided calibration as a state machine.

    `prompt` says what the operator has to do; when done, call `ready()` and `feed` samples until it returns True.
    A step whose signal is not fit raises CalibrationError from `feed` and is asked for again. After the last step
    `finished` is True and `result()` gives the calibration.
    """

    masses_g: Sequence[float]
    lever_arm_m: float = 0.035
    sign: int = 1
    bounds: CalibrationBounds = field(default_factory=CalibrationBounds)
    levels: list[Level] = field(default_factory=list, init=False)
    _samples: list[LoadSample] | None = field(default=None, init=False)
    _to_skip: int = field(default=0, init=False)

    def __post_init__(self) -> None:
        """Refuse masses that no line can be drawn through."""
        if not self.masses_g or any(not (0 < mass < math.inf) for mass in self.masses_g):
            raise CalibrationError("Give at least one mass in grams, each above zero.")
        if len(set(self.masses_g)) < len(self.masses_g):
            raise CalibrationError("Give every mass once; the same one twice says nothing about the line.")

    @property
    def finished(self) -> bool:
        """Whether every step has been measured."""
        return len(self.levels) == len(self.masses_g) + 1

    @property
    def prompt(self) -> str:
        """What the operator has to do for the next step."""
        if not self.levels:
            return "Take every load off the lever arm and let it rest."
        return f"Put {self._mass_g:g} g on the load cell, where the lever arm presses, and let it hang still."

    @property
    def _mass_g(self) -> float:
        return self.masses_g[len(self.levels) - 1] if self.levels else 0.0

    def ready(self) -> None:
        """Begin the step: the operator has done what the prompt asked for."""
        self._samples, self._to_skip = [], self.bounds.skip_samples

    def feed(self, sample: LoadSample) -> bool:
        """Take a sample; return True when it completed the step. Samples between the steps count for nothing."""
        if self._samples is None:
            return False
        if self._to_skip:
            self._to_skip -= 1
            return False
        self._samples.append(sample)
        if len(self._samples) < self.bounds.samples_per_step:
            return False
        samples, self._samples = self._samples, None
        level = level_of(samples, self._mass_g, self.bounds)
        if self.levels:
            _check_levels([*self.levels, level], self.bounds)
        self.levels.append(level)
        return True

    def result(self) -> LoadCalibrationResult:
        """Return the calibration; CalibrationError when the levels do not lie on a line, or a step is missing."""
        if not self.finished:
            raise CalibrationError(f"{len(self.masses_g) + 1 - len(self.levels)} steps are still to be measured.")
        return fit_levels(self.levels, self.lever_arm_m, self.sign, self.bounds)
