"""`shearloop emulate skin`, `skin-source` and `skin-daq`: a shear skin, pushed by commands or turned by a robot."""

import argparse
import asyncio
import math
import time
from pathlib import Path
from typing import TYPE_CHECKING

from shearloop.daemon.cli.emulate import console
from shearloop.daemon.errors import UserError
from shearloop.drivers.emulators import number_between

if TYPE_CHECKING:
    from shearloop.daemon.synthetic_skin import SyntheticSkin
    from shearloop.drivers.emulators.skin import Address, SkinInstruments
    from shearloop.drivers.emulators.ur.server import Controller

SWEEP_PERIOD_S = 20.0
# The gauges' drift advances in steps of this.
REST_S = 1.0
CURE = "choose another port or bind address"
SKIN_EPILOG = """Prints the addresses of source and DAQ, again each time they appear.
Commands, one a line on standard input:
  shear N, normal N              push the skin (not while a robot turns it)
  open 1|2, short 1|2, reversed 1|2, swapped, drift 1|2 SHARE_PER_S, leads OHM, mend
                                 faults of the circuit
  source silence [SECONDS] | unplug [SECONDS] | break-off | normal
  daq silence [SECONDS] | unplug [SECONDS] | normal; of a scanner break-off (the next answer ends half-way), of a
                                 converter board missing, garbage, torn, stuck [SECONDS]
  robot FAULT                    any fault of `emulate ur`
  normal                         end all faults of circuit and instruments
"""
INSTRUMENT_EPILOG = (
    "Prints the port's path or address, again each time it appears. On standard input: `shear N` and `normal N` push "
    "the skin; `open`, `short`, `reversed` 1 or 2, `swapped`, `drift 1|2 SHARE_PER_S`, `leads OHM`, `mend` apply to "
    "the circuit; `silence [SECONDS]`, `unplug [SECONDS]`, `normal` to the interface; "
)


class PushedSkin:
    """A synthetic skin that drifts with the clock and is pushed by commands, a sweep, a robot or a gripped tool."""

    def __init__(self, skin: "SyntheticSkin", sweep_n: float = 0.0) -> None:
        self.skin = skin
        self._normal_n = skin.normal_n
        self._sweep_n = sweep_n
        self._began_s = self._rested_s = time.monotonic()
        self._angle_rad: float | None = None

    def resistances_ohm(self) -> tuple[float, float]:
        """Return R₁ and R₂ now."""
        now_s = time.monotonic()
        if now_s - self._rested_s >= REST_S:
            self.skin.rest(now_s - self._rested_s)
            self._rested_s = now_s
        if self._sweep_n:
            self.skin.push(self._sweep_n * math.sin(2.0 * math.pi * (now_s - self._began_s) / SWEEP_PERIOD_S))
        return self.skin.resistances_ohm()

    def turn(self, angle_rad: float) -> float:
        """Turn the tool with the wrist, counted from its first angle; return the torque on the flange."""
        if self._angle_rad is None:
            self._angle_rad = angle_rad
        self.skin.turn(angle_rad - self._angle_rad)
        return -self.skin.torque_nm

    def follow_grip(self, torque_nm: float, *, gripped: bool, lever_m: float) -> None:
        """Shear the skin by a gripped tool's torque at a lever; an open grip does not touch it."""
        self.skin.normal_n = self._normal_n if gripped else 0.0
        self.skin.push(torque_nm / lever_m if gripped else 0.0)

    def command(self, line: str) -> bool:
        """Execute `shear N` or `normal N`; return False for another command, ValueError for a bad number."""
        match line.split():
            case ["shear", newtons]:
                self.skin.push(_newtons(newtons))
            case ["normal", newtons]:
                self.skin.normal_n = abs(_newtons(newtons))
                self.skin.push(self.skin.shear_n)
            case _:
                return False
        self._sweep_n = 0.0
        return True


def _newtons(text: str) -> float:
    return number_between(text, -20.0, 20.0, "no force of at most 20 N; write for instance 0.5")


def _add_address(parser: argparse.ArgumentParser, prefix: str, link_help: str, port_help: str) -> None:
    addresses = parser.add_mutually_exclusive_group()
    addresses.add_argument(f"--{prefix}link", type=Path, metavar="PATH", help=link_help)
    addresses.add_argument(f"--{prefix}port", type=int, metavar="N", help=port_help)


