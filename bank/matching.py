"""Matching a measured difference against a bank: the paper's heatmap and its maximum.

Trehan et al. 2025, section 2: the heatmap holds, for every k and σ, the largest normalised cross-correlation between
|frame − homogeneous frame| and |simulated signal| over all lags along the channels. Its maximum gives k and σ. This
module is the reference in float64; `pruned_matching` is faster and is tested against it.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike
from scipy import fft
from scipy.special import chdtri

from shearloop.bank.arrays import BoolArray, Float32Array, FloatArray, IntArray
from shearloop.bank.bank_file import Bank
from shearloop.bank.errors import MatchingError
from shearloop.words import counted

# Scores closer than this are equal up to rounding: the first cell in (k, σ) order wins.
TIE = 1e-12
# Cells this near to the maximum, in k or in σ, belong to its peak and are no runner-up.
RUNNER_UP_RADIUS = 5
# Fraction of pure noise frames that pass as a signal: at 1.85 frames/s, one in about six days.
FALSE_ALARM = 1e-6
# Cells scored at a time: with 896 channels, 1024 × 897 complex numbers and their correlations take 30 MB.
CHUNK_CELLS = 1024


@dataclass(frozen=True, slots=True)
class Match:
    """A heatmap's maximum, and the best score outside its neighbourhood (None where no cell lies outside).

    cell is (row of k, column of σ). A runner_up as good as score means that the frame fits two places of the bank.
    """

    k: float
    sigma: float
    cell: tuple[int, int]
    score: float
    runner_up: float | None
    runner_up_cell: tuple[int, int] | None


class Matcher(ABC):
    """Scores differences against all valid cells of a bank; keeps no state between calls."""

    # The basis model, the identity and the geometry of the bank that it was made from.
    model = identity = geometry_hash = ""

    def __init__(self, signals: Float32Array, valid: BoolArray, k_grid: FloatArray, sigma_grid: FloatArray) -> None:
        """Take (K, S, n) difference signals, (K, S) validity, and the (K,) and (S,) grids.

        Signals are not copied; invalid cells' signals are never read. Raises MatchingError when no cell is valid, or a
        valid cell has no signal.
        """
        if not valid.any():
            raise MatchingError("no cell of the bank is valid: choose k and σ where the conductivity stays positive")
        self.k_grid = k_grid
        self.sigma_grid = sigma_grid
        self.valid = valid
        # A plain array: indexing a memory map is slow.
        self.n_channels = signals.shape[2]
        self._signals = np.asarray(signals).reshape(-1, self.n_channels)
        self._cells = np.flatnonzero(valid)

    @classmethod
    def from_bank(cls, bank: Bank) -> Self:
        """Return the matcher of an opened bank."""
        made = cls(bank.signals, bank.valid, bank.k_grid, bank.sigma_grid)
        made._name_bank(bank)
        return made

    def _name_bank(self, bank: Bank) -> None:
        self.model, self.identity, self.geometry_hash = bank.model, bank.identity, bank.geometry_hash

    def heatmap(self, difference: ArrayLike) -> FloatArray:
        """Return the (K, S) scores, 0 to 1, of one (n,) difference; NaN in invalid cells. Errors as `heatmaps`."""
        found: FloatArray = self.heatmaps(np.asarray(difference)[None])[0]
        return found

    def heatmaps(self, differences: ArrayLike) -> FloatArray:
        """Return the (m, K, S) scores of (m, n) differences; their sign and scale do not matter.

        Raises MatchingError for a wrong shape, a value that is not finite, and a difference of zeros (ask
        `signal_above_noise` first).
        """
        frames = unit_magnitudes(differences, self.n_channels)
        maps = np.full((len(frames), self.valid.size), np.nan)
        for cells in in_chunks(self._cells):
            maps[:, cells] = self._scores(frames, self._unit_signals(cells))
        # Rounding may carry a perfect fit past 1 by one bit.
        return np.clip(maps, 0.0, 1.0, out=maps).reshape(-1, *self.valid.shape)

    def match(self, difference: ArrayLike) -> Match:
        """Return the maximum of one (n,) difference's heatmap and its runner-up. Errors as `heatmaps`."""
        return best_match(self.heatmap(difference), self.k_grid, self.sigma_grid)

    def _unit_signals(self, cells: IntArray) -> FloatArray:
        magnitudes = self._magnitudes(cells)
        norms = np.linalg.norm(magnitudes, axis=1, keepdims=True)
        # Below the smallest normal number float32 has lost its digits.
        if not (np.isfinite(norms) & (norms > np.finfo(np.float32).tiny)).all():
            raise MatchingError("a valid cell of the bank has no finite signal; build the bank again")
        return np.asarray(magnitudes / norms)

    def _magnitudes(self, cells: IntArray) -> FloatArray:
        return np.abs(self._signals.take(cells, axis=0), dtype=np.float64)

    @abstractmethod
    def _scores(self, frames: FloatArray, signals: FloatArray) -> FloatArray:
        """Return the (m, c) scores of (m, n) frames and (c, n) signals, both magnitudes of norm 1."""


