"""The fit of a diameter to the mean position of the gel in a grip, for the estimator of motion."""

import math
from collections.abc import Sequence

import numpy as np

from shearloop.bank.arrays import BoolArray, FloatArray
from shearloop.bank.channels import ChannelTable, smoothed_along_channels
from shearloop.estimation.defaults import BASELINE_FRAMES
from shearloop.estimation.estimator import MIN_LEFT, CalibrationRows
from shearloop.estimation.interval_fit import MIN_HALF_WIDTH
from shearloop.estimation.interval_regressor import IntervalRegressor, Intervals, ValueRange
from shearloop.estimation.ridge import Ridge
from shearloop.estimation.values import TWO_SIDED_95

# Directions of motion within recordings that the diameter's line shrinks, and the most frames that they are fitted to.
_N_NUISANCE, _MAX_FRAMES = 16, 500
# The tools differ along a direction where the positions vary by this factor more than their noise. At least this
# fraction of the variation along the clearest direction counts as the tools', at any noise.
_CLEAR, _MIN_FRACTION = 2.0, 0.2
# Centred positions have one direction less than their number; the last one is rounding.
_ROUNDING = 1e-9


def fit_cylinders(grips: Sequence[CalibrationRows], table: ChannelTable) -> IntervalRegressor:
    """Return the diameter's regressor on the mean of a grip, from recordings of one grip each, of three diameters or
    more.

    Its interval is the error on cylinders left out.
    """
    diameters = np.array([grip.diameter_mm[0] for grip in grips])
    reduction = _reduction(grips, table)
    reduced = [grip.position @ reduction for grip in grips]
    line = _fit_reduced(grips, reduced, reduction)
    squares = []
    for grip, diameter in zip(grips, diameters, strict=True):
        # Leave out all grips of this cylinder: another one would only confirm this diameter.
        kept = np.flatnonzero(diameters != diameter).tolist()
        if len(set(diameters[kept].tolist())) >= MIN_LEFT:
            rest = _fit_reduced([grips[i] for i in kept], [reduced[i] for i in kept], reduction)
            squares.append(float(((rest.predict(grip.mean_position) - diameter) ** 2).mean()))
    # Each recording counts once, which is too few for a quantile.
    half_width = max(TWO_SIDED_95 * math.sqrt(np.mean(squares)), MIN_HALF_WIDTH * float(np.ptp(diameters)))
    low, high = float(diameters.min()), float(diameters.max())
    intervals = Intervals(np.zeros(0), np.array([half_width]))
    return IntervalRegressor(line, intervals, ValueRange(low, high), line.mean, np.zeros(0))


def fit_line(grips: Sequence[CalibrationRows], table: ChannelTable) -> Ridge:
    """Return the line from a position to a diameter through grips of two diameters or more.

    The noise of the idle frame is constant within a recording, like the diameter, so a regression on single frames
    confuses the two. Here a recording counts as one position of known noise. Motion within recordings is shrunk, and
    the line uses only directions where positions differ by more than their noise, by the amount that they would
    differ without it (errors in variables, Fuller 1987). Averaging channels of one voltage and smoothing along
    neighbours, as the paper did with its cylinders, lowers the noise.
    """
    reduction = _reduction(grips, table)
    return _fit_reduced(grips, [grip.position @ reduction for grip in grips], reduction)


def _reduction(grips: Sequence[CalibrationRows], table: ChannelTable) -> FloatArray:
    """Return the (d, d) map that averages channels of one voltage and smooths along neighbours, on each side."""
    n_sides = grips[0].position.shape[1] // table.n_channels
    one_side = table.twin_means(smoothed_along_channels(np.eye(table.n_channels)))
    return np.asarray(np.kron(np.eye(n_sides), one_side))


def _fit_reduced(grips: Sequence[CalibrationRows], frames: Sequence[FloatArray], reduction: FloatArray) -> Ridge:
    """Return the line of `fit_line`; `frames` are the grips' positions times the reduction."""
    diameters = np.array([grip.diameter_mm[0] for grip in grips])
    positions = np.array([grip_frames.mean(axis=0) for grip_frames in frames])
    moved = np.concatenate([grip_frames - position for grip_frames, position in zip(frames, positions, strict=True)])
    moved = moved[:: 1 + len(moved) // _MAX_FRAMES]
    _, sizes, directions = np.linalg.svd(moved, full_matrices=False)
    n = max(min(_N_NUISANCE, int(np.count_nonzero(sizes)) - 1), 0)
    shrink = 1.0 - sizes[n] / sizes[:n]

    def whitened(rows: FloatArray) -> FloatArray:
        return np.asarray(rows - (rows @ directions[:n].T * shrink) @ directions[:n])

    frame_noise = float((whitened(moved) ** 2).sum()) / max(len(moved) - len(grips), 1)
    noise = frame_noise * (1.0 / BASELINE_FRAMES + float(np.mean([1.0 / len(grip_frames) for grip_frames in frames])))
    centred = whitened(positions - positions.mean(axis=0))
    squares, modes = np.linalg.eigh(centred @ centred.T)
    clear: BoolArray = squares > max(_CLEAR * noise, _ROUNDING * float(squares[-1]))
    clear[-1] = True
    squares, modes = squares[clear], modes[:, clear]
    # One recording under several diameters differs by rounding alone, and would give an arbitrarily steep line.
    least = _ROUNDING * noise + float(np.finfo(np.float64).eps * (positions**2).sum())
    true = np.maximum(squares - noise, _MIN_FRACTION * squares) + least
    along = centred.T @ (modes @ (modes.T @ (diameters - diameters.mean()) / true))
    mean = np.mean([grip.position.mean(axis=0) for grip in grips], axis=0)
    return Ridge(mean, reduction @ whitened(along), float(diameters.mean()), 0.0)
