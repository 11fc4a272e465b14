"""`shearloop emulate DEVICE`: plays one device on a port or socket of its own.

A device is a module in `shearloop.daemon.cli.emulated` with `configure(parser)` and `run(args) -> exit status`, as a
command is.
"""

import argparse
import importlib
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, NoReturn


class Device(NamedTuple):
    """Where a device's command lives and what the overview says of it."""

    module: str
    summary: str


DEVICES = {
    "eit-kit": Device("shearloop.daemon.cli.emulated.eit_kit", "the EIT board of a fingertip, on a pseudo-terminal"),
    "hx711": Device("shearloop.daemon.cli.emulated.hx711", "the load cell's board, on a pseudo-terminal"),
    "gripper-socket": Device("shearloop.daemon.cli.emulated.gripper_socket", "a 2F-140 behind the URCap's socket"),
    "gripper-modbus": Device(
        "shearloop.daemon.cli.emulated.gripper_modbus", "a 2F-140 on Modbus RTU, on a pseudo-terminal"
    ),
    "skin": Device(
        "shearloop.daemon.cli.emulated.skin", "the shear skin with source and DAQ, and the robot that turns it"
    ),
    "skin-source": Device("shearloop.daemon.cli.emulated.skin_source", "the Keithley 6430 that feeds the shear skin"),
    "skin-daq": Device("shearloop.daemon.cli.emulated.skin_daq", "what reads the voltages of the shear skin"),
    "ur": Device("shearloop.daemon.cli.emulated.ur", "a UR robot's controller, on an address of this machine"),
    "rig": Device("shearloop.daemon.cli.emulated.rig", "all devices of the rig, tied by one physics"),
}


def configure(parser: argparse.ArgumentParser) -> None:
    """Add a sub-parser per device."""
    devices = parser.add_subparsers(dest="device", metavar="DEVICE", required=True)
    for name, device in DEVICES.items():
        module = importlib.import_module(device.module)
        module.configure(devices.add_parser(name, help=device.summary, description=f"Play {device.summary}."))


class _Refusing(argparse.ArgumentParser):
    """Raises UserError where a parser would end the program."""

    def error(self, message: str) -> NoReturn:
        from shearloop.daemon.errors import UserError

        raise UserError(message)


def checked_arguments(device: str, arguments: Sequence[str], folder: Path) -> argparse.Namespace:
    """Return what a device's arguments, as a configuration in `folder` gives them, mean.

    Raises UserError for arguments that its command would not take, and for a bank that is not there.
    """
    from shearloop.daemon.errors import UserError

    parser = _Refusing(prog=device, allow_abbrev=False, add_help=False)
    importlib.import_module(DEVICES[device].module).configure(parser)
    args = parser.parse_args(arguments)
    bank = getattr(args, "bank", None)
    if bank is not None and not (folder / bank).exists():
        raise UserError(f"--bank {bank}: there is no such file; make it with `shearloop bank build`")
    return args


def run(args: argparse.Namespace) -> int:
    """Play the device until SIGINT or SIGTERM, or until standard input, where that is a pipe, is closed."""
    status: int = importlib.import_module(DEVICES[args.device].module).run(args)
    return status
