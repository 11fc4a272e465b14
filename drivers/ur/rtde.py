"""RTDE's packages, protocol 2 of UR's RTDE guide: requests, and the input registers that a program's client writes.

ur-rtde does not check the answer to its protocol request and waits without a limit for a silent peer, so that the
driver asks first.
"""

import socket
import struct
from typing import Final

from shearloop.drivers.defaults import RTDE_PORT
from shearloop.drivers.ur.messages import RobotLostError
from shearloop.drivers.ur.ports import FIELDBUS_MENU, connected
from shearloop.drivers.ur.script import FIRST_WITH_LOWER_ALONE, LOWER, NO_MOTION_TICKS, UPPER, ScriptRegisters

# Each package begins with its size in bytes, and its kind.
HEADER: Final = struct.Struct(">HB")
PROTOCOL, CONTROLLER_VERSION, OUTPUTS, INPUTS, START, DATA = b"VvOISU"
_OTHER_PACKAGES = 20
# An input package: the header, the recipe's number and one value.
INPUT_PACKAGE: Final = struct.Struct(">HBBi")


def agree_on_protocol(connection: socket.socket) -> bool:
    """Ask for protocol 2 and return whether the controller accepts it."""
    return request(connection, PROTOCOL, b"\x00\x02")[:1] == b"\x01"


def request(connection: socket.socket, kind: int, payload: bytes = b"") -> bytes:
    """Send an RTDE package and return the next one of its kind; OSError where the next twenty are of other kinds."""
    connection.sendall(HEADER.pack(HEADER.size + len(payload), kind) + payload)
    for _ in range(_OTHER_PACKAGES):
        size, got = HEADER.unpack(_receive_exactly(connection, HEADER.size))
        answer = _receive_exactly(connection, size - HEADER.size)
        if got == kind:
            return answer
    raise OSError("something else than RTDE listens on its port")


def _receive_exactly(connection: socket.socket, size: int) -> bytes:
    data = b""
    while len(data) < size:
        part = connection.recv(size - len(data))
        if not part:
            raise OSError("the connection was closed")
        data += part
    return data


def free_registers(host: str, timeout_s: float, version: str) -> ScriptRegisters | None:
    """Return the half of the input registers that no other client writes, the upper one first; None for neither.

    `version` is the controller's, as 5.17.3.0: on a new one, ur-rtde can use the lower half alone.
    """
    major, minor, *_ = map(int, version.split("."))
    for registers in (LOWER,) if (major, minor) >= FIRST_WITH_LOWER_ALONE else (UPPER, LOWER):
        if not are_in_use(host, timeout_s, registers):
            return registers
    return None


def are_in_use(host: str, timeout_s: float, registers: ScriptRegisters) -> bool:
    """Return whether another client writes one of these input registers."""
    # A register belongs to a connection: closing it gives the register back.
    with connected(host, RTDE_PORT, timeout_s, "asking for its registers") as connection:
        agree_on_protocol(connection)
        return b"IN_USE" in request(connection, INPUTS, ",".join(registers.inputs).encode())


def has_other_client(host: str, timeout_s: float, own: ScriptRegisters) -> bool:
    """Return whether another client writes the half of the registers that is not `own`, as another daemon does."""
    return are_in_use(host, timeout_s, LOWER if own == UPPER else UPPER)


def registers_in_use(host: str) -> RobotLostError:
    """Return the error about input registers that another client writes."""
    return RobotLostError(
        "registers-in-use",
        f"The input registers of the robot at {host} are already in use by another RTDE client, EtherNet/IP or "
        f"PROFINET, or a URCap: end the other program, disable the adapter ({FIELDBUS_MENU}), or uninstall "
        "the URCap. A program whose cable was pulled keeps its registers for some minutes.",
    )


def register_round_trip(host: str, timeout_s: float, registers: ScriptRegisters, value: int) -> int:
    """Write a value into our register, and return what the controller reports of it; no program may run.

    Raises:
        RobotLostError: the register is in use, or the controller does not answer.
    """
    with connected(host, RTDE_PORT, timeout_s, "writing a register") as connection:
        agree_on_protocol(connection)
        name = registers.deadline.encode()
        request(connection, OUTPUTS, struct.pack(">d", 125.0) + name)
        answer = request(connection, INPUTS, name)
        if b"IN_USE" in answer:
            raise registers_in_use(host)
        request(connection, START)
        connection.sendall(INPUT_PACKAGE.pack(INPUT_PACKAGE.size, DATA, answer[0], value))
        read = value + 1
        for _ in range(_OTHER_PACKAGES):
            size, kind = HEADER.unpack(_receive_exactly(connection, HEADER.size))
            content = _receive_exactly(connection, size - HEADER.size)
            if kind == DATA and (read := struct.unpack(">i", content[1:5])[0]) == value:
                break
        # An old deadline must not stay.
        connection.sendall(INPUT_PACKAGE.pack(INPUT_PACKAGE.size, DATA, answer[0], NO_MOTION_TICKS))
        return read
