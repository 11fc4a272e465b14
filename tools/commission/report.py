"""The report of a commissioning: one YAML file that later stages continue, and one page for a person.

Nothing here reads a clock or a device. It is a record, not a safety function.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path

from shearloop.daemon.commissioning_report import Line, Report, RigIdentity, StageResult, Verdict
from shearloop.daemon.report_validity import MAX_AGE_DAYS, load_report
from shearloop.daemon.supplied_values import NOTHING_SUPPLIED, Supplied
from shearloop.errors import UserError
from shearloop.files import replace_file
from shearloop.yaml_files import save_yaml

# How each page begins.
PAGE_BEGINS = b"<!doctype html><html lang='en'>"
COLUMNS = ("what", "value", "limit", "count", "promise", "verdict")


@dataclass(slots=True)
class Measured:
    """What a stage found: its lines, and the values that the daemon takes from it."""

    lines: Sequence[Line]
    supplies: Supplied = field(default=NOTHING_SUPPLIED)


def judged(what: str, value: str, limit: str, promise: str, *, passed: bool, count: int = 1) -> Line:
    """Return a line with a verdict."""
    verdict: Verdict = "passed" if passed else "failed"
    return Line(what=what, value=value, limit=limit, count=count, promise=promise, verdict=verdict)


def percentile_99(values: Iterable[float]) -> float:
    """Return the smallest value that 99 of 100 do not exceed."""
    ordered = sorted(values)
    return ordered[math.ceil(0.99 * len(ordered)) - 1]


def page_of(report: Report, unmeasured: Sequence[str] = ()) -> str:
    """Return the report as a page in HTML that needs no other file; `unmeasured` are stages that were not run."""
    rig = report.rig
    title = f"{'EMULATED: ' if rig.emulated else ''}commissioning"
    parts = [
        f"{PAGE_BEGINS.decode()}<head><meta charset='utf-8'>"
        "<meta name='viewport' content='width=device-width, initial-scale=1'>",
        f"<title>{title}</title><style>{_STYLE}</style></head><body><h1>{title}</h1>",
        "<p>Every device was emulated: this report raises no limit of a real robot.</p>" if rig.emulated else "",
        "<p>A record of measurements, not a safety function: only the pendant's safety configuration is rated.</p>",
        f"<p>Robot {escape(rig.robot_serial_number or 'without a serial number')}, PolyScope {escape(rig.polyscope)}, "
        f"ur-rtde {escape(rig.ur_rtde)}. SHA-256: devices {rig.configuration_sha256[:16]}, robot's settings "
        f"{rig.robot_settings_sha256[:16]}, script {rig.script_sha256[:16]}. It counts for {MAX_AGE_DAYS} days after "
        "its oldest stage.</p>",
    ]
    for stage in report.stages:
        date = f"{stage.date:%Y-%m-%d %H:%M %Z}"
        parts.append(f"<h2>{escape(stage.stage)}</h2><p>{escape(stage.operator)}, {date}</p><table>")
        parts.append(_row("th", COLUMNS))
        parts += [_row("td", map(str, (getattr(line, name) for name in COLUMNS)), line.verdict) for line in stage.lines]
        parts.append("</table>")
    if unmeasured:
        stages = escape(", ".join(unmeasured))
        parts.append(f"<h2>Not measured</h2><p>{stages}. What only these stages measure stays capped.</p>")
    return "\n".join([*parts, "</body></html>\n"])


# The colours of the live page, light and dark.
_STYLE = (
    ":root{color-scheme:light dark;--ink:#10212e;--line:#c3ccd3;--paper:#f3f5f7;--alarm:#fbdcd8;--passed:#d3efd3}"
    "@media (prefers-color-scheme:dark){"
    ":root{--ink:#e6edf2;--line:#40505c;--paper:#0e161c;--alarm:#4d1712;--passed:#12402a}}"
    "body{font-family:sans-serif;max-width:70em;margin:2em auto;padding:0 1em;color:var(--ink);background:var(--paper)}"
    "table{border-collapse:collapse}td,th{border:1px solid var(--line);padding:.3em .6em;text-align:left}"
    ".failed{background:var(--alarm)}.passed{background:var(--passed)}"
)


def _row(kind: str, cells: Iterable[str], verdict: str = "") -> str:
    return f"<tr class='{verdict}'>{''.join(f'<{kind}>{escape(cell)}</{kind}>' for cell in cells)}</tr>"


def earlier_report(path: Path) -> Report | None:
    """Return the report in a file, to continue it, or None if the file does not exist; UserError for another file."""
    if path == page_path(path):
        raise UserError(f"--out {path} is the name of the report's page; choose one that ends in .yaml")
    return load_report(path) if path.exists() else None


def report_for(rig: RigIdentity, found: Report | None, path: Path) -> Report:
    """Return the report `found` in `path`, or a new one; UserError if it is of another rig or of other settings.

    A report of other settings in which no stage passed is replaced by a new one: the settings were changed to pass.
    """
    if found is None:
        return Report(rig=rig)
    if found.rig.emulated != rig.emulated:
        of, here = ("emulated", "real") if found.rig.emulated else ("real", "emulated")
        raise UserError(f"{path} is of {of} devices, and these are {here}; give another --out")
    if differs := list(found.rig.differences(rig)):
        if not any(stage.passed for stage in found.stages):
            return Report(rig=rig)
        raise UserError(
            f"{path}: {' and '.join(differs)} changed since this report was begun, and its results are of the old "
            "one; begin a new report with another --out"
        )
    return found


def with_stage(report: Report, result: StageResult) -> Report:
    """Return a report with this result, which replaces an earlier result of the same stage, also by another name."""
    others = [stage for stage in report.stages if stage.number != result.number]
    stages = sorted([*others, result], key=lambda stage: stage.number)
    return report.model_copy(update={"stages": tuple(stages)})


def without_stage(report: Report, result: StageResult) -> Report:
    """Return a report without this stage."""
    others = (stage for stage in report.stages if stage.number != result.number)
    return report.model_copy(update={"stages": tuple(others)})


def page_path(report: Path) -> Path:
    """Return the path of a report's page, in the report's folder."""
    return report.with_suffix(".html")


def write_report(path: Path, report: Report) -> None:
    """Write the report; raises UserError where that fails, and an earlier report is then unchanged."""
    content = report.model_dump(mode="json", exclude_none=True)
    save_yaml(path, content, UserError, "report", "make room there, or make the folder writable")


def write_page(path: Path, report: Report, unmeasured: Sequence[str] = ()) -> Path:
    """Write the page of a report that is written, and return its path; raises UserError where that fails."""
    page = page_path(path)
    try:
        with replace_file(page) as file:
            file.write(page_of(report, unmeasured).encode())
    except OSError as error:
        raise UserError(
            f"{page}: the page of the report cannot be written: {error.strerror}; make room there, or make the folder "
            f"writable. The report {path} is whole"
        ) from error
    return page
