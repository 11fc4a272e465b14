"""`shearloop emulate rig`: arm, gripper, load cell and two fingertips in one process, twisting one tool."""

import argparse
import json
import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

from shearloop.daemon.cli.emulated.link import checked_link

if TYPE_CHECKING:
    from shearloop.drivers.emulators.rig import EmulatedRig, RigSettings, RigSkin
    from shearloop.drivers.emulators.scene import Truth
    from shearloop.drivers.emulators.ur.robot import RobotEvent

JOINTS = ("lever", "tightening", "seized", "stripping")
EPILOG = """Prints `rig ready` and where everything is, then what happens to the robot, a JSON object a line.
Commands, one a line on standard input:
  truth                       print what is really so: torque, angles, width, diameter
  kick NM                     turn the workpiece so that the torque jumps by so much
  slip [NM]                   let the tool slip in the grip until so much torque (0) is left
  joint KIND                  put the tool on another joint: lever, tightening, seized, stripping
  object MM | object none     put something of that width between the fingers, or take it away
  silence DEVICE [SECONDS]    a device that says nothing: right, left, load, gripper, robot
  unplug DEVICE [SECONDS]     a device that is gone, without a number until `replug DEVICE`
  right|left FAULT            any fault of `emulate eit-kit`, for instance right cut-line
  load FAULT                  any fault of `emulate hx711`, for instance load spike
  skin FAULT                  any fault of `emulate skin`, for instance skin open 1 or skin source silence
  gripper drop|fault CODE|…   the tool falls; or any command of `emulate gripper-socket`
  protective-stop, …          any fault of `emulate ur`
  normal                      end all faults, the robot's included
With --speed N gel, fingers and boards are N times as fast. The arm turns at its own pace unless --arm-speed says
otherwise: a loop in real time closes in on angles that many times as fast, and has to be slowed by as much.
"""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `emulate rig`."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = EPILOG
    parser.add_argument("--bank", type=Path, required=True, metavar="FILE", help="the frames are made of its signals")
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
        "--gripper", choices=("socket", "modbus"), default="socket", help="how it is spoken to (default: %(default)s)"
    )
    parser.add_argument("--joint", choices=JOINTS, default="lever", help="what the tool is in (default: %(default)s)")
    parser.add_argument("--diameter-mm", type=float, default=20.0, metavar="MM", help="of the tool (default: 20)")
    parser.add_argument(
        "--gel-stiffness", type=float, default=0.8, metavar="NM_PER_RAD", help="of both pads (default: %(default)s)"
    )
    parser.add_argument("--speed", type=float, default=1.0, metavar="N", help="of gel, fingers and boards (default: 1)")
    parser.add_argument("--arm-speed", type=float, default=1.0, metavar="N", help="of the arm (default: 1)")
    parser.add_argument("--seed", type=int, default=0, help="of all noise (default: %(default)s)")
    parser.add_argument("--truth", type=Path, metavar="FILE", help="add what is really so, ten times a second, as JSON")
    parser.add_argument(
        "--paper-sketch", action="store_true", help="the load cell sends N·m, as the paper's, not counts"
    )
    sigma = parser.add_mutually_exclusive_group()
    sigma.add_argument(
        "--sigma", type=float, nargs=2, metavar=("REST", "LARGEST"), help="sigma at 0 and at 0.14 N·m (1.85 1.25)"
    )
    sigma.add_argument("--calibration", type=Path, metavar="FILE", help="take sigma from this calibration's torques")
    parser.add_argument("--rate-hz", type=float, default=500.0, help="control cycles per second (default: %(default)s)")
    parser.add_argument("--unlock-wait-s", type=float, default=5.0, help="time in which a stop is not unlocked (5)")
    parser.add_argument("--power-on-s", type=float, default=1.0, help="time of each power-on step (default: 1)")
    parser.add_argument("--tool-length-m", type=float, default=0.0, help="flange to tool centre point (default: 0)")


