"""The emulated devices that share one physics: `emulate rig`, and `emulate skin` with the robot that turns it."""

import argparse
import asyncio
import json
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from shearloop.cli.emulate import console
from shearloop.cli.emulate.devices import Playing, add_load_cell, add_robot, load_cell_sketch, play_robot, robot_make
from shearloop.cli.options import PORT, TOOL_MM, add_option, number, positive
from shearloop.cli.output_paths import output_path
from shearloop.drivers.defaults import DAQ_RATE_HZ
from shearloop.drivers.robotiq.models import DEFAULT_MODEL, MODELS
from shearloop.emulators.numbers import number_between
from shearloop.errors import UserError

if TYPE_CHECKING:
    from shearloop.emulators.emulated_rig import EmulatedRig
    from shearloop.emulators.scene import Scene, Truth
    from shearloop.emulators.skin import Address, Gauges, SkinInstruments
    from shearloop.emulators.synthetic_frames import RigFrames
    from shearloop.emulators.synthetic_skin import SyntheticSkin

TRUTH_PERIOD_S = 0.1
# The gauges' drift advances in steps of this.
REST_S = 1.0
RIG_EPILOG = """Prints `rig ready` and all addresses, then the robot's events, a JSON object a line.
Commands, one a line on standard input:
  truth                       print the true state: torque, angles, width, diameter
  kick NM                     turn the workpiece so that the torque jumps by NM
  slip [NM]                   let the tool slip in the grip until NM (0) remain
  joint KIND                  put the tool on another joint: lever, tightening, seized
  spring NM_PER_RAD           put it on a lever; gel and lever together are as stiff as this
  object MM | object none     put something of that width between the fingers, or take it away
  silence DEVICE [SECONDS]    silence a device: right, left, load, skin, gripper, robot
  unplug DEVICE [SECONDS]     disconnect a device, without a number until `replug DEVICE`
  weigh NM                    add a torque to the load cell's, on top of the tool's
  flip load|FINGERTIP         turn the sign of the load cell, or of a fingertip's shear, until `normal`
  right|left FAULT            any fault of `emulate eit-kit`, for instance right cut-line
  load FAULT                  any fault of `emulate hx711`, for instance load spike
  skin FAULT                  any fault of `emulate skin`, for instance skin short 1
  gripper drop|fault CODE|…   the tool falls; or any command of `emulate gripper-socket`
  protective-stop, …          any fault of `emulate ur`
  normal                      end all faults, and the program on the robot: `unlock` starts it again
With --speed N gel, fingers and boards are N times as fast; the arm stays in real time.
"""
SKIN_EPILOG = """Prints the addresses of source and DAQ, again each time they appear, and the robot's events.
Commands, one a line on standard input:
  shear N                        push the skin (not while a robot turns it)
  kick NM                        push the tool on the skin so that its torque jumps by NM (with a robot)
  open 1|2, short 1|2, reversed 1|2, swapped, leads OHM, mend
                                 faults of the circuit
  source silence [SECONDS] | unplug [SECONDS] | normal
  daq silence [SECONDS] | unplug [SECONDS] | normal; of a converter board also stuck [SECONDS],
                                 and for one line each: missing, garbage, torn
  robot FAULT                    any fault of `emulate ur`
  normal                         end all faults of circuit and instruments
"""


class PushedSkin:
    """A synthetic skin that drifts with the clock, pushed by commands or by a robot's tool."""

    def __init__(self, skin: "SyntheticSkin") -> None:
        self.skin = skin
        self._rested_s = time.monotonic()
        self._first_rad: float | None = None
        self._kicked_rad = 0.0

    def kick(self, jump_nm: float) -> None:
        """Push the tool so that its torque jumps."""
        self._kicked_rad += self.skin.press(jump_nm)

    def resistances_ohm(self) -> tuple[float, float]:
        """Return R₁ and R₂ now."""
        now_s = time.monotonic()
        if now_s - self._rested_s >= REST_S:
            self.skin.rest(now_s - self._rested_s)
            self._rested_s = now_s
        return self.skin.resistances_ohm()

    def step(self, dt_s: float, wrist_rad: float) -> float:  # noqa: ARG002 - the skin has no dynamics
        """Turn the tool with the wrist, counted from its first angle; return the torque on the flange."""
        if self._first_rad is None:
            self._first_rad = wrist_rad
        self.skin.turn(wrist_rad - self._first_rad + self._kicked_rad)
        return -self.skin.torque_nm


