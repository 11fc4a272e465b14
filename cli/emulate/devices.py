"""The emulated devices that stand alone: `eit-kit`, `hx711`, `ur`, `gripper-socket` and `gripper-modbus`."""

import argparse
import asyncio
from collections.abc import Callable, Coroutine, Iterator
from itertools import count, cycle, repeat
from pathlib import Path
from typing import TYPE_CHECKING

from shearloop.cli.emulate import console
from shearloop.cli.options import PORT, add_option, number, positive
from shearloop.drivers.defaults import EMULATED_ANSWER, LOAD_CELL_RATE_HZ, URCAP_PORT
from shearloop.drivers.robotiq.models import DEFAULT_MODEL, MODELS
from shearloop.emulators.numbers import number_between
from shearloop.errors import UserError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from shearloop.emulators.boards import Sketch
    from shearloop.emulators.ur_controller import Controller
    from shearloop.emulators.ur_robot import ControllerSpec

# The tool of synthetic frames.
DIAMETER_MM = 20.0
Playing = Coroutine[None, None, None]
RATE_HZ = number(50.0, 1000.0)
UR_FAULTS = """Prints events, a JSON object a line. Faults, one a line on standard input:
  protective-stop         stop for safety, pause the program
  emergency-stop          press the button: stop, end the program, power off
  release                 release the button; power comes back from the dashboard
  stop                    press the stop of the program at the pendant
  drop-rtde               close the RTDE connections, but not the dashboard's
  silence SECONDS         send nothing on any port
  hold-back SECONDS       send nothing on any port, and all of it later, as after a short pull of the cable
  registers-in-use        refuse input registers as if a fieldbus had them
  upper-registers-in-use  refuse those from 24 on as if another RTDE client had them
  local-control           leave remote control
  refuse-protocol         refuse the RTDE protocol version
  mute-dashboard          accept connections to the dashboard, and send nothing on them
  drop-scripts            take programs, and play none
  block-scripts           take connections to the script port, and neither read nor send on them
  protect-abrupt-ends     end in a protective stop when a program ends while the arm moves
  protect-ends            end in a protective stop when a program ends by itself
  float-clock             let the script's clock lose 2.3 %, as a sum of cycles in 32-bit floats does after 17 min
  velocity-noise RAD/S    report joint speeds with this noise
  slow-braking RAD/S²     brake no joint faster than this
  slow-arm RAD/S²         brake no joint but the wrist faster than this
  watchdog-waits          let the watchdog not look while the arm moves straight
  bias N                  report a force that nothing exerts
  wrench-error FACTOR     multiply the errors of force and torque, 1 as on UR's data sheet
  hang KG                 hang a mass on the tool
  slider FRACTION         move the pendant's speed slider, 1 at its right end
  scaling FRACTION        let the controller slow every motion by itself, to this fraction
  error-code CODE         report an error code, as the pendant's log has it
  version A.B.C.D         report this version of PolyScope to later connections
  payload KG              have another payload set at the pendant
  normal                  end all of them, and the program on the robot
"""


def _configure_eit_kit(parser: argparse.ArgumentParser) -> None:
    parser.epilog = (
        "Prints the port's path, again each time it is plugged in. A fault's name on standard input applies to the "
        "next frame: cut-line, wrong-count, nan, garbage; or to what follows: silence [SECONDS], unplug [SECONDS], "
        "zero-channel [SECONDS]; late N sends each line N lines late. "
        "Starting the board ends a silence without a number; `normal` ends every fault."
    )
    frames = parser.add_argument_group("frames")
    add_option(frames, "--recording", Path, "FILE", "a recorded stream (.mat)")
    frames.add_argument("--side", choices=("left", "right"), help="which fingertip, if the file holds both")
    add_option(frames, "--bank", Path, "FILE", "synthesise twists from this bank's signals")
    console.add_sigma(frames)
    frames.add_argument("--once", action="store_true", help="with --recording: play it once, then be silent")
    console.add_seed_and_speed(parser, "the board's 1.85 frames per second")
    console.add_link(parser)


def _play_eit_kit(args: argparse.Namespace) -> Playing:
    from shearloop.drivers.defaults import FRAME_PERIOD_S
    from shearloop.emulators.boards import EitKitBoard, format_line

    link = console.checked_link(args.link)
    lines = map(format_line, _frames(args, FRAME_PERIOD_S))
    board = EitKitBoard(lines, period_s=FRAME_PERIOD_S / args.speed, link=link, seed=args.seed)
    return console.play(board.run(), board.command, port=board.port.appearances)


def _frames(args: argparse.Namespace, period_s: float) -> Iterator["NDArray[np.float64]"]:
    if (args.recording is None) == (args.bank is None):
        raise UserError("give either --recording FILE to play a recording or --bank FILE to synthesise frames")
    if args.recording is None:
        if args.once:
            raise UserError("--once is for a recording; synthetic frames have no end")
        return _synthetic(args, period_s)
    from shearloop.tools.recordings.matlab_import import read_lines

    lines = read_lines(args.recording, args.side)
    return iter(lines) if args.once else cycle(lines)


