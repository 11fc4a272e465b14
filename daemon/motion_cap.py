"""The limits that the report of a rig's commissioning allows, and the cap on a robot without a valid report.

The report is a record, not a safety function. Only the pendant's safety configuration is rated.
"""

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Final, TypeVar

from shearloop.daemon.config import DaemonConfig
from shearloop.daemon.supplied_values import NOTHING_SUPPLIED, Supplied
from shearloop.daemon.torques import BOTH_DIRECTIONS, Direction
from shearloop.drivers.defaults import EMULATED_SERIAL_NUMBER
from shearloop.drivers.ur.messages import RobotLostError
from shearloop.drivers.ur.settings import Bound, UrSettings
from shearloop.errors import Hint

if TYPE_CHECKING:
    # A rig without a report does not load it.
    from shearloop.daemon.commissioning_report import Report

BoundT = TypeVar("BoundT", bound=Bound)

# A robot without a valid report turns and moves at most this fast, and may have at most this torque.
CAPPED_RAD_PER_S: Final = 0.2
CAPPED_M_PER_S: Final = 0.05
CAPPED_NM: Final = 0.3
# A measured value beyond this multiple of a capped speed stops the motion.
_HARD: Final = 1.6
# The stages that a quantity's limits depend on, by the first figure of their names.
_SPEED_NEEDS: Final = "0134"
_TORQUE_NEEDS: Final = "01357"


def new_report(file: str = "NEW_FILE", *, rehearsed: bool = False) -> str:
    """Return the cure where no report can be continued; in a rehearsal one of emulated devices helps."""
    if rehearsed:
        return (
            f"run `shearloop commission CONFIG --out {file} --emulate`, then rehearse with the option `--set "
            "commissioned=…` that it prints at its end"
        )
    return (
        f"run `shearloop commission CONFIG --out {file}`, then write the line `commissioned: …` that it prints at its "
        "end into the configuration"
    )


@dataclass(frozen=True, slots=True)
class MotionCap:
    """The largest speeds and torque that a rig's report allows, why no larger ones, and what raises them.

    A step may have `torque_nm` if one of `torque_sources` drives its experiment, and if it loads the tool in
    `torque_directions` alone. Any other step may have `CAPPED_NM`.
    """

    why: str
    cure: str = ""
    wrist_speed_rad_per_s: float = CAPPED_RAD_PER_S
    linear_speed_m_per_s: float = CAPPED_M_PER_S
    torque_nm: float = CAPPED_NM
    torque_sources: tuple[str, ...] = ()
    torque_directions: frozenset[Direction] = BOTH_DIRECTIONS

    def torque_nm_of(self, source: str, directions: frozenset[Direction] = BOTH_DIRECTIONS) -> float:
        """Return the largest torque of a step that loads the tool in these directions, driven by this source."""
        is_measured = source in self.torque_sources and directions <= self.torque_directions
        return self.torque_nm if is_measured else CAPPED_NM

    @property
    def sentence(self) -> str:
        """Return the cap in words, with its cure."""
        return "; ".join(filter(None, (self.cause, self.cure)))

    @property
    def cause(self) -> str:
        """Return the cap in words, without its cure."""
        return (
            f"the robot is capped at {self.wrist_speed_rad_per_s:g} rad/s, {self.linear_speed_m_per_s:g} m/s and "
            f"{self.torque_nm:g} N·m{self._raised_for}: {self.why}"
        )

    @property
    def _raised_for(self) -> str:
        """For which sources and directions the torque is raised, in words."""
        if not self.torque_sources:
            return ""
        sources = ", ".join(self.torque_sources)
        if self.torque_directions == BOTH_DIRECTIONS:
            return f" ({sources}; any other source {CAPPED_NM:g} N·m)"
        (direction,) = self.torque_directions
        return f" ({sources}, {direction} alone; else {CAPPED_NM:g} N·m)"


