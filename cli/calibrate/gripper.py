"""`shearloop calibrate gripper`: grips objects of known diameter, to convert counts to millimetres."""

import argparse
import asyncio
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from shearloop.cli.calibrations import save_measured
from shearloop.cli.options import PORT, TOOL_MM, add_json, add_option
from shearloop.cli.output_paths import output_path, written_to
from shearloop.cli.terminal import Operator, print_result
from shearloop.drivers.defaults import URCAP_PORT
from shearloop.drivers.robotiq.models import MODELS
from shearloop.errors import UserError
from shearloop.tools.outputs import YAML_KEYS, check_overwrite
from shearloop.words import counted

if TYPE_CHECKING:
    from shearloop.daemon.rig_memory import Remembered
    from shearloop.drivers.robotiq.gripper import RobotiqGripper


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `calibrate gripper`."""
    parser.epilog = (
        "The fingers open and close: keep clear of them. Asks for one object after the other, to be held between the "
        "fingertips, and closes on each after you press Enter. Stop the daemon first: it has the gripper. "
        "Name the file as `gripper.calibration` in the configuration."
    )
    way = parser.add_mutually_exclusive_group(required=True)
    way.add_argument("--host", metavar="ADDRESS", help="the robot's controller, for the URCap's socket")
    way.add_argument("--serial-number", metavar="NUMBER", help="the USB adapter's serial number, for Modbus RTU")
    add_option(way, "--port", Path, "PATH", "the USB adapter's port, for Modbus RTU")
    text = "the URCap's, with --host (default: %(default)s)"
    add_option(parser, "--socket-port", PORT, "PORT", text, default=URCAP_PORT)
    names = ", ".join(MODELS)
    text = f"{names}; as on its type plate, and as `gripper.model` in the configuration"
    parser.add_argument("--model", choices=tuple(MODELS), metavar="MODEL", required=True, help=text)
    text = "an object's diameter; give it once per object, of at least two; four over half of the stroke show its bow"
    add_option(parser, "--diameter-mm", TOOL_MM, "MM", text, action="append", required=True)
    add_option(parser, "--out", output_path, "FILE", "the calibration file to write", required=True)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Grip each object and write the calibration."""
    from shearloop.daemon.rig_memory import Remembered, read_memories
    from shearloop.daemon.robot_files import RobotFiles, lock_gripper
    from shearloop.drivers.hosts import why_no_address
    from shearloop.drivers.robotiq.gripper import RobotiqClient, RobotiqGripper
    from shearloop.drivers.robotiq.modbus_client import ModbusClient
    from shearloop.drivers.robotiq.socket_client import SocketClient
    from shearloop.drivers.robotiq.width_fit import fit_width
    from shearloop.drivers.robotiq.widths import WidthCalibration
    from shearloop.tools.robot_use import ROBOT_TIMEOUT_S, refuse_used_robot

    if len(set(args.diameter_mm)) < 2:
        raise UserError("give at least two different --diameter-mm")
    check_overwrite(args.out, "a calibration file", YAML_KEYS)
    if args.host is not None and (reason := why_no_address(args.host)):
        raise UserError(f"--host: {args.host!r} {reason}")
    client: RobotiqClient
    left = Remembered()
    with ExitStack() as opened:
        if args.host is not None:
            # The URCap's socket serves a daemon at the same time; a serial port has one program.
            opened.enter_context(lock_gripper(args.host, args.socket_port))
            refuse_used_robot(args.host, ROBOT_TIMEOUT_S)
            left = read_memories(RobotFiles(args.host))
            client = SocketClient(args.host, args.socket_port)
        else:
            path = str(args.port) if args.port is not None else None
            client = ModbusClient(serial_number=args.serial_number, path=path)
        gripper = RobotiqGripper(client, WidthCalibration.nominal(args.model))
        operator = Operator(stdout_is_for_json=args.json)
        gauges = asyncio.run(_grip(gripper, args.diameter_mm, operator, left))
    calibration = fit_width(gauges, args.model)
    replaced = args.out.exists()
    save_measured(args.out, calibration)
    report = {
        "path": str(args.out),
        "calibration": calibration.model_dump(mode="json"),
        "mm_per_count": calibration.mm_per_count,
        "width_std_mm": calibration.width_std_mm,
        "gauges": [{"counts": counts, "diameter_mm": diameter_mm} for counts, diameter_mm in gauges],
    }
    sentences = [
        f"One count is {-calibration.mm_per_count:.3f} mm; a diameter is good to {calibration.width_std_mm:.2f} mm."
        + (f" The width bows by {calibration.bow_mm:+.1f} mm half-way." if calibration.bow_mm else ""),
        written_to(args.out, replaced=replaced),
    ]
    return print_result(report, sentences, as_json=args.json)


async def _grip(
    gripper: "RobotiqGripper", diameters_mm: list[float], operator: Operator, left: "Remembered"
) -> list[tuple[float, float]]:
    from shearloop.tools.halted_fingers import halted_if_interrupted
    from shearloop.tools.left_tool import left_tool

    with operator:
        try:
            await gripper.connect()
            for sentence in (*(fault.cause for fault in left.faults), left_tool(left)):
                if sentence:
                    await operator.ask(f"From the last program: {sentence}. Look at the rig, then press Enter.")
            warning = "The fingers will open and close. Empty them, keep your hands clear, then press Enter."
            await operator.ask(warning)
            async with halted_if_interrupted(gripper):
                await gripper.activate(operator_confirmed=True)
            gauges: list[tuple[float, float]] = []
            while len(gauges) < len(diameters_mm):
                diameter_mm = diameters_mm[len(gauges)]
                await operator.ask(f"Hold the object of {diameter_mm:g} mm between the fingertips, then press Enter.")
                async with halted_if_interrupted(gripper):
                    counts = await _contact(gripper)
                if counts is None:
                    print("Refused: the fingers closed without meeting anything.", file=sys.stderr, flush=True)
                else:
                    operator.say(f"  {diameter_mm:g} mm: {counted(counts, 'count')}.")
                    gauges.append((counts, diameter_mm))
            return gauges
        finally:
            await gripper.close()


async def _contact(gripper: "RobotiqGripper") -> int | None:
    """Close and open; return the position of the contact, or None without one."""
    from shearloop.drivers.robotiq.messages import GripperCommand, ObjectStatus

    stroke_mm, slowest_mm_s = gripper.model.stroke_mm, gripper.model.speed_mm_per_s.low
    # Beyond the fingers' stop: reaching the target is never a contact.
    closed = await gripper.finish(await gripper.move(GripperCommand(-stroke_mm, slowest_mm_s)))
    await gripper.finish(await gripper.move(GripperCommand(stroke_mm)))
    return closed.position_counts if closed.object is ObjectStatus.CONTACT_CLOSING else None