def _configure_rig(parser: argparse.ArgumentParser) -> None:
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = RIG_EPILOG
    add_option(parser, "--bank", Path, "FILE", "synthesise frames of a right and a left fingertip from its signals")
    text = "a fingertip of this name with frames from this bank; may be given several times"
    add_option(parser, "--fingertip", str, ("NAME", "FILE"), text, nargs=2, action="append", default=[])
    text = "folder for the ports eit-right, eit-left and load-cell"
    add_option(parser, "--run-dir", Path, "DIR", text, required=True)
    parser.add_argument("--host", default="127.0.0.1", help="address of robot and gripper (default: %(default)s)")
    text = "the gripper's interface, or none: the tool is clamped to the wrist (default: %(default)s)"
    parser.add_argument("--gripper", choices=("socket", "modbus", "none"), default="socket", help=text)
    text = f"{', '.join(MODELS)} (default: %(default)s)"
    parser.add_argument("--model", choices=tuple(MODELS), metavar="MODEL", default=DEFAULT_MODEL, help=text)
    parser.add_argument("--no-load-cell", action="store_true", help="play no load cell")
    add_load_cell(parser)
    _add_skin(parser.add_argument_group("a shear skin that bears the tool's torque, if one of its addresses is given"))
    add_option(parser, "--diameter-mm", TOOL_MM, "MM", "of the tool (default: 20)", default=20.0)
    add_option(parser, "--gel-stiffness", positive(), "NM_PER_RAD", "of both pads (default: %(default)s)", default=0.8)
    console.add_seed_and_speed(parser, "the pace of gel, fingers and boards")
    add_option(parser, "--truth", output_path, "FILE", "append the true state, ten times a second, as JSON")
    text = "the load cell sends N·m, as the paper's, not counts"
    parser.add_argument("--paper-sketch", action="store_true", help=text)
    console.add_sigma(parser)
    add_robot(parser)


def _play_rig(args: argparse.Namespace) -> Playing:
    from shearloop.emulators.boards import PAPER_SKETCH
    from shearloop.emulators.emulated_rig import NOISE_NM, EmulatedRig
    from shearloop.emulators.scene import TwinSettings

    make = robot_make(args)
    args.run_dir.mkdir(parents=True, exist_ok=True)
    sketch = replace(PAPER_SKETCH, noise_counts=NOISE_NM) if args.paper_sketch else None
    if args.load_calibration is not None:
        sketch = load_cell_sketch(args.load_calibration, NOISE_NM)
    rig = EmulatedRig(
        _fingertips(args),
        args.run_dir,
        host=args.host,
        gripper_on=args.gripper,
        model=MODELS[args.model],
        load_cell=not args.no_load_cell,
        load_rate_hz=args.load_rate_hz,
        skin=_skin_on_tool(args),
        twin=TwinSettings(gel_stiffness_nm_per_rad=args.gel_stiffness),
        diameter_mm=args.diameter_mm,
        speed=args.speed,
        rate_hz=args.rate_hz,
        make=make,
        sketch=sketch,
        seed=args.seed,
    )
    others: list[Callable[[], Playing]] = [rig.run, partial(_print_ready, rig, args.host)]
    if args.truth is not None:
        others.append(partial(_write_truths, rig, args.truth, TRUTH_PERIOD_S / args.speed))
    return console.play(play_robot(rig.controller, *others), partial(_obey, rig))


def _fingertips(args: argparse.Namespace) -> "dict[str, RigFrames]":
    """Return what makes the frames of each fingertip; raises UserError for a name that another device has."""
    from shearloop.emulators.synthetic_frames import RigFrames

    if args.bank is not None:
        both = RigFrames(args.bank, args.seed, args.sigma)
        return {"right": both, "left": both}
    for name, _ in args.fingertip:
        if name in ("load", "skin", "gripper", "robot"):
            raise UserError(f"--fingertip {name}: another device of the emulated rig has this name; choose another")
    return {name: RigFrames(Path(bank), args.seed + n, args.sigma) for n, (name, bank) in enumerate(args.fingertip)}


async def _print_ready(rig: "EmulatedRig", host: str) -> None:
    places = {name: await port.get() for name, port in rig.ports.items()}
    print("rig ready", *(f"{name}={place}" for name, place in {"robot": host, **places}.items()), flush=True)


async def _write_truths(rig: "EmulatedRig", path: Path, period_s: float) -> None:
    due_s = time.monotonic()
    with path.open("a", buffering=1, encoding="utf-8") as file:
        while True:
            file.write(json.dumps({"t_mono_ns": time.monotonic_ns(), **_fields(rig.scene.truth())}) + "\n")
            due_s = max(due_s + period_s, time.monotonic())
            await asyncio.sleep(due_s - time.monotonic())


def _obey(rig: "EmulatedRig", line: str) -> None:
    if line == "truth":
        console.print_event("truth", **_fields(rig.scene.truth()))
    else:
        rig.command(line)
        console.print_event("obeyed", detail=line)


