"""What fitting chooses by the estimator, for raw frames as for slices: its head, strengths, and place in the bank."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from shearloop.bank.arrays import FloatArray
from shearloop.bank.eit.bank_file import Bank
from shearloop.bank.estimation.bank_match import BankMatcher
from shearloop.bank.estimation.calibrated import NEEDS_BANK, Calibration, Name, locator_for
from shearloop.bank.estimation.fitting_regressor import STRENGTHS
from shearloop.bank.estimation.interval_regressor import Head
from shearloop.bank.estimation.regressors import Ridge

if TYPE_CHECKING:
    from shearloop.bank.eit.mesh import Mesh


@dataclass(frozen=True, slots=True)
class Physics:
    """What was known beforehand: the bank, and the mesh that an image is reconstructed on."""

    bank: Bank | None = None
    mesh: "Mesh | None" = None


def locator_of(calibration: Calibration, physics: Physics) -> BankMatcher | None:
    """Return what finds places in the bank, None for an estimator that does without."""
    if calibration.estimator not in NEEDS_BANK or physics.bank is None:
        return None
    return locator_for(calibration.estimator, physics.bank, calibration.registration)


def ks_of(name: Name, features: FloatArray) -> FloatArray:
    """Return the least and the largest k of (n, d) features, none for an estimator without a bank."""
    return np.array([features[:, 0].min(), features[:, 0].max()]) if name in NEEDS_BANK else np.zeros(0)


def ridge_for(name: Name) -> Callable[[FloatArray, FloatArray, float], Head]:
    """Return what fits a ridge to features: each in its own unit where they are places in the bank."""
    return Ridge.fit_scaled if name in NEEDS_BANK else Ridge.fit


def strengths_for(name: Name) -> tuple[float, ...]:
    """Return the strengths to choose from: none for the paper's polynomials, nor for curves."""
    return {"paper": (1e-9,), "fused": (0.0,)}.get(name, STRENGTHS)
