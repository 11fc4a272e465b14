"""The report of a rig's commissioning: its rig, its stages with their lines, and the values that they supply."""

from collections.abc import Iterator, Mapping
from typing import Annotated, Final, Literal

from pydantic import AwareDatetime, BaseModel, ConfigDict, Field

from shearloop.drivers import ranges
from shearloop.drivers.robotiq.models import COUNTS_MAX, LARGEST_STROKE_MM
from shearloop.drivers.ur.settings import LONGEST_REACTION_S, RestSpeed

Verdict = Literal["passed", "failed", "noted"]

# A report raises the wrist's speed to this at most.
FASTEST_RAD_PER_S: Final = 0.5

# A person can edit the file, and nothing else bounds these values.
_Delay = Annotated[float, Field(ge=0, le=LONGEST_REACTION_S)]
_Counts = Annotated[float, Field(ge=0, le=COUNTS_MAX)]
_Width = Annotated[float, Field(gt=0, le=LARGEST_STROKE_MM)]
# Empty for a source whose settings have no hash.
_Sha256 = Annotated[str, Field(pattern="^([0-9a-f]{64})?$")]


class Record(BaseModel):
    """A part of a report."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Supplied(Record):
    """Values that the daemon takes from a stage; a key that is absent was not measured."""

    # Stage 4 tries no faster stop.
    wrist_speed_rad_per_s: Annotated[float, Field(ge=0, le=FASTEST_RAD_PER_S)] | None = None
    torque_nm: ranges.TorqueLimit | None = None
    torque_sources: Mapping[str, _Sha256] | None = None
    """Sources with the right sign and scale up to `torque_nm`, beside the load cell; each with its `source_sha256`."""
    rest_rad_per_s: RestSpeed | None = None
    actuation_s: _Delay | None = None
    reaction_s: _Delay | None = None
    stop_rad: Annotated[float, Field(ge=0, le=ranges.LARGEST_MARGIN_RAD)] | None = None
    widths: tuple[tuple[_Counts, _Width], ...] | None = None
    """Pairs of counts and mm."""


NOTHING_SUPPLIED: Final = Supplied()


class RigIdentity(Record):
    """Which rig a report is about: hashes in hexadecimal, versions, and the robot's serial number."""

    emulated: bool
    configuration_sha256: str
    robot_settings_sha256: str
    script_sha256: str
    ur_rtde: str
    polyscope: str
    robot_serial_number: str

    def differences(self, other: "RigIdentity") -> Iterator[str]:
        """Yield each difference in words."""
        for key, what in _IDENTITY.items():
            if getattr(self, key) != getattr(other, key):
                yield what


_IDENTITY: Final = {
    "emulated": "`emulated`",
    "configuration_sha256": "the devices in the configuration",
    "robot_settings_sha256": "the robot's settings",
    "script_sha256": "the script for the robot",
    "ur_rtde": "the version of ur-rtde",
    "polyscope": "the version of PolyScope",
    "robot_serial_number": "the robot's serial number",
}


class Line(Record):
    """One measured or noted value: its name, its limit, the number of measurements, and the promise it checks."""

    what: str
    value: str
    limit: str = ""
    count: Annotated[int, Field(ge=0)] = 1
    promise: str = ""
    verdict: Verdict = "noted"


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
