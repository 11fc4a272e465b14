"""`shearloop emulate DEVICE`: plays one device on its own port or socket.

Each module has a table COMMANDS: a device's `configure(parser)` and `run(args) -> exit status`.
"""

import argparse
import importlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple, NoReturn

Configure = Callable[[argparse.ArgumentParser], None]
Run = Callable[[argparse.Namespace], int]


class Device(NamedTuple):
    """The module of a device's command, and its summary."""

    module: str
    summary: str


DEVICES = {
    "eit-kit": Device("boards", "the EIT board of a fingertip, on a pseudo-terminal"),
    "hx711": Device("boards", "the load cell's board, on a pseudo-terminal"),
    "gripper-socket": Device("robots", "a 2F-140 behind the URCap's socket"),
    "gripper-modbus": Device("robots", "a 2F-140 on Modbus RTU, on a pseudo-terminal"),
    "skin": Device("skin", "the shear skin with source and DAQ, and the robot that turns it"),
    "skin-source": Device("skin", "the Keithley 6430 that feeds the shear skin"),
    "skin-daq": Device("skin", "the scanner or converter board of the shear skin"),
    "ur": Device("robots", "a UR robot's controller, on an address of this machine"),
    "rig": Device("rig", "all devices of the rig, tied by one physics"),
}


def _command(device: str) -> tuple[Configure, Run]:
    module = importlib.import_module(f"shearloop.daemon.cli.emulate.{DEVICES[device].module}")
    commands: dict[str, tuple[Configure, Run]] = module.COMMANDS
    return commands[device]


def configure(parser: argparse.ArgumentParser) -> None:
    """Add a sub-parser per device."""
    devices = parser.add_subparsers(dest="device", metavar="DEVICE", required=True)
    for name, device in DEVICES.items():
        _command(name)[0](devices.add_parser(name, help=device.summary, description=f"Play {device.summary}."))


class _RaisingParser(argparse.ArgumentParser):
    """Raises UserError instead of ending the program."""

    def error(self, message: str) -> NoReturn:
        from shearloop.daemon.errors import UserError

        raise UserError(message)


def checked_arguments(device: str, arguments: Sequence[str], folder: Path) -> argparse.Namespace:
    """Return the parsed arguments of a device, as a configuration in `folder` gives them.

    Raises UserError for wrong arguments and for a missing bank.
    """
    from shearloop.daemon.errors import UserError

    parser = _RaisingParser(prog=device, allow_abbrev=False, add_help=False)
    _command(device)[0](parser)
    args = parser.parse_args(arguments)
    bank = getattr(args, "bank", None)
    if bank is not None and not (folder / bank).exists():
        raise UserError(f"--bank {bank}: there is no such file; make it with `shearloop bank build`")
    return args


def run(args: argparse.Namespace) -> int:
    """Play the device until SIGINT or SIGTERM, or until standard input, if it is a pipe, is closed."""
    return _command(args.device)[1](args)
