"""Recordings as series of frames with their torques, for a fit and for its judgement; the daemon runs without them."""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from shearloop.bank.arrays import BoolArray, FloatArray
from shearloop.bank.channels import PAPER_TABLE, ChannelTable
from shearloop.bank.errors import CalibrationError
from shearloop.estimation.values import Measured, TactileFrame, torque_at
from shearloop.words import counted


@dataclass(frozen=True, slots=True, eq=False)
class FrameSeries:
    """Frames in time order with the torque and the tool's diameter, where these are known.

    t_s (n,) is the middle of each acquisition in seconds; channels (n, m, c) in volts for m sides. torque_nm (p,)
    was measured at torque_t_s (p,) on the same clock. diameter_mm (n,) is NaN where unknown; gripper_mm is then the
    gripper's width, if there was a gripper. Diameters are not fitted to gripper_mm. first_frame is the first frame's
    number in the whole recording. load_doubt says why the torque's times may be wrong. left_out names frames and
    torques that were left out, with their number. emulated says that every device was emulated. fingers_moved (n, m)
    says during which frames the gripper's fingers opened or closed; it is None if that is not known. period_s is the
    frame period of the daemon's configuration, infinite without one. whole_t_s (w,) has the times of all frames of the
    recording where this series is a part of it.
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
    period_s: float = np.inf
    whole_t_s: FloatArray | None = None

    def __post_init__(self) -> None:
        """Check shapes and times."""
        object.__setattr__(self, "sides", names_of(self.sides))
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

    def frames(self) -> Iterator[TactileFrame]:
        """Yield the frames as a session takes them."""
        for number, (t_s, channels) in enumerate(zip(self.t_s.tolist(), self.channels, strict=True)):
            moved = self.fingers_moved is not None and bool(self.fingers_moved[number].any())
            yield TactileFrame.of(t_s, channels, fingers_moved=moved)

    def torque_at_frames(self) -> FloatArray:
        """Return the (n,) torque in N·m at the middle of each frame, NaN where no reading is near."""
        return torque_at(self.t_s, self.torque_t_s, self.torque_nm)

    def select_sides(self, sides: str | Iterable[str]) -> Self:
        """Return the series with one side or several only; raises CalibrationError for a side that is missing."""
        sides = names_of(sides)
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
            whole_t_s=self.t_s if self.whole_t_s is None else self.whole_t_s,
        )

    @property
    def tool_mm(self) -> Measured | None:
        """Diameter of the tool, None where unknown."""
        if not len(self.t_s):
            return None
        known_mm = float(self.diameter_mm[0])
        return Measured(known_mm, 0.0) if np.isfinite(known_mm) else self.gripper_mm


def names_of(names: str | Iterable[str]) -> tuple[str, ...]:
    """Return one name or several as a tuple: a text is one name, not a list of letters."""
    return (names,) if isinstance(names, str) else tuple(names)


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
