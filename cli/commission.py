"""`shearloop commission`: measure what a rig does, stage after stage, into a report."""

import argparse
import sys
from functools import partial
from pathlib import Path
from typing import TextIO

from shearloop.cli.options import add_option
from shearloop.errors import UserError


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `commission`."""
    add_option(parser, "config", Path, "CONFIG", "a configuration with a robot; no daemon may run with it")
    add_option(parser, "--out", Path, "FILE", "the report, a YAML file; an earlier one is continued", required=True)
    add_option(parser, "--stages", str, "FIGURES", "run only these stages, also again: 34 for 3 and 4", default="")
    add_option(parser, "--stops", int, "N", "stops by each layer at each speed; fewer than 5 raise no speed")
    parser.add_argument("--json", action="store_true", help="print the report as JSON; questions go to stderr")
    parser.epilog = (
        "Each motion is shown with its speed and travel, and needs a typed word. It stays within 0.1 rad of the pose "
        "that you confirm, 0.5 rad/s, 20 mm and 0.05 m/s. The report is written after each stage, and a page in HTML "
        "beside it. It is a record, not a safety function. Exit status: 0 every line passed, 1 one failed. See "
        "docs/commissioning.md."
    )


def run(args: argparse.Namespace) -> int:
    """Run the stages, and write report and page."""
    from dataclasses import replace

    from shearloop.cli.terminal import print_result
    from shearloop.daemon.config import load_daemon_config
    from shearloop.tools.commission.context import Counts
    from shearloop.tools.commission.operator import Operator
    from shearloop.tools.commission.procedure import commission

    said = sys.stderr if args.json else sys.stdout
    counts = Counts() if args.stops is None else replace(Counts(), stops=args.stops)
    operator = Operator(partial(_answer, said), partial(print, file=said, flush=True))
    report, page = commission(load_daemon_config(args.config), args.config, args.out, operator, counts, args.stages)
    print_result(
        report.model_dump(mode="json", exclude_none=True), [f"{args.out} and {page} are written."], as_json=args.json
    )
    return 0 if report.passed else 1


def _answer(said: TextIO, question: str) -> str:
    """Return the operator's line; raises UserError at the end of the input."""
    print(question, file=said, flush=True)
    line = sys.stdin.readline()
    if not line:
        raise UserError("the input ended before all was answered; run it again to continue, and answer each question")
    return line