def _add_common(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--bind", default="127.0.0.1", metavar="ADDRESS", help="of the sockets (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of all noise (default: %(default)s)")
    parser.add_argument("--speed", type=float, default=1.0, metavar="N", help="times the instruments' own pace")


def _address(args: argparse.Namespace, prefix: str) -> "Address | None":
    """Return the given address; None for an unnamed pseudo-terminal."""
    link, port = getattr(args, f"{prefix}link"), getattr(args, f"{prefix}port")
    if port is None:
        return console.checked_link(link)
    if not 0 <= port <= 65535:
        raise UserError(f"--{prefix.replace('_', '-')}port {port} is no port; give 0 to 65535")
    return args.bind, port


def _configure_skin(parser: argparse.ArgumentParser) -> None:
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = SKIN_EPILOG
    _add_address(parser, "source-", "a name for the source's RS-232 port", "the source on a socket instead")
    _add_address(parser, "daq-", "a name for a converter board's port", "a scanner on a socket instead")
    _add_common(parser)
    parser.add_argument("--sweep-n", type=float, default=0.0, metavar="N", help="sweep the shear force to ± this")
    parser.add_argument("--normal-n", type=float, default=1.0, metavar="N", help="normal force (default: %(default)s)")
    robot = parser.add_argument_group("a robot whose wrist turns a tool on the skin")
    robot.add_argument("--robot", metavar="HOST", help="play a UR controller on this address of this machine")
    robot.add_argument("--radius-mm", type=float, default=15.0, metavar="MM", help="of the tool (default: %(default)s)")
    robot.add_argument("--rate-hz", type=float, default=500.0, help="control cycles per second (default: %(default)s)")


def _run_skin(args: argparse.Namespace) -> int:
    from shearloop.daemon.synthetic_skin import SyntheticSkin
    from shearloop.drivers.emulators.skin import SkinInstruments
    from shearloop.drivers.emulators.ur.robot import Robot
    from shearloop.drivers.emulators.ur.server import Controller

    console.check_positive(args, "speed")
    if not abs(args.sweep_n) <= 5.0:
        raise UserError(f"--sweep-n {args.sweep_n:g} is beyond the 5 N that the skin is made for")
    console.check_range(args, "normal_n", 0, 20, " N")
    console.check_range(args, "radius_mm", 0.1, 200, " mm")
    console.check_range(args, "rate_hz", 50, 1000)
    if args.robot is not None and args.sweep_n:
        raise UserError("a skin that a robot turns is not swept: leave --sweep-n or --robot out")
    skin = SyntheticSkin(radius_mm=args.radius_mm, normal_n=args.normal_n, seed=args.seed)
    pushed = PushedSkin(skin, args.sweep_n)
    instruments = SkinInstruments(
        pushed.resistances_ohm,
        _address(args, "source_"),
        _address(args, "daq_"),
        on_port=lambda device, port: print(f"{device} {port}", flush=True),
        speed=args.speed,
        seed=args.seed,
    )
    controller = None
    if args.robot is not None:
        robot = Robot(plant=lambda wrist_rad, _speed, _dt_s: pushed.turn(wrist_rad))
        controller = Controller(robot, host=args.robot, rate_hz=args.rate_hz)

    def on_command(line: str) -> None:
        name, _, fault = line.partition(" ")
        if name == "robot" and controller is not None:
            controller.apply_fault(fault)
        elif not pushed.command(line):
            instruments.command(line)

    with console.report_busy_address("the skin cannot be played", "choose another port or address"):
        console.play(_play(instruments, controller), on_command)
    return 0


async def _play(instruments: "SkinInstruments", controller: "Controller | None") -> None:
    if controller is None:
        await instruments.run()
        return
    async with controller, asyncio.TaskGroup() as group:
        group.create_task(instruments.run())
        async for _ in controller.run():
            pass


def _configure_source(parser: argparse.ArgumentParser) -> None:
    parser.epilog = f"{INSTRUMENT_EPILOG}`break-off` ends its next answer half-way."
    _add_address(parser, "", "a name for its RS-232 port", "listen on this port instead, 0 for a free one")
    _add_common(parser)


def _configure_daq(parser: argparse.ArgumentParser) -> None:
    parser.epilog = (
        f"{INSTRUMENT_EPILOG}`break-off` ends the scanner's next answer half-way, and `missing`, `garbage`, `torn`, "
        "`stuck [SECONDS]` apply to the board's lines."
    )
    _add_address(
        parser,
        "",
        "play a converter board under this name (default: without a name)",
        "play a scanning multimeter on this port instead, 0 for a free one",
    )
    _add_common(parser)


def _run_instrument(args: argparse.Namespace) -> int:
    from shearloop.daemon.synthetic_skin import SyntheticSkin
    from shearloop.drivers.emulators.skin import Circuit, play_daq, play_source

    console.check_positive(args, "speed")
    address = _address(args, "")
    pushed = PushedSkin(SyntheticSkin(seed=args.seed))
    circuit = Circuit(pushed.resistances_ohm)
    if args.device == "skin-daq":
        circuit.level_a, circuit.compliance_v, circuit.output_on = 5e-3, 1.0, True
    play_instrument = play_daq if args.device == "skin-daq" else play_source
    instrument = play_instrument(circuit, address, console.print_port, speed=args.speed, seed=args.seed)

    def on_command(line: str) -> None:
        if pushed.command(line):
            return
        try:
            circuit.command(line, time.monotonic())
        except ValueError:
            instrument.command(line)

    with console.report_busy_address("it cannot be played", CURE):
        console.play(instrument.run(), on_command)
    return 0


DEVICES = {
    "skin": console.Device(
        "the shear skin with source and DAQ, and the robot that turns it", _configure_skin, _run_skin
    ),
    "skin-source": console.Device("the Keithley 6430 that feeds the shear skin", _configure_source, _run_instrument),
    "skin-daq": console.Device("the scanner or converter board of the shear skin", _configure_daq, _run_instrument),
}