def _synthetic(args: argparse.Namespace, period_s: float) -> Iterator["NDArray[np.float64]"]:
    import numpy as np

    from shearloop.emulators.synthetic_frames import RigFrames, TwistProgramme

    # Opened now: an error comes before a port appears.
    frames, programme = RigFrames(args.bank, args.seed, args.sigma), TwistProgramme()
    moments = (programme.at((number + 0.5) * period_s) for number in count())
    return (frames.line(np.array([grip]), np.array([torque_nm]), DIAMETER_MM) for grip, torque_nm in moments)


def add_load_cell(parser: argparse.ArgumentParser) -> None:
    """Add the calibration and the rate of a load cell's board."""
    text = "send counts that this calibration of `shearloop calibrate load` turns into the torque"
    add_option(parser, "--load-calibration", Path, "FILE", text)
    text = "its lines per second (default: %(default)s)"
    add_option(parser, "--load-rate-hz", positive(high=1000.0), "HZ", text, default=LOAD_CELL_RATE_HZ)


def load_cell_sketch(calibration: Path, noise_nm: float) -> "Sketch":
    """Return the board that sends the counts of a torque by a calibration file."""
    from shearloop.drivers.calibration_files import load_device_calibration
    from shearloop.drivers.load_cell import LoadCalibration
    from shearloop.emulators.boards import Sketch

    given = load_device_calibration(calibration, LoadCalibration)
    counts_per_nm = 1.0 / given.nm_per_count
    return Sketch(counts_per_nm, given.tare_counts, abs(noise_nm * counts_per_nm), decimals=12)


def _configure_hx711(parser: argparse.ArgumentParser) -> None:
    parser.epilog = (
        "Prints the port's path, again each time it is plugged in. A fault's name on standard input applies to the "
        "next line: garbage, spike, torn; or to what follows: silence [SECONDS], saturation [SECONDS], stuck "
        "[SECONDS], unplug [SECONDS], late N, each line N lines late; `normal` ends them. `torque NM` sets the "
        "torque, `mass G` that of a mass on the lever."
    )
    add_option(parser, "--torque-nm", number(-1000.0, 1000.0), "NM", "the torque (default: %(default)s)", default=0.0)
    parser.add_argument("--paper-sketch", action="store_true", help="send N·m, as the paper's board did, not counts")
    add_load_cell(parser)
    console.add_seed_and_speed(parser, "the pace of its lines")
    console.add_link(parser)


def _play_hx711(args: argparse.Namespace) -> Playing:
    from shearloop.drivers.load_cell import LEVER_ARM_M
    from shearloop.drivers.load_cell_calibration import STANDARD_GRAVITY
    from shearloop.emulators.boards import PAPER_SKETCH, Hx711Board, Sketch

    held_nm, period_s = args.torque_nm, 1.0 / (args.load_rate_hz * args.speed)
    sketch = PAPER_SKETCH if args.paper_sketch else Sketch()
    if args.load_calibration is not None:
        sketch = load_cell_sketch(args.load_calibration, sketch.noise_counts / sketch.counts_per_nm)
    link = console.checked_link(args.link)
    lines = sketch.lines((held_nm for _ in repeat(None)), args.seed)
    board = Hx711Board(lines, period_s=period_s, link=link, seed=args.seed)

    def on_command(line: str) -> None:
        nonlocal held_nm
        match line.split():
            case ["torque", number]:
                held_nm = number_between(number, -1000.0, 1000.0, "no torque in N·m")
            case ["mass", number]:
                mass_g = number_between(number, 0.0, 1e6, "no mass in g")
                held_nm = mass_g * 1e-3 * STANDARD_GRAVITY * LEVER_ARM_M
            case _:
                board.command(line)

    return console.play(board.run(), on_command, port=board.port.appearances)


def add_robot(parser: argparse._ActionsContainer) -> None:
    """Add the arguments of every emulated controller."""
    add_option(parser, "--rate-hz", RATE_HZ, "HZ", "control cycles per second (default: %(default)s)", default=500.0)
    parser.add_argument("--cb3", action="store_true", help="play a CB3 with PolyScope 3.15, not an e-Series")
    text = "serial number, in digits; an emulated rig takes the default alone (default: %(default)s)"
    add_option(parser, "--serial-number", str, "TEXT", text, default=EMULATED_ANSWER)
    parser.add_argument("--unlock-wait-s", type=float, default=5.0, help="time in which a stop is not unlocked (5)")
    parser.add_argument("--power-on-s", type=float, default=1.0, help="time of each power-on step (default: 1)")
    text = "joints where the arm stands at first"
    add_option(parser, "--joints-rad", float, ("Q1", "Q2", "Q3", "Q4", "Q5", "Q6"), text, nargs=6)
    text = "payload set at the pendant (default: %(default)s)"
    add_option(parser, "--payload-kg", number(0.0, 100.0), "KG", text, default=1.0)
    text = "its centre of gravity from the flange (default: 0 0 0.06)"
    add_option(parser, "--payload-cog-m", float, ("X", "Y", "Z"), text, nargs=3, default=(0.0, 0.0, 0.06))
    text = "tool centre point set at the pendant, from the flange (default: at the flange)"
    axes = ("X", "Y", "Z", "RX", "RY", "RZ")
    add_option(parser, "--tcp-offset", float, axes, text, nargs=6, default=(0.0,) * 6)


