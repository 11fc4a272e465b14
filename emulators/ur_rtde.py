"""The controller's side of RTDE without I/O: bytes of one connection in, packages out (UR's RTDE guide, protocol 2)."""

import re
import struct
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, field

from shearloop.emulators.ur_arm import Vector
from shearloop.emulators.ur_robot import (
    MODE_RUNNING,
    SAFETY_EMERGENCY_STOP,
    SAFETY_NORMAL,
    SAFETY_PROTECTIVE_STOP,
    Robot,
)
from shearloop.emulators.urscript import COMMANDS

Value = int | float | Sequence[float] | Vector

VERSION, URCONTROL_VERSION, DATA, OUTPUTS, INPUTS, START, PAUSE = b"VvUOISP"
_HEADER = struct.Struct(">HB")

FORMATS = {"UINT32": "I", "INT32": "i", "DOUBLE": "d", "VECTOR3D": "3d", "VECTOR6D": "6d"}
_REGISTERS = 48
_REGISTER = re.compile(r"(input|output)_(int|double)_register_(\d+)")
_SAFETY_BITS = {
    SAFETY_NORMAL: 1 << 0,
    SAFETY_PROTECTIVE_STOP: 1 << 2 | 1 << 10,
    SAFETY_EMERGENCY_STOP: 1 << 6 | 1 << 7 | 1 << 10,
}
# What the driver and ur-rtde ask for: the type, and the value where it is an output.
_VARIABLES: dict[str, tuple[str, Callable[[Robot], Value]]] = {
    "timestamp": ("DOUBLE", lambda robot: robot.clock_s),
    "actual_q": ("VECTOR6D", lambda robot: robot.arm.q_rad),
    "actual_qd": ("VECTOR6D", lambda robot: robot.arm.measured_rad_per_s),
    "actual_TCP_pose": ("VECTOR6D", lambda robot: robot.arm.pose),
    "actual_TCP_speed": ("VECTOR6D", lambda robot: robot.arm.speed),
    "actual_TCP_force": ("VECTOR6D", lambda robot: robot.arm.wrench),
    "robot_mode": ("INT32", lambda robot: robot.robot_mode),
    "safety_mode": ("INT32", lambda robot: robot.safety_mode),
    "safety_status_bits": ("UINT32", lambda robot: _SAFETY_BITS[robot.safety_mode]),
    "runtime_state": ("UINT32", lambda robot: robot.runtime_state),
    "robot_status_bits": ("UINT32", lambda robot: int(robot.robot_mode == MODE_RUNNING) | robot.program_running << 1),
    "target_speed_fraction": ("DOUBLE", lambda robot: robot.arm.speed_slider),
    "speed_scaling": ("DOUBLE", lambda robot: robot.arm.limiter_scaling),
    "external_force_torque": ("VECTOR6D", lambda _: (0.0,) * 6),
    "payload": ("DOUBLE", lambda robot: robot.spec.payload_kg),
    "payload_cog": ("VECTOR3D", lambda robot: robot.spec.payload_cog_m),
    "tcp_offset": ("VECTOR6D", lambda robot: robot.spec.tcp_offset),
}


def type_of(name: str) -> str:
    """Return the RTDE type of a register or variable, NOT_FOUND for an unknown one."""
    register = _REGISTER.fullmatch(name)
    if register is not None and int(register[3]) < _REGISTERS:
        return "INT32" if register[2] == "int" else "DOUBLE"
    return _VARIABLES[name][0] if name in _VARIABLES else "NOT_FOUND"


def variable(robot: Robot, name: str) -> Value:
    """Return the present value of a known register or variable."""
    if name in _VARIABLES:
        return _VARIABLES[name][1](robot)
    value = robot.registers[name]
    return int(value) if "_int_" in name else value


def pack(kinds: Iterable[str], values: Iterable[Value]) -> bytes:
    """Return values one after the other, big-endian and without padding."""
    return b"".join(
        struct.pack(">" + FORMATS[kind], *([value] if isinstance(value, int | float) else value))
        for kind, value in zip(kinds, values, strict=True)
    )


def unpack(kinds: Iterable[str], data: bytes) -> list[float] | None:
    """Return the scalar values of an input package, or None when its length is not the recipe's."""
    layout = ">" + "".join(FORMATS[kind] for kind in kinds)
    if struct.calcsize(layout) != len(data):
        return None
    return list(struct.unpack(layout, data))


