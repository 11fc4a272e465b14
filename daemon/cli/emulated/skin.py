"""`shearloop emulate skin`: the shear skin with both of its instruments, pushed by commands or turned by a robot."""

import argparse
import asyncio
from typing import TYPE_CHECKING

from shearloop.daemon.cli.emulated import skin_place

if TYPE_CHECKING:
    from shearloop.daemon.cli.emulated.skin_push import PushedSkin
    from shearloop.drivers.emulators.skin import SkinInstruments
    from shearloop.drivers.emulators.ur.server import Controller

EPILOG = """Prints where source and DAQ are, again each time they are there. Commands, one a line on standard input:
  shear N, normal N              push the skin (not while a robot turns it)
  open 1|2, short 1|2, reversed 1|2, swapped, drift 1|2 SHARE_PER_S, leads OHM, mend
                                 what befalls the circuit
  source silence [SECONDS] | unplug [SECONDS] | break-off | normal
  daq silence [SECONDS] | unplug [SECONDS] | normal; of a scanner break-off (the next answer ends half-way), of a
                                 converter board missing, garbage, torn, stuck [SECONDS]
  robot FAULT                    any fault of `emulate ur`
  normal                         end all faults of circuit and instruments
"""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `emulate skin`."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = EPILOG
    skin_place.add_place(parser, "source-", "a name for the source's RS-232 port", "the source on a socket instead")
    skin_place.add_place(parser, "daq-", "a name for a converter board's port", "a scanner on a socket instead")
    skin_place.add_common(parser)
    parser.add_argument("--sweep-n", type=float, default=0.0, metavar="N", help="sweep the shear force to ± so much")
    parser.add_argument("--normal-n", type=float, default=1.0, metavar="N", help="normal force (default: %(default)s)")
    robot = parser.add_argument_group("a robot whose wrist turns a tool on the skin")
    robot.add_argument("--robot", metavar="HOST", help="play a UR controller on this address of this machine")
    robot.add_argument("--radius-mm", type=float, default=15.0, metavar="MM", help="of the tool (default: %(default)s)")
    robot.add_argument("--rate-hz", type=float, default=500.0, help="control cycles per second (default: %(default)s)")


def run(args: argparse.Namespace) -> int:
    """Play until told to stop."""
    from shearloop.daemon.cli.emulated.console import play
    from shearloop.daemon.cli.emulated.skin_push import PushedSkin
    from shearloop.daemon.errors import UserError
    from shearloop.daemon.synthetic_skin import SyntheticSkinSettings
    from shearloop.drivers.emulators.skin import SkinInstruments
    from shearloop.drivers.emulators.ur.faults import obey

    _check(args)
    settings = SyntheticSkinSettings(radius_mm=args.radius_mm, normal_n=args.normal_n)
    pushed = PushedSkin(args.seed, args.sweep_n, settings)
    instruments = SkinInstruments(
        pushed.resistances_ohm,
        skin_place.place(args, "source_"),
        skin_place.place(args, "daq_"),
        on_port=lambda device, port: print(f"{device} {port}", flush=True),
        speed=args.speed,
        seed=args.seed,
    )
    controller = _controller(args, pushed) if args.robot is not None else None

    def on_command(line: str) -> None:
        name, _, fault = line.partition(" ")
        if name == "robot" and controller is not None:
            obey(controller, fault)
        elif not pushed.told(line):
            instruments.command(line)

    try:
        play(_play(instruments, controller), on_command)
    except* OSError as errors:
        raise UserError(f"the skin cannot be played: {errors.exceptions[0]}; choose another port or address") from None
    return 0


def _check(args: argparse.Namespace) -> None:
    from shearloop.daemon.errors import UserError

    skin_place.check_speed(args.speed)
    if not abs(args.sweep_n) <= 5.0:
        raise UserError(f"--sweep-n {args.sweep_n:g} is beyond the 5 N that the skin is made for")
    if not 0 <= args.normal_n <= 20:
        raise UserError(f"--normal-n {args.normal_n:g} is no normal force from 0 to 20 N")
    if not 0 < args.radius_mm <= 200:
        raise UserError(f"--radius-mm {args.radius_mm:g} is no radius up to 200 mm")
    if not 50 <= args.rate_hz <= 1000:
        raise UserError(f"--rate-hz {args.rate_hz:g} is outside 50 to 1000")
    if args.robot is not None and args.sweep_n:
        raise UserError("a skin that a robot turns is not swept: leave --sweep-n or --robot out")


def _controller(args: argparse.Namespace, pushed: "PushedSkin") -> "Controller":
    from shearloop.drivers.emulators.ur.robot import Robot
    from shearloop.drivers.emulators.ur.server import Controller

    robot = Robot(plant=lambda wrist_rad, _speed, _dt_s: pushed.turned(wrist_rad))
    return Controller(robot, host=args.robot, rate_hz=args.rate_hz)


async def _play(instruments: "SkinInstruments", controller: "Controller | None") -> None:
    if controller is None:
        await instruments.run()
        return
    async with controller, asyncio.TaskGroup() as group:
        group.create_task(controller.run())
        group.create_task(instruments.run())
