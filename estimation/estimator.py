"""The estimators' contract: requirements, features of a frame, and fit; and the estimator that reads channels alone.

An estimator is a subclass of `Estimator`, and a line in `estimator_names.py`. It must have `name` and `features`.
Modules that only a fit or a bank needs are imported where they are used: the daemon runs without them.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, ClassVar, Literal, Self, TypeAlias

import numpy as np

from shearloop.bank.arrays import BoolArray, FloatArray, IntArray
from shearloop.bank.channels import PAPER_TABLE, ChannelTable
from shearloop.estimation.channel_imputer import ChannelImputer
from shearloop.estimation.fingertip_validator import FingertipValidator
from shearloop.estimation.grip_memory import Motion
from shearloop.estimation.interval_regressor import IntervalRegressor
from shearloop.estimation.ridge import STRENGTHS, Ridge
from shearloop.estimation.values import ProcessedFrame

if TYPE_CHECKING:
    from shearloop.bank.bank_file import Bank
    from shearloop.bank.mesh import Mesh
    from shearloop.estimation.bank_match import BankMatch, BankMatcher

Quantity = Literal["torque", "diameter"]
# Least and largest torque (n,) that each frame may have.
Bounds: TypeAlias = tuple[FloatArray, FloatArray]
# Two cells of the paper's bank.
_MIN_MARGIN_K_CM = 0.05
# A diameter is constant within a recording: more frames add nothing and take long.
_MAX_FOR_DIAMETER = 240
# Fewer diameters do not determine a line and its error.
MIN_DIAMETERS, MIN_LEFT = 3, 2
NO_ERRORS: FloatArray = np.zeros((0, 1, 1))


@dataclass(frozen=True, slots=True)
class Physics:
    """Knowledge before calibration: the bank, and the mesh of the reconstruction."""

    bank: "Bank | None" = None
    mesh: "Mesh | None" = None


@dataclass(frozen=True, slots=True, eq=False)
class OutputModel:
    """How one quantity is predicted: its regressor.

    k_range holds the least and largest matched k in cm, or nothing without a bank.
    """

    regressor: IntervalRegressor
    k_range: FloatArray


def match_reasons(k_range: FloatArray, match: "BankMatch") -> tuple[str, ...]:
    """Return the reason against a bank match far from the calibrated ones, if there is one.

    k_range holds the least and largest calibrated k in cm, or nothing.
    """
    if not len(k_range):
        return ()
    low, high = k_range.tolist()
    margin = max(high - low, _MIN_MARGIN_K_CM)
    if low - margin <= match.k <= high + margin:
        return ()
    return (
        f"the bank fits best at k = {match.k:.2f} cm, outside the calibrated {low:.2f} to {high:.2f} cm; "
        "the match is on another ridge of the bank",
    )


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """What an estimator reads: a frame after the session's checks, at t_s, and each side's match in its bank."""

    frame: ProcessedFrame
    t_s: float
    matches: "tuple[BankMatch, ...]"

    @classmethod
    def of(cls, frame: ProcessedFrame, t_s: float, matcher: "BankMatcher | None") -> Self:
        """Return the reading of a frame; the matcher belongs to the estimator's bank, None without one."""
        return cls(frame, t_s, () if matcher is None else tuple(map(matcher.match, frame.difference)))

    @property
    def is_ambiguous(self) -> bool:
        """Whether two positions of the bank far apart fit the first side's frame equally well."""
        return bool(self.matches) and self.matches[0].ambiguous


@dataclass(frozen=True, slots=True, eq=False)
class Material:
    """What an estimator is prepared from: the scale (m, c) of its differences, knowledge before calibration, and
    the channels.

    grips are the (n, m, c) frames of each grip. With `nested` the fit chooses its settings.
    """

    scale: FloatArray
    physics: Physics
    table: ChannelTable
    validators: tuple[FingertipValidator, ...] = ()
    grips: Sequence[FloatArray] = ()
    nested: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationRows:
    """Calibration frames: the recording (n,), number and age (n,) of each there, its features (n, d) and the truth.

    grip (n,) numbers the grips of all recordings. position and mean_position (n, m·c) are the difference to the idle
    frame and its mean over the grip, in units of noise.
    """

    recording: IntArray
    frame: IntArray
    age_s: FloatArray
    features: FloatArray
    position: FloatArray
    mean_position: FloatArray
    torque_nm: FloatArray
    diameter_mm: FloatArray
    grip: IntArray

    def where(self, rows: IntArray | BoolArray) -> Self:
        """Return some of the frames."""
        return type(self)(*(getattr(self, field.name)[rows] for field in fields(self)))


