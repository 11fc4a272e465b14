"""The commands of the command line: their modules, groups and other spellings.

A command is a module with `configure(parser)` and `run(args) -> exit status`. It may define
`expand_default_command(arguments)` to insert an optional word. Modules are imported when their command runs, and import
large libraries inside functions, so that help and errors come at once. The commands to a daemon are in `command.py`.
"""

import importlib
from collections.abc import Mapping
from types import ModuleType
from typing import NamedTuple


class Command(NamedTuple):
    """A command's module in this package, and its summary for the overview.

    `ended_by_interrupt`: Ctrl-C is its usual end, and nothing is left undone.
    """

    module: str
    summary: str
    ended_by_interrupt: bool = False


# The commands of each group of the overview, in its order.
GROUPS: Mapping[str, Mapping[str, Command]] = {
    "run": {
        "demo": Command("demo", "run the whole rig, emulated, in closed loop"),
        "init": Command("init", "write a commented configuration and experiments to start from"),
        "run": Command("run", "run the daemon that a configuration describes"),
        "view": Command("view", "show a running daemon as a page in the browser, with a stop button", True),
        "command": Command("command", "send a command to a running daemon: tare, start, pause, stop, unlock …"),
        "listen": Command("listen", "print what a running daemon publishes", True),
    },
    "bring up": {
        "ports": Command("ports", "list the serial ports with their serial numbers"),
        "check": Command("check", "check a configuration and the files it names, or print an experiment's plan"),
        "doctor": Command("doctor", "find out what is wrong: files, ports, devices, robot, clock, disk, keys"),
        "commission": Command("commission", "measure what a real rig is and does, stage after stage, into a report"),
        "install": Command("install", "install the daemon as a service of this computer"),
        "uninstall": Command("install", "remove the service"),
        "keys": Command("keys", "make the keys for daemon and clients on a network"),
        "schema": Command("schema", "print the JSON Schema of a configuration, an experiment or another file"),
        "completion": Command("completion", "print the completion script for bash, zsh or tcsh"),
    },
    "recordings": {"recording": Command("recording", "list, inspect, repair, export, replay and import recordings")},
    "calibrate": {
        "calibrate": Command("calibrate", "calibrate an estimator, a gel's creep, the load cell or the gripper"),
        "adapt": Command("adapt", "correct a calibration's gain by one or a few twists of known torque"),
        "evaluate": Command("evaluate", "judge a calibrated estimator on recordings or slices"),
        "bank": Command("bank", "solve, build, design and inspect banks of simulated signals"),
    },
    "research": {
        "reproduce": Command("reproduce", "compute the paper's numbers and figures from recorded slices"),
        "chart": Command("chart", "chart speed against accuracy, stability, and how much model is needed"),
        "skin": Command("skin", "compare the shear skin's models with its paper, and calibrate a skin"),
        "emulate": Command("emulate", "emulate a device, byte for byte, on a port of its own", True),
    },
}
COMMANDS = {name: command for group in GROUPS.values() for name, command in group.items()}
# Spellings that scripts and people in a hurry use, and the words that stand for them.
OTHER_SPELLINGS = {
    "replay": ("recording", "replay"),
    "import": ("recording", "import"),
    "export": ("recording", "export"),
    "info": ("recording", "info"),
    "repair": ("recording", "repair"),
    "stop": ("command", "stop"),
    "pause": ("command", "pause"),
    "status": ("command", "status"),
}

# Commands that move the rig: no abbreviation or mistyped word selects one.
MOVING = frozenset({"start", "resume", "unlock", "release", "commission"})


def command_module(name: str) -> ModuleType:
    """Import and return the module of a command."""
    return importlib.import_module(f"shearloop.cli.{COMMANDS[name].module}")
