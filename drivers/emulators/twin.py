"""The physics between a gripped tool and the sensors: gel, grip, screw, load cell. No I/O; time is passed in.

Wrist and base hold two springs in series: the gel pads between the fingers and the tool (they creep, and slip when
the grip gives way) and the tool in its joint (a lever on the load cell, or a screw that tightens, breaks loose or
strips). All motion is slow, so the torque is the same everywhere and follows from a balance at each step.
"""

import math
from dataclasses import dataclass, field, replace
from enum import Enum


class Joint(Enum):
    """What the tool is in."""

    LEVER = "lever"  # rests on the load cell for ever: the paper's rig
    TIGHTENING = "tightening"  # friction grows with the angle turned
    SEIZED = "seized"  # holds up to a torque, then turns at a lower one
    STRIPPING = "stripping"  # tightens, then gives way for good


@dataclass(frozen=True, slots=True)
class TwinSettings:
    """The rig's constants. Gel figures are of the size seen in recordings of the paper's rig."""

    gel_stiffness_nm_per_rad: float = 0.8
    # What a held twist loses in the end, and how fast.
    relaxing_share: float = 0.08
    relaxation_s: float = 20.0
    # Width of the band in which the gel's conductivity does not follow a reversal.
    hysteresis_rad: float = 0.004
    # Torque that the grip bears, per newton of gripping force.
    slip_torque_nm_per_n: float = 0.012
    joint: Joint = Joint.LEVER
    joint_stiffness_nm_per_rad: float = 20.0
    breakaway_torque_nm: float = 0.18
    running_torque_nm: float = 0.06
    tightening_nm_per_rad: float = 0.15
    stripping_torque_nm: float = 0.22

    def __post_init__(self) -> None:
        """Refuse constants that no gel has."""
        if not 0.0 <= self.relaxing_share < 1.0:
            raise ValueError(f"relaxing_share is {self.relaxing_share}, outside 0 to 1")
        if min(self.gel_stiffness_nm_per_rad, self.joint_stiffness_nm_per_rad, self.relaxation_s) <= 0:
            raise ValueError("stiffnesses and relaxation time must be positive")


@dataclass(frozen=True, slots=True)
class TwinState:
    """What the sensors would see now."""

    torque_nm: float = 0.0
    # Shear of the gel as its conductivity shows it, expressed as the torque that it means on a fresh gel.
    shear_torque_nm: float = 0.0
    tool_angle_rad: float = 0.0
    slipped_rad: float = 0.0
    gripped: bool = False


@dataclass(slots=True)
class Twin:
    """Steps the physics; `kick_nm` is a torque from outside, for disturbances and faults."""

    settings: TwinSettings = field(default_factory=TwinSettings)
    state: TwinState = TwinState()
    kick_nm: float = 0.0
    _reference_rad: float = 0.0  # wrist angle at which the gel would be free of torque
    _crept_rad: float = 0.0
    _turned_rad: float = 0.0  # plastic angle of the joint
    _broken_loose: bool = False
    _stripped: bool = False
    _seen_rad: float = 0.0  # the hysteresis band's centre

    def step(self, dt_s: float, wrist_rad: float, grip_force_n: float) -> TwinState:
        """Advance by dt_s with the wrist at an angle and the fingers pressing with a force (0: open)."""
        if grip_force_n <= 0.0:
            self._reference_rad, self._crept_rad, self._seen_rad = wrist_rad, 0.0, 0.0
            self.state = replace(self.state, torque_nm=0.0, shear_torque_nm=0.0, slipped_rad=0.0, gripped=False)
            return self.state
        if not self.state.gripped:
            # The tool is taken as it stands: what the joint holds is not yet in the gel.
            self._reference_rad = wrist_rad - self._turned_rad
        settings = self.settings
        torque, gel_rad = self._balance(wrist_rad)
        slip_nm = settings.slip_torque_nm_per_n * grip_force_n
        slipped_rad = 0.0
        for _ in range(50):  # each pass moves what is weakest until both grip and joint bear the torque
            limit_nm = min(slip_nm, self._joint_bears_nm(torque))
            excess_nm = abs(torque) - limit_nm
            if excess_nm <= 1e-12:
                break
            give_rad = math.copysign(excess_nm * self._compliance(), torque)
            if slip_nm <= self._joint_bears_nm(torque):
                slipped_rad += give_rad
                self._reference_rad += give_rad
            else:
                self._turn(give_rad, torque)
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
        """Turn the workpiece by so much that the torque jumps by jump_nm, where grip and joint bear it."""
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

    def _joint_bears_nm(self, torque_nm: float) -> float:
        """Return the torque beyond which the joint turns, in the direction of the torque."""
        settings = self.settings
        match settings.joint:
            case Joint.LEVER:
                return math.inf
            case Joint.SEIZED:
                return settings.running_torque_nm if self._broken_loose else settings.breakaway_torque_nm
            case Joint.TIGHTENING | Joint.STRIPPING:
                if self._stripped:
                    return settings.running_torque_nm / 2
                # Clockwise, the negative direction, tightens; loosening takes a little less than was put in.
                into_rad = max(0.0, -self._turned_rad)
                bears_nm = settings.running_torque_nm + settings.tightening_nm_per_rad * into_rad
                return bears_nm if torque_nm < 0 else 0.8 * bears_nm

    def _turn(self, give_rad: float, torque_nm: float) -> None:
        self._turned_rad += give_rad
        self._broken_loose = True
        if self.settings.joint is Joint.STRIPPING and abs(torque_nm) >= self.settings.stripping_torque_nm:
            self._stripped = True