@dataclass(frozen=True, eq=False)
class Estimator(ABC):
    """An estimator of one calibration. The file keeps its fields, which are arrays, values, or dataclasses of these.

    scale (m, c) divides differences per channel and is infinite for dead ones. imputer fills in dead channels.
    """

    name: ClassVar[str]
    needs: ClassVar[Literal["bank", "mesh", ""]] = ""
    # Features that a quantity is predicted from.
    columns: ClassVar[Mapping[Quantity, slice]] = {"torque": slice(None), "diameter": slice(None)}
    # Penalties to choose from.
    strengths: ClassVar[tuple[float, ...]] = STRENGTHS
    # Whether features further from their mean than any at calibration are refused.
    limits_features: ClassVar[bool] = True
    # Whether a session imputes dead channels along the motion, or the imputer does.
    imputes_by_motion: ClassVar[bool] = False

    scale: FloatArray
    table: ChannelTable = PAPER_TABLE
    imputer: ChannelImputer | None = None

    @classmethod
    def prepare(cls, material: Material) -> Self:
        """Return the estimator before its fit."""
        return cls(material.scale, material.table)

    @property
    def motion(self) -> Motion:
        """What a session remembers of the gel's motion."""
        return Motion()

    def matcher(self, _bank: "Bank") -> "BankMatcher | None":
        """Return the matcher on the bank, None for an estimator without a bank."""
        return None

    @abstractmethod
    def features(self, reading: Reading) -> FloatArray:
        """Return the (d,) features of a reading."""

    def inputs(self, quantity: Quantity, features: FloatArray, _reading: Reading) -> FloatArray:
        """Return the (d,) inputs of a quantity's regressor."""
        return features[self.columns[quantity]]

    def impute(self, difference: FloatArray, usable: BoolArray) -> tuple[FloatArray, FloatArray]:
        """Return a (m, c) difference with unusable channels imputed, and their errors (k, m, c)."""
        return (difference, NO_ERRORS) if self.imputer is None else self.imputer.impute(difference, usable)

    def position_noise_mm(self, _regressor: IntervalRegressor) -> float:
        """Return the diameter's 95 % error from the noise of one frame."""
        return 0.0

    def ridge(self, features: FloatArray, values: FloatArray, strength: float) -> Ridge:
        """Fit a ridge to (n, d) features and (n,) values."""
        return Ridge.fit(features, values, strength)

    def k_range(self, features: FloatArray) -> FloatArray:
        """Return the least and the largest k of (n, d) features, empty for an estimator without a bank."""
        return np.array([features[:, 0].min(), features[:, 0].max()]) if self.needs == "bank" else np.zeros(0)

    def fit_torque(
        self, features: FloatArray, torque_nm: FloatArray, bounds: Bounds | None, grips: IntArray
    ) -> tuple[Self, IntervalRegressor, float]:
        """Return the torque's regressor on frames of numbered grips (n,), and the estimator as it uses them.

        The third value is the fraction of the torque's variance that a tool's motion leaves unexplained on frames left
        out, 0 where that is not tested.
        """
        from shearloop.estimation.interval_fit import Validation, fit_interval_regressor
        from shearloop.estimation.left_out import later_origins

        # Without memory the gel's drift enters the torque, so validation uses later frames only.
        regressor = fit_interval_regressor(
            features[:, self.columns["torque"]],
            torque_nm,
            self.ridge,
            strengths=self.strengths,
            limit_features=self.limits_features,
            validation=Validation.by_parts(later_origins(len(torque_nm)), len(torque_nm)),
            bounds=bounds,
            grips=grips,
            fingertips=len(self.scale),
        )
        return self, regressor, 0.0

    def feature_width(self, quantity: Quantity) -> int | None:  # noqa: ARG002 - estimators with a known width use it
        """Return the number of inputs of a quantity's regressor, None if the estimator does not say."""
        return None

    def side_of_features(self, n_features: int) -> IntArray:
        """Return the side (d,) that each of the torque's features comes from: one number where they have no side."""
        return np.zeros(n_features, dtype=np.int64)

    def fit_diameter(self, rows: CalibrationRows) -> OutputModel:
        """Return the diameter's model from rows of known diameters, by age."""
        from shearloop.estimation.interval_fit import Validation, fit_interval_regressor
        from shearloop.estimation.left_out import left_out_groups

        n = len(rows.age_s)
        rows = rows.where(np.arange(0, n, 1 + n // _MAX_FOR_DIAMETER))
        # A new grip is another recording, not a later part of this one.
        recordings = left_out_groups(rows.recording)
        left_out = [pair for pair in recordings if len(np.unique(rows.diameter_mm[pair[0]])) >= MIN_LEFT]
        regressor = fit_interval_regressor(
            rows.features[:, self.columns["diameter"]],
            rows.diameter_mm,
            self.ridge,
            strengths=self.strengths,
            validation=Validation.by_parts(left_out, len(rows.age_s)),
        )
        return OutputModel(regressor, self.k_range(rows.features))


class Regression(Estimator):
    """A ridge on the difference of each channel."""

    name: ClassVar[str] = "regression"

    def features(self, reading: Reading) -> FloatArray:
        """Return the channels' differences."""
        return (reading.frame.difference / self.scale).ravel()

    def feature_width(self, _quantity: Quantity) -> int:
        """Return the number of channels of all sides."""
        return int(self.scale.size)
