"""What a skin can tell, by the paper's definitions: noise, dynamic range, precision, drift, crosstalk, temperature.

Every function takes recorded arrays and returns numbers; responses are equation (1)'s, forces in N.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student

from shearloop.bank.arrays import FloatArray
from shearloop.bank.errors import CalibrationError


def origin_slope(shear_n: FloatArray, response: FloatArray) -> float:
    """Return Σxy/Σx², the slope in 1/N of the straight line through the origin.

    This is the sensitivity of the paper's table 1 as read here: over one loading from zero, in equal steps from the
    first one to the normal force (at most 1.2 N in the experiments), deadband included. It is therefore smaller
    than the slope beyond the deadband by about μ F_n Σx/Σx².
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
    usual = np.median(counts)
    full = np.flatnonzero((counts >= 2) & (counts >= 0.9 * usual))
    if not full.size:
        raise CalibrationError(f"The noise floor needs at least two responses within {window_s} s; record faster.")
    squares = sum(float(np.var(response[window == i]) * counts[i]) for i in full)
    return math.sqrt(squares / float((counts[full] - 1).sum())) / sensitivity_per_n


def dynamic_range_bits(full_range_n: float, noise_floor_n: float) -> float:
    """Return log₂ of the largest force over the noise floor."""
    return math.log2(full_range_n / noise_floor_n)


@dataclass(frozen=True, slots=True)
class LineFit:
    """A straight calibration line, response = offset + slope · force, and what it tells about a force."""

    slope_per_n: float
    offset: float
    scatter: float
    n: int
    mean_n: float
    spread_n2: float

    def prediction_half_width_n(self, shear_n: float, confidence: float = 0.95) -> float:
        """Return ± the interval (N) that holds a new single force read off the line near `shear_n`.

        t(n−2) · s / slope · √(1 + 1/n + (x − x̄)² / Σ(x − x̄)²).
        """
        quantile = float(student.ppf((1 + confidence) / 2, self.n - 2))
        widening = 1 + 1 / self.n + (shear_n - self.mean_n) ** 2 / self.spread_n2
        return quantile * self.scatter / abs(self.slope_per_n) * math.sqrt(widening)


def fit_line(shear_n: FloatArray, response: FloatArray) -> LineFit:
    """Return the least-squares line of at least three responses; raises CalibrationError for less."""
    n = len(shear_n)
    spread = float(np.var(shear_n) * n)
    if n < 3 or not spread > 0:
        raise CalibrationError("A calibration line needs at least three responses, at more than one shear force.")
    slope, offset = (float(value) for value in np.polyfit(shear_n, response, 1))
    left = response - offset - slope * shear_n
    scatter = math.sqrt(float(left @ left) / (n - 2))
    return LineFit(slope, offset, scatter, n, float(shear_n.mean()), spread)


@dataclass(frozen=True, slots=True)
class Drift:
    """How a response wanders at constant load: its standard deviation, in N too, and its trend in N per hour."""

    std: float
    std_n: float
    trend_n_per_h: float


def drift(time_s: FloatArray, response: FloatArray, sensitivity_per_n: float) -> Drift:
    """Return the drift over a recording at constant load; the paper's is one hour at 0.01 Hz, and gives the std."""
    if len(time_s) < 3:
        raise CalibrationError("Drift needs at least three responses at constant load; the paper's hour has 36.")
    std = float(np.std(response, ddof=1))
    trend = float(np.polyfit(time_s / 3600, response, 1)[0])
    return Drift(std, std / sensitivity_per_n, trend / sensitivity_per_n)


@dataclass(frozen=True, slots=True)
class Crosstalk:
    """The largest response to normal force alone, the same in N of shear, and N of shear per N of normal force."""

    largest: float
    largest_n: float
    slope_n_per_n: float


def crosstalk(normal_n: FloatArray, response: FloatArray, sensitivity_per_n: float) -> Crosstalk:
    """Return the crosstalk from responses to normal forces without shear."""
    largest = float(abs(response).max())
    slope = origin_slope(normal_n, response)
    return Crosstalk(largest, largest / sensitivity_per_n, slope / sensitivity_per_n)


def temperature_sensitivity_per_k(
    cold: tuple[FloatArray, FloatArray], hot: tuple[FloatArray, FloatArray], cold_c: float, hot_c: float
) -> float:
    """Return the relative change of sensitivity per kelvin, from (shear_n, response) at two temperatures in °C."""
    if hot_c == cold_c:
        raise CalibrationError("Temperature sensitivity needs two loadings at different temperatures.")
    ratio = fit_line(*hot).slope_per_n / fit_line(*cold).slope_per_n
    return (ratio - 1) / (hot_c - cold_c)