class ReferenceMatcher(Matcher):
    """The paper's score: the largest cross-correlation, over all 2n − 1 lags, of two magnitudes of norm 1."""

    def _scores(self, frames: FloatArray, signals: FloatArray) -> FloatArray:
        # Padded to all lags, nothing wraps around. Padding may add a lag without overlap, where the product is 0.
        n = fft.next_fast_len(2 * self.n_channels - 1, real=True)
        spectra = fft.rfft(signals, n)
        scores = np.empty((len(frames), len(signals)))
        for row, spectrum in enumerate(fft.rfft(frames, n)):
            scores[row] = fft.irfft(spectrum * np.conj(spectra), n).max(axis=1)
        return scores


class ZeroLagMatcher(Matcher):
    """The cosine of the angle between two magnitudes: the cross-correlation at lag 0 alone.

    Bank and board number the channels alike; any other lag compares voltages of different electrodes.
    """

    def _scores(self, frames: FloatArray, signals: FloatArray) -> FloatArray:
        return np.asarray(frames @ signals.T)


def in_chunks(cells: IntArray, size: int = CHUNK_CELLS) -> list[IntArray]:
    """Return (n,) cells in parts of at most `size`."""
    return np.split(cells, range(size, len(cells), size))


def unit_magnitudes(differences: ArrayLike, n_channels: int) -> FloatArray:
    """Return the magnitudes of (m, n) differences, each row of norm 1.

    Raises MatchingError for a wrong shape, a value that is not finite, and a row of zeros.
    """
    values = np.asarray(differences, dtype=np.float64)
    if values.ndim != 2 or values.shape[1] != n_channels:
        raise MatchingError(f"a difference has {n_channels} channels; the array has shape {values.shape}")
    magnitudes = np.abs(values)
    # Scaled by the largest first, so that squares neither overflow nor vanish.
    largest = magnitudes.max(axis=1, keepdims=True, initial=0.0)
    if not np.isfinite(largest).all():
        wrong = int((~np.isfinite(values)).sum())
        raise MatchingError(f"the difference has {counted(wrong, 'channel that is', 'channels that are')} not finite")
    if not (largest > 0).all():
        raise MatchingError("the difference is zero in all channels: there is nothing to match")
    magnitudes /= largest
    return np.asarray(magnitudes / np.linalg.norm(magnitudes, axis=1, keepdims=True))


def signal_above_noise(difference: FloatArray, noise_std: FloatArray) -> str | None:
    """Return why an (n,) difference is no signal and must not be matched, or None where it exceeds the noise.

    noise_std (n,) is the difference's standard deviation from noise alone. For independent Gaussian noise
    Σ (difference/noise_std)² is χ² distributed with n degrees of freedom; a signal exceeds its quantile at
    1 − FALSE_ALARM.
    """
    with np.errstate(over="ignore"):  # infinite energy is still a signal
        energy = float(np.sum((difference / noise_std) ** 2))
    least = float(chdtri(len(difference), FALSE_ALARM))
    if energy > least:
        return None
    return (
        f"no signal above the noise: the difference is {np.sqrt(energy / len(difference)):.2f} times the noise, "
        f"and a signal needs {np.sqrt(least / len(difference)):.2f} times"
    )


def best_match(
    heatmap: FloatArray, k_grid: FloatArray, sigma_grid: FloatArray, radius: int = RUNNER_UP_RADIUS
) -> Match:
    """Return the maximum of a (K, S) heatmap and its runner-up; NaN cells are never returned.

    Of scores that tie (within TIE) the lowest flat index wins. The runner-up is the best cell more than `radius` cells
    away in k or in σ. Raises MatchingError where no cell is valid.
    """
    if heatmap.shape != (len(k_grid), len(sigma_grid)):
        raise MatchingError(f"the heatmap has shape {heatmap.shape}, the grids {len(k_grid)} k × {len(sigma_grid)} σ")
    best = _first_maximum(heatmap)
    if best is None:
        raise MatchingError("no cell of the heatmap is valid")
    row, column = best
    beyond = heatmap.copy()
    beyond[max(row - radius, 0) : row + radius + 1, max(column - radius, 0) : column + radius + 1] = np.nan
    runner_up = _first_maximum(beyond)
    return Match(
        k=float(k_grid[row]),
        sigma=float(sigma_grid[column]),
        cell=best,
        score=float(heatmap[best]),
        runner_up=None if runner_up is None else float(heatmap[runner_up]),
        runner_up_cell=runner_up,
    )


def _first_maximum(heatmap: FloatArray) -> tuple[int, int] | None:
    scores = np.where(np.isnan(heatmap), -np.inf, heatmap)
    largest = scores.max()
    if largest == -np.inf:
        return None
    row, column = np.unravel_index(int(np.argmax(scores >= largest - TIE)), scores.shape)
    return int(row), int(column)
