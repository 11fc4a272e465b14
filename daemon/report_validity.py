"""Why the report of a rig's commissioning does not count for a configuration.

The report is a record, not a safety function. Only the pendant's safety configuration is rated.
"""

from collections.abc import Mapping, Sequence
from datetime import datetime, timedelta
from pathlib import Path
from typing import Final

from shearloop.daemon.commissioning_report import Report, StageResult
from shearloop.daemon.config import DaemonConfig
from shearloop.daemon.motion_cap import new_report
from shearloop.daemon.rig_identity import identity_of, judged_by, judged_sha256s, text_sha256s
from shearloop.drivers.defaults import EMULATED_SERIAL_NUMBER
from shearloop.errors import Hint, UserError
from shearloop.yaml_files import Document

# A report counts for this time after its oldest stage.
MAX_AGE_DAYS: Final = 180
# This computer's clock may be this much behind the clock that dated the report.
_CLOCKS_DIFFER = timedelta(days=1)


def old_stages(report: Report, config: DaemonConfig) -> list[tuple[StageResult, list[str]]]:
    """Return the stages that judged keys or files which have changed since, and these, for a sentence."""
    hashes, texts = judged_sha256s(config), text_sha256s(config)
    found = []
    for stage in report.stages:
        own, now = stage.judged_sha256s, judged_by(stage.number, hashes)
        changed = [key for key in sorted({*own, *now}) if own.get(key) not in _hashes_of(key, now, texts)]
        if changed:
            found.append((stage, [f"`{key}`" for key in changed]))
    return found


def _hashes_of(key: str, now: Mapping[str, str], texts: Mapping[str, str]) -> list[str | None]:
    """Return the hashes that a stage has of what it judged, if that is as it is now: those of earlier versions too."""
    found = [now.get(key)]
    if key in texts:
        found.append(texts[key])
    return found


def why_not(report: Report, config: DaemonConfig, now: datetime) -> Hint | None:
    """Return why a report does not count for a configuration, with the cure, or None."""
    name, rehearsed = config.commissioned, config.real is not config
    seen = identity_of(config, report.rig.polyscope, report.rig.robot_serial_number, report.rig)
    # Each of these marks is enough, so one mistake in a file cannot raise a real robot's cap.
    is_emulated = report.rig.emulated or report.rig.robot_serial_number == EMULATED_SERIAL_NUMBER
    if is_emulated and not config.emulated:
        return Hint(f"{name} is of emulated devices, and raises nothing on real ones", new_report())
    # In a rehearsal a report of the real devices counts too.
    robot = {key: getattr(report.rig, key) for key in ("emulated", "robot_serial_number")}
    seen = seen.model_copy(update=robot)
    if differs := list(report.rig.differences(seen)):
        changed = f"{' and '.join(differs)} changed since {name} was measured"
        return Hint(changed, new_report(rehearsed=rehearsed))
    # A report of real devices is continued on these, also if a rehearsal uses it.
    options = ("--emulate",) if is_emulated else ()
    if old := old_stages(report, config):
        keys = " and ".join(dict.fromkeys(key for _, differs in old for key in differs))
        cause = f"{keys} changed since stage {' and '.join(one.stage for one, _ in old)} of {name}"
        return Hint(cause, _measured_again([stage for stage, _ in old], *options))
    failed = [f"{line.what} in stage {stage.stage}" for stage in report.stages for line in stage.lines
              if line.verdict == "failed"]  # fmt: skip
    if failed:
        return Hint(f"{name} says that {failed[0]} failed", f"mend the cause, and {_continued(*options)}")
    if not report.stages:
        return Hint(f"{name} has no stage", _continued(*options))
    if expired := [stage for stage in report.stages if now - stage.date > timedelta(days=MAX_AGE_DAYS)]:
        date = min(stage.date for stage in expired)
        return Hint(f"{name} is of {date:%Y-%m-%d}, older than {MAX_AGE_DAYS} days", _measured_again(expired, *options))
    if early := [stage for stage in report.stages if stage.date - now > _CLOCKS_DIFFER]:
        date = max(stage.date for stage in early)
        cause = f"{name} is of {date:%Y-%m-%d}, which is in the future by this computer's clock"
        return Hint(cause, f"set the clock, or {_measured_again(early, *options)}")
    return None


def _continued(*options: str) -> str:
    """Return the cure that continues a report in its own file."""
    command = " ".join(("shearloop commission CONFIG --out FILE", *options))
    return f"run `{command}`"


def _measured_again(stages: Sequence[StageResult], *options: str) -> str:
    return _continued(*options, "--stages", "".join(stage.number for stage in stages))


def load_report(path: Path) -> Report:
    """Return the report in a file; raises UserError for a file that is not a report."""
    cure = "; make it with `shearloop commission`"
    document = Document.read(path, UserError, "report of a commissioning", cure, model=Report)
    try:
        return document.model(Report)
    except UserError as error:
        raise UserError(f"{error}\nThis report cannot be continued: {new_report()}") from error
