"""Finds the time of a step in curves of any rate. Values and times in, times out."""

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from shearloop.bank.arrays import FloatArray

# Times in ns and values.
Curve = Sequence[tuple[int, float]]
# A step this many standard deviations of its own statistic above noise is no accident.
_SIGMAS = 10.0
# A rise is sought among ramps: their middles in steps of this time, their lengths in parts of the longest one.
_RESOLUTION_S = 0.002
_PARTS_OF_RISE = (1 / 30, 1 / 12, 1 / 6, 1 / 3, 2 / 3, 1.0)


def middle_s(curve: Curve, before: float, after: float) -> float:
    """Return the middle in s of a rise from one level to another: where a step of the same area would be.

    A mean over each conversion does not move it, so that curves of different rates can be compared.
    """
    area_s = sum(
        (later_ns - earlier_ns) / 1e9 * (0.5 * (one + other) - before) / (after - before)
        for (earlier_ns, one), (later_ns, other) in pairwise(curve)
    )
    return curve[-1][0] / 1e9 - area_s


def step_index(values: FloatArray) -> int | None:
    """Return the first of (n, c) rows after a step, None where noise explains all differences.

    The split with the largest difference of the means of both sides, in units of their noise, is the step.
    """
    n, c = values.shape
    if n < 4:
        return None
    centred = values - values.mean(axis=0)
    total = float((centred**2).sum())
    sizes = np.arange(1, n)
    sums = np.cumsum(centred, axis=0)[:-1]
    between = (sums**2).sum(axis=1) * n / (sizes * (n - sizes))
    best = int(np.argmax(between))
    noise = (total - float(between[best])) / ((n - 2) * c)
    is_noise = between[best] <= noise * (c + _SIGMAS * math.sqrt(2 * c))
    return None if is_noise else best + 1


def step_s(curve: Curve, longest_rise_s: float) -> float | None:
    """Return the middle in s of a curve's rise or fall from one level to another; None if noise explains the curve.

    The rise is the ramp that explains most of the curve's variance. It takes at most `longest_rise_s`, and the curve
    shows each level for at least this time.
    """
    values = np.array([value for _, value in curve])
    split = step_index(values[:, None])
    if split is None:
        return None
    times_s = np.array([t_ns / 1e9 for t_ns, _ in curve])
    about_s = times_s[split]
    if about_s - times_s[0] <= longest_rise_s or times_s[-1] - about_s <= longest_rise_s:
        return None
    middles_s = np.arange(about_s - longest_rise_s, about_s + longest_rise_s, _RESOLUTION_S)
    centred = values - values.mean()
    best_s, most = about_s, 0.0
    for part in _PARTS_OF_RISE:
        rises = np.clip((times_s - middles_s[:, None]) / (part * longest_rise_s) + 0.5, 0.0, 1.0)
        rises -= rises.mean(axis=1, keepdims=True)
        explained = (rises @ centred) ** 2 / (rises**2).sum(axis=1)
        found = int(np.argmax(explained))
        if explained[found] > most:
            best_s, most = middles_s[found], explained[found]
    return float(best_s)


def scanned_step_s(times_s: FloatArray, rows: FloatArray) -> float | None:
    """Return when (n, c) rows changed from one level to another, where each value has a time of its own, (n, c) in s.

    A row that the step meets has the old level before it and the new one after it: the split in time that leaves the
    smallest differences to both levels is the step. None where noise explains all, or a level is not seen.
    """
    split = step_index(rows)
    if split is None or split < 2 or split > len(rows) - 2:
        return None
    before, after = rows[: split - 1].mean(axis=0), rows[split + 1 :].mean(axis=0)
    near = slice(split - 1, split + 1)
    # How much nearer each value is to the new level than to the old one.
    nearer = ((rows[near] - before) ** 2 - (rows[near] - after) ** 2).ravel()
    order = np.argsort(times_s[near].ravel(), kind="stable")
    moments_s = times_s[near].ravel()[order]
    # Of the values from each moment on.
    gains = np.cumsum(nearer[order][::-1])[::-1]
    # The values of one moment belong together.
    first = np.flatnonzero(np.diff(moments_s, prepend=-math.inf) > 0)
    chosen = int(np.argmax(gains[first]))
    if chosen == 0:
        return float(moments_s[0])
    return float(0.5 * (moments_s[first[chosen]] + moments_s[first[chosen - 1]]))
