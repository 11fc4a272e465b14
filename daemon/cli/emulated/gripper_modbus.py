"""`shearloop emulate gripper-modbus`: a 2F-140 behind Modbus RTU on a pseudo-terminal."""

import argparse
from functools import partial

from shearloop.daemon.cli.emulated import gripper as common
from shearloop.daemon.cli.emulated.link import add_link, checked_link


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `emulate gripper-modbus`."""
    common.configure(parser, "the port's path")
    add_link(parser)


def run(args: argparse.Namespace) -> int:
    """Play until told to stop."""
    from shearloop.drivers.emulators.robotiq.modbus_face import ModbusServer

    link = checked_link(args.link)
    on_port = partial(print, flush=True)
    return common.play_gripper(args, lambda gripper: ModbusServer(gripper, link, on_port))
