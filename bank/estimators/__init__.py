"""Estimators: `fit` makes a calibration from recordings, a `Tracker` turns frames into estimates with it."""

from bank.estimators.calibrated import NAMES, Calibration, Name
from bank.estimators.fitting import fit
from bank.estimators.fitting_choices import Physics
from bank.estimators.tracker import Tracker
from bank.estimators.values import Estimate, FrameSeries, Measured, TactileFrame, fused

__all__ = [
    "NAMES",
    "Calibration",
    "Estimate",
    "FrameSeries",
    "Measured",
    "Name",
    "Physics",
    "TactileFrame",
    "Tracker",
    "fit",
    "fused",
]
