"""The fingertip's conductivity that an estimate stands for, by the bank's reduced-order model."""

from typing import Any

import numpy as np

from shearloop.bank.eit.fingertip import Fingertip
from shearloop.bank.eit.models import MODELS

# Heights at which the page is told the conductivity: finer than a pixel of its drawing.
HEIGHTS = 145


def profile(model: str, k: float, sigma: float, height_cm: float) -> list[float] | None:
    """Return the conductivity, relative to the untouched gel's, at HEIGHTS heights from bottom to top.

    None where the model is not known or the numbers are not of a conductivity (Trehan et al. 2025, equations 1 to 5).
    """
    if model not in MODELS or not (np.isfinite(k) and np.isfinite(sigma) and sigma > 0):
        return None
    y_cm = np.linspace(0.0, height_cm, HEIGHTS)
    with np.errstate(over="ignore", invalid="ignore"):
        values = 1.0 + MODELS[model].function(y_cm, k, sigma, height_cm / 2)
    return values.tolist() if np.isfinite(values).all() else None


def outline(fingertip: Fingertip) -> dict[str, Any]:
    """Return what the page draws of a fingertip's geometry, in cm."""
    return {
        "width_cm": fingertip.width_cm,
        "height_cm": fingertip.height_cm,
        "electrode_width_cm": fingertip.electrode_width_cm,
        "electrodes": [{"side": place.side, "centre_cm": place.centre_cm} for place in fingertip.electrodes],
    }
