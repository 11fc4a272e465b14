"""A quick calibration of the paper's estimator on made-up matches."""

from dataclasses import replace

import numpy as np

from shearloop.bank.arrays import FloatArray
from shearloop.estimation import Calibration
from shearloop.estimation.estimator import OutputModel
from shearloop.estimation.interval_fit import fit_interval_regressor

Points = tuple[FloatArray, FloatArray]


def paper_curve(bank_identity: str, *, torque: Points | None = None, diameter: Points | None = None) -> Calibration:
    """Return the curves through torque = (σ (n,) in cm, N·m (n,)) and diameter = (k (n,) in cm, mm (n,)), for any side.

    A session begins with the idle frame.
    """
    blank = Calibration.uncalibrated(bank_identity)

    def curve(features: FloatArray, values: FloatArray) -> OutputModel:
        regressor = fit_interval_regressor(features, values, blank.estimator.ridge, strengths=blank.estimator.strengths)
        return OutputModel(regressor, np.zeros(0))

    return replace(
        blank,
        source="made up",
        torque=curve(np.column_stack([torque[0], torque[0] ** 2]), torque[1]) if torque else None,
        diameter=curve(diameter[0][:, None], diameter[1]) if diameter else None,
    )
