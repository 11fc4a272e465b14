"""What the robot's control box is and does: its version, its mode, its ports, and registers that are free."""

import re
import struct
from contextlib import suppress
from dataclasses import dataclass
from typing import Final

from shearloop.drivers.defaults import RTDE_PORT
from shearloop.drivers.errors import DriverError
from shearloop.drivers.ur.dashboard import SERIAL_NUMBER, ask_dashboard, serial_number_in
from shearloop.drivers.ur.messages import RobotLostError
from shearloop.drivers.ur.ports import closed_ports_sentence, connected, probe_ports
from shearloop.drivers.ur.rtde import CONTROLLER_VERSION, agree_on_protocol, free_registers, request
from shearloop.drivers.ur.script import ScriptRegisters
from shearloop.drivers.ur.settings import GENERATIONS, UrSettings
from shearloop.errors import Hint

# By major version: the oldest controllers with all that ur-rtde uses, and the newest that ur-rtde 1.6 is tested on.
OLDEST: Final = {3: (3, 10), 5: (5, 4)}
NEWEST_TESTED: Final = {3: (3, 15, 8), 5: (5, 17, 3)}


@dataclass(frozen=True, slots=True)
class ControllerInfo:
    """A controller's mode. `remote` is None if the controller has no remote mode (CB series)."""

    version: str
    serial_number: str
    robot_mode: str
    safety_mode: str
    remote: bool | None
    # Those that the daemon would use; None where other clients write both halves.
    registers: ScriptRegisters | None


def probe_controller(host: str, timeout_s: float) -> str:
    """Return the controller's version, as 5.17.3.0, after agreeing on protocol 2.

    Raises:
        RobotLostError: it is not there, stays silent, refuses the protocol, or its version is not supported.
    """
    with connected(host, RTDE_PORT, timeout_s, "greeting it") as connection:
        answer = request(connection, CONTROLLER_VERSION)
        numbers = struct.unpack(">4I", answer[:16])
        accepted = agree_on_protocol(connection)
    version = ".".join(map(str, numbers))
    if numbers[0] not in OLDEST or numbers < OLDEST[numbers[0]]:
        raise RobotLostError(
            "version",
            f"The UR controller at {host} has PolyScope {version}, which cannot be driven; install PolyScope 3.10 "
            "(CB3) or 5.4 (e-Series), or a newer 3.x or 5.x, and restart the daemon.",
        )
    if not accepted:
        raise RobotLostError(
            "protocol",
            f"The UR controller at {host} refuses version 2 of the RTDE protocol. Restart the controller; the daemon "
            "tries again.",
        )
    return version


def check_generation(settings: UrSettings, version: str) -> None:
    """Raise RobotLostError where a controller of this version is not of the generation in the settings."""
    major = int(version.split(".", maxsplit=1)[0])
    if major != settings.facts.major:
        found = next((key for key, facts in GENERATIONS.items() if facts.major == major), "unknown")
        raise RobotLostError(
            "version",
            f"The UR controller at {settings.host} has PolyScope {version}, and the robot's settings are for "
            f"{settings.facts.name}: write `generation: {found}` into them, check their limits of force and torque, "
            "and restart the daemon.",
        )


def untested(version: str) -> Hint | None:
    """Return a hint about a version (5.17.3.0) that is newer than those tested, or None."""
    numbers = tuple(map(int, version.split(".")))[:3]
    newest = NEWEST_TESTED[numbers[0]]
    if numbers <= newest:
        return None
    tested = ".".join(map(str, newest))
    newer = f"PolyScope {version} is newer than {tested}, the newest that ur-rtde 1.6 is tested on"
    return Hint(newer, "move slowly first")


def query_controller(host: str, timeout_s: float) -> ControllerInfo:
    """Return a controller's mode without changing anything; DriverError where it is absent or silent."""
    version = probe_controller(host, timeout_s)
    requests = ("robotmode", "safetymode", "is in remote control", SERIAL_NUMBER)
    robot_mode, safety_mode, remote, serial_number = ask_dashboard(host, timeout_s, requests)
    return ControllerInfo(
        version,
        serial_number_in(serial_number),
        robot_mode.removeprefix("Robotmode: "),
        safety_mode.removeprefix("Safetymode: "),
        {"true": True, "false": False}.get(remote.lower()),
        free_registers(host, timeout_s, version),
    )


def check_ports(host: str, timeout_s: float) -> None:
    """Raise RobotLostError where a controller is there and does not serve every port that is needed.

    The error names the menu that opens a port, or a version that cannot be driven.
    """
    found = probe_ports(host, timeout_s)
    closed = [port for port, reason in found.items() if reason]
    if closed and len(closed) < len(found):
        raise RobotLostError("unreachable", closed_ports_sentence(host, closed, _known_version(host, timeout_s)))


def _known_version(host: str, timeout_s: float) -> tuple[int, ...]:
    """Return the major and minor version from the dashboard server or RTDE; empty if neither reports it."""
    with suppress(DriverError):
        (answer,) = ask_dashboard(host, timeout_s, ("PolyscopeVersion",))
        if found := re.search(r"(\d+)\.(\d+)", answer):
            return int(found[1]), int(found[2])
    try:
        major, minor, *_ = probe_controller(host, timeout_s).split(".")
    except RobotLostError as error:
        # A controller that cannot be driven, such as PolyScope X, has no menu for these ports.
        if error.kind == "version":
            raise
        return ()
    return int(major), int(minor)
