"""What the two emulated grippers have in common on the command line."""

import argparse
import math
from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from shearloop.drivers.emulators.robotiq.gripper import Gripper
    from shearloop.drivers.emulators.robotiq.player import Server


def configure(parser: argparse.ArgumentParser, where: str, more: str = "") -> None:
    """Add the arguments of every gripper; `where` is what is printed, `more` the face's own commands."""
    parser.epilog = (
        f"Prints {where}, again each time it comes back. On standard input: `object MM` puts something of that width "
        "between the fingers, `object none` takes it away; `fault CODE` makes the gripper report a fault, `cool` ends "
        f"one below 10; `lose [SECONDS]` breaks the connection, `silence [SECONDS]` answers nothing.{more}"
    )
    parser.add_argument("--speed", type=float, default=1.0, metavar="N", help="times the gripper's own pace")
    parser.add_argument("--object-mm", type=float, metavar="MM", help="the width of what is between the fingers")


def play_gripper(args: argparse.Namespace, make_server: Callable[["Gripper"], "Server"]) -> int:
    """Play a gripper behind the server that is made for it, until told to stop."""
    from shearloop.daemon.cli.emulated.console import play
    from shearloop.daemon.errors import UserError
    from shearloop.drivers.emulators.robotiq.gripper import Gripper
    from shearloop.drivers.emulators.robotiq.player import GripperPlayer

    if not (math.isfinite(args.speed) and args.speed > 0):
        raise UserError(f"--speed {args.speed:g} is not above 0")
    gripper = Gripper()
    player = GripperPlayer(gripper, make_server(gripper), args.speed)
    if args.object_mm is not None:
        try:
            player.command(f"object {args.object_mm}")
        except ValueError as error:
            raise UserError(f"--object-mm: {error}") from None
    try:
        play(player.run(), player.command)
    except* OSError as errors:
        raise UserError(
            f"the gripper cannot be played: {errors.exceptions[0]}; choose another port or bind address"
        ) from None
    return 0
