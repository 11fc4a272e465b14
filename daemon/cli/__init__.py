"""The command line, `shearloop COMMAND …`.

A command is a module with `configure(parser)` and `run(args) -> exit status`; one that leaves words out where they are
plain adds them in `spelled_out(arguments)`. Modules are imported only when
their command is asked for, and import what is heavy only when they run, so that help and errors come at once.
"""

import argparse
import importlib
import os
import sys
from collections.abc import Sequence
from typing import NamedTuple, NoReturn, Protocol

from shearloop.daemon.cli.interruption import ended, interrupts_heard

# Many small solves and products: a BLAS that spreads each over all cores is slower. Before numpy is loaded.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


class Command(NamedTuple):
    """Where a command lives and what the overview says of it."""

    module: str
    summary: str


COMMANDS = {
    "run": Command("shearloop.daemon.cli.run", "run the daemon that a configuration describes"),
    "import": Command("shearloop.daemon.cli.import_", "bring the paper's MATLAB streams into a recording"),
    "recording": Command(
        "shearloop.daemon.cli.recording", "look into recordings, repair them, and export them as tables"
    ),
    "replay": Command("shearloop.daemon.cli.replay", "send a recording through the same estimators again, as if live"),
    "evaluate": Command("shearloop.daemon.cli.evaluate", "judge a calibrated estimator on recordings or slices"),
    "chart": Command(
        "shearloop.daemon.cli.chart",
        "chart speed against accuracy, stability, and how much model is needed",
    ),
    "check": Command("shearloop.daemon.cli.check", "say whether a configuration and the files it names are in order"),
    "listen": Command("shearloop.daemon.cli.listen", "print what a running daemon publishes"),
    "command": Command(
        "shearloop.daemon.cli.command", "ask a running daemon to do something: tare, start, pause, stop, unlock …"
    ),
    "view": Command("shearloop.daemon.cli.view", "show a running daemon as a page in the browser, with a stop button"),
    "calibrate": Command(
        "shearloop.daemon.cli.calibrate", "calibrate an estimator, a gel's creep, the load cell or the gripper"
    ),
    "emulate": Command("shearloop.daemon.cli.emulate", "play a device, byte for byte, on a port of its own"),
    "bank": Command("shearloop.daemon.cli.bank", "solve, build, inspect and draw banks of simulated signals"),
    "doctor": Command(
        "shearloop.daemon.cli.doctor", "find out what is wrong: files, ports, devices, robot, clock, disk, keys"
    ),
    "ports": Command("shearloop.daemon.cli.ports", "list the serial ports with their serial numbers"),
    "keys": Command("shearloop.daemon.cli.keys", "make the keys for daemon and clients on a network"),
    "completion": Command(
        "shearloop.daemon.cli.completion", "print what bash, zsh or tcsh needs to complete the command line"
    ),
    "install": Command("shearloop.daemon.cli.install", "make the daemon a service of this computer"),
    "uninstall": Command("shearloop.daemon.cli.uninstall", "take the service away again"),
    "skin": Command(
        "shearloop.daemon.cli.skin", "hold the shear skin's models against its paper, and calibrate a skin"
    ),
    "reproduce": Command(
        "shearloop.daemon.cli.reproduce", "compute the paper's numbers and figures anew from recorded slices"
    ),
}

EXIT_OK, EXIT_FAILURE, EXIT_USAGE = 0, 1, 2
# Of `run`: the experiment with which it was to end (`stop_when_done`) is not done.
EXIT_UNFINISHED = 3


class Parser(argparse.ArgumentParser):
    """Says what is wrong in one sentence, and where the rest stands; actions of a command have one of their own."""

    def error(self, message: str) -> NoReturn:
        """End with the sentence and exit status 2."""
        self.exit(EXIT_USAGE, f"{self.prog}: {message}; see `{self.prog} --help`\n")


class CommandModule(Protocol):
    """What a command's module provides."""

    def configure(self, parser: argparse.ArgumentParser) -> None:
        """Add the command's arguments to its parser."""

    def run(self, args: argparse.Namespace) -> int:
        """Carry the command out and return the exit status."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; a mistake of the user ends in one sentence on stderr and exit status 2."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    overview = _overview()
    known = overview.parse_args(arguments[:1])
    command = COMMANDS[known.command]
    module: CommandModule = importlib.import_module(command.module)
    parser = Parser(prog=f"shearloop {known.command}", description=command.summary)
    module.configure(parser)
    spelled_out = getattr(module, "spelled_out", list)
    args = parser.parse_args(spelled_out(arguments[1:]))
    try:
        with interrupts_heard():
            return module.run(args)
    except _user_errors() as error:
        print(f"shearloop {known.command}: {error}", file=sys.stderr)
        return EXIT_USAGE
    except BrokenPipeError:
        # The reader of our output (`| head`) has gone; that is no error.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_OK
    except KeyboardInterrupt as interrupt:
        return ended(f"shearloop {known.command}: interrupted before it was done", interrupt)


def _user_errors() -> tuple[type[Exception], ...]:
    from shearloop.bank.errors import BankError
    from shearloop.daemon.errors import UserError
    from shearloop.drivers.errors import DriverError

    return (BankError, DriverError, UserError)


_BEGINNING = """Where to begin with devices of your own:
`shearloop ports` says how to name them, `shearloop check CONFIG` whether the configuration
is in order, `shearloop doctor CONFIG` what is wrong with cables and devices."""


def _overview() -> argparse.ArgumentParser:
    width = max(map(len, COMMANDS))
    listing = "\n".join(f"  {name:<{width}}  {command.summary}" for name, command in COMMANDS.items())
    parser = Parser(
        prog="shearloop",
        description="Closed-loop twisting with soft shear-sensing skins.",
        epilog=f"commands:\n{listing}\n\n`shearloop COMMAND --help` explains one. {_BEGINNING}",
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
