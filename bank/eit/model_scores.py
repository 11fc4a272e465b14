"""Scores of the basis models on measured differences: the ranking of Trehan et al. 2025, figure 5.

`envelope_score` is the paper's: the rank correlation of the envelopes of a raw difference and a simulated signal, at
the best circular shift. It is averaged over a few settings of models centred on the fingertip, because it jumps between
settings. `matching_scores` is the matcher's own: the largest normalised cross-correlation at the best of many settings.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import find_peaks
from scipy.stats import rankdata

from shearloop.bank.arrays import FloatArray
from shearloop.bank.eit.channels import N_CHANNELS
from shearloop.bank.eit.forward import ForwardModel
from shearloop.bank.eit.matching import ReferenceMatcher
from shearloop.bank.eit.models import conductivity
from shearloop.bank.errors import MatchingError

# As in the paper: peaks of an envelope are this many channels apart, and a moving average smooths it.
_PEAK_DISTANCE = 50
_AVERAGED = 5


class Setting(NamedTuple):
    """One k and σ of a model."""

    k: float
    sigma: float


def centred_settings(model: str, centre: float) -> list[Setting]:
    """Return settings of a model that is centred on the fingertip, in cm (modulated Gaussian: k in rad/cm)."""
    widths = {
        "step": [1.0],
        "linear": [2.0, 2.5, 3.0, 4.0, 6.0],
        "cut_linear": [2.0, 3.0, 4.0],
        "gaussian_derivative": [0.7, 0.8, 0.9, 1.0, 1.2, 1.5],
        "modulated_gaussian": [0.3, 0.4, 0.5],
    }[model]
    places = {"cut_linear": [1.0, 2.0, 3.0], "modulated_gaussian": [4.0, 5.0, 6.0]}.get(model, [centre])
    return [Setting(k, sigma) for k in places for sigma in widths]


def searched_settings(model: str, height: float) -> list[Setting]:
    """Return settings all over a fingertip of this height, in cm, to search for the best one."""
    up = (height * np.linspace(0.1, 0.9, 9)).tolist()
    places, widths = {
        "step": (up, [1.0]),
        "linear": (up, [2.5, 4.0, 6.0, 10.0]),
        "cut_linear": ([0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.4], [2.0, 3.0, 4.0]),
        "gaussian_derivative": (up, [0.65, 0.8, 1.0, 1.2, 1.5, 1.9, 2.5]),
        "modulated_gaussian": ([1.0, 2.0, 3.0, 4.0, 5.0, 6.0], [0.3, 0.4, 0.6, 0.9, 1.2]),
    }[model]
    return [Setting(k, sigma) for k in places for sigma in widths]


def simulated_signals(forward: ForwardModel, model: str, settings: Sequence[Setting]) -> FloatArray:
    """Return the (m, 896) difference signals of the settings whose conductivity is positive everywhere."""
    homogeneous = forward.homogeneous()
    cells = [conductivity(forward.mesh, model, k, sigma) for k, sigma in settings]
    signals = [forward.voltages(cell) - homogeneous for cell in cells if cell.min() > 0]
    return np.array(signals).reshape(-1, N_CHANNELS)


def envelope(magnitudes: FloatArray) -> FloatArray:
    """Return the (896,) smoothed curve over the peaks of (896,) magnitudes, the last channel followed by the first.

    Raises MatchingError where there are no two peaks to carry it.
    """
    thrice = np.tile(magnitudes, 3)
    peaks, _ = find_peaks(thrice, distance=_PEAK_DISTANCE)
    if len(peaks) < 2:
        raise MatchingError("a signal without peaks has no envelope")
    curve = CubicSpline(peaks, thrice[peaks])(np.arange(N_CHANNELS, 2 * N_CHANNELS))
    return _moving_average(curve)


def envelope_score(difference: FloatArray, signal: FloatArray) -> float:
    """Return Spearman's correlation of the envelopes of two (896,) signals, the largest over all circular shifts.

    The difference is smoothed beforehand. Raises MatchingError as `envelope` does.
    """
    a, b = _ranks(envelope(_moving_average(np.abs(difference)))), _ranks(envelope(np.abs(signal)))
    correlations = np.fft.irfft(np.fft.rfft(a) * np.conj(np.fft.rfft(b)), N_CHANNELS)
    return float(correlations.max())


def mean_envelope_score(difference: FloatArray, signals: FloatArray) -> float:
    """Return the mean of the envelope scores of (m, 896) signals, for one (896,) difference."""
    return float(np.mean([envelope_score(difference, signal) for signal in signals]))


def matching_scores(differences: FloatArray, signals: FloatArray) -> FloatArray:
    """Return the (n,) best scores, over (m, 896) signals and all lags, of (n, 896) differences."""
    m = len(signals)
    matcher = ReferenceMatcher(
        signals[:, None].astype(np.float32), np.ones((m, 1), dtype=np.bool_), np.arange(float(m)), np.zeros(1)
    )
    best: FloatArray = matcher.heatmaps(differences).max(axis=(1, 2))
    return best


def _moving_average(values: FloatArray) -> FloatArray:
    return np.asarray(np.mean([np.roll(values, shift) for shift in range(_AVERAGED)], axis=0))


def _ranks(values: FloatArray) -> FloatArray:
    """Return ranks of mean 0 and norm 1, so that their correlation is a sum of products."""
    ranks = rankdata(values) - (len(values) + 1) / 2
    return np.asarray(ranks / np.linalg.norm(ranks))
