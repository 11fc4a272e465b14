"""Fitting an estimator to slices: differences of one fingertip, each with a torque or a diameter."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from shearloop.bank.arrays import FloatArray
from shearloop.bank.errors import CalibrationError
from shearloop.bank.estimation.bank_match import BankMatcher
from shearloop.bank.estimation.calibrated import Calibration, OutputModel, columns_for, features_of
from shearloop.bank.estimation.contamination import ContaminationTest
from shearloop.bank.estimation.fitting_choices import Physics, ks_of, locator_of, ridge_for, strengths_for
from shearloop.bank.estimation.fitting_regressor import fit_reader
from shearloop.bank.estimation.interval_regressor import Head
from shearloop.bank.estimation.novelty import NoveltyDetector
from shearloop.bank.estimation.regressors import InverseCalibration, later_origins
from shearloop.bank.estimation.soundness import parts_of
from shearloop.bank.estimation.values import FrameSeries

# The curve of frames over torque and over diameter: degree, directions of drift, and whether there is a trend. Of the
# torque's the mean error over six origins (19 to 44 of 49 slices, judged on all that follow) was least for these
# (docs/decisions/0042).
_TORQUE_CURVE, _DIAMETER_CURVE = (3, 3, True), (1, 1, False)
# With a block left out, as many are left as it takes to know what is familiar, or to determine the torque's curve.
_LEAST_TORQUE_SLICES, _LEAST_FOR_CURVE = 10, 14


def fit_slices(
    blank: Calibration, recordings: list[FrameSeries], physics: Physics, *, all_torques: bool = False
) -> Calibration:
    """Return a blank calibration with what slices in time order tell of torque and diameter.

    With `all_torques` none beyond them will come. Raises CalibrationError for slices of several fingertips, and for
    too few.
    """
    if len(blank.sides) > 1:
        raise CalibrationError(
            f"slices of {len(blank.sides)} fingertips ({', '.join(blank.sides)}) do not go into one calibration; make "
            "one for each"
        )
    frames = np.concatenate([one.channels for one in recordings])
    times = _consecutive([one.t_s for one in recordings])
    torque = np.concatenate([one.torque_at_frames() for one in recordings])
    diameter = np.concatenate([one.diameter_mm for one in recordings])
    registered = locator_of(blank, physics)
    tasks = {}
    for name, values in (("torque", torque), ("diameter", diameter)):
        # Cylinders were twisted too, at one torque each: that does not determine a torque.
        known = np.isfinite(values) & (np.isfinite(diameter) if name == "diameter" else ~np.isfinite(diameter))
        if not known.any():
            continue
        least = _LEAST_FOR_CURVE if blank.estimator == "fused" else _LEAST_TORQUE_SLICES
        if name == "torque" and known.sum() < least:
            raise CalibrationError(
                f"{known.sum()} slices with a torque are too few for the estimator {blank.estimator}; record {least} "
                "or more"
            )
        differences = np.abs(frames[known])
        # Before anything else is fitted to them: it looks whether they are slices of a board.
        guard = NoveltyDetector.fit(differences[:, 0])
        features = np.array(
            [
                features_of(blank, registered, one, None, t).features
                for one, t in zip(differences, times[known].tolist(), strict=True)
            ]
        )
        columns = columns_for(blank.estimator, name, features)
        later = _mixtures(blank, registered, differences[:, 0], times[known]) if name == "torque" else None
        curve = _TORQUE_CURVE if name == "torque" else _DIAMETER_CURVE
        if blank.estimator == "fused":
            _check_distinct(name, values[known], curve[0])
        reader = fit_reader(
            columns,
            values[known],
            _curve(curve) if blank.estimator == "fused" else ridge_for(blank.estimator),
            strengths=strengths_for(blank.estimator),
            left_out=later_origins(int(known.sum())) if name == "torque" else (),
            difficulty=later.difficulty if later is not None else None,
            mixed=later.passing if later is not None else None,
            all_values=all_torques,
        )
        tasks[name] = OutputModel(reader, guard, ks_of(blank.estimator, features))
    if not tasks:
        raise CalibrationError("the slices come with neither torque nor diameter")
    return replace(blank, torque=tasks.get("torque"), diameter=tasks.get("diameter"))


def _mixtures(
    blank: Calibration, locator: BankMatcher | None, differences: FloatArray, t_s: FloatArray
) -> ContaminationTest:
    """Return (n, 896) differences at (n,) times with what may be hidden in them, as the torque is read from it."""

    def features(difference: FloatArray, row: int) -> FloatArray:
        seen = features_of(blank, locator, difference[None], None, float(t_s[row]))
        return columns_for(blank.estimator, "torque", seen.features)

    return ContaminationTest(differences, features)


def _check_distinct(name: str, values: FloatArray, degree: int) -> None:
    """Raise CalibrationError where a part of (n,) values has too few different ones for a curve, unless all are one."""
    if np.ptp(values) == 0:
        return
    for rows in parts_of(len(values)):
        distinct = len(np.unique(values[rows]))
        if distinct <= degree:
            raise CalibrationError(
                f"{len(rows)} of the {len(values)} slices have too few different {name}s for the estimator fused, "
                f"{distinct}; record more of them, in turn"
            )


def _curve(shape: tuple[int, int, bool]) -> Callable[[FloatArray, FloatArray, float], Head]:
    degree, n_drift, trend = shape
    return lambda features, values, _: InverseCalibration.fit(features, values, degree, n_drift, trend=trend)


def _consecutive(times: list[FloatArray]) -> FloatArray:
    """Return the times of several series one after another, each beginning one later than the one before has ended."""
    shifted: list[FloatArray] = []
    for one in times:
        begins_early = bool(shifted) and one[0] <= shifted[-1][-1]
        shifted.append(one - one[0] + shifted[-1][-1] + 1.0 if begins_early else one)
    return np.concatenate(shifted)