def robot_make(args: argparse.Namespace) -> "ControllerSpec":
    """Return the controller's make."""
    from shearloop.emulators.ur_robot import CB3_VERSION, ControllerSpec

    return ControllerSpec(
        version=CB3_VERSION if args.cb3 else ControllerSpec().version,
        serial_number=args.serial_number,
        unlock_wait_s=args.unlock_wait_s,
        power_on_s=args.power_on_s,
        payload_kg=args.payload_kg,
        payload_cog_m=tuple(args.payload_cog_m),
        tcp_offset=tuple(args.tcp_offset),
        joints_rad=None if args.joints_rad is None else tuple(args.joints_rad),
    )


async def play_robot(controller: "Controller", *others: Callable[[], Playing]) -> None:
    """Play a controller and print its events; run `others` too once it listens."""
    async with controller.open(), asyncio.TaskGroup() as group:
        for run in others:
            group.create_task(run())
        async for event in controller.run():
            console.print_event(event.name, detail=event.detail, time_s=round(event.time_s, 6))


def _configure_ur(parser: argparse.ArgumentParser) -> None:
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = UR_FAULTS
    text = "address to listen on; its ports 29999, 30003 and 30004 are the client's"
    parser.add_argument("--host", default="127.0.0.1", help=text)
    add_robot(parser)


def _play_ur(args: argparse.Namespace) -> Playing:
    from shearloop.emulators.ur_controller import Controller
    from shearloop.emulators.ur_robot import Robot

    controller = Controller(Robot(robot_make(args)), host=args.host, rate_hz=args.rate_hz)

    def on_command(line: str) -> None:
        controller.command(line)
        console.print_event("obeyed", detail=line)

    async def print_address() -> None:
        console.print_event("listening", detail=args.host)

    return console.play(play_robot(controller, print_address), on_command)


def _configure_gripper(parser: argparse.ArgumentParser, printed: str) -> None:
    parser.epilog = (
        f"Prints {printed}, again each time it comes back. On standard input: `object MM` puts something of that width "
        "between the fingers, `object none` or `drop` takes it away; `fault CODE` makes the gripper report a fault; "
        "`unplug [SECONDS]` breaks the connection, `silence [SECONDS]` answers nothing, `slow MILLISECONDS` answers "
        "late; `normal` ends them, and a fault below 10."
    )
    add_option(parser, "--speed", positive(), "N", "times the gripper's own pace", default=1.0)
    text = f"{', '.join(MODELS)} (default: %(default)s)"
    parser.add_argument("--model", choices=tuple(MODELS), metavar="MODEL", default=DEFAULT_MODEL, help=text)
    text = "position of the open fingers (default: %(default)s)"
    add_option(parser, "--open-counts", number(0, 20), "N", text, default=3.0)
    text = "how much wider than a straight line over the counts they are half-way (default: %(default)s)"
    add_option(parser, "--bow-mm", number(-5, 5), "MM", text, default=0.0)


def _configure_gripper_socket(parser: argparse.ArgumentParser) -> None:
    _configure_gripper(parser, "its address")
    add_option(parser, "--bind", str, "ADDRESS", "address to listen on (default: %(default)s)", default="127.0.0.1")
    add_option(parser, "--port", PORT, "PORT", "0 for a free one (default: %(default)s)", default=URCAP_PORT)


def _configure_gripper_modbus(parser: argparse.ArgumentParser) -> None:
    _configure_gripper(parser, "the port's path")
    console.add_link(parser)


def _play_gripper(args: argparse.Namespace) -> Playing:
    from shearloop.emulators.gripper import Fingers, Gripper, GripperPlayer, ModbusSlave, UrcapSession
    from shearloop.emulators.ports import PtyServer, SocketServer

    gripper = Gripper(fingers=Fingers(MODELS[args.model], args.open_counts, bow_mm=args.bow_mm))
    server: SocketServer | PtyServer
    if args.device == "gripper-modbus":
        server = PtyServer(ModbusSlave(gripper), console.checked_link(args.link))
    else:
        server = SocketServer(UrcapSession(gripper), args.bind, args.port)
    player = GripperPlayer(gripper, server, args.speed)
    return console.play(player.run(), player.command, port=server.appearances)


DEVICES = {
    "eit-kit": console.Device("the EIT board of a fingertip, on a pseudo-terminal", _configure_eit_kit, _play_eit_kit),
    "hx711": console.Device("the load cell's board, on a pseudo-terminal", _configure_hx711, _play_hx711),
    "ur": console.Device("a UR robot's controller, on an address of this machine", _configure_ur, _play_ur),
    "gripper-socket": console.Device("a gripper behind the URCap's socket", _configure_gripper_socket, _play_gripper),
    "gripper-modbus": console.Device("a gripper on Modbus RTU, on a port", _configure_gripper_modbus, _play_gripper),
}
