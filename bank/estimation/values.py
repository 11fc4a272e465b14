"""What estimators are made from and what they give: series of frames, single frames, estimates. No I/O, no clock."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from shearloop.bank.arrays import BoolArray, FloatArray
from shearloop.bank.eit.channels import N_CHANNELS
from shearloop.bank.eit.polynomial import TWO_SIDED_95
from shearloop.bank.errors import CalibrationError

# A raw frame is in volts as the board sends it; a difference is |frame − homogeneous frame|, already smoothed over
# time by whoever made it, and without the frames around it.
Kind = Literal["raw", "difference"]

# A load cell that this tells apart from nothing hangs on a lever that bears some N·m: more is a damaged line.
LARGEST_TORQUE_NM = 20.0
# From a torque this far away in time a frame's own may differ by all there is: recorded loads change by 0.76 N·m/s.
_FURTHEST_TORQUE_S = 1.0


@dataclass(frozen=True, slots=True)
class Measured:
    """A value and the half width of its 95 % interval."""

    value: float
    half_width: float


@dataclass(frozen=True, slots=True, eq=False)
class FrameSeries:
    """Frames in time order with what was known beside them.

    t_s (n,) is the middle of each acquisition in seconds, not its arrival; channels (n, m, 896) in volts, one layer
    for each of the m sides. torque_nm (p,) was measured at torque_t_s (p,) on the same clock; diameter_mm (n,) is NaN
    where it is not known. Then `gripped_mm` may tell of it: the gripper's width, which is no truth to fit a diameter
    to. Raises CalibrationError for shapes that do not belong together and for times that fall.
    """

    kind: Kind
    sides: tuple[str, ...]
    t_s: FloatArray
    channels: FloatArray
    torque_t_s: FloatArray
    torque_nm: FloatArray
    diameter_mm: FloatArray
    gripped_mm: Measured | None = None

    def __post_init__(self) -> None:
        """Refuse what is no series."""
        n, m = len(self.t_s), len(self.sides)
        if self.channels.shape != (n, m, N_CHANNELS) or self.diameter_mm.shape != (n,):
            raise CalibrationError(
                f"{n} frames of {m} sides need channels of shape {(n, m, N_CHANNELS)} and {n} diameters, not "
                f"{self.channels.shape} and {self.diameter_mm.shape}"
            )
        if self.torque_t_s.shape != self.torque_nm.shape:
            raise CalibrationError(f"{self.torque_t_s.shape} times do not go with {self.torque_nm.shape} torques")
        for name, times in (("frames", self.t_s), ("torques", self.torque_t_s)):
            if (np.diff(times) < 0).any():
                raise CalibrationError(f"the times of the {name} must not fall; sort them")

    def torque_at_frames(self) -> FloatArray:
        """Return the (n,) torque in N·m at the middle of each frame.

        NaN outside of what was measured, and where the load cell said nothing for so long that nobody knows.
        """
        if len(self.torque_t_s) == 0:
            return np.full(len(self.t_s), np.nan)
        after = np.searchsorted(self.torque_t_s, self.t_s).clip(0, len(self.torque_t_s) - 1)
        around = self.torque_t_s[[np.maximum(after - 1, 0), after]]
        known = np.abs(around - self.t_s).min(axis=0) <= _FURTHEST_TORQUE_S
        torque = np.interp(self.t_s, self.torque_t_s, self.torque_nm, left=np.nan, right=np.nan)
        return np.where(known, torque, np.nan)

    def of_sides(self, sides: tuple[str, ...]) -> "FrameSeries":
        """Return the same series with these sides only; raises CalibrationError for a side that it does not have."""
        missing = [side for side in sides if side not in self.sides]
        if missing:
            raise CalibrationError(
                f"the recording has the sides {', '.join(self.sides)}, and not {' and '.join(missing)}; "
                "choose among those that are there"
            )
        layers = [self.sides.index(side) for side in sides]
        return replace(self, sides=sides, channels=self.channels[:, layers])

    def between(self, start: int, stop: int) -> "FrameSeries":
        """Return frames `start` to `stop` with all of the torques."""
        part = slice(start, stop)
        return replace(self, t_s=self.t_s[part], channels=self.channels[part], diameter_mm=self.diameter_mm[part])

    @property
    def tool_mm(self) -> Measured | None:
        """The diameter of the one tool that raw frames are of, as far as it is known."""
        if self.kind != "raw" or not len(self.t_s):
            return None
        known_mm = float(self.diameter_mm[0])
        return Measured(known_mm, 0.0) if np.isfinite(known_mm) else self.gripped_mm


@dataclass(frozen=True, slots=True, eq=False)
class TactileFrame:
    """One moment: t_s in seconds (the middle of the acquisition), channels (m, 896) in volts of the m sides.

    usable (m, 896) is False at channels that are dead or saturated. The arrays are kept: nobody changes them
    afterwards.
    """

    t_s: float
    channels: FloatArray
    usable: BoolArray

    @classmethod
    def of(cls, t_s: float, channels: FloatArray, usable: BoolArray | None = None) -> "TactileFrame":
        """Return a frame; channels that are not finite are never usable."""
        # One after the other in memory, so that a sum over channels is the same to the bit whoever made the frame.
        channels = np.ascontiguousarray(channels)
        finite = np.isfinite(channels)
        if not everywhere(finite):
            channels = np.where(finite, channels, 0.0)
            usable = finite if usable is None else finite & usable
        return cls(t_s, channels, np.ones(channels.shape, dtype=np.bool_) if usable is None else usable)


def everywhere(mask: BoolArray) -> bool:
    """Return whether a mask is true everywhere; counted, which costs a tenth of `all` where that has not run lately."""
    return bool(np.count_nonzero(mask) == mask.size)


@dataclass(frozen=True, slots=True)
class Estimate:
    """What one frame says: values with 95 % intervals, None where not known; `why` speaks against them.

    An estimate that is not valid has no torque and no diameter. score and runner_up are the bank's, k and sigma in
    the bank's units.
    """

    valid: bool
    why: tuple[str, ...] = ()
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


def distinct(measured: Sequence[Measured]) -> list[Measured]:
    """Return the things that were measured, the most certain measurement of each, by rising value.

    Two measurements that their 95 % intervals cannot tell apart are of one thing.
    """
    things: list[Measured] = []
    for one in sorted(measured, key=lambda one: (one.half_width, one.value)):
        if all(abs(one.value - other.value) > math.hypot(one.half_width, other.half_width) for other in things):
            things.append(one)
    return sorted(things, key=lambda one: one.value)


def fused(*measured: Measured | None) -> Measured | None:
    """Return the mean of independent measurements of one thing, weighted by their variances; None without any.

    Used for the diameter, which the fingertips and the gripper's width both give. The half widths are those of 95 %
    intervals. Measurements further apart than they should be make the mean as much less certain (Birge 1932).
    """
    present = [one for one in measured if one is not None]
    if not present:
        return None
    if any(one.half_width <= 0 for one in present):
        raise ValueError("a measurement with no uncertainty cannot be weighed against others")
    weighed = [(one.half_width**-2, one.value) for one in present]
    total = sum(weight for weight, _ in weighed)
    if not total:
        # Each of them may be anything.
        return None
    mean = sum(weight * value for weight, value in weighed) / total
    squares = sum(weight * (value - mean) ** 2 for weight, value in weighed)
    apart = TWO_SIDED_95**2 * squares / max(len(present) - 1, 1)
    return Measured(mean, math.sqrt(max(apart, 1.0) / total))
