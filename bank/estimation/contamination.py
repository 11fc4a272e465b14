"""What of something foreign a slice may hold unseen: `ContaminationTest`.

A tenth of a foreign frame moves a slice no further than its own drift does, so no guard can refuse it (docs/charts.md),
and its estimate has to say so itself. Stand-ins tell by how much: the mean of the calibration's slices with the
electrodes numbered from elsewhere, mixed into later slices, of which the guard of the earlier ones decides what passes.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from shearloop.bank.arrays import FloatArray, IntArray
from shearloop.bank.eit.channels import N_CHANNELS, N_ELECTRODES
from shearloop.bank.estimation.bank_match import Registration
from shearloop.bank.estimation.novelty import NoveltyDetector

# Every eighth of a turn, as it is and mirrored, but for the own numbering; the charts judge by other foreign frames.
# Of a few alone the outcome depends on which: single ones ask for half to twice as much as the median.
_NUMBERINGS = [(turn, mirrored) for turn in range(0, N_ELECTRODES, N_ELECTRODES // 8) for mirrored in (False, True)][1:]
# Of more than the last hardly any mixture passes.
_SHARES = (0.1, 0.2, 0.3)
# So many later slices of each origin are mixed with all of them: with twice as many the outcome is the same.
_MOST_LATER = 10
_ALL = np.ones(N_CHANNELS, dtype=np.bool_)


@dataclass(frozen=True, slots=True, eq=False)
class Passing:
    """The (q,) rows that were mixed with something, and of each mixture the (q, d) features and (q,) nearness."""

    rows: IntArray
    features: FloatArray
    nearness: FloatArray


class ContaminationTest:
    """Slices as guards of earlier ones see them, as they are and mixed with what they are not."""

    def __init__(self, differences: FloatArray, features_of: Callable[[FloatArray, int], FloatArray]) -> None:
        """Take (n, 896) differences in time order, and what makes (d,) features of one, given the row it was."""
        self._differences = differences
        self._features_of = features_of
        mean = differences.mean(axis=0)
        self._foreign = [
            mean[Registration(turn, mirrored, score=1.0, runner_up=0.0).model_channels()]
            for turn, mirrored in _NUMBERINGS
        ]
        self._guards: dict[bytes, NoveltyDetector] = {}
        self._features: dict[tuple[int, int, float], FloatArray] = {}

    def difficulty(self, past: IntArray, future: IntArray) -> FloatArray:
        """Return how much wider the intervals of (q,) later slices are, by a guard of the earlier ones."""
        guard = self._guard(past)
        return np.array([guard.widening(one, _ALL) for one in self._differences[future]])

    def passing(self, past: IntArray, future: IntArray) -> Passing:
        """Return the mixtures of later slices that a guard of the earlier ones lets pass."""
        guard = self._guard(past)
        chosen = future[np.unique(np.linspace(0, len(future) - 1, min(len(future), _MOST_LATER)).astype(int))]
        rows, features, nearness = [], [], []
        for row in chosen.tolist():
            for number, foreign in enumerate(self._foreign):
                for share in _SHARES:
                    mixed = (1 - share) * self._differences[row] + share * foreign
                    judged = guard.judge(mixed, _ALL)
                    if judged.why:
                        break
                    rows.append(row)
                    nearness.append(judged.nearness)
                    key = row, number, share
                    if key not in self._features:
                        self._features[key] = self._features_of(mixed, row)
                    features.append(self._features[key])
        return Passing(np.array(rows, dtype=np.int64), np.array(features), np.array(nearness))

    def _guard(self, past: IntArray) -> NoveltyDetector:
        key = past.tobytes()
        if key not in self._guards:
            self._guards[key] = NoveltyDetector.fit(self._differences[past])
        return self._guards[key]
