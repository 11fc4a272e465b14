"""`shearloop commission`: measure what a rig does, stage after stage, into a report."""

import argparse
import os
import shlex
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

from shearloop.cli.options import add_option
from shearloop.cli.output_paths import output_path
from shearloop.daemon.running_rig import EMULATED
from shearloop.errors import UserError

if TYPE_CHECKING:
    from shearloop.cli.emulator_processes import EmulatedDevices
    from shearloop.daemon.config import DaemonConfig

# The reply to a daemon that starts meanwhile, and to every command.
_HOLDER = (
    "`shearloop commission` (process {}) has the robot of {}: wait for its end, end it with Ctrl-C in its terminal, or "
    "press the emergency stop"
)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `commission`."""
    add_option(parser, "config", Path, "CONFIG", "a configuration with a robot; no daemon may run with it")
    add_option(
        parser, "--out", output_path, "FILE", "the report, a YAML file; an earlier one is continued", required=True
    )
    add_option(parser, "--stages", str, "FIGURES", "run only these stages, also again: 34 for 3 and 4", default="")
    add_option(parser, "--stops", int, "N", "stops by each layer at each speed; fewer than 5 raise no speed")
    text = (
        "rehearse it: emulate every device of this configuration; no real device is opened, and none needs your hands"
    )
    parser.add_argument("--emulate", action="store_true", help=text)
    parser.add_argument("--json", action="store_true", help="print the report as JSON; questions go to stderr")
    parser.epilog = (
        "Each motion is shown with its speed and travel, and needs a typed word. It stays within 0.1 rad of the pose "
        "that you confirm, 0.5 rad/s, 20 mm and 0.05 m/s. The report is written after each stage, and a page in HTML "
        "beside it. It is a record, not a safety function. Exit status: 0 every line passed, 1 one failed. See "
        "docs/commissioning.md."
    )


def run(args: argparse.Namespace) -> int:
    """Run the stages, and write report and page."""
    import logging
    from dataclasses import replace

    from shearloop.cli.held_address import held_from_daemons
    from shearloop.cli.terminal import print_result
    from shearloop.daemon.config import load_daemon_config
    from shearloop.daemon.logs import logging_to_stderr
    from shearloop.daemon.report_in_use import commissioning_of
    from shearloop.daemon.rig import open_settings
    from shearloop.tools.commission.context import Counts
    from shearloop.tools.commission.operator import Operator
    from shearloop.tools.commission.procedure import commission

    config = load_daemon_config(args.config)
    counts = Counts() if args.stops is None else replace(Counts(), stops=args.stops)
    label = f"{EMULATED}: " if args.emulate or config.emulated else ""
    terminal = Terminal(sys.stderr if args.json else sys.stdout, label)
    with ExitStack() as emulating:
        # Errors only: a warning reports a client of the held address, and would appear between the questions.
        emulating.enter_context(logging_to_stderr(level=logging.ERROR))
        order = None
        if args.emulate:
            config, devices = emulating.enter_context(_emulated(config, args.config, terminal))
            order = devices.order
        else:
            emulating.enter_context(held_from_daemons(config.commands, _HOLDER.format(os.getpid(), args.config)))
        # A script may answer for emulated devices.
        allows = config.emulated or sys.stdin.isatty()
        operator = Operator(terminal.answer, terminal.say, order, allows)
        with operator.word.watched():
            report, page = commission(config, args.config, args.out, operator, counts, args.stages)
        sentences = [f"{label}{args.out} and {page} are written."]
        settings = open_settings(config)
        if settings is not None:
            named = config.model_copy(update={"commissioned": args.out})
            if allowed := commissioning_of(named, settings).sentence:
                sentences.append(
                    f"{label}With {how_to_configure(args.out, args.config, rehearsed=args.emulate)}, {allowed}."
                )
    print_result(report.model_dump(mode="json", exclude_none=True), sentences, as_json=args.json)
    return 0 if report.passed else 1


def how_to_configure(report: Path, config: Path, *, rehearsed: bool) -> str:
    """Return the option or the line of the configuration that names a report, from the configuration's folder.

    A real rig's configuration would refuse a report of emulated devices, so a `rehearsed` one is named by an option.
    """
    import yaml

    report, folder = report.resolve(), config.resolve().parent
    path = str(report.relative_to(folder) if report.is_relative_to(folder) else report)
    if rehearsed:
        return f"`--set {shlex.quote(f'commissioned={path}')}`"
    line = yaml.safe_dump({"commissioned": path}, width=sys.maxsize, allow_unicode=True).strip()
    return f"the line `{line}` in {config}"


@contextmanager
def _emulated(
    config: "DaemonConfig", path: Path, terminal: "Terminal"
) -> "Iterator[tuple[DaemonConfig, EmulatedDevices]]":
    """Run the emulators of all devices; yield the configuration that names them."""
    from shearloop.cli.emulator_processes import EmulatedDevices
    from shearloop.cli.rehearsal import rehearsal

    if config.robot is None:
        raise UserError(f"{path} has no robot to commission: add `robot: ur.yaml`")
    with rehearsal(config, path) as rehearsed, EmulatedDevices(rehearsed.config.emulators, path.parent) as devices:
        for sentence in rehearsed.sentences:
            terminal.say(sentence)
        # A tool comes between the fingers when the operator says so.
        devices.order("object none" if config.gripper is not None else "robot normal")
        yield rehearsed.config, devices


class Terminal:
    """The operator's terminal; each line begins with `label`."""

    def __init__(self, said: TextIO, label: str) -> None:
        self._said, self._label = said, label

    def say(self, line: str) -> None:
        """Print a line."""
        print(f"{self._label}{line}", file=self._said, flush=True)

    def answer(self, question: str) -> str:
        """Return the line that the operator types after the question; raises UserError at the end of the input."""
        from shearloop.cli.terminal import STDIN, forget_typed_ahead

        forget_typed_ahead(STDIN)
        self.say(question)
        line = sys.stdin.readline()
        if not line:
            raise UserError("the input ended before all was answered: answer each question")
        return line
