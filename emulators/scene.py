"""The physics shared by all emulated devices: gel, grip, joint and load cell. No I/O; time is passed in.

The arm gives the wrist's angle, the fingers their force. Wrist and base hold two springs in series: the gel pads
(they creep, and slip when the grip gives way) and the tool in its joint (a lever on the load cell, or a screw that
tightens or breaks loose). All motion is slow, so one torque follows from a balance at each step. The boards see
it as they measure: the load cell as a mean over each conversion, the EIT-kit injection by injection.
"""

import math
from collections import deque
from dataclasses import asdict, dataclass, field, replace
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from shearloop.emulators.gripper import Gripper

FloatArray = NDArray[np.float64]

N_INJECTIONS = 32
# Samples in the mean over a conversion.
N_MOMENTS = 16
# A little longer than a frame.
HISTORY_S = 0.6
# Without any friction the twin would take the fingers for open.
MIN_FORCE_N = 1e-6


class Joint(Enum):
    """The joint that holds the tool."""

    LEVER = "lever"  # rests on the load cell for ever: the paper's rig
    TIGHTENING = "tightening"  # friction grows with the angle turned
    SEIZED = "seized"  # holds up to a torque, then turns at a lower one


@dataclass(frozen=True, slots=True)
class TwinSettings:
    """The rig's constants; the gel's are typical of the paper's recordings."""

    gel_stiffness_nm_per_rad: float = 0.8
    # The share of a held twist that relaxes in the end, and its time constant.
    relaxing_share: float = 0.08
    relaxation_s: float = 20.0
    # After a reversal the gel's conductivity follows only beyond this angle.
    hysteresis_rad: float = 0.004
    # Torque that the grip bears, per newton of gripping force.
    slip_torque_nm_per_n: float = 0.012
    joint: Joint = Joint.LEVER
    joint_stiffness_nm_per_rad: float = 20.0
    breakaway_torque_nm: float = 0.18
    running_torque_nm: float = 0.06
    tightening_nm_per_rad: float = 0.15


@dataclass(frozen=True, slots=True)
class TwinState:
    """The true state that the sensors measure."""

    torque_nm: float = 0.0
    # The gel's shear as its conductivity shows it, as the torque of a fresh gel.
    shear_torque_nm: float = 0.0
    tool_angle_rad: float = 0.0
    slipped_rad: float = 0.0
    gripped: bool = False


@dataclass(slots=True)
class Twin:
    """The springs between wrist and base; `kick_nm` is an external torque, for disturbances and faults."""

    settings: TwinSettings = field(default_factory=TwinSettings)
    state: TwinState = TwinState()
    kick_nm: float = 0.0
    _reference_rad: float = 0.0  # wrist angle without torque in the gel
    _crept_rad: float = 0.0
    _turned_rad: float = 0.0  # plastic angle of the joint
    _broken_loose: bool = False
    _seen_rad: float = 0.0  # the hysteresis band's centre

    def step(self, dt_s: float, wrist_rad: float, grip_force_n: float) -> TwinState:
        """Advance by dt_s with a wrist angle and a gripping force (0: open)."""
        if grip_force_n <= 0.0:
            self._reference_rad, self._crept_rad, self._seen_rad = wrist_rad, 0.0, 0.0
            self.state = replace(self.state, torque_nm=0.0, shear_torque_nm=0.0, slipped_rad=0.0, gripped=False)
            return self.state
        if not self.state.gripped:
            # The joint's own torque is not yet in the gel.
            self._reference_rad = wrist_rad - self._turned_rad
        settings = self.settings
        torque, gel_rad = self._balance(wrist_rad)
        slip_nm = settings.slip_torque_nm_per_n * grip_force_n
        slipped_rad = 0.0
        for _ in range(50):  # each pass moves the weakest part until grip and joint bear the torque
            limit_nm = min(slip_nm, self._joint_limit_nm(torque))
            excess_nm = abs(torque) - limit_nm
            if excess_nm <= 1e-12:
                break
            give_rad = math.copysign(excess_nm * self._compliance(), torque)
            if slip_nm <= self._joint_limit_nm(torque):
                slipped_rad += give_rad
                self._reference_rad += give_rad
            else:
                self._turned_rad += give_rad
                self._broken_loose = True
            torque, gel_rad = self._balance(wrist_rad)
        self._crept_rad += (gel_rad - self._crept_rad) * -math.expm1(-dt_s / settings.relaxation_s)
        band_rad = settings.hysteresis_rad / 2
        self._seen_rad = min(max(self._seen_rad, gel_rad - band_rad), gel_rad + band_rad)
        self.state = TwinState(
            torque_nm=torque,
            shear_torque_nm=settings.gel_stiffness_nm_per_rad * self._seen_rad,
            tool_angle_rad=self._turned_rad + torque / settings.joint_stiffness_nm_per_rad,
            slipped_rad=self.state.slipped_rad + slipped_rad,
            gripped=True,
        )
        return self.state

    def kick(self, jump_nm: float) -> None:
        """Turn the workpiece so that the torque jumps by jump_nm, if grip and joint bear it."""
        self.kick_nm += jump_nm * self.settings.joint_stiffness_nm_per_rad * self._compliance()

    def _compliance(self) -> float:
        return 1.0 / self.settings.gel_stiffness_nm_per_rad + 1.0 / self.settings.joint_stiffness_nm_per_rad

    def _balance(self, wrist_rad: float) -> tuple[float, float]:
        """Return torque and shear angle of the gel: a creeping spring in series with the joint's."""
        settings = self.settings
        stretch_rad = wrist_rad - self._reference_rad - self._turned_rad
        crept_rad = settings.relaxing_share * self._crept_rad
        kick_rad = self.kick_nm / settings.joint_stiffness_nm_per_rad
        torque = (stretch_rad + kick_rad - crept_rad) / self._compliance()
        return torque, torque / settings.gel_stiffness_nm_per_rad + crept_rad

    def _joint_limit_nm(self, torque_nm: float) -> float:
        """Return the torque beyond which the joint turns, in the direction of `torque_nm`."""
        settings = self.settings
        match settings.joint:
            case Joint.LEVER:
                return math.inf
            case Joint.SEIZED:
                return settings.running_torque_nm if self._broken_loose else settings.breakaway_torque_nm
            case Joint.TIGHTENING:
                # Clockwise, the negative direction, tightens; loosening takes a little less.
                into_rad = max(0.0, -self._turned_rad)
                limit_nm = settings.running_torque_nm + settings.tightening_nm_per_rad * into_rad
                return limit_nm if torque_nm < 0 else 0.8 * limit_nm


