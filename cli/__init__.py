"""The command line, `shearloop COMMAND …`.

A command is a module with `configure(parser)` and `run(args) -> exit status`. It may define
`expand_default_command(arguments)` to insert an optional word. Modules are imported when their command runs, and import
large libraries inside functions, so that help and errors come at once.
"""

import argparse
import contextlib
import importlib
import os
import re
import sys
from collections.abc import Sequence
from difflib import get_close_matches
from types import ModuleType
from typing import Any, NoReturn

from shearloop.daemon.errors import USER_ERRORS
from shearloop.daemon.process import interrupt_status, raise_ending_signals
from shearloop.errors import UserError
from shearloop.printable import printable_output

# Our products are small: a BLAS with one thread is faster. Must be set before numpy is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Colours are control characters, which the output escapes (help of Python 3.14, log outside of `logging_to_stderr`).
os.environ.setdefault("NO_COLOR", "1")


# Ctrl-C is their usual end, and nothing is left undone.
_ENDED_BY_INTERRUPT = ("shearloop listen", "shearloop view", "shearloop emulate")
# The module of each command in this package, and its summary for the overview.
COMMANDS = {
    "demo": ("demo", "run the whole rig, emulated, in closed loop"),
    "init": ("init", "write a commented configuration and experiments to start from"),
    "run": ("run", "run the daemon that a configuration describes"),
    "import": ("recording", "convert the paper's MATLAB streams into a recording"),
    "recording": ("recording", "inspect recordings, repair them, and export them as tables"),
    "replay": ("replay", "send a recording through the same estimators again, as if live"),
    "evaluate": ("evaluate", "judge a calibrated estimator on recordings or slices"),
    "adapt": ("adapt", "correct a calibration's gain by one or a few twists of known torque"),
    "chart": ("chart", "chart speed against accuracy, stability, and how much model is needed"),
    "check": ("check", "check a configuration and the files it names"),
    "commission": ("commission", "measure what a real rig is and does, stage after stage, into a report"),
    "schema": ("schema", "print the JSON Schema of a configuration, an experiment or another file"),
    "listen": ("listen", "print what a running daemon publishes"),
    "command": ("command", "send a command to a running daemon: tare, start, pause, stop, unlock …"),
    "view": ("view", "show a running daemon as a page in the browser, with a stop button"),
    "calibrate": ("calibrate", "calibrate an estimator, a gel's creep, the load cell or the gripper"),
    "emulate": ("emulate", "emulate a device, byte for byte, on a port of its own"),
    "bank": ("bank", "solve, build, design and inspect banks of simulated signals"),
    "doctor": ("doctor", "find out what is wrong: files, ports, devices, robot, clock, disk, keys"),
    "ports": ("ports", "list the serial ports with their serial numbers"),
    "keys": ("keys", "make the keys for daemon and clients on a network"),
    "completion": ("completion", "print the completion script for bash, zsh or tcsh"),
    "install": ("install", "install the daemon as a service of this computer"),
    "uninstall": ("install", "remove the service"),
    "skin": ("skin", "compare the shear skin's models with its paper, and calibrate a skin"),
    "reproduce": ("reproduce", "compute the paper's numbers and figures from recorded slices"),
}

# What may move the rig: no other word is taken for one of these.
MOVING = frozenset({"start", "resume", "unlock", "release", "commission"})
EXIT_OK, EXIT_USAGE = 0, 2
# Of `run`: the experiment of `stop_when_done` did not finish.
EXIT_UNFINISHED = 3

_FIRST_STEPS = """First steps without devices: `shearloop demo`.
With your own: `shearloop init DIR` writes a configuration, `shearloop ports` shows the devices' names,
`shearloop check CONFIG` checks the configuration, `shearloop doctor CONFIG` finds faults of cables and devices."""