@dataclass
class RtdeSession:
    """One client on port 30004."""

    robot: Robot
    rate_hz: float
    # Names of faults; `refuse-protocol`, `registers-in-use` and `upper-registers-in-use` concern this connection.
    faults: set[str]
    # Of all clients, as far as they are connected now; this one can be among them.
    clients: Collection["RtdeSession"] = field(default=(), repr=False, compare=False)
    _buffer: bytearray = field(default_factory=bytearray)
    _inputs: list[list[str]] = field(default_factory=list)
    # Types by name.
    _outputs: dict[str, str] = field(default_factory=dict)
    _period_s: float = 0.008
    _due_s: float = 0.0
    _started: bool = False

    def receive(self, data: bytes) -> bytes:
        """Return the replies to all complete packages; the rest waits for more bytes."""
        self._buffer += data
        replies = bytearray()
        while len(self._buffer) >= _HEADER.size:
            size, kind = _HEADER.unpack_from(self._buffer)
            if len(self._buffer) < size:
                break
            payload = bytes(self._buffer[_HEADER.size : size])
            del self._buffer[:size]
            replies += self._answer(kind, payload)
        return bytes(replies)

    def data(self) -> bytes:
        """Return the data package that is due at the robot's time, or nothing."""
        if not self._started or self.robot.time_s < self._due_s - 1e-9:
            return b""
        self._due_s = max(self._due_s + self._period_s, self.robot.time_s)
        values = [variable(self.robot, name) for name in self._outputs]
        return package(DATA, b"\x01" + pack(self._outputs.values(), values))

    def writes(self, name: str) -> bool:
        """Return whether this client has an input of this name."""
        return any(name in names for names in self._inputs)

    def _answer(self, kind: int, payload: bytes) -> bytes:
        if kind == DATA:
            self._write(payload)
            return b""
        if kind == VERSION:
            return package(VERSION, bytes([payload == b"\x00\x02" and "refuse-protocol" not in self.faults]))
        if kind == URCONTROL_VERSION:
            return package(URCONTROL_VERSION, struct.pack(">4I", *self.robot.spec.version))
        if kind == OUTPUTS:
            return self._set_outputs(payload)
        if kind == INPUTS:
            return self._set_inputs(payload)
        if kind in (START, PAUSE):
            self._started, self._due_s = kind == START, self.robot.time_s
            return package(kind, b"\x01")
        raise ValueError(f"an RTDE package of type {kind}")

    def _set_outputs(self, payload: bytes) -> bytes:
        (rate_hz,) = struct.unpack_from(">d", payload)
        self._period_s = 1.0 / min(rate_hz, self.rate_hz)
        names = _names(payload[8:])
        kinds = [type_of(name) for name in names]
        found = "NOT_FOUND" not in kinds
        self._outputs = dict(zip(names, kinds, strict=True)) if found else {}
        return package(OUTPUTS, bytes([found]) + ",".join(kinds).encode())

    def _set_inputs(self, payload: bytes) -> bytes:
        names = _names(payload)
        kinds = [type_of(name) for name in names]
        kinds = ["IN_USE" if self._is_taken(name) else kind for name, kind in zip(names, kinds, strict=True)]
        if {"IN_USE", "NOT_FOUND"} & set(kinds):
            return package(INPUTS, b"\x00" + ",".join(kinds).encode())
        self._inputs.append(names)
        return package(INPUTS, bytes([len(self._inputs)]) + ",".join(kinds).encode())

    def _is_taken(self, name: str) -> bool:
        """Return whether another client writes this input: an RTDE client, or by a fault a fieldbus."""
        if any(client.writes(name) for client in self.clients if client is not self):
            return True
        register = _REGISTER.fullmatch(name)
        upper = register is not None and int(register[3]) >= _REGISTERS // 2
        return register is not None and (
            "registers-in-use" in self.faults or (upper and "upper-registers-in-use" in self.faults)
        )

    def _write(self, payload: bytes) -> None:
        names = self._inputs[payload[0] - 1]
        values = unpack([type_of(name) for name in names], payload[1:])
        if values is None:
            # The client sends a vector of a wrong length as a short package; a controller drops it.
            return
        # The command's register last: it needs the arguments.
        pairs = list(zip(names, values, strict=False))
        for name, value in sorted(pairs, key=lambda pair: pair[0] in COMMANDS):
            self.robot.registers.write(name, value, self.robot.time_s)


def package(kind: int, payload: bytes) -> bytes:
    """Return one RTDE package."""
    return _HEADER.pack(_HEADER.size + len(payload), kind) + payload


def _names(payload: bytes) -> list[str]:
    return [name for name in payload.decode("ascii").split(",") if name]