@dataclass(frozen=True, slots=True, kw_only=True)
class Truth(TwinState):
    """The true state at `time_s` of the scene's own time; without an object diameter_mm is None."""

    time_s: float
    wrist_rad: float
    grip_force_n: float
    width_mm: float
    diameter_mm: float | None
    joint: str


class Scene:
    """Gripper, tool and joint, `speed` times as fast as real time.

    A wrist turned in its positive direction puts a positive torque into the tool.
    """

    def __init__(
        self, gripper: Gripper, settings: TwinSettings | None = None, speed: float = 1.0, clamp_n: float = 0.0
    ) -> None:
        """Take the gripper; `clamp_n` is the force of a clamp that holds the tool without one."""
        self.gripper = gripper
        self._clamp_n = clamp_n
        self.twin = Twin(settings or TwinSettings())
        self.time_s = 0.0
        self._speed = speed
        self._wrist_rad = 0.0
        self._slips_to_nm: float | None = None
        # On the load cell alone: a torque on top of the tool's, and the sign of a cell that is mounted the other way.
        self.load_nm, self.load_sign = 0.0, 1.0
        self._states = deque([(0.0, TwinState())])

    def step(self, dt_s: float, wrist_rad: float) -> float:
        """Advance by dt_s of real time; return the tool's resisting torque on the flange in N·m."""
        dt_s *= self._speed
        self.time_s += dt_s
        self._wrist_rad = wrist_rad
        self.gripper.step(dt_s)
        force_n = max(self.gripper.grip_force_n, self._clamp_n)
        if force_n <= 0.0:
            # A kick does not act on the next grip.
            self.twin.kick_nm = 0.0
        elif self._slips_to_nm is not None:
            force_n = min(force_n, max(self._slips_to_nm / self.twin.settings.slip_torque_nm_per_n, MIN_FORCE_N))
        self._slips_to_nm = None
        state = self.twin.step(dt_s, wrist_rad, force_n)
        self._states.append((self.time_s, state))
        while self._states[0][0] < self.time_s - HISTORY_S:
            self._states.popleft()
        return -state.torque_nm

    def conversion_nm(self, duration_s: float) -> float:
        """Return the mean torque on the lever, in N·m, over the last `duration_s` of the scene's time."""
        return self.load_sign * (self.load_nm + float(self._history("torque_nm", duration_s, N_MOMENTS).mean()))

    def frame(self, duration_s: float) -> tuple[FloatArray, FloatArray, float]:
        """Return grip (0…1) and shear (N·m) at each injection of a frame, (32,) each, and the fingers' width in mm.

        The frame covers the last `duration_s` of the scene's time.
        """
        grip = self._history("gripped", duration_s, N_INJECTIONS)
        return grip, self._history("shear_torque_nm", duration_s, N_INJECTIONS), self.gripper.width_mm

    def truth(self) -> Truth:
        """Return the true state now."""
        return Truth(
            **asdict(self.twin.state),
            time_s=self.time_s,
            wrist_rad=self._wrist_rad,
            grip_force_n=self.gripper.grip_force_n,
            width_mm=self.gripper.width_mm,
            diameter_mm=self.gripper.object_mm,
            joint=self.twin.settings.joint.value,
        )

    def kick(self, jump_nm: float) -> None:
        """Turn the workpiece so that the torque jumps by jump_nm; ValueError if nothing is gripped."""
        self._require_grip("kick")
        self.twin.kick(jump_nm)

    def slip(self, left_nm: float = 0.0) -> None:
        """Let the tool slip in the grip until left_nm remains; ValueError if nothing is gripped."""
        self._require_grip("slip")
        self._slips_to_nm = abs(left_nm)

    def put_on(self, joint: Joint) -> None:
        """Put the tool on another joint, not yet turned; a gripped tool loses its torque."""
        self.twin = Twin(replace(self.twin.settings, joint=joint))

    def put_on_spring(self, nm_per_rad: float) -> None:
        """Put the tool on a lever that gives gel and joint together this stiffness."""
        each = 2.0 * nm_per_rad
        self.twin = Twin(
            replace(
                self.twin.settings, joint=Joint.LEVER, gel_stiffness_nm_per_rad=each, joint_stiffness_nm_per_rad=each
            )
        )

    def _require_grip(self, command: str) -> None:
        if not self.twin.state.gripped:
            raise ValueError(f"{command} needs a tool in the grip, and the fingers hold nothing")

    def _history(self, name: str, duration_s: float, n: int) -> FloatArray:
        """Return a quantity (n,) in the middles of n equal parts of the last `duration_s`."""
        middles_s = self.time_s - duration_s * (1.0 - (np.arange(n) + 0.5) / n)
        times_s = [time_s for time_s, _ in self._states]
        values = [float(getattr(state, name)) for _, state in self._states]
        return np.asarray(np.interp(middles_s, times_s, values))
