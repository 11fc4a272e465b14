"""`shearloop emulate ur`: a UR controller that the real ur-rtde client connects to."""

import argparse
import json
import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from shearloop.drivers.emulators.ur.robot import RobotEvent
    from shearloop.drivers.emulators.ur.server import Controller

FAULTS = """Prints what happens, a JSON object a line. Faults, one a line on standard input:
  protective-stop         stop for safety, pause the program
  emergency-stop          press the button: stop, end the program, power off
  release                 release the button; power comes back from the dashboard
  drop-rtde               close the RTDE connections, the dashboard living on
  silence SECONDS         send nothing on any port
  stop-hangs N            neither answer nor carry out the next N times that the dashboard is asked to stop
  registers-in-use [off]  refuse input registers as if a fieldbus had them
  local-control [off]     leave remote control
  refuse-protocol [off]   refuse the RTDE protocol version
  normal                  end all of them
"""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `emulate ur`."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = FAULTS
    parser.add_argument(
        "--host", default="127.0.0.1", help="address to listen on; its ports 29999, 30003 and 30004 are the client's"
    )
    parser.add_argument("--version", default="5.17.3.0", help="PolyScope version to give (default: %(default)s)")
    parser.add_argument("--rate-hz", type=float, default=500.0, help="control cycles per second (default: %(default)s)")
    parser.add_argument(
        "--unlock-wait-s", type=float, default=5.0, help="time in which a protective stop is not unlocked (default: 5)"
    )
    parser.add_argument("--power-on-s", type=float, default=1.0, help="time of each power-on step (default: 1)")
    parser.add_argument("--tool-length-m", type=float, default=0.0, help="flange to tool centre point (default: 0)")


def run(args: argparse.Namespace) -> int:
    """Play until told to stop."""
    from shearloop.daemon.cli.emulated.console import play
    from shearloop.daemon.errors import UserError
    from shearloop.drivers.emulators.ur.faults import obey
    from shearloop.drivers.emulators.ur.make import Make
    from shearloop.drivers.emulators.ur.robot import Robot
    from shearloop.drivers.emulators.ur.server import Controller

    if not 50 <= args.rate_hz <= 1000:
        raise UserError(f"--rate-hz {args.rate_hz:g} is outside 50 to 1000")
    try:
        version = tuple(int(part) for part in args.version.split("."))
    except ValueError:
        raise UserError(f"--version {args.version} is no version; write for instance 5.17.3.0") from None
    make = Make(
        version=version,
        unlock_wait_s=args.unlock_wait_s,
        power_on_s=args.power_on_s,
        tool_length_m=args.tool_length_m,
    )
    controller = Controller(Robot(make), host=args.host, rate_hz=args.rate_hz, on_event=_print_event)

    def on_command(line: str) -> None:
        obey(controller, line)
        _print("obeyed", detail=line)

    try:
        play(_play(controller, args.host), on_command)
    except OSError as error:
        raise UserError(f"the controller cannot listen on {args.host}: {error}; choose another --host") from error
    return 0


async def _play(controller: "Controller", host: str) -> None:
    async with controller:
        _print("listening", detail=host)
        await controller.run()


def _print_event(event: "RobotEvent") -> None:
    _print(
        event.name,
        detail=event.detail,
        time_s=round(event.time_s, 6),
        since_command_s=round(event.since_command_s, 6),
        q_rad=[round(angle, 9) for angle in event.q_rad],
    )


def _print(event: str, **fields: object) -> None:
    print(json.dumps({"t_mono_ns": time.monotonic_ns(), "event": event, **fields}), flush=True)
