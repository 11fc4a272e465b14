"""Groups of measurements of one torque level: by their place in repeated series, or by k-means."""

from dataclasses import dataclass

import numpy as np
from scipy.cluster.vq import kmeans2

from shearloop.bank.arrays import FloatArray, IntArray
from shearloop.bank.errors import CalibrationError

# A fall by more than this share of the whole range begins a new series.
_RESTART_SHARE = 0.5
# This share of a series' steps must rise: noise may swap neighbouring levels.
_RISING_SHARE = 0.8
# k-means runs from this many starts, and the tightest groups are kept.
_STARTS = 20


@dataclass(frozen=True, slots=True, eq=False)
class RepeatedSeries:
    """Repeats of one rising series: the repeat and the level (n,) of each measurement, from 0.

    A repeat may lack levels.
    """

    repeat: IntArray
    level: IntArray


def place_in_series(values: FloatArray) -> RepeatedSeries | None:
    """Return the places of (n,) values, in order of time, that repeat one rising series; None where they do not.

    A series restarts where the value falls by more than half of the whole range. The longest series have all levels.
    The values of a shorter one go, in their order, to the levels with the nearest means over the longest, in the sum of
    squares. There must be two series, of three levels or more.
    """
    falls = np.diff(values) < -_RESTART_SHARE * np.ptp(values)
    repeat = np.concatenate([[0], np.cumsum(falls)]).astype(np.int64)
    length = np.bincount(repeat)
    steps = np.diff(values)[~falls]
    if len(length) < 2 or length.max() < 3 or np.mean(steps > 0) < _RISING_SHARE:
        return None
    complete = [values[repeat == each] for each in np.flatnonzero(length == length.max())]
    means = np.mean(complete, axis=0)
    level = np.empty(len(values), dtype=np.int64)
    for each in range(len(length)):
        members = np.flatnonzero(repeat == each)
        level[members] = _rising_levels((values[members, None] - means) ** 2)
    return RepeatedSeries(repeat, level)


def _rising_levels(cost: FloatArray) -> IntArray:
    """Return the rising levels (n,) of n values with the least total of an (n, m) cost."""
    n, m = cost.shape
    # least[i, j] is the least cost of the first i values on the first j levels.
    least = np.full((n + 1, m + 1), np.inf)
    least[0] = 0.0
    for i in range(1, n + 1):
        for j in range(i, m + 1):
            least[i, j] = min(least[i, j - 1], least[i - 1, j - 1] + cost[i - 1, j - 1])
    levels, j = np.empty(n, dtype=np.int64), m
    for i in range(n, 0, -1):
        while least[i, j - 1] == least[i, j]:
            j -= 1
        j -= 1
        levels[i - 1] = j
    return levels


def kmeans_groups(points: FloatArray, n_groups: int, seed: int = 0) -> IntArray:
    """Return the group of each of (n, d) points, numbered from 0 by the mean of the first coordinate.

    Coordinates are scaled to the same spread. The same points and seed give the same groups. Raises CalibrationError
    when there are fewer distinct points than groups.
    """
    distinct = len(np.unique(points, axis=0))
    if not 1 <= n_groups <= distinct:
        raise CalibrationError(f"{distinct} distinct points cannot be sorted into {n_groups} groups")
    spread = points.std(axis=0)
    scaled = points / np.where(spread > 0, spread, 1.0)
    generator = np.random.default_rng(seed)
    best, least = np.zeros(len(points), dtype=np.int64), np.inf
    for _ in range(_STARTS):
        start = np.unique(scaled, axis=0)[generator.choice(distinct, n_groups, replace=False)]
        centres, labels = kmeans2(scaled, start, iter=100, minit="matrix", missing="raise")
        distance = float(((scaled - centres[labels]) ** 2).sum())
        if distance < least:
            best, least = labels.astype(np.int64), distance
    order = np.argsort(group_means(points[:, 0], best))
    renumbered = np.empty(n_groups, dtype=np.int64)
    renumbered[order] = np.arange(n_groups)
    return renumbered[best]


def group_means(values: FloatArray, groups: IntArray) -> FloatArray:
    """Return the mean of (n,) values in each group, by rising number of the groups that have members."""
    _, member = np.unique(groups, return_inverse=True)
    means: FloatArray = np.bincount(member, values) / np.bincount(member)
    return means
