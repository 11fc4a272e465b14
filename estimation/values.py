"""Values that estimators take and return: single frames, measurements, estimates."""

import math
from dataclasses import dataclass, field
from enum import Enum
from typing import Self

import numpy as np

from shearloop.bank.arrays import BoolArray, FloatArray

# Of 95 % intervals. This number of standard deviations to either side of a Gaussian's mean holds 95 %.
LEVEL, TWO_SIDED_95 = 0.95, 1.96
# Metadata of a dataclass's field: in the calibration's file its fields join the other fields of the dataclass.
INLINE = {"inline": True}
# A measured tool is another one if its diameter differs by a larger fraction of the known diameter.
_LARGEST_TOOL_FRACTION = 0.15
# Recorded loads change by up to 0.76 N·m/s, so that nothing is known between readings further apart. One reading of a
# loop of two a second may be missing, and one of a slower one, up to a limit.
_LOAD_GAP_S, _LOAD_GAP_STEPS, _LARGEST_LOAD_GAP_S = 1.2, 2.2, 3.5
# Fewer readings do not show how slow a loop is.
_LEAST_READINGS = 10


@dataclass(frozen=True, slots=True)
class Measured:
    """A value and the half width of its 95 % interval."""

    value: float
    half_width: float


@dataclass(frozen=True, slots=True, eq=False)
class TactileFrame:
    """Frames of m sides at one time: t_s in seconds (middle of the acquisition), channels (m, c) in volts.

    usable (m, c) is False at dead and saturated channels, `repeated` True where a board sent a frame again.
    fingers_moved: they opened or closed during a part of the acquisition. `read_after_periods` frame periods passed
    from the middle of the acquisition until the last of the frames was read. Do not change the arrays afterwards.
    """

    t_s: float
    channels: FloatArray
    usable: BoolArray
    repeated: bool = False
    fingers_moved: bool = False
    read_after_periods: float = 0.0

    @classmethod
    def of(
        cls, t_s: float, channels: FloatArray, usable: BoolArray | None = None, *, fingers_moved: bool = False
    ) -> "TactileFrame":
        """Return a frame; channels that are not finite are unusable."""
        # Contiguous memory makes sums over channels reproducible to the bit.
        channels = np.ascontiguousarray(channels)
        finite = np.isfinite(channels)
        if not finite.all():
            channels = np.where(finite, channels, 0.0)
            usable = finite if usable is None else finite & usable
        usable = np.ones(channels.shape, dtype=np.bool_) if usable is None else usable
        return cls(t_s, channels, usable, fingers_moved=fingers_moved)


@dataclass(frozen=True, slots=True)
class HeldTool:
    """The diameter of the held tool in mm: as the gripper measures it, and as the experiment states it; None without.

    The stated one counts: it is exact. A measured one of another tool contradicts it, and then there is no torque.
    """

    measured: Measured | None
    stated_mm: float | None = None

    @property
    def diameter(self) -> Measured | None:
        """The diameter that counts, None where nothing is known."""
        return self.measured if self.stated_mm is None else Measured(self.stated_mm, 0.0)

    @property
    def conflict(self) -> str:
        """How the measured diameter contradicts the stated one; empty where it does not."""
        if self.measured is None or self.stated_mm is None or not is_another_tool(self.stated_mm, self.measured):
            return ""
        return (
            f"the experiment states a tool of {self.stated_mm:g} mm, and the gripper measures "
            f"{self.measured.value:.1f} mm: put that tool between the fingers, or correct `tool_mm`"
        )


def is_another_tool(known_mm: float, measured: Measured) -> bool:
    """Return whether a tool of a known diameter cannot be the measured one; False for an unknown one (NaN)."""
    return abs(measured.value - known_mm) > _LARGEST_TOOL_FRACTION * known_mm + measured.half_width


@dataclass(frozen=True, slots=True, eq=False)
class KnownTorques:
    """Torques (n,) in N·m of another source, `reference`, at the frames of this grip; NaN where unknown."""

    reference: str
    torque_nm: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class BeforeFrame:
    """What a session has to know before a frame, and the frame does not contain; `Session.prepare` says who applies it.

    begins_tare: the next frames are of untouched fingertips and make the idle frame. gives_up_tare: they do not, or not
    any longer. tool: it has changed; None if not. fingers_moved: during a part of the frame's acquisition.
    known_torques correct the gain of this grip.
    """

    begins_tare: bool = False
    gives_up_tare: bool = False
    tool: HeldTool | None = None
    fingers_moved: bool = False
    known_torques: KnownTorques | None = None