class Parser(argparse.ArgumentParser):
    """Reports a mistake in one sentence and names the help; takes a list's values from between options too."""

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> tuple[Any, list[str]]:
        """Return the arguments and what is left over, as argparse does, with a list's later values in the list.

        argparse ends a list of positional arguments at the first option: in `NAME --out DIR REC`, REC is left over.
        """
        found, extras = super().parse_known_args(args, namespace)
        lists = [action for action in self._actions if not action.option_strings and action.nargs in ("*", "+")]
        # A word after an unknown option may be its value.
        if lists and not any(text.startswith("-") for text in extras):
            more = [self._get_value(lists[-1], text) for text in extras]
            setattr(found, lists[-1].dest, [*getattr(found, lists[-1].dest), *more])
            return found, []
        return found, extras

    def error(self, message: str) -> NoReturn:
        """Raise UserError with the sentence."""
        raise UserError(f"{self._plain(message)}; see `{self.prog} --help`")

    def _plain(self, message: str) -> str:
        """Return argparse's message without `argument`, and with the nearest known word."""
        value = re.fullmatch(r"argument (\S+): (.* is .*)", message)
        if value is not None:
            return f"{value[1]} {value[2]}"
        choice = re.fullmatch(r"argument (\S+): invalid choice: '(.*)' \(choose from (.*)\)", message)
        if choice is not None:
            name, given, known = choice[1], choice[2], [one.strip("'") for one in choice[3].split(", ")]
            of = f" of {name}" if name.startswith("--") else ""
            # A mistyped word must not become a motion.
            safe = [one for one in known if one not in MOVING]
            meant = "".join(f"; did you mean {one}?" for one in get_close_matches(given, safe, 1))
            return f"there is no {given!r}{of}{meant or '; there are ' + ', '.join(known)}"
        required = re.fullmatch(r"the following arguments are required: (.*)", message)
        if required is not None:
            lists = [
                f"; {action.metavar or action.dest} is one of {', '.join(action.choices)}"
                for action in self._actions
                if action.choices and (action.metavar or action.dest) in required[1].split(", ")
            ]
            return message + "".join(lists)
        unknown = re.match(r"unrecognized arguments: (\S+)", message)
        near = get_close_matches(unknown[1], self._option_string_actions, 1) if unknown else []
        return f"{message}; did you mean {near[0]}?" if near else message


def command_module(name: str) -> ModuleType:
    """Import and return the module of a command."""
    return importlib.import_module(f"shearloop.cli.{COMMANDS[name][0]}")


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; print a user's mistake as one sentence on stderr and return status 2."""
    with printable_output():
        return _run(argv)


def _run(argv: Sequence[str] | None) -> int:
    arguments = list(sys.argv[1:] if argv is None else argv)
    if arguments[:1] in ([], ["help"]):
        arguments = [*arguments[1:2], "--help"]
    program = "shearloop"
    try:
        name = _overview().parse_args(arguments[:1]).command
        program, module = f"shearloop {name}", command_module(name)
        parser = Parser(prog=program, description=COMMANDS[name][1])
        module.configure(parser)
        expand = getattr(module, "expand_default_command", list)
        args = parser.parse_args(expand(arguments[1:]))
        with raise_ending_signals():
            status: int = module.run(args)
            return status
    except USER_ERRORS as error:
        print(f"{program}: {error}", file=sys.stderr)
        return EXIT_USAGE
    except BrokenPipeError:
        # The reader of our output (`| head`) has closed the pipe; that is no error.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_OK
    except KeyboardInterrupt as interrupt:
        if program not in _ENDED_BY_INTERRUPT:
            # A closed terminal accepts no output.
            with contextlib.suppress(OSError):
                print(f"{program}: interrupted before it was done", file=sys.stderr)
        return interrupt_status(interrupt)


def _overview() -> argparse.ArgumentParser:
    width = max(map(len, COMMANDS))
    listing = "\n".join(f"  {name:<{width}}  {summary}" for name, (_, summary) in COMMANDS.items())
    parser = Parser(
        prog="shearloop",
        description="Closed-loop twisting with soft shear-sensing skins.",
        epilog=f"commands:\n{listing}\n\n`shearloop COMMAND --help` explains one. {_FIRST_STEPS}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="show the version and exit")
    parser.add_argument("command", choices=COMMANDS, metavar="COMMAND", help="one of the commands below")
    return parser


class _Version(argparse.Action):
    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        from importlib.metadata import version

        print(version("shearloop"))
        parser.exit()
