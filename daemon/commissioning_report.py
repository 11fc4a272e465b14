"""The report of a rig's commissioning: its rig, its stages with their lines, and the values that they supply."""

from collections.abc import Iterable, Iterator, Mapping
from typing import Annotated, Any, Final, Literal

from pydantic import AfterValidator, AwareDatetime, Field, ValidationInfo, field_validator

from shearloop.daemon.supplied_values import NOTHING_SUPPLIED, Record, Supplied

Verdict = Literal["passed", "failed", "noted"]


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


def has_failed(lines: Iterable[Line]) -> bool:
    """Return whether a line failed."""
    return any(line.verdict == "failed" for line in lines)


def stage_number(name: str) -> str:
    """Return the figure at the beginning of a stage's name, by which the stage is known."""
    return name[0]


def _numbered(name: str) -> str:
    if not name[:1].isdecimal():
        raise ValueError("a stage's name begins with its number, as in `7 tool and spring`")
    return name


class StageResult(Record):
    """The lines of one stage, who ran it, and when.

    `judged_sha256s`: hashes of the keys and files that only this stage or a few stages judge, in hexadecimal.
    `RigIdentity` has the hashes for all stages.
    """

    stage: Annotated[str, AfterValidator(_numbered)]
    operator: str
    date: AwareDatetime
    lines: tuple[Line, ...]
    supplies: Supplied = NOTHING_SUPPLIED
    judged_sha256s: Mapping[str, str] = {}

    @field_validator("supplies", mode="before")
    @classmethod
    def _of_a_stage_that_passed(cls, value: Any, info: ValidationInfo) -> Any:
        """Return no values for a failed stage: they may be beyond every range, and an earlier version wrote them."""
        return NOTHING_SUPPLIED if has_failed(info.data.get("lines", ())) else value

    @property
    def number(self) -> str:
        """The stage's number."""
        return stage_number(self.stage)

    @property
    def passed(self) -> bool:
        """Whether no line failed."""
        return not has_failed(self.lines)


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
        """Return the stage with this number, if it was run."""
        return next((stage for stage in self.stages if stage.number == number), None)

    def supplied(self) -> Supplied:
        """Return the values of all stages."""
        values: dict[str, object] = {}
        for stage in self.stages:
            values |= stage.supplies.model_dump(exclude_none=True)
        return Supplied.model_validate(values)

    def has(self, numbers: str) -> bool:
        """Return whether all of these stages were run."""
        return all(self.stage(number) is not None for number in numbers)
