"""What the bank and the mesh say of a difference: the paper's match, a better one, and an image.

`BestCell` is the paper's: the largest cross-correlation over all lags. `NearestCell` leaves the lag out and finds
instead once, at calibration, how the electrodes are numbered (`Registration`); frame and bank are smoothed alike along
the channels, as the paper did with its cylinders, the place is refined between the grid's cells, and the amplitude
is kept. `image_matrix` is the traditional way: one step of Gauss–Newton from the homogeneous conductivity, with the
NOSER prior (Cheney et al. 1990).
"""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol

import numpy as np

from shearloop.bank.arrays import FloatArray
from shearloop.bank.eit.bank_file import Bank
from shearloop.bank.eit.channels import CHANNELS, N_CHANNELS, N_ELECTRODES, smoothed_along_channels
from shearloop.bank.eit.pruned_matching import PrunedMatcher

if TYPE_CHECKING:
    from shearloop.bank.eit.mesh import Mesh

# A cell that scores within this of the best one makes a match ambiguous when it is further away than this in k (an
# eighth of the fingertip), or in sigma by this ratio.
_ALIKE, _FAR_K_CM, _FAR_SIGMA = 0.002, 0.55, 1.5
# Scores that are e times less likely to be the best than the best: chosen on synthetic and recorded slices, where from
# 0.0003 to 0.001 the error does not change and the largest hop falls to a fifth.
_NEARLY, _LEAST_WEIGHT = 0.0005, 1e-9
# A mean over a sampled Gaussian peak is its place if its standard deviation is 0.6 cells or more: if the weights reach
# as far as this share of the drop to the next cell. On a grid that is coarser than _COARSE that would be across the
# whole ridge, and a parabola through the maximum finds the place.
_RESOLVED, _COARSE = 0.7, 0.005
_PIXELS_ALONG = 12
_STEP = 1e-3


@dataclass(frozen=True, slots=True)
class BankMatch:
    """Where a difference lies in the bank; ambiguous says that another place, far away, fits as well."""

    k: float
    sigma: float
    log_amplitude: float
    score: float
    runner_up: float | None
    ambiguous: bool

    @property
    def features(self) -> FloatArray:
        """The numbers that torque and diameter are regressed on."""
        return np.array([self.k, self.sigma, self.sigma**2, self.log_amplitude])


class BankMatcher(Protocol):
    """Anything that finds a difference's place in the bank."""

    def locate(self, difference: FloatArray) -> BankMatch:
        """Return the place of a (896,) difference, whose sign does not matter."""


class BestCell:
    """The paper's method: the heatmap's maximum over all lags, found without the rest of the heatmap."""

    def __init__(self, bank: Bank) -> None:
        self._matcher = PrunedMatcher.from_bank(bank)

    def locate(self, difference: FloatArray) -> BankMatch:
        """Return the place of the heatmap's maximum."""
        found = self._matcher.match(difference)
        size = float(np.log(np.linalg.norm(difference)))
        return BankMatch(found.k, found.sigma, size, found.score, found.runner_up, ambiguous=False)


@dataclass(frozen=True, slots=True)
class Registration:
    """Which electrode of the model each of the board's is: e becomes rotation + e, or rotation − e when reflected.

    score and runner_up are the correlations of the idle frame with the homogeneous voltages, for this numbering and
    the best that is not the same by symmetry.
    """

    rotation: int
    reflected: bool
    score: float
    runner_up: float

    def model_channels(self) -> "np.ndarray[tuple[int], np.dtype[np.int64]]":
        """Return (896,) the number of the model's channel that each of the board's channels is."""
        sink, _, positive, negative = CHANNELS.T
        turn = -1 if self.reflected else 1

        def electrode(number: "np.ndarray[tuple[int], np.dtype[np.int64]]") -> FloatArray:
            return np.asarray((self.rotation + turn * number) % N_ELECTRODES)

        # A reflected pair is measured the other way round: the model's pair begins at what was its end.
        first = electrode(negative if self.reflected else positive)
        place = np.full((N_ELECTRODES, N_ELECTRODES), -1)
        place[sink, positive] = np.arange(N_CHANNELS)
        return np.asarray(place[electrode(sink).astype(int), first.astype(int)])


NOT_TURNED = Registration(0, reflected=False, score=1.0, runner_up=0.0)


def register(idle: FloatArray, homogeneous: FloatArray) -> Registration:
    """Return the numbering under which a (896,) idle frame's magnitudes go best with the homogeneous voltages'."""
    model, measured = np.abs(homogeneous), np.abs(idle)
    scores = {}
    for reflected in (False, True):
        for rotation in range(N_ELECTRODES):
            turned = Registration(rotation, reflected, 0.0, 0.0).model_channels()
            scores[rotation, reflected] = float(np.corrcoef(model[turned], measured)[0, 1])
    best = max(scores, key=lambda key: (round(scores[key], 9), -key[0]))
    # Half a turn swaps the two ends of every injection and changes no magnitude of a symmetric tip.
    other = [score for key, score in scores.items() if key[1] != best[1] or (key[0] - best[0]) % 16]
    return Registration(best[0], best[1], scores[best], max(other))


