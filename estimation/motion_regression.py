"""The estimator of motion, the default: the gel's motion over the last seconds.

Its features are the frame's motion since some earlier frames, in a few directions per fingertip. Older frames are
averaged in growing steps. The gel creeps for seconds under a held twist, so its speed shows torque that its position
does not, and slow drift of the baseline leaves no trace. If the gel holds its position, the position is a feature too
and shows a long twist. `motion_fit` chooses directions and memory.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np

from shearloop.bank.arrays import BoolArray, FloatArray, IntArray
from shearloop.estimation.confidence import TWO_SIDED_95
from shearloop.estimation.estimator import Bounds, CalibrationRows, Estimator, Material, OutputModel, Quantity, Reading
from shearloop.estimation.fingertip_validator import FingertipValidator
from shearloop.estimation.grip_memory import Motion
from shearloop.estimation.interval_regressor import IntervalRegressor
from shearloop.estimation.ridge import CensoredRidge, Ridge, is_one_sided
from shearloop.estimation.twists import LOADED_FRACTION

if TYPE_CHECKING:
    from shearloop.estimation.motion_fit import MotionFit

# The directions of the motion over this many frames, 4 s. Over 6 frames the first twists after a grip err
# more, over 12 frames later twists do (docs/decisions/0044). A nested choice tries all three.
_DIRECTION_FRAMES, _NESTED_DIRECTION_FRAMES = (8,), (8, 6, 12)
# An estimate needs this many frames of the grip before its own, 6.5 s. An older part of the memory counts as the oldest
# of them, so that the memory costs no twist.
_MIN_LAGS = 12
# A longer memory in a file would fill the session's own.
_MAX_LAGS = 1000
# Positions drift between recordings, motion does not. So the position must lower motion's squared error on frames left
# out to the second fraction where motion leaves more than the first of the torque's variance, else to the third. On
# recorded fingertips, which were twisted one way, the fraction is 0.54 to 18, on emulated ones 0.01 to 0.4.
_MOTION_MAY_LEAVE, _POSITION_GAINS, _POSITION_GAINS_MUCH = 0.5, 0.5, 0.3
# Of twists both ways, motion may learn the order, which is another one next time, and twists left out do not show it.
# There the position also serves where it leaves this fraction of the torque's variance at most.
_POSITION_MAY_LEAVE = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class TemporalFeatures(Motion):
    """Directions (m, p, c) along which each side's motion is measured, in units of noise, and how far back.

    edges (s + 1,) are the ends of the memory's s steps in frames back. With uses_position the position relative to the
    idle frame is a feature too.
    """

    directions: FloatArray
    edges: IntArray
    uses_position: bool = False

    @classmethod
    def fit(
        cls, parts: Sequence[FloatArray], validators: tuple[FingertipValidator, ...], *, nested: bool = False
    ) -> Self:
        """Fit the main directions of motion to each recording's (n, m, c) gripped frames.

        With `nested` they are of the motion over several times, for the fit to choose.
        """
        from shearloop.estimation.motion_fit import MEMORY_EDGES, main_directions

        windows = _NESTED_DIRECTION_FRAMES if nested else _DIRECTION_FRAMES
        directions = []
        for layer, validator in enumerate(validators):
            of_side = [part[:, layer] for part in parts]
            directions.append(np.vstack([main_directions(of_side, validator.noise, frames) for frames in windows]))
        return cls(np.array(directions), np.array(MEMORY_EDGES), uses_position=True)

    @property
    def n_lags(self) -> int:
        """How many frames back the memory reaches."""
        return int(self.edges[-1]) - 1

    @property
    def n_needed(self) -> int:
        """How many positions of a grip an estimate needs."""
        return min(self.n_lags, _MIN_LAGS) + 1

    def reduced(self, to: "MotionFit") -> Self:
        """Return the features that a fit uses."""
        first = to.first_direction
        directions = self.directions[:, first : first + to.n_directions].copy()
        return replace(self, directions=directions, edges=self.edges[: to.n_steps + 1], uses_position=to.position)

    def project(self, channels: FloatArray) -> FloatArray:
        """Return the (…, m·p) positions of (…, m, c) frames along the directions."""
        found = np.einsum("...mc,mpc->...mp", channels, self.directions)
        return np.asarray(found.reshape(*found.shape[:-2], -1))

    def impute(
        self, moved: FloatArray, usable: BoolArray, sides: Sequence[FingertipValidator], *, from_idle: bool
    ) -> FloatArray:
        """Return a motion (m, c), unusable channels along the directions, and from idle along the grip too."""
        imputed = []
        for layer, validator in enumerate(sides):
            alive = np.isfinite(validator.noise)
            modes = self.directions[layer] * np.where(alive, validator.noise, 0.0) ** 2
            if from_idle:
                modes = np.vstack([modes, validator.gripped - validator.idle])
            weights = np.where(usable[layer] & alive, 1.0 / validator.noise, 0.0)
            found = np.linalg.lstsq((modes * weights).T, moved[layer] * weights, rcond=None)[0]
            imputed.append(found @ modes)
        return np.where(usable, moved, imputed)

    def features(self, positions: Sequence[FloatArray], from_idle: FloatArray) -> FloatArray:
        """Return s · m·p features of motion, nearest step first, and m·p of position where it is used.

        positions are the last (m·p,) positions, up to n_lags + 1; from_idle (m·p,) is the newest one relative to idle.
        """
        missing = self.n_lags + 1 - len(positions)
        rows = np.array([*[positions[0]] * missing, *positions])
        starts, counts = self.edges[:-1] - 1, np.diff(self.edges)
        before = np.add.reduceat(rows[-2::-1], starts, axis=0) / counts[:, None]
        moved = (rows[-1] - before).ravel()
        return np.concatenate([moved, from_idle]) if self.uses_position else moved


def _reads_position(alone: "MotionFit", with_position: "MotionFit", torque_nm: FloatArray) -> bool:
    """Return whether torques (n,) are fitted to the gel's position too, by both fits' errors on frames left out."""
    variance = float(torque_nm.var())
    leaves_much = alone.squared_error > _MOTION_MAY_LEAVE * variance
    share = _POSITION_GAINS if leaves_much else _POSITION_GAINS_MUCH
    if with_position.squared_error < share * alone.squared_error:
        return True
    loaded_nm = LOADED_FRACTION * float(np.abs(torque_nm).max())
    both_ways = bool(torque_nm.min() < -loaded_nm and torque_nm.max() > loaded_nm)
    return both_ways and with_position.squared_error < _POSITION_MAY_LEAVE * variance


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
        temporal = TemporalFeatures.fit(material.grips, material.validators, nested=material.nested)
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
        from shearloop.estimation.interval_fit import fit_interval_regressor
        from shearloop.estimation.left_out import left_out_blocks
        from shearloop.estimation.motion_fit import Layout, LinearFit, choose_motion, twists_left_out

        temporal = self.temporal
        m, p, _ = temporal.directions.shape
        layout = Layout(len(temporal.edges) - 1, m, p)
        fit_one: LinearFit = CensoredRidge.fit if is_one_sided(torque_nm) else Ridge.fit_scaled
        twists, variance = twists_left_out(torque_nm), float(torque_nm.var())
        left_out = twists or left_out_blocks(len(torque_nm))
        alone, with_position = (
            choose_motion(features, torque_nm, layout, fit_one, left_out, position=used) for used in (False, True)
        )
        chosen = with_position if _reads_position(alone, with_position, torque_nm) else alone
        regressor = fit_interval_regressor(
            features[:, chosen.columns], torque_nm, chosen.fit_used, strengths=(0.0,), limit_features=True,
            twists=twists, bounds=bounds, grips=grips, fingertips=len(temporal.directions),
        )  # fmt: skip
        return replace(self, temporal=temporal.reduced(chosen)), regressor, chosen.squared_error / variance

    def side_of_features(self, n_features: int) -> IntArray:
        """Return the side (d,) that each of the torque's features comes from."""
        m, p, _ = self.temporal.directions.shape
        return np.tile(np.repeat(np.arange(m), p), n_features // (m * p))

    def fit_diameter(self, rows: CalibrationRows) -> OutputModel:
        """Return the diameter's model from rows of known diameters, by age."""
        from shearloop.estimation.cylinder_fit import fit_cylinders

        grips = [rows.where(rows.recording == recording) for recording in np.unique(rows.recording)]
        return OutputModel(fit_cylinders(grips, self.table), np.zeros(0))
