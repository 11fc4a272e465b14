"""The estimator of motion, the default: the gel's motion over the last seconds.

Its features are the frame's motion since some earlier frames, in a few directions per fingertip. Older frames are
averaged in growing steps. The gel creeps for seconds under a held twist, so its speed shows torque that its position
does not, and slow drift of the baseline leaves no trace. If the gel holds its position, the position is a feature too
and shows a long twist. `motion_fit` chooses directions and memory.
"""

import math
from dataclasses import dataclass, field, replace
from typing import ClassVar, Self

import numpy as np

from shearloop.bank.arrays import FloatArray, IntArray
from shearloop.estimation.estimator import Bounds, CalibrationRows, Estimator, Material, OutputModel, Quantity, Reading
from shearloop.estimation.grip_memory import Motion
from shearloop.estimation.interval_regressor import IntervalRegressor
from shearloop.estimation.motion_features import TemporalFeatures
from shearloop.estimation.values import TWO_SIDED_95

# A longer memory in a file would fill the session's own.
_MAX_LAGS = 1000


@dataclass(frozen=True, eq=False)
class MotionRegression(Estimator):
    """A ridge on the gel's motion over the last frames."""

    name: ClassVar[str] = "motion_regression"
    strengths: ClassVar[tuple[float, ...]] = (0.0,)
    imputes_by_motion: ClassVar[bool] = True

    temporal: TemporalFeatures = field(kw_only=True)

    @classmethod
    def prepare(cls, material: Material) -> Self:
        """Return the estimator with the directions of the grips' motion."""
        from shearloop.estimation.motion_fit import fit_directions

        temporal = fit_directions(material.grips, material.validators, nested=material.nested)
        return cls(material.scale, material.table, temporal=temporal)

    @property
    def motion(self) -> Motion:
        """What a session remembers of the gel's motion."""
        return self.temporal

    def features(self, reading: Reading) -> FloatArray:
        """Return the features of motion."""
        return reading.frame.motion

    def inputs(self, quantity: Quantity, features: FloatArray, reading: Reading) -> FloatArray:
        """Return the inputs of a quantity's regressor; the diameter's are the gel's mean position in this grip."""
        if quantity == "diameter":
            return np.asarray((reading.frame.mean_difference / self.scale).ravel())
        return features

    def feature_width(self, quantity: Quantity) -> int:
        """Return the number of inputs of a quantity's regressor; raises ValueError for directions of other channels."""
        m, c = map(int, self.scale.shape)
        directions = self.temporal.directions
        if directions.ndim != 3 or (directions.shape[0], directions.shape[2]) != (m, c):
            raise ValueError(f"directions have the shape {directions.shape}, expected {m} sides of {c} channels")
        if quantity == "diameter":
            return m * c
        edges = self.temporal.edges
        if edges.ndim != 1 or len(edges) < 2 or edges[0] < 1 or (np.diff(edges) < 1).any() or edges[-1] > _MAX_LAGS + 1:
            raise ValueError(f"the memory ends at {edges.tolist()} frames, expected up to {_MAX_LAGS} that rise")
        return m * int(directions.shape[1]) * (len(edges) - 1 + self.temporal.uses_position)

    def position_noise_mm(self, regressor: IntervalRegressor) -> float:
        """Return the diameter's 95 % error from the noise of one frame, where each feature has a noise of 1.

        A mean of n frames has a root of n less. The calibrated interval lacks this noise: it comes from means of whole
        grips, which have little noise left.
        """
        weights = regressor.point.weights
        return TWO_SIDED_95 * math.sqrt(weights @ weights)

    def fit_torque(
        self, features: FloatArray, torque_nm: FloatArray, bounds: Bounds | None, grips: IntArray
    ) -> tuple[Self, IntervalRegressor, float]:
        """Return the torque's regressor, and the estimator with the chosen features."""
        from shearloop.estimation.motion_fit import fit_motion

        temporal, regressor, unexplained = fit_motion(self.temporal, features, torque_nm, bounds, grips)
        return replace(self, temporal=temporal), regressor, unexplained

    def side_of_features(self, n_features: int) -> IntArray:
        """Return the side (d,) that each of the torque's features comes from."""
        m, p, _ = self.temporal.directions.shape
        return np.tile(np.repeat(np.arange(m), p), n_features // (m * p))

    def fit_diameter(self, rows: CalibrationRows) -> OutputModel:
        """Return the diameter's model from rows of known diameters, by age."""
        from shearloop.estimation.cylinder_fit import fit_cylinders

        grips = [rows.where(rows.recording == recording) for recording in np.unique(rows.recording)]
        return OutputModel(fit_cylinders(grips, self.table), np.zeros(0))
