"""Fitting an estimator to slices: differences of one fingertip, each with a torque or a diameter."""

from dataclasses import dataclass, replace

import numpy as np

from shearloop.bank.arrays import FloatArray, IntArray
from shearloop.bank.eit.channels import N_CHANNELS, N_ELECTRODES
from shearloop.bank.errors import CalibrationError
from shearloop.bank.estimation.bank_match import BankMatcher, ElectrodeNumbering
from shearloop.bank.estimation.calibration import Assumption, Calibration
from shearloop.bank.estimation.estimator import Estimator, OutputModel, Physics, Quantity, Reading
from shearloop.bank.estimation.interval_regressor import Mixtures, fit_interval_regressor
from shearloop.bank.estimation.novelty import NoveltyDetector
from shearloop.bank.estimation.regressors import later_origins
from shearloop.bank.estimation.values import FrameSeries

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
    estimator = blank.estimator
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
        n = int(known.sum())
        if quantity == "torque" and n < estimator.least_slices:
            raise CalibrationError(
                f"{n} slices with a torque are too few for the estimator {estimator.name}; record "
                f"{estimator.least_slices} or more"
            )
        differences = np.abs(frames[known])
        # First, because it checks that a board sent the slices.
        novelty = NoveltyDetector.fit(differences[:, 0])
        reader = SliceReader(estimator, matcher, times[known])
        features = np.array([reader.features(one, row) for row, one in enumerate(differences[:, 0])])
        test = ContaminationTest(differences[:, 0], reader) if quantity == "torque" else None
        regressor = fit_interval_regressor(
            features[:, estimator.columns[quantity]],
            values[known],
            estimator.slices_fit(quantity, values[known]),
            strengths=estimator.strengths,
            left_out=later_origins(n) if quantity == "torque" else (),
            test=test,
            full_range=full_range,
        )
        models[quantity] = OutputModel(regressor, novelty, estimator.k_range(features))
    if not models:
        raise CalibrationError("the slices come with neither torque nor diameter")
    assumptions: tuple[Assumption, ...] = ("full range",) if full_range and "torque" in models else ()
    return replace(blank, torque=models.get("torque"), diameter=models.get("diameter"), assumptions=assumptions)


@dataclass(frozen=True, slots=True, eq=False)
class SliceReader:
    """Makes features of slices at the times t_s (n,)."""

    estimator: Estimator
    matcher: BankMatcher | None
    t_s: FloatArray

    def features(self, difference: FloatArray, row: int) -> FloatArray:
        """Return the (d,) features of a (896,) difference at the time of a row."""
        slice_ = difference[None]
        reading = Reading(slice_, float(self.t_s[row]), slice_, np.zeros(0), self.matcher)
        return self.estimator.features(reading)[0]

    def torque_inputs(self, difference: FloatArray, row: int) -> FloatArray:
        """Return those features that the torque is predicted from."""
        return self.features(difference, row)[self.estimator.columns["torque"]]


class ContaminationTest:
    """Slices mixed with foreign ones, as detectors of novelty fitted to earlier slices assess them.

    A tenth of a foreign frame moves a slice no further than its own drift, so no detector can refuse it
    (docs/charts.md), and the interval has to cover it. Stand-ins for foreign frames are the mean slice with the
    electrodes renumbered.
    """

    def __init__(self, differences: FloatArray, reader: SliceReader) -> None:
        """Take (n, 896) differences in time order, and their reader."""
        self._differences = differences
        self._reader = reader
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
                        self._features[key] = self._reader.torque_inputs(mixed, row)
                    features.append(self._features[key])
        return Mixtures(np.array(rows, dtype=np.int64), np.array(features), np.array(limit_shares))

    def _detector(self, past: IntArray) -> NoveltyDetector:
        key = past.tobytes()
        if key not in self._detectors:
            self._detectors[key] = NoveltyDetector.fit(self._differences[past])
        return self._detectors[key]


def _consecutive(times: list[FloatArray]) -> FloatArray:
    """Return the times of several series one after another; each starts one after the end of the last, or later."""
    shifted: list[FloatArray] = []
    for one in times:
        begins_early = bool(shifted) and one[0] <= shifted[-1][-1]
        shifted.append(one - one[0] + shifted[-1][-1] + 1.0 if begins_early else one)
    return np.concatenate(shifted)
