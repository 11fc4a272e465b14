"""Fitting an estimator to slices: differences of one fingertip, each with a torque or a diameter."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from shearloop.bank.arrays import FloatArray, IntArray
from shearloop.bank.eit.channels import N_CHANNELS, N_ELECTRODES
from shearloop.bank.errors import CalibrationError
from shearloop.bank.estimation.bank_match import BankMatcher, ElectrodeNumbering
from shearloop.bank.estimation.calibration import Calibration, OutputModel, Quantity
from shearloop.bank.estimation.fitting_raw import Physics, k_range, ridge_fit, strengths_for
from shearloop.bank.estimation.interval_regressor import Mixtures, fit_interval_regressor
from shearloop.bank.estimation.novelty import NoveltyDetector, fitted_parts
from shearloop.bank.estimation.regressors import InverseCalibration, Regressor, later_origins
from shearloop.bank.estimation.values import FrameSeries

# Inverse calibration over torque and over diameter: degree, directions of drift, trend. The torque's have the least
# mean error over six origins (19 to 44 of 49 slices, evaluated on all later ones; docs/decisions/0042).
_TORQUE_CURVE, _DIAMETER_CURVE = (3, 3, True), (1, 1, False)
# With a block left out, enough remain for novelty detection, or for the torque's curve.
_LEAST_TORQUE_SLICES, _LEAST_FOR_CURVE = 10, 14
# Foreign frames: every eighth of a turn, plain and mirrored, except the own numbering. Of a few numberings alone the
# result depends on the choice: single ones give half to twice the median.
_NUMBERINGS = [(turn, mirrored) for turn in range(0, N_ELECTRODES, N_ELECTRODES // 8) for mirrored in (False, True)][1:]
# Hardly any mixture with a larger share is accepted.
_SHARES = (0.1, 0.2, 0.3)
# Later slices of each origin that are mixed; twice as many give the same result.
_MOST_LATER = 10
_ALL = np.ones(N_CHANNELS, dtype=np.bool_)


def fit_slices(
    blank: Calibration, recordings: list[FrameSeries], physics: Physics, *, full_range: bool = False
) -> Calibration:
    """Return a blank calibration with torque and diameter fitted to slices in time order.

    With `full_range` no torque beyond theirs will occur. Raises CalibrationError for slices of several fingertips, and
    for too few.
    """
    if len(blank.sides) > 1:
        raise CalibrationError(
            f"slices of {len(blank.sides)} fingertips ({', '.join(blank.sides)}) do not fit into one calibration; make "
            "one for each"
        )
    is_curve = blank.estimator == "motion_regression"
    frames = np.concatenate([one.channels for one in recordings])
    times = _consecutive([one.t_s for one in recordings])
    torque = np.concatenate([one.torque_at_frames() for one in recordings])
    diameter = np.concatenate([one.diameter_mm for one in recordings])
    matcher = blank.matcher(physics.bank)
    models: dict[Quantity, OutputModel] = {}
    # Cylinders were twisted too, but at one torque each, which determines no torque.
    torque = np.where(np.isfinite(diameter), np.nan, torque)
    truths: dict[Quantity, FloatArray] = {"torque": torque, "diameter": diameter}
    for quantity, values in truths.items():
        known = np.isfinite(values)
        if not known.any():
            continue
        n, least = int(known.sum()), _LEAST_FOR_CURVE if is_curve else _LEAST_TORQUE_SLICES
        if quantity == "torque" and n < least:
            raise CalibrationError(
                f"{n} slices with a torque are too few for the estimator {blank.estimator}; record {least} or more"
            )
        differences = np.abs(frames[known])
        # First, because it checks that a board sent the slices.
        novelty = NoveltyDetector.fit(differences[:, 0])
        features = np.array(
            [
                blank.features(matcher, one, None, t_s)[0]
                for one, t_s in zip(differences, times[known].tolist(), strict=True)
            ]
        )
        test = None
        if quantity == "torque":
            test = ContaminationTest(differences[:, 0], _features_of(blank, matcher, times[known]))
        degree, n_drift, trend = _TORQUE_CURVE if quantity == "torque" else _DIAMETER_CURVE
        if is_curve:
            _check_distinct(quantity, values[known], degree)
        regressor = fit_interval_regressor(
            blank.columns(quantity, features),
            values[known],
            _curve_fit(degree, n_drift, trend) if is_curve else ridge_fit(blank.estimator),
            strengths=strengths_for(blank.estimator),
            left_out=later_origins(n) if quantity == "torque" else (),
            growth=test.growth if test is not None else None,
            mixtures=test.accepted if test is not None else None,
            full_range=full_range,
        )
        models[quantity] = OutputModel(regressor, novelty, k_range(blank.estimator, features))
    if not models:
        raise CalibrationError("the slices come with neither torque nor diameter")
    return replace(blank, torque=models.get("torque"), diameter=models.get("diameter"))


def _features_of(
    blank: Calibration, matcher: BankMatcher | None, t_s: FloatArray
) -> Callable[[FloatArray, int], FloatArray]:
    """Return a function from a (896,) difference and its row to the torque's features."""
    return lambda difference, row: blank.columns(
        "torque", blank.features(matcher, difference[None], None, float(t_s[row]))[0]
    )


