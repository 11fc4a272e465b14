"""`shearloop commission`: measure what a rig does, stage after stage, into a report."""

import argparse
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import TextIO

from shearloop.cli.options import add_option
from shearloop.errors import UserError


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `commission`."""
    add_option(parser, "config", Path, "CONFIG", "a configuration with a robot; no daemon may run with it")
    add_option(parser, "--out", Path, "FILE", "the report, a YAML file; an earlier one is continued", required=True)
    parser.add_argument("--json", action="store_true", help="print the report as JSON; questions go to stderr")
    parser.epilog = (
        "Stage 0 (identity) moves nothing: it reads versions, modes, speed slider, payload and tool centre point, and "
        "asks for your name and the pendant's safety checksum. A page in HTML is written beside the report. It is a "
        "record, not a safety function. Exit status: 0 every line passed, 1 one failed. See docs/first-real-robot.md."
    )


def run(args: argparse.Namespace) -> int:
    """Run the stages, and write report and page."""
    from shearloop.cli.terminal import print_result
    from shearloop.daemon.config import load_daemon_config
    from shearloop.daemon.rig import open_settings
    from shearloop.tools.commission import identity
    from shearloop.tools.commission.report import Report, StageResult, open_report, save_report, sha256

    config = load_daemon_config(args.config)
    settings = open_settings(config)
    if settings is None or config.robot is None:
        raise UserError(f"{args.config} has no robot to commission: add `robot: ur.yaml`")
    begun = Report(
        emulated=config.emulated, configuration_sha256=sha256(args.config), robot_settings_sha256=sha256(config.robot)
    )
    report = open_report(args.out, begun)
    said = sys.stderr if args.json else sys.stdout
    if config.emulated:
        print("EMULATED: the report will say so.", file=said, flush=True)
    operator = _answer("Your name:", said)
    checksum = _answer(identity.CHECKSUM_QUESTION, said)
    lines = identity.judge_identity(identity.read_identity(settings, checksum), settings, config)
    date = datetime.now(UTC).isoformat(timespec="seconds")
    report = report.with_stage(StageResult(stage=identity.STAGE, operator=operator, date=date, lines=lines))
    page = save_report(args.out, report)
    sentences = [
        *(
            f"{line.verdict:<6} {line.what}: {line.value}" + (f" (limit: {line.limit})" if line.limit else "")
            for line in lines
        ),
        f"{args.out} and {page} are written.",
    ]
    print_result(report.model_dump(mode="json"), sentences, as_json=args.json)
    return 0 if report.passed else 1


def _answer(question: str, said: TextIO) -> str:
    """Return the operator's line; raises UserError at the end of the input."""
    print(question, file=said, flush=True)
    line = sys.stdin.readline()
    if not line:
        raise UserError("the input ended before all was answered; begin again, and answer each question")
    return line.strip()
