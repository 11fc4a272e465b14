"""The report of a rig's commissioning, the limits that it allows, and the cap on a robot without a valid report.

The report is a record, not a safety function. Only the pendant's safety configuration is rated.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Final, Literal, TypeVar

from pydantic import AwareDatetime

from shearloop.daemon.config import DaemonConfig
from shearloop.daemon.rig_identity import Record, RigIdentity, identity_of, judged_by, judged_sha256s, why_not_emulated
from shearloop.drivers.defaults import EMULATED_SERIAL_NUMBER
from shearloop.drivers.errors import DriverError
from shearloop.drivers.robotiq.models import ModelName
from shearloop.drivers.robotiq.widths import WidthCalibration
from shearloop.drivers.ur.messages import RobotLostError
from shearloop.drivers.ur.settings import Bound, UrSettings
from shearloop.errors import UserError
from shearloop.yaml_files import load_model

Verdict = Literal["passed", "failed", "noted"]
BoundT = TypeVar("BoundT", bound=Bound)

# A robot without a valid report turns and moves at most this fast, and may have at most this torque.
CAPPED_RAD_PER_S: Final = 0.2
CAPPED_M_PER_S: Final = 0.05
CAPPED_NM: Final = 0.3
# A report counts for this time after its oldest stage.
MAX_AGE_DAYS: Final = 180
# This computer's clock may be this much behind the clock that dated the report.
_CLOCKS_DIFFER = timedelta(days=1)
# A measured value beyond this multiple of a capped speed stops the motion.
_HARD: Final = 1.6
CURE: Final = (
    "run `shearloop commission CONFIG --out FILE{option}`, then write `commissioned: FILE` into the configuration"
)
# The stages that a quantity's limits depend on, by the first figure of their names.
_SPEED_NEEDS: Final = "0134"
_TORQUE_NEEDS: Final = "01357"


class Line(Record):
    """One measured or noted value: its name, its limit, the number of measurements, and the promise it checks."""

    what: str
    value: str
    limit: str = ""
    count: int = 1
    promise: str = ""
    verdict: Verdict = "noted"


class Supplied(Record):
    """Values that the daemon takes from a stage; a key that is absent was not measured."""

    wrist_speed_rad_per_s: float | None = None
    torque_nm: float | None = None
    rest_rad_per_s: float | None = None
    actuation_s: float | None = None
    reaction_s: float | None = None
    stop_rad: float | None = None
    widths: tuple[tuple[float, float], ...] | None = None
    """Pairs of counts and mm."""


NOTHING_SUPPLIED: Final = Supplied()


class StageResult(Record):
    """The lines of one stage, who ran it, and when.

    `judged_sha256s`: hashes of the keys and files that only this stage or a few stages judge, in hexadecimal.
    `RigIdentity` has the hashes for all stages.
    """

    stage: str
    operator: str
    date: AwareDatetime
    lines: tuple[Line, ...]
    supplies: Supplied = NOTHING_SUPPLIED
    judged_sha256s: Mapping[str, str] = {}

    @property
    def passed(self) -> bool:
        """Whether no line failed."""
        return all(line.verdict != "failed" for line in self.lines)

    def changed_since(self, hashes: Mapping[str, str]) -> list[str]:
        """Return the keys and files that this stage judged and that have changed since, for a sentence."""
        now = judged_by(self.stage, hashes)
        return [f"`{key}`" for key, own in now.items() if self.judged_sha256s.get(key) != own]


class Report(Record):
    """All stages of one rig."""

    version: Literal[3] = 3
    rig: RigIdentity
    stages: tuple[StageResult, ...] = ()

    @property
    def passed(self) -> bool:
        """Whether the report has a stage, and no stage has a failed line."""
        return bool(self.stages) and all(stage.passed for stage in self.stages)

    def stage(self, number: str) -> StageResult | None:
        """Return the stage with this figure at the beginning of its name, if it was run."""
        return next((stage for stage in self.stages if stage.stage.startswith(number)), None)

    def supplied(self) -> Supplied:
        """Return the values of all stages."""
        values: dict[str, object] = {}
        for stage in self.stages:
            values |= stage.supplies.model_dump(exclude_none=True)
        return Supplied.model_validate(values)

    def has(self, numbers: str) -> bool:
        """Return whether all of these stages were run."""
        return all(self.stage(number) is not None for number in numbers)


@dataclass(frozen=True, slots=True)
class MotionCap:
    """The largest speeds and torque that a rig's report allows, why no larger ones, and what raises them."""

    why: str
    cure: str = ""
    wrist_speed_rad_per_s: float = CAPPED_RAD_PER_S
    linear_speed_m_per_s: float = CAPPED_M_PER_S
    torque_nm: float = CAPPED_NM

    @property
    def sentence(self) -> str:
        """Return the cap in words, with its cure."""
        return "; ".join(filter(None, (self.cause, self.cure)))

    @property
    def cause(self) -> str:
        """Return the cap in words, without its cure."""
        return (
            f"the robot is capped at {self.wrist_speed_rad_per_s:g} rad/s, {self.linear_speed_m_per_s:g} m/s and "
            f"{self.torque_nm:g} N·m: {self.why}"
        )