def run(args: argparse.Namespace) -> int:
    """Play until told to stop."""
    from shearloop.daemon.cli.emulated.console import play
    from shearloop.daemon.cli.emulated.frames import frame_maker
    from shearloop.daemon.errors import UserError
    from shearloop.drivers.emulators.rig import EmulatedRig

    settings = _settings(args)
    frames = frame_maker(args.bank, args.seed, sigma=args.sigma, calibration=args.calibration)
    with _truth_file(args.truth) as file:
        rig = EmulatedRig(
            settings,
            frames,
            skin=_skin(args) if args.skin else None,
            on_event=_print_event,
            on_truth=None if file is None else partial(_write_truth, file),
            on_ready=partial(_print_ready, settings),
        )
        try:
            play(rig.run(), partial(_obey, rig))
        except* OSError as errors:
            raise UserError(
                f"the rig cannot be played on {args.host} and in {args.run_dir}: {errors.exceptions[0]}; "
                "choose another --host or --run-dir, or end what uses them"
            ) from None
    return 0


def _settings(args: argparse.Namespace) -> "RigSettings":
    from dataclasses import replace

    from shearloop.daemon.errors import UserError
    from shearloop.drivers.emulators.boards import PAPER_SKETCH
    from shearloop.drivers.emulators.rig import NOISE_NM, RigSettings
    from shearloop.drivers.emulators.scene import Joint, TwinSettings
    from shearloop.drivers.emulators.ur.make import Make

    for name in ("speed", "arm_speed", "gel_stiffness"):
        if not (math.isfinite(getattr(args, name)) and getattr(args, name) > 0):
            raise UserError(f"--{name.replace('_', '-')} {getattr(args, name):g} is not above 0")
    if not 50 <= args.rate_hz <= 1000:
        raise UserError(f"--rate-hz {args.rate_hz:g} is outside 50 to 1000")
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
        make=Make(unlock_wait_s=args.unlock_wait_s, power_on_s=args.power_on_s, tool_length_m=args.tool_length_m),
        seed=args.seed,
    )
    if args.paper_sketch:
        settings = replace(settings, sketch=replace(PAPER_SKETCH, noise_counts=NOISE_NM))
    try:
        args.run_dir.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"--run-dir {args.run_dir} cannot be made ({error.strerror}); choose another") from None
    for link in settings.ports.values():
        checked_link(link)
    return settings


def _skin(args: argparse.Namespace) -> "RigSkin":
    """Return a skin that bears half of the tool's torque: the other finger bears the other half."""
    from shearloop.daemon.cli.emulated.skin_push import PushedSkin
    from shearloop.drivers.emulators.rig import RigSkin

    pushed, lever_m = PushedSkin(args.seed), args.diameter_mm * 1e-3

    def follow(torque_nm: float, gripped: bool) -> None:
        pushed.gripped(torque_nm, gripped=gripped, lever_m=lever_m)

    return RigSkin(follow, pushed.resistances_ohm)


def _obey(rig: "EmulatedRig", line: str) -> None:
    if line == "truth":
        _print("truth", **_fields(rig.scene.truth()))
    else:
        rig.command(line)
        _print("obeyed", detail=line)


@contextmanager
def _truth_file(path: Path | None) -> Iterator[TextIO | None]:
    from shearloop.daemon.errors import UserError

    if path is None:
        yield None
        return
    try:
        file = path.open("a", buffering=1, encoding="utf-8")
    except OSError as error:
        raise UserError(f"--truth {path} cannot be written ({error.strerror}); choose another file") from None
    with file:
        yield file


def _write_truth(file: TextIO, truth: "Truth") -> None:
    file.write(json.dumps({"t_mono_ns": time.monotonic_ns(), **_fields(truth)}) + "\n")


def _print_ready(settings: "RigSettings") -> None:
    places = {device: str(path) for device, path in settings.ports.items()}
    places.setdefault("gripper", f"{settings.host}:{settings.gripper_port}")
    print("rig ready", *(f"{name}={place}" for name, place in {"robot": settings.host, **places}.items()), flush=True)


def _print_event(event: "RobotEvent") -> None:
    _print(
        event.name,
        detail=event.detail,
        since_command_s=round(event.since_command_s, 6),
        q_rad=[round(angle, 9) for angle in event.q_rad],
    )


def _print(event: str, **fields: object) -> None:
    print(json.dumps({"t_mono_ns": time.monotonic_ns(), "event": event, **fields}), flush=True)


def _fields(truth: "Truth") -> dict[str, object]:
    from dataclasses import asdict

    return {name: round(value, 9) if isinstance(value, float) else value for name, value in asdict(truth).items()}
