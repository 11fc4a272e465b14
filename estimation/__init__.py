"""Estimators: `fit` makes a calibration from recordings; an `EstimatorSession` turns frames into estimates with it."""

from shearloop.estimation.calibration import Calibration
from shearloop.estimation.estimator import Estimator, Physics
from shearloop.estimation.fitting import adapt, fit
from shearloop.estimation.load_delay import TRUSTED, LoadTiming, measure_timing
from shearloop.estimation.session import Adaptation, EstimatorSession
from shearloop.estimation.values import Estimate, FrameSeries, Measured, TactileFrame, combine, torque_at

__all__ = [
    "TRUSTED",
    "Adaptation",
    "Calibration",
    "Estimate",
    "Estimator",
    "EstimatorSession",
    "FrameSeries",
    "LoadTiming",
    "Measured",
    "Physics",
    "TactileFrame",
    "adapt",
    "combine",
    "fit",
    "measure_timing",
    "torque_at",
]
