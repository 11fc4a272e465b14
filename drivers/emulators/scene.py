"""What happens between gripper, tool and sensors: one physics for all devices of the rig. No I/O; time is passed in.

The wrist's angle comes from the arm and the force from the fingers; the twin makes a torque of them; the boards see it
as they measure: the load cell as a mean over each conversion, the EIT injection after injection.
"""

from collections import deque
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from shearloop.drivers.emulators.robotiq.gripper import Gripper
from shearloop.drivers.emulators.twin import Joint, Twin, TwinSettings

FloatArray = NDArray[np.float64]

N_INJECTIONS = 32
# Moments at which a mean over a conversion looks.
N_MOMENTS = 16
# A little longer than the longest measurement, a frame.
REMEMBERED_S = 0.6
# Without any friction at all the twin would take the fingers for open.
LEAST_FORCE_N = 1e-6


@dataclass(frozen=True, slots=True)
class Truth:
    """What is really so at `time_s` of the scene's own time; diameter_mm is None while nothing is there to grip."""

    time_s: float
    wrist_rad: float
    torque_nm: float
    shear_torque_nm: float
    tool_angle_rad: float
    slipped_rad: float
    gripped: bool
    grip_force_n: float
    width_mm: float
    diameter_mm: float | None
    joint: str


@dataclass(frozen=True, slots=True)
class Sheared:
    """What a frame saw at each of its 32 injections: whether the tool was gripped (0…1) and the gel's shear in N·m."""

    grip: FloatArray
    shear_torque_nm: FloatArray
    diameter_mm: float


@dataclass(frozen=True, slots=True)
class _Moment:
    time_s: float
    grip: float
    shear_torque_nm: float
    torque_nm: float


class Scene:
    """Gripper, tool and joint, `speed` times as fast as the time that `step` is given.

    Positive torque is what a wrist turned in its positive direction puts into the tool.
    """

    def __init__(self, gripper: Gripper, settings: TwinSettings | None = None, speed: float = 1.0) -> None:
        self.gripper = gripper
        self.twin = Twin(settings or TwinSettings())
        self.time_s = 0.0
        self._speed = speed
        self._wrist_rad = 0.0
        self._slips_to_nm: float | None = None
        self._moments = deque([_Moment(0.0, 0.0, 0.0, 0.0)])

    def step(self, dt_s: float, wrist_rad: float) -> float:
        """Advance and return the torque in N·m with which the tool resists: the one that the flange feels."""
        dt_s *= self._speed
        self.time_s += dt_s
        self._wrist_rad = wrist_rad
        self.gripper.step(dt_s)
        force_n = self.gripper.grip_force_n
        if force_n <= 0.0:
            # Whoever turned the workpiece did not twist what is gripped next.
            self.twin.kick_nm = 0.0
        elif self._slips_to_nm is not None:
            force_n = min(force_n, max(self._slips_to_nm / self.twin.settings.slip_torque_nm_per_n, LEAST_FORCE_N))
        self._slips_to_nm = None
        state = self.twin.step(dt_s, wrist_rad, force_n)
        self._remember(_Moment(self.time_s, float(state.gripped), state.shear_torque_nm, state.torque_nm))
        return -state.torque_nm

    def conversion_nm(self, duration_s: float) -> float:
        """Return the mean torque on the lever, in N·m, over the last so many seconds of the scene's time."""
        return float(np.interp(self._before(duration_s, N_MOMENTS), *self._history("torque_nm")).mean())

    def frame(self, duration_s: float) -> Sheared:
        """Return what each injection of a frame saw that took the last so many seconds of the scene's time."""
        times_s = self._before(duration_s, N_INJECTIONS)
        return Sheared(
            grip=np.interp(times_s, *self._history("grip")),
            shear_torque_nm=np.interp(times_s, *self._history("shear_torque_nm")),
            diameter_mm=self.gripper.width_mm,
        )

    def truth(self) -> Truth:
        """Return what is so now."""
        state = self.twin.state
        return Truth(
            time_s=self.time_s,
            wrist_rad=self._wrist_rad,
            torque_nm=state.torque_nm,
            shear_torque_nm=state.shear_torque_nm,
            tool_angle_rad=state.tool_angle_rad,
            slipped_rad=state.slipped_rad,
            gripped=state.gripped,
            grip_force_n=self.gripper.grip_force_n,
            width_mm=self.gripper.width_mm,
            diameter_mm=self.gripper.between(0.0),
            joint=self.twin.settings.joint.value,
        )

    def kick(self, jump_nm: float) -> None:
        """Let the torque jump by so much: the workpiece is turned. ValueError when nothing is gripped."""
        self._require_grip("kick")
        self.twin.kick(jump_nm)

    def slip(self, left_nm: float = 0.0) -> None:
        """Let the tool slip in the grip until so much torque is left. ValueError when nothing is gripped."""
        self._require_grip("slip")
        self._slips_to_nm = abs(left_nm)

    def put_on(self, joint: Joint) -> None:
        """Put the tool on another joint, which nobody has turned yet; a tool in the grip is without torque then."""
        self.twin = Twin(replace(self.twin.settings, joint=joint))

    def _require_grip(self, what: str) -> None:
        if not self.twin.state.gripped:
            raise ValueError(f"{what} needs a tool in the grip, and the fingers hold nothing")

    def _remember(self, moment: _Moment) -> None:
        self._moments.append(moment)
        while self._moments[0].time_s < self.time_s - REMEMBERED_S:
            self._moments.popleft()

    def _before(self, duration_s: float, n: int) -> FloatArray:
        """Return the middles (n,) of n equal parts of the last so many seconds."""
        return self.time_s - duration_s * (1.0 - (np.arange(n) + 0.5) / n)

    def _history(self, name: str) -> tuple[FloatArray, FloatArray]:
        times_s = np.array([moment.time_s for moment in self._moments])
        return times_s, np.array([getattr(moment, name) for moment in self._moments])
