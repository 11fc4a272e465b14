"""Estimators: `fit` makes a calibration from recordings; a `Session` turns frames into estimates with it."""

from typing import TYPE_CHECKING

from shearloop.faces import importer

if TYPE_CHECKING:
    from shearloop.estimation.adaptation import Adaptation
    from shearloop.estimation.calibration import Calibration
    from shearloop.estimation.estimator import Estimator, Physics
    from shearloop.estimation.fitting import adapt, fit
    from shearloop.estimation.load_delay import TRUSTED, LoadTiming, measure_timing
    from shearloop.estimation.series import FrameSeries
    from shearloop.estimation.session import Session
    from shearloop.estimation.values import (
        BeforeFrame,
        Estimate,
        HeldTool,
        KnownTorques,
        Measured,
        TactileFrame,
        combine,
        torque_at,
    )

__all__ = [
    "TRUSTED",
    "Adaptation",
    "BeforeFrame",
    "Calibration",
    "Estimate",
    "Estimator",
    "FrameSeries",
    "HeldTool",
    "KnownTorques",
    "LoadTiming",
    "Measured",
    "Physics",
    "Session",
    "TactileFrame",
    "adapt",
    "combine",
    "fit",
    "measure_timing",
    "torque_at",
]

_HOMES = {
    "Adaptation": "shearloop.estimation.adaptation:Adaptation",
    "BeforeFrame": "shearloop.estimation.values:BeforeFrame",
    "Calibration": "shearloop.estimation.calibration:Calibration",
    "Estimate": "shearloop.estimation.values:Estimate",
    "Estimator": "shearloop.estimation.estimator:Estimator",
    "FrameSeries": "shearloop.estimation.series:FrameSeries",
    "HeldTool": "shearloop.estimation.values:HeldTool",
    "KnownTorques": "shearloop.estimation.values:KnownTorques",
    "LoadTiming": "shearloop.estimation.load_delay:LoadTiming",
    "Measured": "shearloop.estimation.values:Measured",
    "Physics": "shearloop.estimation.estimator:Physics",
    "Session": "shearloop.estimation.session:Session",
    "TRUSTED": "shearloop.estimation.load_delay:TRUSTED",
    "TactileFrame": "shearloop.estimation.values:TactileFrame",
    "adapt": "shearloop.estimation.fitting:adapt",
    "combine": "shearloop.estimation.values:combine",
    "fit": "shearloop.estimation.fitting:fit",
    "measure_timing": "shearloop.estimation.load_delay:measure_timing",
    "torque_at": "shearloop.estimation.values:torque_at",
}
__getattr__ = importer(__name__, globals(), _HOMES)