@dataclass(slots=True)
class Commissioning:
    """The robot's settings within its report. An emulated robot needs no report, unless it plays a real robot.

    `reason` says why the report raises nothing, and what helps. It is None for a report that counts. `emulated` means
    a robot without a cap, `rehearsed` an emulated robot with the cap of the real one. The report raises the torque of
    `torque_sources`, in the directions that its stage measured.
    """

    given: UrSettings
    report: "Report | None"
    reason: Hint | None = None
    emulated: bool = False
    rehearsed: bool = False
    torque_sources: tuple[str, ...] = ()
    torque_directions: frozenset[Direction] = BOTH_DIRECTIONS
    # How the connected controller differs from the report's.
    _other: Hint | None = field(default=None, init=False)

    @property
    def cap(self) -> MotionCap | None:
        """The present cap; None for an emulated robot that plays no real robot."""
        if self.emulated:
            return None
        if self.report is None:
            cure = new_report("FILE", rehearsed=self.rehearsed)
            return MotionCap("`commissioned` is not in the configuration", cure)
        if why := self.reason or self._other:
            return MotionCap(why.cause, why.cure)
        found = self.report.supplied()
        wrist_rad_per_s = found.wrist_speed_rad_per_s if self.report.has(_SPEED_NEEDS) else None
        torque_nm = (found.torque_nm if self.report.has(_TORQUE_NEEDS) else None) or 0.0
        devices = " of emulated devices" if self.report.rig.emulated else ""
        return MotionCap(
            f"its report{devices} covers no more",
            wrist_speed_rad_per_s=max(CAPPED_RAD_PER_S, wrist_rad_per_s or 0.0),
            torque_nm=max(CAPPED_NM, torque_nm),
            torque_sources=self.torque_sources if torque_nm > CAPPED_NM else (),
            torque_directions=self.torque_directions,
        )

    @property
    def settings(self) -> UrSettings:
        """The robot's settings within the cap, with the values that a counting report supplies."""
        cap, settings = self.cap, self.given
        if cap is None:
            return settings
        limits = settings.limits
        joints = limits.joints
        if self.supplied.stop_rad is not None:
            joints = replace(joints, margin_rad=max(joints.margin_rad, self.supplied.stop_rad))
        limits = replace(
            limits,
            joints=joints,
            wrist_speed_rad_per_s=_lowered(limits.wrist_speed_rad_per_s, cap.wrist_speed_rad_per_s),
            linear_speed_m_per_s=_lowered(limits.linear_speed_m_per_s, cap.linear_speed_m_per_s),
        )
        measured = self.supplied
        return replace(
            settings,
            limits=limits,
            rest_rad_per_s=settings.rest_rad_per_s if measured.rest_rad_per_s is None else measured.rest_rad_per_s,
            # Braking before an end of a range needs the longest delay, and the few measured turns may not show it.
            reaction_s=max(settings.reaction_s, measured.reaction_s or 0.0),
        )

    @property
    def supplied(self) -> Supplied:
        """The values of a counting report; empty without one."""
        return self.report.supplied() if self.report is not None and self.counts else NOTHING_SUPPLIED

    @property
    def counts(self) -> bool:
        """Whether there is a report that raises the limits that its stages cover."""
        return self.report is not None and not (self.reason or self._other)

    def on_controller(self, polyscope: str, serial_number: str) -> UrSettings:
        """Compare the connected controller with the report's, and return the settings for it.

        A rehearsal has an emulated controller, which is never the report's. Raises RobotLostError for a real controller
        in an emulated rig, because this rig has neither the deadlines nor the cap of a real one.
        """
        plays = self.emulated or self.rehearsed
        if plays and (reason := why_not_emulated(self.given.host, serial_number)):
            raise RobotLostError("not-emulated", f"{reason.clause}.")
        if self.report is not None and not self.rehearsed:
            seen = {"polyscope": polyscope, "robot_serial_number": serial_number}
            differs = list(self.report.rig.differences(self.report.rig.model_copy(update=seen)))
            changed = f"{' and '.join(differs)} changed since its report"
            self._other = Hint(changed, new_report()) if differs else None
        return self.settings

    @property
    def sentence(self) -> str:
        """The cap in words; empty without a cap."""
        return self.cap.sentence if self.cap is not None else ""


def why_not_emulated(host: str, robot_serial_number: str) -> Hint | None:
    """Return that the controller at an address is no emulated one, by its serial number, and the cure; or None."""
    if robot_serial_number == EMULATED_SERIAL_NUMBER:
        return None
    return Hint(
        f"The configuration says `emulated: true`, and the controller at {host} is no emulated one: its serial number "
        f"is {robot_serial_number or 'unknown'}, not {EMULATED_SERIAL_NUMBER}",
        "take `emulated` out for a real robot",
    )


def _lowered(bound: BoundT, cap: float) -> BoundT:
    """Return a bound on a speed that keeps commands at or below the cap, and measured values not far above it."""
    if bound.inner <= cap:
        return bound
    return replace(bound, inner=cap, hard=min(bound.hard, _HARD * cap))


def knows_tool(stated_mm: float | None, config: DaemonConfig, robot: Commissioning | None) -> bool:
    """Return whether the tool's diameter is stated, or measured by the gripper's calibration or the report's table."""
    if stated_mm is not None or config.gripper is None:
        return stated_mm is not None
    return config.gripper.calibration is not None or (robot is not None and robot.supplied.widths is not None)
