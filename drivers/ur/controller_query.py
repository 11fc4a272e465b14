"""A look at a controller that changes nothing: its mode, whether it takes commands from the network, free registers.

Dashboard server: UR's "Dashboard Server e-Series" page; a line in, a line out. RTDE: the guide's control package for
setting up inputs, which answers IN_USE for a register that another client writes.
"""

import socket
from dataclasses import dataclass

from shearloop.drivers.errors import DriverError
from shearloop.drivers.ur.probe import RTDE_PORT, agree_on_protocol, explained, probe, request

DASHBOARD_PORT = 29999
# What ur-rtde's control script takes its commands from.
REGISTERS = ("input_int_register_0", "input_double_register_0")
_INPUTS = ord("I")
_LONGEST_LINE = 1024


@dataclass(frozen=True, slots=True)
class ControllerInfo:
    """What was seen. `remote` is None where the controller has no such mode (CB series)."""

    version: str
    robot_mode: str
    safety_mode: str
    remote: bool | None
    registers_free: bool


def look(host: str, timeout_s: float) -> ControllerInfo:
    """Return what can be seen of a controller; raises DriverError where it is not there or does not answer.

    The registers are given back at once: they belong to a connection, which is closed.
    """
    version = probe(host, timeout_s)
    with explained(host, timeout_s, "asking for its mode"):
        robot_mode, safety_mode, remote = _ask(host, timeout_s, ("robotmode", "safetymode", "is in remote control"))
        free = _registers_free(host, timeout_s)
    return ControllerInfo(
        version,
        robot_mode.removeprefix("Robotmode: "),
        safety_mode.removeprefix("Safetymode: "),
        {"true": True, "false": False}.get(remote.lower()),
        free,
    )


def _ask(host: str, timeout_s: float, questions: tuple[str, ...]) -> list[str]:
    answers = []
    with socket.create_connection((host, DASHBOARD_PORT), timeout=timeout_s) as connection:
        lines = connection.makefile("rb")
        with lines:
            # The banner.
            lines.readline(_LONGEST_LINE)
            for question in questions:
                connection.sendall(f"{question}\n".encode())
                answer = lines.readline(_LONGEST_LINE)
                if not answer:
                    raise DriverError(f"The dashboard server at {host} closed the connection at `{question}`.")
                answers.append(answer.decode(errors="replace").strip())
    return answers


def _registers_free(host: str, timeout_s: float) -> bool:
    with socket.create_connection((host, RTDE_PORT), timeout=timeout_s) as connection:
        agree_on_protocol(connection)
        return b"IN_USE" not in request(connection, _INPUTS, ",".join(REGISTERS).encode())
