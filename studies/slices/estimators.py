"""Fits each estimator on slices: its features, its fits, and its treatment of dead channels.

Regression, reconstruction, bank and paper read a difference as they do live. A slice has no motion. So under the name
of the estimator of motion there is a curve of frames over the value.
"""

from typing import ClassVar

import numpy as np

from shearloop.bank.arrays import FloatArray
from shearloop.bank.channels import ChannelTable
from shearloop.bank.errors import CalibrationError
from shearloop.estimation.bank_estimators import BankEstimator, PaperEstimator
from shearloop.estimation.estimator import Estimator, Material, Physics, Quantity, Reading
from shearloop.estimation.estimator_names import DEFAULT, EstimatorName, estimator_class
from shearloop.studies.slices.curve import CurveMean
from shearloop.studies.slices.hidden_values import SlicePoint
from shearloop.studies.slices.novelty import fitted_parts
from shearloop.studies.slices.regressor import SliceFit

# Inverse calibration over torque and over diameter: degrees of the averaged curves, directions of drift, trend. The
# torque's have the least mean error over six origins (19 to 44 of 49 slices, evaluated on all later ones) with and
# without the judged level of torque (docs/decisions/0045).
_CURVES: dict[Quantity, tuple[tuple[int, ...], int, bool]] = {
    "torque": ((1, 3, 4), 3, True),
    "diameter": ((1,), 1, False),
}
# With a block left out, enough remain for the torque's curve.
_MIN_SLICES, _MIN_FOR_CURVE = 10, 15


class SliceCurve(Estimator):
    """A curve of frames over the value. A slice has its time as a feature, because the gel drifts."""

    name: ClassVar[str] = DEFAULT
    strengths: ClassVar[tuple[float, ...]] = (0.0,)

    def features(self, reading: Reading) -> FloatArray:
        """Return the channels' differences and the time."""
        return np.append((reading.frame.difference / self.scale).ravel(), reading.t_s)

    def feature_width(self, _quantity: Quantity) -> int:
        """Return the number of inputs of a quantity's regressor."""
        return self.scale.size + 1


def slice_estimator_class(name: str) -> type[Estimator]:
    """Return the class that reads slices; raises CalibrationError for a name that this version does not know."""
    return SliceCurve if name == SliceCurve.name else estimator_class(name)


def prepared(name: EstimatorName, physics: Physics, table: ChannelTable) -> Estimator:
    """Return the estimator for slices of one fingertip, before its fit."""
    kind, scale = slice_estimator_class(name), np.ones((1, table.n_channels))
    # Slices have no idle frame to find the electrodes' numbering by.
    return kind(scale, table) if kind is BankEstimator else kind.prepare(Material(scale, physics, table))


def least_slices(estimator: Estimator) -> int:
    """Return how many slices with a torque an estimator needs."""
    return _MIN_FOR_CURVE if isinstance(estimator, SliceCurve) else _MIN_SLICES


def uses_amplitude(estimator: Estimator) -> bool:
    """Return whether a slice's size matters."""
    return not isinstance(estimator, PaperEstimator)


def ignores_nan(estimator: Estimator) -> bool:
    """Return whether the regressor ignores channels that are NaN."""
    return isinstance(estimator, SliceCurve)


def fits_of(estimator: Estimator, quantity: Quantity, values: FloatArray) -> tuple[SliceFit, SliceFit]:
    """Return the fit to slices of (n,) values, and the fit of a line, which reads values beyond these.

    Raises CalibrationError where a part of the values has too few distinct ones for a curve.
    """
    if not isinstance(estimator, SliceCurve):
        return estimator.ridge, estimator.ridge
    degrees, n_drift, trend = _CURVES[quantity]
    for rows in fitted_parts(len(values)) if np.ptp(values) > 0 else ():
        n_distinct = len(np.unique(values[rows]))
        if n_distinct <= max(degrees):
            raise CalibrationError(
                f"{len(rows)} of the {len(values)} slices have too few different {quantity}s for the estimator "
                f"{estimator.name}, {n_distinct}; record more of them, in turn"
            )

    def fit_of(degrees: tuple[int, ...]) -> SliceFit:
        def fit(frames: FloatArray, known: FloatArray, _strength: float) -> SlicePoint:
            return CurveMean.fit(frames, known, degrees, n_drift, trend=trend)

        return fit

    return fit_of(degrees), fit_of((1,))