class Commissioning:
    """The robot's settings within its report. An emulated robot needs no report, unless it plays a real robot."""

    def __init__(
        self,
        settings: UrSettings,
        report: Report | None,
        reason: str = "",
        *,
        emulated: bool = False,
        rehearsed: bool = False,
    ) -> None:
        """`reason` says why the report, or its absence, raises nothing. It is empty for a report that counts.

        `emulated` means a robot without a cap, `rehearsed` an emulated robot with the cap of the real one.
        """
        self._given, self._report, self._reason, self._emulated = settings, report, reason, emulated
        self._rehearsed = rehearsed
        # How the connected controller differs from the report's.
        self._other = ""

    @property
    def cap(self) -> MotionCap | None:
        """The present cap; None for an emulated robot that plays no real robot."""
        if self._emulated:
            return None
        if self._report is None or not self.counts:
            cure = CURE.format(option=" --emulate" if self._rehearsed else "")
            return MotionCap(self._reason or self._other, cure)
        found = self._report.supplied()
        wrist_rad_per_s = found.wrist_speed_rad_per_s if self._report.has(_SPEED_NEEDS) else None
        torque_nm = found.torque_nm if self._report.has(_TORQUE_NEEDS) else None
        devices = " of emulated devices" if self._report.rig.emulated else ""
        return MotionCap(
            f"its report{devices} covers no more",
            wrist_speed_rad_per_s=max(CAPPED_RAD_PER_S, wrist_rad_per_s or 0.0),
            torque_nm=max(CAPPED_NM, torque_nm or 0.0),
        )

    @property
    def settings(self) -> UrSettings:
        """The robot's settings within the cap, with the values that a counting report supplies."""
        cap, settings = self.cap, self._given
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
        return self._report.supplied() if self._report is not None and self.counts else NOTHING_SUPPLIED

    @property
    def counts(self) -> bool:
        """Whether there is a report that raises the limits that its stages cover."""
        return self._report is not None and not (self._reason or self._other)

    def on_controller(self, polyscope: str, serial_number: str) -> UrSettings:
        """Compare the connected controller with the report's, and return the settings for it.

        A rehearsal has an emulated controller, which is never the report's. Raises RobotLostError for a real controller
        in an emulated rig, because this rig has neither the deadlines nor the cap of a real one.
        """
        plays = self._emulated or self._rehearsed
        if plays and (reason := why_not_emulated(self._given.host, serial_number)):
            raise RobotLostError("not-emulated", reason)
        if self._report is not None and not self._rehearsed:
            seen = {"polyscope": polyscope, "robot_serial_number": serial_number}
            differs = list(self._report.rig.differences(self._report.rig.model_copy(update=seen)))
            self._other = f"{' and '.join(differs)} changed since its report" if differs else ""
        return self.settings

    @property
    def sentence(self) -> str:
        """The cap in words; empty without a cap."""
        return self.cap.sentence if self.cap is not None else ""


