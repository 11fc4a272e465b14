"""The estimators' names and classes; the command line reads the names without importing NumPy."""

import importlib
from typing import TYPE_CHECKING, Literal, TypeAlias

from shearloop.bank.errors import CalibrationError

if TYPE_CHECKING:
    from shearloop.estimation.estimator import Estimator

    EstimatorName: TypeAlias = str

# The first is the default.
ESTIMATORS = {
    "motion_regression": "shearloop.estimation.motion_regression:MotionRegression",
    "regression": "shearloop.estimation.estimator:Regression",
    "bank": "shearloop.estimation.bank_estimators:BankEstimator",
    "paper": "shearloop.estimation.bank_estimators:PaperEstimator",
    "reconstruction": "shearloop.estimation.reconstruction:Reconstruction",
}
DEFAULT = next(iter(ESTIMATORS))
if not TYPE_CHECKING:
    EstimatorName = Literal[tuple(ESTIMATORS)]


def estimator_class(name: str) -> "type[Estimator]":
    """Return an estimator's class; raises CalibrationError for a name that this version does not know."""
    if name not in ESTIMATORS:
        raise CalibrationError(f"the estimator is {name!r}, which this version does not know")
    module, _, attribute = ESTIMATORS[name].partition(":")
    found: type[Estimator] = getattr(importlib.import_module(module), attribute)
    return found
