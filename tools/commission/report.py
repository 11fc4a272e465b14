"""The report of a commissioning: one YAML file that later stages continue, and one page for a person.

Nothing here reads a clock or a device. It is a record, not a safety function.
"""

import hashlib
from collections.abc import Iterable
from html import escape
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict

from shearloop.errors import UserError
from shearloop.yaml_files import load_model, save_yaml

Verdict = Literal["passed", "failed", "noted"]
COLUMNS = ("what", "value", "limit", "count", "promise", "verdict")


class _Record(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Line(_Record):
    """One measured or noted value: its name, its limit, the number of measurements, and the promise it checks."""

    what: str
    value: str
    limit: str = ""
    count: int = 1
    promise: str = ""
    verdict: Verdict = "noted"


class StageResult(_Record):
    """The lines of one stage, who ran it, and when (ISO 8601)."""

    stage: str
    operator: str
    date: str
    lines: tuple[Line, ...]

    @property
    def passed(self) -> bool:
        """Whether no line failed."""
        return all(line.verdict != "failed" for line in self.lines)


class Report(_Record):
    """All stages of one rig. The hashes are of the files that the stages were run with."""

    version: Literal[1] = 1
    emulated: bool
    configuration_sha256: str
    robot_settings_sha256: str
    stages: tuple[StageResult, ...] = ()

    @property
    def passed(self) -> bool:
        """Whether there is a stage, and none has a failed line."""
        return bool(self.stages) and all(stage.passed for stage in self.stages)

    def with_stage(self, result: StageResult) -> "Report":
        """Return the report with this result in the place of an earlier one of the same stage."""
        others = [stage for stage in self.stages if stage.stage != result.stage]
        stages = sorted([*others, result], key=lambda stage: stage.stage)
        return self.model_copy(update={"stages": tuple(stages)})

    def page(self) -> str:
        """Return the report as a page in HTML that needs no other file."""
        title = f"{'EMULATED: ' if self.emulated else ''}commissioning"
        parts = [
            "<!doctype html><html lang='en'><head><meta charset='utf-8'>",
            f"<title>{title}</title><style>{_STYLE}</style></head><body><h1>{title}</h1>",
            "<p>A record of measurements, not a safety function: only the pendant's safety configuration is rated.</p>",
            f"<p>Configuration {self.configuration_sha256[:16]}, robot's settings {self.robot_settings_sha256[:16]} "
            "(SHA-256).</p>",
        ]
        for stage in self.stages:
            parts.append(f"<h2>{escape(stage.stage)}</h2><p>{escape(stage.operator)}, {escape(stage.date)}</p><table>")
            parts.append(_row("th", COLUMNS))
            parts += [
                _row("td", map(str, (getattr(line, name) for name in COLUMNS)), line.verdict) for line in stage.lines
            ]
            parts.append("</table>")
        return "\n".join([*parts, "</body></html>\n"])


_STYLE = (
    "body{font-family:sans-serif;max-width:70em;margin:2em auto}table{border-collapse:collapse}"
    "td,th{border:1px solid #bbb;padding:.3em .6em;text-align:left}"
    ".failed{background:#f6c6c6}.passed{background:#d3efd3}"
)


def _row(kind: str, cells: Iterable[str], verdict: str = "") -> str:
    return f"<tr class='{verdict}'>{''.join(f'<{kind}>{escape(cell)}</{kind}>' for cell in cells)}</tr>"


def sha256(path: Path) -> str:
    """Return the SHA-256 of a file in hexadecimal; raises UserError if it cannot be read."""
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror}") from error


def open_report(path: Path, begun: Report) -> Report:
    """Return the report in a file, to continue it, or `begun` if the file does not exist.

    Raises UserError for a file that is no report, or one of another rig or of other settings.
    """
    if not path.exists():
        return begun
    found = load_model(path, Report, UserError, "report of a commissioning")
    for key, what in (
        ("emulated", "`emulated`"),
        ("configuration_sha256", "the configuration"),
        ("robot_settings_sha256", "the robot's settings"),
    ):
        if getattr(found, key) != getattr(begun, key):
            raise UserError(
                f"{path}: {what} changed since this report was begun, and its results are of the old one; "
                "begin a new report with another --out"
            )
    return found


def save_report(path: Path, report: Report) -> Path:
    """Write the report, and its page into the same folder; return the page's path."""
    save_yaml(path, report.model_dump(mode="json"), UserError)
    page = path.with_suffix(".html")
    try:
        page.write_text(report.page(), encoding="utf-8")
    except OSError as error:
        raise UserError(f"{page} cannot be written: {error.strerror}; choose another --out") from error
    return page
