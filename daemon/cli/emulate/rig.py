"""`shearloop emulate rig`: arm, gripper, load cell and two fingertips in one process, twisting one tool."""

import argparse
import json
import time
from contextlib import nullcontext
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

from shearloop.daemon.cli.emulate import console
from shearloop.daemon.cli.emulate.robots import add_robot, print_robot_event, robot_make
from shearloop.daemon.errors import UserError

if TYPE_CHECKING:
    from shearloop.drivers.emulators.rig import EmulatedRig, RigSettings, RigSkin
    from shearloop.drivers.emulators.scene import Truth

JOINTS = ("lever", "tightening", "seized", "stripping")
EPILOG = """Prints `rig ready` and all addresses, then the robot's events, a JSON object a line.
Commands, one a line on standard input:
  truth                       print the true state: torque, angles, width, diameter
  kick NM                     turn the workpiece so that the torque jumps by NM
  slip [NM]                   let the tool slip in the grip until NM (0) remain
  joint KIND                  put the tool on another joint: lever, tightening, seized, stripping
  object MM | object none     put something of that width between the fingers, or take it away
  silence DEVICE [SECONDS]    silence a device: right, left, load, gripper, robot
  unplug DEVICE [SECONDS]     disconnect a device, without a number until `replug DEVICE`
  right|left FAULT            any fault of `emulate eit-kit`, for instance right cut-line
  load FAULT                  any fault of `emulate hx711`, for instance load spike
  skin FAULT                  any fault of `emulate skin`, for instance skin open 1 or skin source silence
  gripper drop|fault CODE|…   the tool falls; or any command of `emulate gripper-socket`
  protective-stop, …          any fault of `emulate ur`
  normal                      end all faults, the robot's included
With --speed N gel, fingers and boards are N times as fast. The arm turns at its own pace unless --arm-speed says
otherwise: a loop in real time then sees angles change that many times as fast, and needs a slower controller.
"""


def _configure(parser: argparse.ArgumentParser) -> None:
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = EPILOG
    parser.add_argument("--bank", type=Path, required=True, metavar="FILE", help="synthesise frames from its signals")
    parser.add_argument(
        "--run-dir",
        type=Path,
        required=True,
        metavar="DIR",
        help="folder for the ports eit-right, eit-left and load-cell",
    )
    parser.add_argument(
        "--skin", action="store_true", help="a shear skin on one finger too: skin-source and skin-daq in --run-dir"
    )
    parser.add_argument("--host", default="127.0.0.1", help="address of robot and gripper (default: %(default)s)")
    parser.add_argument(
        "--gripper", choices=("socket", "modbus"), default="socket", help="its interface (default: %(default)s)"
    )
    parser.add_argument("--joint", choices=JOINTS, default="lever", help="of the tool (default: %(default)s)")
    parser.add_argument("--diameter-mm", type=float, default=20.0, metavar="MM", help="of the tool (default: 20)")
    parser.add_argument(
        "--gel-stiffness", type=float, default=0.8, metavar="NM_PER_RAD", help="of both pads (default: %(default)s)"
    )
    parser.add_argument("--speed", type=float, default=1.0, metavar="N", help="of gel, fingers and boards (default: 1)")
    parser.add_argument("--arm-speed", type=float, default=1.0, metavar="N", help="of the arm (default: 1)")
    parser.add_argument("--seed", type=int, default=0, help="of all noise (default: %(default)s)")
    parser.add_argument("--truth", type=Path, metavar="FILE", help="append the true state, ten times a second, as JSON")
    parser.add_argument(
        "--paper-sketch", action="store_true", help="the load cell sends N·m, as the paper's, not counts"
    )
    sigma = parser.add_mutually_exclusive_group()
    sigma.add_argument(
        "--sigma", type=float, nargs=2, metavar=("REST", "LARGEST"), help="sigma at 0 and at 0.14 N·m (1.85 1.25)"
    )
    sigma.add_argument("--calibration", type=Path, metavar="FILE", help="take sigma from this calibration's torques")
    add_robot(parser)


