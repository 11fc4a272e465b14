"""Values that estimators take and return: series of frames, single frames, measurements, estimates."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Self

import numpy as np

from shearloop.bank.arrays import BoolArray, FloatArray
from shearloop.bank.channels import PAPER_TABLE, ChannelTable
from shearloop.bank.errors import CalibrationError
from shearloop.estimation.confidence import TWO_SIDED_95
from shearloop.words import counted

# Metadata of a dataclass's field: in the calibration's file its fields join the other fields of the dataclass.
INLINE = {"inline": True}
# Load cells on a lever bear some N·m; larger readings come from a damaged line.
LARGEST_TORQUE_NM = 20.0
# Recorded loads change by up to 0.76 N·m/s, so older readings say nothing.
_MAX_TORQUE_AGE_S = 1.0


@dataclass(frozen=True, slots=True)
class Measured:
    """A value and the half width of its 95 % interval."""

    value: float
    half_width: float


@dataclass(frozen=True, slots=True, eq=False)
class FrameSeries:
    """Frames in time order with the torque and the tool's diameter, where these are known.

    t_s (n,) is the middle of each acquisition in seconds; channels (n, m, c) in volts for m sides. torque_nm (p,)
    was measured at torque_t_s (p,) on the same clock. diameter_mm (n,) is NaN where unknown; gripper_mm is then the
    gripper's width, if there was a gripper. Diameters are not fitted to gripper_mm. first_frame is the first frame's
    number in the whole recording. load_doubt says why the torque's times may be wrong. left_out names frames and
    torques that were left out, with their number. emulated says that every device was emulated. fingers_moved (n, m)
    says during which frames the gripper's fingers opened or closed; it is None if that is not known.
    Raises CalibrationError for shapes that do not match and for times that decrease.
    """

    sides: tuple[str, ...]
    t_s: FloatArray
    channels: FloatArray
    torque_t_s: FloatArray
    torque_nm: FloatArray
    diameter_mm: FloatArray
    gripper_mm: Measured | None = None
    table: ChannelTable = PAPER_TABLE
    first_frame: int = 0
    load_doubt: str = ""
    left_out: tuple[str, ...] = ()
    emulated: bool = False
    fingers_moved: BoolArray | None = None

    def __post_init__(self) -> None:
        """Check shapes and times."""
        n, m = len(self.t_s), len(self.sides)
        expected = n, m, self.table.n_channels
        if self.channels.shape != expected or self.diameter_mm.shape != (n,):
            raise CalibrationError(
                f"{n} frames of {m} sides need channels of shape {expected} and {n} diameters, not "
                f"{self.channels.shape} and {self.diameter_mm.shape}"
            )
        if self.fingers_moved is not None and self.fingers_moved.shape != (n, m):
            raise CalibrationError(f"{n} frames of {m} sides do not match motions of shape {self.fingers_moved.shape}")
        if self.torque_t_s.shape != self.torque_nm.shape:
            raise CalibrationError(f"{self.torque_t_s.shape} times do not match {self.torque_nm.shape} torques")
        for name, times in (("frames", self.t_s), ("torques", self.torque_t_s)):
            if (np.diff(times) < 0).any():
                raise CalibrationError(f"the times of the {name} must not decrease; sort them")

    def frames(self) -> "Iterator[TactileFrame]":
        """Yield the frames as a session takes them."""
        for number, (t_s, channels) in enumerate(zip(self.t_s.tolist(), self.channels, strict=True)):
            moved = self.fingers_moved is not None and bool(self.fingers_moved[number].any())
            yield TactileFrame.of(t_s, channels, fingers_moved=moved)

    def torque_at_frames(self) -> FloatArray:
        """Return the (n,) torque in N·m at the middle of each frame, NaN where no reading is near."""
        return torque_at(self.t_s, self.torque_t_s, self.torque_nm)

    def select_sides(self, sides: tuple[str, ...]) -> Self:
        """Return the series with these sides only; raises CalibrationError for a side that is missing."""
        missing = [side for side in sides if side not in self.sides]
        if missing:
            raise CalibrationError(
                f"the recording has the sides {', '.join(self.sides)} but not {' and '.join(missing)}; "
                "choose among those"
            )
        layers = [self.sides.index(side) for side in sides]
        moved = None if self.fingers_moved is None else self.fingers_moved[:, layers]
        return replace(self, sides=sides, channels=self.channels[:, layers], fingers_moved=moved)

    def between(self, start: int, stop: int) -> Self:
        """Return frames `start` to `stop` with all torques."""
        part = slice(start, stop)
        return replace(
            self,
            t_s=self.t_s[part],
            channels=self.channels[part],
            diameter_mm=self.diameter_mm[part],
            first_frame=self.first_frame + start,
            fingers_moved=None if self.fingers_moved is None else self.fingers_moved[part],
        )

    @property
    def tool_mm(self) -> Measured | None:
        """Diameter of the tool, None where unknown."""
        if not len(self.t_s):
            return None
        known_mm = float(self.diameter_mm[0])
        return Measured(known_mm, 0.0) if np.isfinite(known_mm) else self.gripper_mm


@dataclass(frozen=True, slots=True, eq=False)
class TactileFrame:
    """Frames of m sides at one time: t_s in seconds (middle of the acquisition), channels (m, c) in volts.

    usable (m, c) is False at dead and saturated channels, `repeated` True where a board sent a frame again.
    fingers_moved: they opened or closed during a part of the acquisition. Do not change the arrays afterwards.
    """

    t_s: float
    channels: FloatArray
    usable: BoolArray
    repeated: bool = False
    fingers_moved: bool = False

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
    """What the fingers hold: the tool's diameter in mm, None where unknown."""

    diameter: Measured | None


