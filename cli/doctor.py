"""`shearloop doctor`: check computer, files and devices, and name the next step for each fault."""

import argparse
import json
import logging
from dataclasses import asdict
from pathlib import Path

from shearloop.cli.options import add_option, positive
from shearloop.daemon.running_rig import EMULATED
from shearloop.words import counted

MARKS = {"good": "ok   ", "note": "note ", "trouble": "WRONG"}


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `doctor`."""
    text = "check its files and devices too (default: none, this computer alone)"
    add_option(parser, "config", Path, "CONFIG", text, nargs="?")
    text = "how long to listen to the devices (default: %(default)s)"
    add_option(parser, "--seconds", positive(high=600.0), "S", text, default=6.0)
    add_option(parser, "--geometry", Path, "FILE", "the fingertip's geometry, to compare with its bank")
    parser.add_argument("--json", action="store_true", help="print the findings as JSON")
    parser.epilog = "Exit status: 0 nothing is wrong, 1 something is. See also docs/troubleshooting.md."


def run(args: argparse.Namespace) -> int:
    """Print all findings; return 1 if something is wrong."""

    from shearloop.cli.emulator_processes import check_emulators
    from shearloop.daemon.logs import logging_to_stderr
    from shearloop.tools.doctor import examine

    findings = []
    with logging_to_stderr(level=logging.ERROR):
        for finding in examine(args.config, args.seconds, check_emulators, args.geometry):
            findings.append(finding)
            if args.json:
                continue
            print(f"{MARKS[finding.state]} {finding.subject}: {finding.found}", flush=True)
            if finding.means:
                print(f"        it means: {finding.means}")
            if finding.next_step:
                print(f"        next: {finding.next_step}", flush=True)
    wrong = sum(finding.state == "trouble" for finding in findings)
    if args.json:
        emulated = any(finding.subject == EMULATED for finding in findings)
        said = [{**asdict(finding), "emulated": emulated} for finding in findings]
        print(json.dumps(said, ensure_ascii=False))
    else:
        notes = sum(finding.state == "note" for finding in findings)
        print(f"{counted(len(findings), 'check')}: {wrong} wrong, {notes} to note")
    return 1 if wrong else 0