def settle_half_turn(found: Registration, touch: FloatArray, bank: Bank) -> Registration:
    """Return the numbering or its half turn, whichever places a touch in the bank better; idle frames cannot tell.

    touch (896,) is what a grip changed of the idle frame, in volts.
    """
    turned = replace(found, rotation=(found.rotation + N_ELECTRODES // 2) % N_ELECTRODES)
    scores = [NearestCell(bank, one).locate(touch).score for one in (found, turned)]
    return turned if scores[1] > scores[0] + _ALIKE else found


class NearestCell:
    """The improved match: no lags, the numbering found once, smoothed alike, a mean of cells that fit nearly alike."""

    def __init__(self, bank: Bank, registration: Registration, *, mean_of_alike: bool = True) -> None:
        self._coarse = _COARSE if mean_of_alike else -np.inf
        self._grids = (bank.k_grid, bank.sigma_grid)
        self._valid = np.asarray(bank.valid).ravel()
        signals = np.abs(bank.signals.reshape(-1, N_CHANNELS)[self._valid][:, registration.model_channels()])
        smooth = smoothed_along_channels(signals.astype(np.float64))
        self._norms = np.linalg.norm(smooth, axis=1)
        self._shapes = (smooth / self._norms[:, None]).astype(np.float32)
        self._cells = np.flatnonzero(self._valid)

    def locate(self, difference: FloatArray) -> BankMatch:
        """Return the refined place of the best cell."""
        (x,) = smoothed_along_channels(np.abs(difference)[None])
        norm = float(np.linalg.norm(x))
        scores = np.full(len(self._valid), -np.inf)
        scores[self._cells] = self._shapes @ (x / norm).astype(np.float32)
        heatmap = scores.reshape(len(self._grids[0]), len(self._grids[1]))
        row, column = (int(i) for i in np.unravel_index(int(np.argmax(heatmap)), heatmap.shape))
        best = float(heatmap[row, column])
        if (drop := _drop(heatmap, row, column)) <= self._coarse:
            width = max(_NEARLY, _RESOLVED * drop)
            k, sigma, amplitude = self._mean_place(scores[self._cells], best, norm, width)
        else:
            k, sigma = _between(heatmap[:, column], row, self._grids[0]), _between(heatmap[row], column, self._grids[1])
            cell = int(np.searchsorted(self._cells, row * heatmap.shape[1] + column))
            amplitude = float(np.log(norm * best / self._norms[cell]))
        ratio = np.abs(np.log(self._grids[1] / self._grids[1][column]))
        far = (np.abs(self._grids[0] - self._grids[0][row]) > _FAR_K_CM)[:, None] | (ratio > np.log(_FAR_SIGMA))
        runner_up = float(heatmap[far].max()) if far.any() and np.isfinite(heatmap[far]).any() else None
        return BankMatch(k, sigma, amplitude, best, runner_up, runner_up is not None and best - runner_up < _ALIKE)

    def _mean_place(self, scores: FloatArray, best: float, norm: float, width: float) -> tuple[float, float, float]:
        """Return k, σ and log amplitude as means over the cells that score nearly as well as the best.

        The maximum itself hops from ridge to ridge for the smallest change of a frame; a mean with weights that follow
        from the scores cannot (docs/charts.md). Between cells it is finer than the grid.
        """
        weights = np.exp((scores - best) / width)
        near = np.flatnonzero(weights > _LEAST_WEIGHT)
        weights = weights[near] / weights[near].sum()
        row, column = np.divmod(self._cells[near], len(self._grids[1]))
        k = float(weights @ self._grids[0][row])
        sigma = float(np.exp(weights @ np.log(self._grids[1][column])))
        return k, sigma, float(weights @ np.log(norm * scores[near] / self._norms[near]))


def image_matrix(mesh: "Mesh", smoothing: float = 0.05) -> FloatArray:
    """Return the (p, 896) matrix from a difference of voltages to the change of p pixels' log conductivity.

    One Gauss–Newton step with J by central differences of whole pixels, and NOSER's prior: (JᵀJ + smoothing · mean ·
    diag(JᵀJ))⁻¹ Jᵀ. Pixels are squares of the mesh's bounding box with at least one triangle.
    """
    # Here, and not above: what only fitting needs costs the daemon neither memory nor time to start.
    from shearloop.bank.eit.forward import ForwardModel

    model = ForwardModel(mesh)
    centres = mesh.nodes[mesh.triangles].mean(axis=1)
    low, high = mesh.nodes.min(axis=0), mesh.nodes.max(axis=0)
    size = float((high - low).max()) / _PIXELS_ALONG
    _, pixel = np.unique(np.floor((centres - low) / size).astype(np.int64) @ [1, 1000], return_inverse=True)
    columns = []
    for one in range(int(pixel.max()) + 1):
        step = np.where(pixel == one, _STEP, 0.0)
        columns.append((model.voltages(1.0 + step) - model.voltages(1.0 - step)) / (2 * _STEP))
    jacobian = np.array(columns).T
    normal = jacobian.T @ jacobian
    prior = np.diag(np.diag(normal)) * smoothing
    return np.asarray(np.linalg.solve(normal + prior, jacobian.T))


def _drop(heatmap: FloatArray, row: int, column: int) -> float:
    """Return how much lower the neighbours of a heatmap's maximum score, along the steeper of its two axes."""
    around = np.pad(heatmap, 1, constant_values=-np.inf)[row : row + 3, column : column + 3]
    drops = [around[1, 1] - pair[np.isfinite(pair)] for pair in (around[[0, 2], 1], around[1, [0, 2]])]
    return max((float(drop.mean()) for drop in drops if len(drop)), default=0.0)


def _between(scores: FloatArray, i: int, grid: FloatArray) -> float:
    """Return where a parabola through a maximum and its neighbours has its top."""
    if i in (0, len(grid) - 1) or not np.isfinite(scores[[i - 1, i + 1]]).all():
        return float(grid[i])
    bend = float(scores[i - 1] - 2 * scores[i] + scores[i + 1])
    shift = 0.5 * float(scores[i - 1] - scores[i + 1]) / bend if bend < 0 else 0.0
    return float(grid[i] + shift * (grid[1] - grid[0]))
