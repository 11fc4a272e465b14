"""How many channels carry the torque (Trehan et al. 2025, figure 3b), judged on data later than what is ranked."""

from collections.abc import Sequence

import numpy as np

from shearloop.bank.arrays import FloatArray, IntArray
from shearloop.bank.estimation.fitting_regressor import STRENGTHS
from shearloop.bank.estimation.regressors import Ridge, best_strength, later_splits, ranked_channels


def accuracy_over_channels(
    past: tuple[FloatArray, FloatArray], future: tuple[FloatArray, FloatArray], counts: Sequence[int]
) -> dict[int, float]:
    """Return, for each count of best channels, r between a ridge's predictions and the truth on the future.

    past and future are (n, d) differences with their (n,) values. Channels are ranked, and the strength chosen, on the
    past alone.
    """
    differences, values = past
    order = ranked_channels(differences, values)
    splits = list(later_splits(len(values)))
    found = {}
    for count in counts:
        best = differences[:, order[:count]]

        def error(strength: float, rows: IntArray, later: IntArray, best: FloatArray = best) -> float:
            ridge = Ridge.fit(best[rows], values[rows], strength)
            return float(((ridge.predict(best[later]) - values[later]) ** 2).mean())

        ridge = Ridge.fit(best, values, best_strength(STRENGTHS, error, splits))
        found[count] = float(np.corrcoef(ridge.predict(future[0][:, order[:count]]), future[1])[0, 1])
    return found