def _run(args: argparse.Namespace) -> int:
    from shearloop.daemon.synthetic import frame_maker
    from shearloop.drivers.emulators.rig import EmulatedRig

    settings = _settings(args)
    frames = frame_maker(args.bank, args.seed, sigma=args.sigma, calibration=args.calibration)
    with nullcontext() if args.truth is None else _open_truth(args.truth) as file:
        rig = EmulatedRig(
            settings,
            frames,
            skin=_skin(args) if args.skin else None,
            on_event=print_robot_event,
            on_truth=None if file is None else partial(_write_truth, file),
            on_ready=partial(_print_ready, settings),
        )
        with console.report_busy_address(
            f"the rig cannot be played on {args.host} and in {args.run_dir}",
            "choose another --host or --run-dir, or end what uses them",
        ):
            console.play(rig.run(), partial(_obey, rig))
    return 0


def _settings(args: argparse.Namespace) -> "RigSettings":
    from shearloop.drivers.emulators.boards import PAPER_SKETCH
    from shearloop.drivers.emulators.rig import NOISE_NM, RigSettings
    from shearloop.drivers.emulators.scene import Joint, TwinSettings

    console.check_positive(args, "speed", "arm_speed", "gel_stiffness")
    make = robot_make(args)
    if not 0 < args.diameter_mm <= 140:
        raise UserError(f"--diameter-mm {args.diameter_mm:g} does not fit between the fingers; give up to 140")
    settings = RigSettings(
        run_dir=args.run_dir,
        host=args.host,
        gripper=args.gripper,
        twin=TwinSettings(joint=Joint(args.joint), gel_stiffness_nm_per_rad=args.gel_stiffness),
        diameter_mm=args.diameter_mm,
        speed=args.speed,
        arm_speed=args.arm_speed,
        rate_hz=args.rate_hz,
        skin=args.skin,
        make=make,
        seed=args.seed,
    )
    if args.paper_sketch:
        settings = replace(settings, sketch=replace(PAPER_SKETCH, noise_counts=NOISE_NM))
    try:
        args.run_dir.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"--run-dir {args.run_dir} cannot be made ({error.strerror}); choose another") from None
    for link in settings.ports.values():
        console.checked_link(link)
    return settings


def _skin(args: argparse.Namespace) -> "RigSkin":
    """Return a skin that bears half of the tool's torque; the other finger bears the other half."""
    from shearloop.daemon.cli.emulate.skin import PushedSkin
    from shearloop.daemon.synthetic_skin import SyntheticSkin
    from shearloop.drivers.emulators.rig import RigSkin

    pushed, lever_m = PushedSkin(SyntheticSkin(seed=args.seed)), args.diameter_mm * 1e-3

    def follow(torque_nm: float, gripped: bool) -> None:
        pushed.follow_grip(torque_nm, gripped=gripped, lever_m=lever_m)

    return RigSkin(follow, pushed.resistances_ohm)


def _obey(rig: "EmulatedRig", line: str) -> None:
    if line == "truth":
        console.print_event("truth", **_fields(rig.scene.truth()))
    else:
        rig.command(line)
        console.print_event("obeyed", detail=line)


def _open_truth(path: Path) -> TextIO:
    try:
        return path.open("a", buffering=1, encoding="utf-8")
    except OSError as error:
        raise UserError(f"--truth {path} cannot be written ({error.strerror}); choose another file") from None


def _write_truth(file: TextIO, truth: "Truth") -> None:
    file.write(json.dumps({"t_mono_ns": time.monotonic_ns(), **_fields(truth)}) + "\n")


def _print_ready(settings: "RigSettings") -> None:
    places = {device: str(path) for device, path in settings.ports.items()}
    places.setdefault("gripper", f"{settings.host}:{settings.gripper_port}")
    print("rig ready", *(f"{name}={place}" for name, place in {"robot": settings.host, **places}.items()), flush=True)


def _fields(truth: "Truth") -> dict[str, object]:
    return {name: round(value, 9) if isinstance(value, float) else value for name, value in asdict(truth).items()}


DEVICES = {"rig": console.Device("all devices of the rig, tied by one physics", _configure, _run)}