def _fields(truth: "Truth") -> dict[str, object]:
    return {name: round(value, 9) if isinstance(value, float) else value for name, value in asdict(truth).items()}


def _configure_skin(parser: argparse.ArgumentParser) -> None:
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = SKIN_EPILOG
    _add_skin(parser)
    console.add_seed_and_speed(parser, "the instruments' own pace")
    robot = parser.add_argument_group("a robot whose wrist turns a tool on the skin")
    robot.add_argument("--robot", metavar="HOST", help="play a UR controller on this address of this machine")
    add_robot(robot)


def _add_skin(parser: argparse._ActionsContainer) -> None:
    """Add the addresses of the skin's instruments, their rate, and the force and the place of the tool."""
    for name, link_help, port_help in (
        ("source", "a name for the source's RS-232 port", "the source on a socket instead"),
        ("daq", "a name for a converter board's port", "a scanner on a socket instead"),
    ):
        addresses = parser.add_mutually_exclusive_group()
        add_option(addresses, f"--{name}-link", Path, "PATH", link_help)
        add_option(addresses, f"--{name}-port", PORT, "N", port_help)
    parser.add_argument("--bind", default="127.0.0.1", metavar="ADDRESS", help="of the sockets (default: %(default)s)")
    add_option(parser, "--normal-n", number(0.0, 100.0), "N", "force on the skin (default: %(default)s)", default=1.0)
    text = "from the wrist's axis to the skin (default: %(default)s)"
    add_option(parser, "--radius-mm", positive(high=200.0), "MM", text, default=15.0)
    text = "readings of a converter board per second (default: %(default)s)"
    add_option(parser, "--daq-rate-hz", positive(high=1000.0), "HZ", text, default=DAQ_RATE_HZ)


def _play_skin(args: argparse.Namespace) -> Playing:
    from shearloop.emulators.emulated_rig import torque
    from shearloop.emulators.ur_controller import Controller
    from shearloop.emulators.ur_robot import Robot

    pushed = PushedSkin(_synthetic_skin(args))
    instruments = _instruments(args, pushed)
    controller = None
    if args.robot is not None:
        controller = Controller(Robot(robot_make(args), pushed), host=args.robot, rate_hz=args.rate_hz)

    def on_command(line: str) -> None:
        match line.split():
            case ["robot", *words] if controller is not None:
                controller.command(" ".join(words))
                console.print_event("obeyed", detail=line)
            case ["kick", jump_nm] if controller is not None:
                pushed.kick(torque(jump_nm))
                console.print_event("obeyed", detail=line)
            case ["shear", newtons]:
                refusal = "no force of at most 20 N; write for instance 0.5"
                pushed.skin.push(number_between(newtons, -20.0, 20.0, refusal))
            case _:
                instruments.command(line)

    running = instruments.run() if controller is None else play_robot(controller, instruments.run)
    return console.play(running, on_command, source=instruments.source_port, daq=instruments.daq_port)


def _skin_on_tool(args: argparse.Namespace) -> "Callable[[Scene], SkinInstruments] | None":
    """Return what makes the instruments of a skin on the rig's tool; None if no address is given."""
    from shearloop.emulators.emulated_rig import SkinOnTool

    if all(at is None for at in (args.source_link, args.source_port, args.daq_link, args.daq_port)):
        return None
    return lambda scene: _instruments(args, SkinOnTool(_synthetic_skin(args), scene))


def _synthetic_skin(args: argparse.Namespace) -> "SyntheticSkin":
    from shearloop.emulators.synthetic_skin import SyntheticSkin

    return SyntheticSkin(radius_mm=args.radius_mm, normal_n=args.normal_n, seed=args.seed)


def _instruments(args: argparse.Namespace, gauges: "Gauges") -> "SkinInstruments":
    """Return the instruments of these gauges at the given addresses."""
    from shearloop.emulators.skin import SkinInstruments

    source_at, daq_at = (_address(args, name) for name in ("source", "daq"))
    return SkinInstruments(gauges, source_at, daq_at, speed=args.speed, daq_rate_hz=args.daq_rate_hz, seed=args.seed)


def _address(args: argparse.Namespace, name: str) -> "Address | None":
    """Return the given address; None for an unnamed pseudo-terminal."""
    port = getattr(args, f"{name}_port")
    if port is None:
        return console.checked_link(getattr(args, f"{name}_link"))
    return args.bind, port


DEVICES = {
    "skin": console.Device("the shear skin, its instruments, the robot that turns it", _configure_skin, _play_skin),
    "rig": console.Device("all devices of the rig, tied by one physics", _configure_rig, _play_rig),
}
