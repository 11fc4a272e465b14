"""A skin's figures of merit by the paper's definitions, and synthetic recordings to test their estimators.

Noise, dynamic range, precision, drift, crosstalk and temperature: each function takes recorded arrays and returns
numbers. Responses follow equation (1), forces are in N.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.stats import norm
from scipy.stats import t as student

from shearloop.bank.arrays import FloatArray
from shearloop.bank.errors import CalibrationError
from shearloop.bank.skin.membrane import UNSTRETCHED, Membrane


def origin_slope(shear_n: FloatArray, response: FloatArray) -> float:
    """Return Σxy/Σx², the slope in 1/N of the straight line through the origin.

    The sensitivity of the paper's table 1: over one loading from zero in equal steps up to the normal force (at most
    1.2 N), deadband included. It is about μ F_n Σx/Σx² smaller than the slope beyond the deadband.
    """
    squares = float(shear_n @ shear_n)
    if not squares > 0:
        raise CalibrationError("A sensitivity needs at least one response at a shear force other than zero.")
    return float(shear_n @ response) / squares


def noise_floor_n(time_s: FloatArray, response: FloatArray, sensitivity_per_n: float, window_s: float = 1.0) -> float:
    """Return the standard deviation within windows of 1 s at constant load, in N; variances are pooled over windows.

    A last window that is not full is left out. Raises CalibrationError where no window holds two values.
    """
    window = np.floor((time_s - time_s[0]) / window_s + 1e-9).astype(np.int64)
    counts = np.bincount(window)
    full = np.flatnonzero((counts >= 2) & (counts >= 0.9 * np.median(counts)))
    if not full.size:
        raise CalibrationError(f"The noise floor needs at least two responses within {window_s} s; record faster.")
    squares = sum(float(np.var(response[window == i]) * counts[i]) for i in full)
    return math.sqrt(squares / float((counts[full] - 1).sum())) / sensitivity_per_n


def dynamic_range_bits(full_range_n: float, noise_floor_n: float) -> float:
    """Return log₂ of the largest force over the noise floor."""
    return math.log2(full_range_n / noise_floor_n)


@dataclass(frozen=True, slots=True)
class LineFit:
    """A straight calibration line, response = offset + slope · force, and its scatter."""

    slope_per_n: float
    offset: float
    scatter: float
    n: int
    mean_n: float
    spread_n2: float

    def prediction_half_width_n(self, shear_n: float, confidence: float = 0.95) -> float:
        """Return ± the interval (N) of a new single force read off the line near `shear_n`.

        t(n−2) · s / slope · √(1 + 1/n + (x − x̄)² / Σ(x − x̄)²).
        """
        quantile = float(student.ppf((1 + confidence) / 2, self.n - 2))
        widening = 1 + 1 / self.n + (shear_n - self.mean_n) ** 2 / self.spread_n2
        return quantile * self.scatter / abs(self.slope_per_n) * math.sqrt(widening)


def fit_line(shear_n: FloatArray, response: FloatArray) -> LineFit:
    """Return the least-squares line of at least three responses; raises CalibrationError for fewer."""
    n = len(shear_n)
    spread = float(np.var(shear_n) * n)
    if n < 3 or not spread > 0:
        raise CalibrationError("A calibration line needs at least three responses, at more than one shear force.")
    slope, offset = (float(value) for value in np.polyfit(shear_n, response, 1))
    left = response - offset - slope * shear_n
    scatter = math.sqrt(float(left @ left) / (n - 2))
    return LineFit(slope, offset, scatter, n, float(shear_n.mean()), spread)


def drift_std(response: FloatArray) -> float:
    """Return the standard deviation of the responses at constant load; the paper records one hour at 0.01 Hz."""
    if len(response) < 3:
        raise CalibrationError("Drift needs at least three responses at constant load; the paper's hour has 36.")
    return float(np.std(response, ddof=1))


def temperature_sensitivity_per_k(
    cold: tuple[FloatArray, FloatArray], hot: tuple[FloatArray, FloatArray], cold_c: float, hot_c: float
) -> float:
    """Return the relative change of sensitivity per kelvin, from (shear_n, response) at two temperatures in °C."""
    if hot_c == cold_c:
        raise CalibrationError("Temperature sensitivity needs two loadings at different temperatures.")
    ratio = fit_line(*hot).slope_per_n / fit_line(*cold).slope_per_n
    return (ratio - 1) / (hot_c - cold_c)


def loading(up_to_n: float, step_n: float = 0.1) -> FloatArray:
    """Return the paper's shear forces: from the first step to `up_to_n`, without zero."""
    return np.arange(1.0, round(up_to_n / step_n) + 1) * step_n


