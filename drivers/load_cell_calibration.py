"""The calibration of the load cell: levels of rest and known masses, then a straight line or the reason for none."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from shearloop.drivers.errors import DeviceCalibrationError
from shearloop.drivers.load_cell import LEVER_ARM_M, LoadCalibration, LoadSample

STANDARD_GRAVITY = 9.80665
# Before the scale is known, any value may be a load.
UNCALIBRATED = LoadCalibration(tare_counts=0.0, scale_n_per_count=1e-9)
SAMPLES_PER_STEP = 30
# The converter settles within four conversions (HX711 data sheet); the mass needs as long to hang still.
SKIP_SAMPLES = 8
# Of the readings of a step; more corrupted ones are refused.
MIN_GOOD_FRACTION = 0.9
# A corrupted reading is further from the median than the nearer half of all, by this factor: eight standard deviations
# of Gaussian noise.
OUTLIER_REACH = 12.0
# A quiet HX711 at gain 128 shows some hundred counts; ten times that is a loose wire or a swinging mass.
MAX_NOISE_COUNTS = 5000.0
# Relative to the measured change, for boards that send N·m.
MAX_NOISE_FRACTION = 0.05
# Cells of such levers bear some kilograms, and resolve a hundredth of a gram.
MIN_MASS_G, LARGEST_MASS_G = 1.0, 20_000.0
MAX_RESIDUAL_FRACTION = 0.02


@dataclass(frozen=True, slots=True)
class Level:
    """The reading under one constant load: mean and standard deviation of `n` raw values; `dropped` were corrupted."""

    mass_g: float
    mean: float
    std: float
    n: int
    dropped: int = 0


@dataclass(frozen=True, slots=True)
class LoadCalibrationResult:
    """A calibration, the largest residual as a torque in N·m, and a report in sentences."""

    calibration: LoadCalibration
    residual_nm: float
    sentences: tuple[str, ...]


def measure_level(samples: Sequence[LoadSample], mass_g: float) -> Level:
    """Return the level of SAMPLES_PER_STEP samples under a constant load; those before them are left out.

    Up to a tenth may be corrupted: spikes, an end of the range, or far from the others. Raises DeviceCalibrationError
    for more, and for a flat or a noisy signal.
    """
    samples = samples[-SAMPLES_PER_STEP:]
    least = MIN_GOOD_FRACTION * SAMPLES_PER_STEP
    if sum(sample.saturated for sample in samples) > SAMPLES_PER_STEP - least:
        raise DeviceCalibrationError(
            "The load cell's converter is at the end of its range: take load off the cell, and check that none of "
            "its four wires is loose."
        )
    good = _without_outliers(
        [sample.raw for sample in samples if not (sample.saturated or sample.spike or sample.partial)]
    )
    if len(good) < least:
        raise DeviceCalibrationError(
            f"Only {len(good)} of the {SAMPLES_PER_STEP} readings needed were good: check the cable, and that "
            "the board sends about 11 lines a second, then measure again."
        )
    mean, std = float(np.mean(good)), float(np.std(good, ddof=1))
    if min(good) == max(good):
        raise DeviceCalibrationError(
            f"All {len(good)} readings are exactly {mean:g}: a live converter is never that still. "
            "Check that the HX711 has power and that its DT and SCK wires are on the pins named in the sketch."
        )
    if std > MAX_NOISE_COUNTS:
        raise DeviceCalibrationError(
            f"The readings scatter by {std:.0f} counts, more than {MAX_NOISE_COUNTS:.0f}: let the mass hang "
            "still, keep the robot off the arm, and check the cell's wires and their shield."
        )
    return Level(mass_g, mean, std, len(good), len(samples) - len(good))


def _without_outliers(raws: list[float]) -> list[float]:
    """Return the readings that are not far from their median."""
    if not raws:
        return raws
    distances = np.abs(np.array(raws) - np.median(raws))
    ordered = np.sort(distances)
    # More than half may be the same after rounding.
    reach = ordered[len(raws) // 2] or ordered[math.ceil(MIN_GOOD_FRACTION * len(raws)) - 1]
    return [raw for raw, distance in zip(raws, distances.tolist(), strict=True) if distance <= OUTLIER_REACH * reach]


def check_levels(levels: Sequence[Level]) -> None:
    """Raise DeviceCalibrationError unless the levels, rest first, change enough and in one direction with the mass."""
    empty, *loaded = levels
    for level in loaded:
        shift, noise = abs(level.mean - empty.mean), math.hypot(level.std, empty.std)
        if shift < 5 * noise:
            raise DeviceCalibrationError(
                f"The reading did not change with {level.mass_g:g} g on the cell (by {shift:.3g}, with a noise of "
                f"{noise:.3g}): check that the mass presses on the cell and that the cell's signal wires are connected."
            )
        if noise > MAX_NOISE_FRACTION * shift:
            raise DeviceCalibrationError(
                f"The readings scatter by {noise / shift:.0%} of what {level.mass_g:g} g change them by, more than "
                f"{MAX_NOISE_FRACTION:.0%}: let the mass hang still, or use a larger one."
            )
    directions = {np.sign(b.mean - a.mean) for a, b in pairwise(sorted(levels, key=lambda level: level.mass_g))}
    if len(directions) > 1:
        raise DeviceCalibrationError(
            "The reading does not change steadily in one direction as the mass grows: "
            "were the masses put on in the order given?"
        )


def check_masses(masses_g: Sequence[float]) -> None:
    """Raise DeviceCalibrationError for masses that do not define a line."""
    if not masses_g or any(not (0 < mass < math.inf) for mass in masses_g):
        raise DeviceCalibrationError("Give at least one mass in grams, each above zero.")
    for mass in masses_g:
        if not MIN_MASS_G <= mass <= LARGEST_MASS_G:
            meant = f" Did you mean {1000 * mass:g}, {mass:g} kg in g?" if mass < MIN_MASS_G else ""
            raise DeviceCalibrationError(
                f"{mass:g} g cannot calibrate a load cell; give masses of {MIN_MASS_G:g} to {LARGEST_MASS_G:g} "
                f"g.{meant}"
            )
    if len(set(masses_g)) < len(masses_g):
        raise DeviceCalibrationError("Give every mass once; the same one twice says nothing about the line.")


def fit_levels(levels: Sequence[Level], lever_arm_m: float = LEVER_ARM_M, sign: int = 1) -> LoadCalibrationResult:
    """Return the least-squares line through the levels of rest and masses, raw against force.

    All levels have equal weight: how a mass hangs matters more than the converter's noise. Raises
    DeviceCalibrationError if they do not lie on a line.
    """
    forces_n = np.array([level.mass_g for level in levels]) * 1e-3 * STANDARD_GRAVITY
    means = np.array([level.mean for level in levels])
    counts_per_n, tare_counts = (float(value) for value in np.polyfit(forces_n, means, 1))
    calibration = LoadCalibration(
        tare_counts=tare_counts, scale_n_per_count=1 / counts_per_n, lever_arm_m=lever_arm_m, sign=-1 if sign < 0 else 1
    )
    residuals = means - (tare_counts + counts_per_n * forces_n)
    worst = int(np.argmax(np.abs(residuals)))
    if abs(residuals[worst]) > MAX_RESIDUAL_FRACTION * float(np.ptp(means)):
        raise DeviceCalibrationError(
            f"The masses do not lie on a straight line: with {levels[worst].mass_g:g} g the reading is off by "
            f"{abs(residuals[worst]) / abs(counts_per_n) / STANDARD_GRAVITY * 1e3:.1f} g. Check the masses that "
            "were given and that each pressed on the cell alone, at the lever arm's place."
        )
    residual_nm = float(abs(residuals[worst] * calibration.nm_per_count))
    noise_nm = max(level.std for level in levels) * abs(calibration.nm_per_count)
    sentences = (
        f"One count is {calibration.nm_per_count:.3e} N·m at a lever arm of {lever_arm_m * 1e3:g} mm.",
        f"The cell at rest reads {tare_counts:.6g}.",
        f"The noise is {noise_nm:.1e} N·m, the worst distance from the straight line {residual_nm:.1e} N·m.",
    )
    return LoadCalibrationResult(calibration, residual_nm, sentences)