def _lowered(bound: BoundT, cap: float) -> BoundT:
    """Return a bound on a speed that keeps commands at or below the cap, and measured values not far above it."""
    if bound.inner <= cap:
        return bound
    return replace(bound, inner=cap, hard=min(bound.hard, _HARD * cap))


def commissioning_of(config: DaemonConfig, settings: UrSettings, now: datetime | None = None) -> Commissioning:
    """Return what a rig's report allows at a time, by default now.

    A rehearsal has the cap of the rig that it plays, and a report of emulated devices raises this cap too. Raises
    UserError for a file that cannot be read or is no report, which is a mistake in the configuration.
    """
    rehearsed = config.real is not config
    if config.emulated and not rehearsed:
        return Commissioning(settings, None, emulated=True)
    if config.commissioned is None:
        return Commissioning(settings, None, "`commissioned` is not in the configuration", rehearsed=rehearsed)
    report = load_report(config.commissioned)
    reason = why_not(report, config, now or datetime.now(UTC))
    return Commissioning(settings, report, reason, rehearsed=rehearsed)


def why_not(report: Report, config: DaemonConfig, now: datetime) -> str:
    """Return why a report does not count for a configuration, or an empty string."""
    seen = identity_of(config, report.rig.polyscope, report.rig.robot_serial_number)
    # Each of these marks is enough, so one mistake in a file cannot raise a real robot's cap.
    is_emulated = report.rig.emulated or report.rig.robot_serial_number == EMULATED_SERIAL_NUMBER
    if is_emulated and not config.emulated:
        return f"{config.commissioned} is of emulated devices, and raises nothing on real ones"
    # In a rehearsal a report of the real devices counts too.
    robot = {key: getattr(report.rig, key) for key in ("emulated", "robot_serial_number")}
    seen = seen.model_copy(update=robot)
    if differs := list(report.rig.differences(seen)):
        return f"{' and '.join(differs)} changed since {config.commissioned} was measured"
    hashes = judged_sha256s(config)
    for stage in report.stages:
        if differs := stage.changed_since(hashes):
            keys = " and ".join(differs)
            cure = f"run `shearloop commission` with `--stages {stage.stage[0]}`"
            return f"{keys} changed since stage {stage.stage} of {config.commissioned} was measured; {cure}"
    failed = [f"{line.what} in stage {stage.stage}" for stage in report.stages for line in stage.lines
              if line.verdict == "failed"]  # fmt: skip
    if failed:
        return f"{config.commissioned} says that {failed[0]} failed"
    if not report.stages:
        return f"{config.commissioned} has no stage"
    dates = [stage.date for stage in report.stages]
    if now - min(dates) > timedelta(days=MAX_AGE_DAYS):
        return f"{config.commissioned} is of {min(dates):%Y-%m-%d}, older than {MAX_AGE_DAYS} days"
    if max(dates) - now > _CLOCKS_DIFFER:
        return f"{config.commissioned} is of {max(dates):%Y-%m-%d}, which is in the future by this computer's clock"
    return ""


def load_report(path: Path) -> Report:
    """Return the report in a file; raises UserError for a file that is not a report."""
    return load_model(path, Report, UserError, "report of a commissioning", "; make it with `shearloop commission`")


def knows_tool(stated_mm: float | None, config: DaemonConfig, robot: Commissioning | None) -> bool:
    """Return whether the tool's diameter is stated, or measured by the gripper's calibration or the report's table."""
    if stated_mm is not None or config.gripper is None:
        return stated_mm is not None
    return config.gripper.calibration is not None or (robot is not None and robot.supplied.widths is not None)


def measured_widths(found: Supplied, model: ModelName) -> WidthCalibration | None:
    """Return the gripper's calibration by a report's table, or None without one."""
    if found.widths is None:
        return None
    # Most rigs have a calibration of their own, or no table.
    from shearloop.drivers.robotiq.width_fit import fit_width

    try:
        return fit_width(found.widths, model)
    except DriverError as error:
        raise UserError(f"the report's table of widths: {error}") from error
