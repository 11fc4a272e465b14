"""`shearloop emulate ur`, `gripper-socket` and `gripper-modbus`: robot controller and gripper."""

import argparse
from typing import TYPE_CHECKING

from shearloop.daemon.cli.emulate import console
from shearloop.daemon.errors import UserError

if TYPE_CHECKING:
    from shearloop.drivers.emulators.ports import PtyServer, SocketServer
    from shearloop.drivers.emulators.robotiq.gripper import Gripper
    from shearloop.drivers.emulators.ur.robot import ControllerSpec, RobotEvent
    from shearloop.drivers.emulators.ur.server import Controller

UR_FAULTS = """Prints events, a JSON object a line. Faults, one a line on standard input:
  protective-stop         stop for safety, pause the program
  emergency-stop          press the button: stop, end the program, power off
  release                 release the button; power comes back from the dashboard
  drop-rtde               close the RTDE connections, but not the dashboard's
  silence SECONDS         send nothing on any port
  stop-hangs N            ignore the dashboard's next N stop commands, without an answer
  registers-in-use [off]  refuse input registers as if a fieldbus had them
  local-control [off]     leave remote control
  refuse-protocol [off]   refuse the RTDE protocol version
  normal                  end all of them
"""


def add_robot(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of every emulated controller."""
    parser.add_argument("--rate-hz", type=float, default=500.0, help="control cycles per second (default: %(default)s)")
    parser.add_argument("--unlock-wait-s", type=float, default=5.0, help="time in which a stop is not unlocked (5)")
    parser.add_argument("--power-on-s", type=float, default=1.0, help="time of each power-on step (default: 1)")
    parser.add_argument("--tool-length-m", type=float, default=0.0, help="flange to tool centre point (default: 0)")


def robot_make(args: argparse.Namespace, version: tuple[int, ...] | None = None) -> "ControllerSpec":
    """Return the controller's make; UserError for a wrong rate."""
    from shearloop.drivers.emulators.ur.robot import ControllerSpec

    console.check_range(args, "rate_hz", 50, 1000)
    times = {name: getattr(args, name) for name in ("unlock_wait_s", "power_on_s", "tool_length_m")}
    return ControllerSpec(**times) if version is None else ControllerSpec(version=version, **times)


def print_robot_event(event: "RobotEvent") -> None:
    """Print an event of the robot."""
    console.print_event(
        event.name,
        detail=event.detail,
        time_s=round(event.time_s, 6),
        since_command_s=round(event.since_command_s, 6),
        q_rad=[round(angle, 9) for angle in event.q_rad],
    )


def _configure_ur(parser: argparse.ArgumentParser) -> None:
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = UR_FAULTS
    parser.add_argument(
        "--host", default="127.0.0.1", help="address to listen on; its ports 29999, 30003 and 30004 are the client's"
    )
    parser.add_argument("--version", default="5.17.3.0", help="PolyScope version to give (default: %(default)s)")
    add_robot(parser)


def _run_ur(args: argparse.Namespace) -> int:
    from shearloop.drivers.emulators.ur.robot import Robot
    from shearloop.drivers.emulators.ur.server import Controller, apply_fault

    try:
        version = tuple(int(part) for part in args.version.split("."))
    except ValueError:
        raise UserError(f"--version {args.version} is no version; write for instance 5.17.3.0") from None
    robot = Robot(robot_make(args, version))
    controller = Controller(robot, host=args.host, rate_hz=args.rate_hz, on_event=print_robot_event)

    def on_command(line: str) -> None:
        apply_fault(controller, line)
        console.print_event("obeyed", detail=line)

    with console.report_busy_address(f"the controller cannot listen on {args.host}", "choose another --host"):
        console.play(_play_ur(controller, args.host), on_command)
    return 0


async def _play_ur(controller: "Controller", host: str) -> None:
    async with controller:
        console.print_event("listening", detail=host)
        await controller.run()


def _configure_gripper(parser: argparse.ArgumentParser, printed: str) -> None:
    parser.epilog = (
        f"Prints {printed}, again each time it comes back. On standard input: `object MM` puts something of that width "
        "between the fingers, `object none` takes it away; `fault CODE` makes the gripper report a fault, `cool` ends "
        "one below 10; `lose [SECONDS]` breaks the connection, `silence [SECONDS]` answers nothing."
    )
    parser.add_argument("--speed", type=float, default=1.0, metavar="N", help="times the gripper's own pace")
    parser.add_argument("--object-mm", type=float, metavar="MM", help="the width of an object between the fingers")


def _configure_gripper_socket(parser: argparse.ArgumentParser) -> None:
    _configure_gripper(parser, "its address")
    parser.add_argument(
        "--bind", default="127.0.0.1", metavar="ADDRESS", help="address to listen on (default: %(default)s)"
    )
    parser.add_argument("--port", type=int, default=63352, help="0 for a free one (default: %(default)s)")


def _configure_gripper_modbus(parser: argparse.ArgumentParser) -> None:
    _configure_gripper(parser, "the port's path")
    console.add_link(parser)


def _run_gripper_socket(args: argparse.Namespace) -> int:
    from shearloop.drivers.emulators.robotiq.gripper import Gripper, urcap_server

    if not 0 <= args.port <= 65535:
        raise UserError(f"--port {args.port} is no port; give 0 to 65535")
    gripper = Gripper()
    return _play_gripper(args, gripper, urcap_server(gripper, args.bind, args.port, console.print_port))


def _run_gripper_modbus(args: argparse.Namespace) -> int:
    from shearloop.drivers.emulators.robotiq.gripper import Gripper, modbus_server

    gripper = Gripper()
    return _play_gripper(args, gripper, modbus_server(gripper, console.checked_link(args.link), console.print_port))


def _play_gripper(args: argparse.Namespace, gripper: "Gripper", server: "SocketServer | PtyServer") -> int:
    from shearloop.drivers.emulators.robotiq.gripper import GripperPlayer

    console.check_positive(args, "speed")
    player = GripperPlayer(gripper, server, args.speed)
    if args.object_mm is not None:
        try:
            player.command(f"object {args.object_mm}")
        except ValueError as error:
            raise UserError(f"--object-mm: {error}") from None
    with console.report_busy_address("the gripper cannot be played", "choose another port or bind address"):
        console.play(player.run(), player.command)
    return 0


DEVICES = {
    "ur": console.Device("a UR robot's controller, on an address of this machine", _configure_ur, _run_ur),
    "gripper-socket": console.Device(
        "a 2F-140 behind the URCap's socket", _configure_gripper_socket, _run_gripper_socket
    ),
    "gripper-modbus": console.Device(
        "a 2F-140 on Modbus RTU, on a pseudo-terminal", _configure_gripper_modbus, _run_gripper_modbus
    ),
}