def _curve_fit(degree: int, n_drift: int, trend: bool) -> Callable[[FloatArray, FloatArray, float], Regressor]:
    return lambda features, values, _: InverseCalibration.fit(features, values, degree, n_drift, trend=trend)


class ContaminationTest:
    """Slices mixed with foreign ones, as detectors of novelty fitted to earlier slices assess them.

    A tenth of a foreign frame moves a slice no further than its own drift, so no detector can refuse it
    (docs/charts.md), and the interval has to cover it. Stand-ins for foreign frames are the mean slice with the
    electrodes renumbered.
    """

    def __init__(self, differences: FloatArray, features_of: Callable[[FloatArray, int], FloatArray]) -> None:
        """Take (n, 896) differences in time order, and a function from one and its row to (d,) features."""
        self._differences = differences
        self._features_of = features_of
        mean = differences.mean(axis=0)
        self._foreign = [
            mean[ElectrodeNumbering(turn, mirrored, score=1.0, runner_up=0.0).model_channels()]
            for turn, mirrored in _NUMBERINGS
        ]
        self._detectors: dict[bytes, NoveltyDetector] = {}
        self._features: dict[tuple[int, int, float], FloatArray] = {}

    def growth(self, past: IntArray, future: IntArray) -> FloatArray:
        """Return the growth of the intervals of (q,) later slices, by a detector fitted to the earlier ones."""
        detector = self._detector(past)
        return np.array([detector.widening(one, _ALL) for one in self._differences[future]])

    def accepted(self, past: IntArray, future: IntArray) -> Mixtures:
        """Return the mixtures of later slices that a detector fitted to the earlier ones accepts."""
        detector = self._detector(past)
        chosen = future[np.unique(np.linspace(0, len(future) - 1, min(len(future), _MOST_LATER)).astype(int))]
        rows, features, limit_shares = [], [], []
        for row in chosen.tolist():
            for number, foreign in enumerate(self._foreign):
                for share in _SHARES:
                    mixed = (1 - share) * self._differences[row] + share * foreign
                    novelty = detector.assess(mixed, _ALL)
                    if novelty.reasons:
                        break
                    rows.append(row)
                    limit_shares.append(novelty.limit_share)
                    key = row, number, share
                    if key not in self._features:
                        self._features[key] = self._features_of(mixed, row)
                    features.append(self._features[key])
        return Mixtures(np.array(rows, dtype=np.int64), np.array(features), np.array(limit_shares))

    def _detector(self, past: IntArray) -> NoveltyDetector:
        key = past.tobytes()
        if key not in self._detectors:
            self._detectors[key] = NoveltyDetector.fit(self._differences[past])
        return self._detectors[key]


def _check_distinct(quantity: Quantity, values: FloatArray, degree: int) -> None:
    """Raise CalibrationError where a part of (n,) values has too few distinct ones for a curve."""
    if np.ptp(values) == 0:
        return
    for rows in fitted_parts(len(values)):
        n_distinct = len(np.unique(values[rows]))
        if n_distinct <= degree:
            raise CalibrationError(
                f"{len(rows)} of the {len(values)} slices have too few different {quantity}s for the estimator "
                f"motion_regression, {n_distinct}; record more of them, in turn"
            )


def _consecutive(times: list[FloatArray]) -> FloatArray:
    """Return the times of several series one after another; each starts one after the end of the last, or later."""
    shifted: list[FloatArray] = []
    for one in times:
        begins_early = bool(shifted) and one[0] <= shifted[-1][-1]
        shifted.append(one - one[0] + shifted[-1][-1] + 1.0 if begins_early else one)
    return np.concatenate(shifted)