def loop(amplitude_n: float, step_n: float = 0.1) -> FloatArray:
    """Return a whole cycle: from the first step to the amplitude, to its negative, and back to the amplitude."""
    n = round(amplitude_n / step_n)
    return np.concatenate([np.arange(1.0, n), np.arange(n, -n, -1), np.arange(-n, n + 1)]) * step_n


def responses(membrane: Membrane, shear_n: Iterable[float], normal_n: float) -> FloatArray:
    """Return the membrane's responses along a path of shear forces, from the unstretched skin."""
    state, found = UNSTRETCHED, []
    for shear in shear_n:
        state = membrane.step(state, float(shear), normal_n)
        found.append(membrane.response(state))
    return np.array(found)


@dataclass(frozen=True, slots=True)
class SkinFigures:
    """The figures that a bench measures; the defaults are the paper's.

    The noise floor and the 95 % prediction interval in N; the drift (std over an hour) and the largest response to 2 N
    of normal force, as responses; the relative change of sensitivity per kelvin (less than 2 % over 15 K).
    """

    noise_floor_n: float = 0.0016
    prediction_half_width_n: float = 0.0802
    drift_std: float = 1.48e-4
    crosstalk: float = 1.24e-4
    sensitivity_per_k: float = 0.02 / 15


def estimated_figures(membrane: Membrane, true: SkinFigures, rng: np.random.Generator) -> SkinFigures:
    """Return the estimates from synthetic recordings of a skin with these true figures.

    The recordings: ten minutes at constant load (10 Hz), 20 loadings from −1 N to 1 N each read once at every 0.1 N,
    one hour at 0.01 Hz, normal forces up to 2 N without shear (a minute each, averaged), and 20 loadings each at 25 °C
    and 40 °C, averaged over 1 s as in the paper.
    """
    sensitivity = membrane.gauge_factor / membrane.axial_stiffness_n
    noise = true.noise_floor_n * sensitivity

    time_s = np.arange(6000) / 10
    still = 0.5 * sensitivity + rng.normal(0, noise, len(time_s))

    shear_n = np.tile(np.concatenate([-loading(1.0)[::-1], [0.0], loading(1.0)]), 20)
    scatter = true.prediction_half_width_n / norm.ppf(0.975) * sensitivity
    line = fit_line(shear_n, shear_n * sensitivity + rng.normal(0, scatter, len(shear_n)))

    wandering = 0.15 * sensitivity + rng.normal(0, true.drift_std, 36)

    normal_n = np.array([0.5, 1.0, 1.5, 2.0])
    pressed = true.crosstalk * normal_n / 2 + rng.normal(0, noise / np.sqrt(600), len(normal_n))

    def at_temperature(celsius: float) -> tuple[FloatArray, FloatArray]:
        factor = sensitivity * (1 + true.sensitivity_per_k * (celsius - 25.0))
        return shear_n, shear_n * factor + rng.normal(0, noise / np.sqrt(10), len(shear_n))

    return SkinFigures(
        noise_floor_n=noise_floor_n(time_s, still, sensitivity),
        prediction_half_width_n=line.prediction_half_width_n(0.0),
        drift_std=drift_std(wandering),
        crosstalk=float(abs(pressed).max()),
        sensitivity_per_k=temperature_sensitivity_per_k(at_temperature(25.0), at_temperature(40.0), 25.0, 40.0),
    )
