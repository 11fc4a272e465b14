"""A tool's diameter from where the gel stands, calibrated on a few grips of known cylinders.

A diameter is the same all through a recording, and so is the noise of the recording's idle frame: a regression on
single frames takes the one for the other, parts its recordings perfectly, and reads the next grip far too near to their
mean (a cylinder of 10 mm on the played rig as 21). So a recording counts as one place, with a noise that is known; what
moves within a recording is looked away from; and the line goes along those directions only in which the places differ
by more than their noise, by as much as they would differ without it (errors in variables, Fuller 1987; principal
components). What opposite injections measure twice is averaged, and neighbouring channels are smoothed as the paper did
with its cylinders: the less noise there is, the more is left to tell diameters by.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from shearloop.bank.arrays import BoolArray, FloatArray
from shearloop.bank.eit.channels import N_CHANNELS, smoothed_along_channels
from shearloop.bank.eit.polynomial import TWO_SIDED_95
from shearloop.bank.estimation.interval_regressor import LEAST_HALF_WIDTH, Head, IntervalRegressor
from shearloop.bank.estimation.intervals import Intervals
from shearloop.bank.estimation.reciprocity import paired
from shearloop.bank.estimation.regressors import Ridge
from shearloop.bank.estimation.session_state import BASELINE_FRAMES

# Nothing holds a line back. Each ridge on single frames, which diameters were read from before, had a penalty.
_STRENGTH = 0.0
# Two diameters determine a line, which the recording that was left out is judged by.
LEAST_LEFT = 2
# Directions in which frames move within recordings, each of which counts no more than the next one does.
_N_NUISANCE = 16
# Frames that those directions are found from: more say no more, and take long.
_MOST_FRAMES = 500
# A direction is one of the tools' where the places differ by so many times what their noise explains …
_CLEAR = 2.0
# … and at least this share of how they differ in the clearest is taken for the tools', whatever their noise.
_LEAST_SHARE = 0.2
# Places about their mean have one direction less than there are of them: it is there by rounding alone.
_ROUNDING = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class Gripped:
    """A recording of one tool: its diameter, (n, d) differences to the idle frame, and (n, d) means over the grip.

    In units of noise, the channels of one side after those of another.
    """

    diameter_mm: float
    frames: FloatArray
    held: FloatArray


def fit_cylinders(grips: Sequence[Gripped]) -> IntervalRegressor:
    """Return how a diameter is read from the mean of a grip, given grips of three diameters or more.

    Its interval is as wide as grips of cylinders go astray that the line was not fitted to.
    """
    diameters = np.array([one.diameter_mm for one in grips])
    head = fit_line(grips)
    astray = []
    for one in grips:
        # Another grip of the same cylinder would vouch for this one, and for no tool between the cylinders.
        rest = [other for other in grips if other.diameter_mm != one.diameter_mm]
        if len({other.diameter_mm for other in rest}) >= LEAST_LEFT:
            astray.append(float(((fit_line(rest).predict(one.held) - one.diameter_mm) ** 2).mean()))
    # Each recording is one instance of a grip, however many frames it has: too few of them for a quantile.
    half_width = max(TWO_SIDED_95 * math.sqrt(np.mean(astray)), LEAST_HALF_WIDTH * float(np.ptp(diameters)))
    return IntervalRegressor(
        head, Intervals(np.zeros(0), np.array([half_width])), float(diameters.min()), float(diameters.max()),
        -np.inf, np.inf, misses_loads=False, mean_feature=head.mean, reach=np.zeros(0),
    )  # fmt: skip


def fit_line(grips: Sequence[Gripped]) -> Ridge:
    """Return the line from a place to a diameter through grips of two diameters or more."""
    diameters = np.array([one.diameter_mm for one in grips])
    seen = _reducing(grips[0].frames.shape[1] // N_CHANNELS)
    frames = [one.frames @ seen for one in grips]
    places = np.array([one.mean(axis=0) for one in frames])
    moved = np.concatenate([one - place for one, place in zip(frames, places, strict=True)])
    moved = moved[:: 1 + len(moved) // _MOST_FRAMES]
    _, sizes, directions = np.linalg.svd(moved, full_matrices=False)
    n = max(min(_N_NUISANCE, int(np.count_nonzero(sizes)) - 1), 0)
    shrink = 1.0 - sizes[n] / sizes[:n]

    def whitened(rows: FloatArray) -> FloatArray:
        return np.asarray(rows - (rows @ directions[:n].T * shrink) @ directions[:n])

    frame_noise = float((whitened(moved) ** 2).sum()) / max(len(moved) - len(grips), 1)
    noise = frame_noise * (1.0 / BASELINE_FRAMES + float(np.mean([1.0 / len(one) for one in frames])))
    apart = whitened(places - places.mean(axis=0))
    squares, ways = np.linalg.eigh(apart @ apart.T)
    told: BoolArray = squares > max(_CLEAR * noise, _ROUNDING * float(squares[-1]))
    told[-1] = True
    squares, ways = squares[told], ways[:, told]
    # Of recordings that are one under several diameters rounding would make a line that is infinitely steep.
    least = _ROUNDING * noise + math.sqrt(np.finfo(np.float64).tiny)
    true = np.maximum(squares - noise, _LEAST_SHARE * squares) + least
    along = apart.T @ (ways @ (ways.T @ (diameters - diameters.mean()) / true))
    everything = np.mean([one.frames.mean(axis=0) for one in grips], axis=0)
    return Ridge(everything, seen @ whitened(along), float(diameters.mean()), _STRENGTH)


def is_line(head: Head) -> bool:
    """Return whether a head is such a line, and not the ridge on single frames of an older calibration."""
    return isinstance(head, Ridge) and head.strength == _STRENGTH


def _reducing(n_sides: int) -> FloatArray:
    """Return the (m·896, m·448) matrix that smooths m sides' channels and averages what is measured twice."""
    return np.asarray(np.kron(np.eye(n_sides), paired(smoothed_along_channels(np.eye(N_CHANNELS)))))