class GripState(Enum):
    """What a frame shows of a grip."""

    NONE = "none"
    HELD = "held"
    UNKNOWN = "unknown"  # the frame was refused, or its session knows of no grips


@dataclass(frozen=True, slots=True, eq=False)
class ProcessedFrame:
    """A frame after the session's checks, with the reasons against it.

    difference (m, c) is to the idle frame, mean_difference its mean over the grip's last held_frames. motion holds
    features of the last frames' motion. usable (m, c) excludes channels that the board or the frame itself shows to be
    lost or saturated. has_baseline is whether every fingertip was seen idle, lag_s the lag of an average.
    """

    difference: FloatArray
    reasons: tuple[str, ...]
    usable: BoolArray
    grip: GripState = GripState.UNKNOWN
    mean_difference: FloatArray = field(default_factory=lambda: np.zeros(0))
    motion: FloatArray = field(default_factory=lambda: np.zeros(0))
    held_frames: int = 1
    has_baseline: bool = True
    lag_s: float = 0.0

    @classmethod
    def refused(cls, usable: BoolArray, *reasons: str) -> Self:
        """Return a frame with reasons against it, without a difference: it shows nothing of a grip."""
        return cls(np.zeros(usable.shape), reasons, usable)


@dataclass(frozen=True, slots=True)
class Estimate:
    """Result of one frame: values with 95 % intervals, None where unknown, and the reasons against them.

    An estimate that is not valid has no torque and no diameter. k, sigma, score and runner_up are the bank's.
    lag_s is how far the torque's time lies before the frame's, where frames are averaged.
    """

    valid: bool
    reasons: tuple[str, ...] = ()
    torque_nm: float | None = None
    torque_low_nm: float | None = None
    torque_high_nm: float | None = None
    diameter_mm: float | None = None
    diameter_low_mm: float | None = None
    diameter_high_mm: float | None = None
    k: float | None = None
    sigma: float | None = None
    score: float | None = None
    runner_up: float | None = None
    lag_s: float = 0.0


def longest_load_gap_s(torque_t_s: FloatArray) -> float:
    """Return the longest time between readings (p,) in time order within which the torque is known."""
    usual_s = float(np.median(np.diff(torque_t_s))) if len(torque_t_s) >= _LEAST_READINGS else 0.0
    return min(max(_LOAD_GAP_S, _LOAD_GAP_STEPS * usual_s), _LARGEST_LOAD_GAP_S)


def torque_at(t_s: FloatArray, torque_t_s: FloatArray, torque_nm: FloatArray) -> FloatArray:
    """Return the (n,) torque at t_s (n,) from readings (p,) in time order, NaN in a gap between them."""
    if len(torque_t_s) == 0:
        return np.full(len(t_s), np.nan)
    after = np.searchsorted(torque_t_s, t_s).clip(0, len(torque_t_s) - 1)
    before_s, after_s = torque_t_s[np.maximum(after - 1, 0)], torque_t_s[after]
    known = (after_s - before_s <= longest_load_gap_s(torque_t_s)) | (t_s == after_s)
    torque = np.interp(t_s, torque_t_s, torque_nm, left=np.nan, right=np.nan)
    return np.where(known, torque, np.nan)


def combine(*measured: Measured | None) -> Measured | None:
    """Return the mean of independent measurements weighted by their variances, None without any.

    Where they differ by more than their intervals allow, the half width grows accordingly (Birge 1932).
    """
    present = [measurement for measurement in measured if measurement is not None]
    if not present:
        return None
    if any(measurement.half_width <= 0 for measurement in present):
        raise ValueError("a measurement without uncertainty has no weight")
    weighted = [(measurement.half_width**-2, measurement.value) for measurement in present]
    total = sum(weight for weight, _ in weighted)
    if not total:  # every half width is infinite
        return None
    mean = sum(weight * value for weight, value in weighted) / total
    squares = sum(weight * (value - mean) ** 2 for weight, value in weighted)
    excess = TWO_SIDED_95**2 * squares / max(len(present) - 1, 1)
    return Measured(mean, math.sqrt(max(excess, 1.0) / total))