@dataclass(frozen=True, slots=True, eq=False)
class KnownTorques:
    """Torques (n,) in N·m of another source, `reference`, at the frames of this grip; NaN where unknown."""

    reference: str
    torque_nm: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class BeforeFrame:
    """What a session has to know before a frame, and the frame does not contain. `Session.prepare` applies it.

    begins_tare: the next frames are of untouched fingertips and make the idle frame. gives_up_tare: they do not, or not
    any longer. tool: it has changed; None if not. fingers_moved: during a part of the frame's acquisition.
    known_torques correct the gain of this grip.
    """

    begins_tare: bool = False
    gives_up_tare: bool = False
    tool: HeldTool | None = None
    fingers_moved: bool = False
    known_torques: KnownTorques | None = None

    def with_later(self, later: "BeforeFrame") -> "BeforeFrame":
        """Return both together: what this one and a later one say of the same frame."""
        return BeforeFrame(
            begins_tare=self.begins_tare or later.begins_tare,
            gives_up_tare=self.gives_up_tare or later.gives_up_tare,
            tool=later.tool or self.tool,
            fingers_moved=self.fingers_moved or later.fingers_moved,
            known_torques=later.known_torques or self.known_torques,
        )


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


def torque_at(t_s: FloatArray, torque_t_s: FloatArray, torque_nm: FloatArray) -> FloatArray:
    """Return the (n,) torque at t_s (n,) from readings (p,) in time order, NaN where no reading is near."""
    if len(torque_t_s) == 0:
        return np.full(len(t_s), np.nan)
    after = np.searchsorted(torque_t_s, t_s).clip(0, len(torque_t_s) - 1)
    around = torque_t_s[[np.maximum(after - 1, 0), after]]
    known = np.abs(around - t_s).min(axis=0) <= _MAX_TORQUE_AGE_S
    torque = np.interp(t_s, torque_t_s, torque_nm, left=np.nan, right=np.nan)
    return np.where(known, torque, np.nan)


def check_finite(recordings: Sequence[FrameSeries]) -> None:
    """Raise CalibrationError for a recording without frames, or with values that are not finite."""
    check_finite_values([(recording.t_s, recording.channels, recording.torque_nm) for recording in recordings])


def check_finite_values(recordings: Sequence[tuple[FloatArray, ...]]) -> None:
    """Raise CalibrationError for times, frames and further values that are not finite, and for no frames."""
    for number, values in enumerate(recordings, 1):
        which = f"recording {number} of {len(recordings)}"
        if not len(values[0]):
            raise CalibrationError(f"{which} has no frames to calibrate on; leave it out, or use a longer part of it")
        wrong = sum(int(np.count_nonzero(~np.isfinite(array))) for array in values)
        if wrong:
            found = counted(wrong, "value that is not a finite number", "values that are not finite numbers")
            raise CalibrationError(f"{which} holds {found}; leave those frames out")


def winkler_scores(truth: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """Return the scores of (n,) 95 % intervals: their widths and 40 times the distance of a truth outside.

    Less is better (Winkler 1972; Gneiting and Raftery 2007, equation 43).
    """
    outside = np.maximum(low - truth, 0.0) + np.maximum(truth - high, 0.0)
    return high - low + 2 / (1 - 0.95) * outside


def distinct(measured: Sequence[Measured]) -> list[Measured]:
    """Return the most certain measurement of each thing, by rising value.

    Two measurements are of one thing if their 95 % intervals cannot separate them.
    """
    things: list[Measured] = []
    for measurement in sorted(measured, key=lambda measurement: (measurement.half_width, measurement.value)):
        if all(
            abs(measurement.value - other.value) > math.hypot(measurement.half_width, other.half_width)
            for other in things
        ):
            things.append(measurement)
    return sorted(things, key=lambda measurement: measurement.value)


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
