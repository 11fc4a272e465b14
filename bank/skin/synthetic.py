"""A skin that never was: the membrane under the paper's protocols, with errors of known size put in.

What the estimators of `statistics` find in its recordings is held against what was put in. Randomness comes from
the generator that is passed in.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.stats import norm

from shearloop.bank.arrays import FloatArray
from shearloop.bank.skin import statistics
from shearloop.bank.skin.membrane import UNSTRETCHED, Membrane


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
class Figures:
    """The figures of a skin that a bench measures; the defaults are the paper's.

    The noise floor and the 95 % prediction interval in N, the drift (std over an hour) and the largest response to
    2 N of normal force as responses, the relative change of sensitivity per kelvin (less than 2 % over 15 K).
    """

    noise_floor_n: float = 0.0016
    prediction_half_width_n: float = 0.0802
    drift_std: float = 1.48e-4
    crosstalk: float = 1.24e-4
    sensitivity_per_k: float = 0.02 / 15


def recover(membrane: Membrane, put_in: Figures, rng: np.random.Generator) -> Figures:
    """Return what the estimators find in recordings made with the figures put in.

    The recordings: ten minutes at constant load (10 Hz), 20 loadings from −1 N to 1 N each read once at every
    0.1 N, one hour at 0.01 Hz, normal forces up to 2 N without shear (a minute each, averaged), and 20 loadings
    each at 25 °C and 40 °C, the readings averaged over 1 s as in the paper.
    """
    sensitivity = membrane.gauge_factor / membrane.axial_stiffness_n
    noise = put_in.noise_floor_n * sensitivity

    time_s = np.arange(6000) / 10
    still = 0.5 * sensitivity + rng.normal(0, noise, len(time_s))

    shear_n = np.tile(np.concatenate([-loading(1.0)[::-1], [0.0], loading(1.0)]), 20)
    scatter = put_in.prediction_half_width_n / norm.ppf(0.975) * sensitivity
    scattered = shear_n * sensitivity + rng.normal(0, scatter, len(shear_n))
    line = statistics.fit_line(shear_n, scattered)

    hour_s = np.arange(0, 3600, 100.0)
    wandering = 0.15 * sensitivity + rng.normal(0, put_in.drift_std, len(hour_s))

    normal_n = np.array([0.5, 1.0, 1.5, 2.0])
    pressed = put_in.crosstalk * normal_n / 2 + rng.normal(0, noise / np.sqrt(600), len(normal_n))

    def at_temperature(celsius: float) -> tuple[FloatArray, FloatArray]:
        factor = sensitivity * (1 + put_in.sensitivity_per_k * (celsius - 25.0))
        return shear_n, shear_n * factor + rng.normal(0, noise / np.sqrt(10), len(shear_n))

    return Figures(
        noise_floor_n=statistics.noise_floor_n(time_s, still, sensitivity),
        prediction_half_width_n=line.prediction_half_width_n(0.0),
        drift_std=statistics.drift(hour_s, wandering, sensitivity).std,
        crosstalk=statistics.crosstalk(normal_n, pressed, sensitivity).largest,
        sensitivity_per_k=statistics.temperature_sensitivity_per_k(
            at_temperature(25.0), at_temperature(40.0), 25.0, 40.0
        ),
    )
