"""The controller's side of RTDE without I/O: bytes of one connection in, packages out (UR's RTDE guide, protocol 2)."""

import math
import struct
from collections.abc import Iterable
from dataclasses import dataclass, field

from shearloop.drivers.emulators.ur.robot import Robot, Value

VERSION, URCONTROL_VERSION, TEXT = b"VvM"
DATA, OUTPUTS, INPUTS, START, PAUSE = b"UOISP"
_HEADER = struct.Struct(">HB")
# The largest input recipe has 25 registers; a longer package than this is no RTDE.
LARGEST_PACKAGE = 4096

FORMATS = {
    "UINT32": "I",
    "UINT64": "Q",
    "INT32": "i",
    "DOUBLE": "d",
    "VECTOR3D": "3d",
    "VECTOR6D": "6d",
    "VECTOR6INT32": "6i",
}
_REGISTERS = 48
_BY_TYPE = {
    "DOUBLE": "timestamp actual_execution_time speed_scaling target_speed_fraction speed_scaling_combined "
    "actual_momentum actual_main_voltage actual_robot_voltage actual_robot_current payload "
    "standard_analog_input0 standard_analog_input1 standard_analog_output0 standard_analog_output1 "
    "standard_analog_input_0 standard_analog_input_1 standard_analog_output_0 standard_analog_output_1 "
    "speed_slider_fraction",
    "VECTOR6D": "target_q target_qd target_qdd target_current target_moment actual_q actual_qd actual_current "
    "joint_control_output actual_TCP_pose actual_TCP_speed actual_TCP_force target_TCP_pose target_TCP_speed "
    "joint_temperatures actual_joint_voltage ft_raw_wrench payload_inertia actual_current_as_torque "
    "external_force_torque",
    "VECTOR3D": "actual_tool_accelerometer payload_cog",
    "VECTOR6INT32": "joint_mode",
    "UINT64": "actual_digital_input_bits actual_digital_output_bits",
    "UINT32": "robot_status_bits safety_status_bits runtime_state speed_slider_mask",
    "INT32": "robot_mode safety_mode safety_status",
}
TYPES = {name: kind for kind, names in _BY_TYPE.items() for name in names.split()}
for _direction in ("input", "output"):
    for _number in range(_REGISTERS):
        TYPES[f"{_direction}_int_register_{_number}"] = "INT32"
        TYPES[f"{_direction}_double_register_{_number}"] = "DOUBLE"

# The version that introduced a variable; an older controller answers NOT_FOUND.
SINCE = {"ft_raw_wrench": (5, 9), "actual_current_as_torque": (5, 23), "external_force_torque": (5, 4)}


def known_type(name: str, version: tuple[int, ...]) -> str | None:
    """Return the RTDE type of a variable, or None where a controller of this version does not have it."""
    if version[:2] < SINCE.get(name, (0, 0)):
        return None
    return TYPES.get(name)


def pack(kinds: Iterable[str], values: Iterable[Value | None]) -> bytes:
    """Return values one after the other, big-endian and without padding; None becomes zero."""
    packed = b""
    for kind, value in zip(kinds, values, strict=True):
        layout = ">" + FORMATS[kind]
        if value is None:
            packed += bytes(struct.calcsize(layout))
        elif isinstance(value, int | float):
            packed += struct.pack(layout, value)
        else:
            packed += struct.pack(layout, *value)
    return packed


def unpack(kinds: Iterable[str], data: bytes) -> list[float] | None:
    """Return the scalar values of an input package, or None when its length is not the recipe's."""
    layout = ">" + "".join(FORMATS[kind] for kind in kinds)
    if struct.calcsize(layout) != len(data):
        return None
    return list(struct.unpack(layout, data))


class NotRtdeError(Exception):
    """The peer does not speak RTDE; the connection is closed."""


@dataclass
class RtdeSession:
    """One client on port 30004."""

    robot: Robot
    rate_hz: float
    protocol_refused: bool = False
    _buffer: bytearray = field(default_factory=bytearray)
    _inputs: list[list[str]] = field(default_factory=list)
    _outputs: list[str] = field(default_factory=list)
    _kinds: list[str] = field(default_factory=list)
    _period_s: float = 0.008
    _due_s: float = 0.0
    _started: bool = False

    def receive(self, data: bytes) -> bytes:
        """Return the replies to all complete packages; the rest waits for more bytes."""
        self._buffer += data
        replies = bytearray()
        while len(self._buffer) >= _HEADER.size:
            size, kind = _HEADER.unpack_from(self._buffer)
            if not _HEADER.size <= size <= LARGEST_PACKAGE:
                raise NotRtdeError(f"a package of {size} bytes")
            if len(self._buffer) < size:
                break
            payload = bytes(self._buffer[_HEADER.size : size])
            del self._buffer[:size]
            try:
                replies += self._answer(kind, payload)
            except (struct.error, UnicodeDecodeError) as error:
                raise NotRtdeError(f"a package of type {kind} that cannot be read: {error}") from error
        return bytes(replies)

    def data(self) -> bytes:
        """Return the data package that is due at the robot's time, or nothing."""
        if not self._started or self.robot.time_s < self._due_s - 1e-9:
            return b""
        self._due_s = max(self._due_s + self._period_s, self.robot.time_s)
        return package(DATA, b"\x01" + pack(self._kinds, [self.robot.variable(name) for name in self._outputs]))

    def _answer(self, kind: int, payload: bytes) -> bytes:
        if kind == DATA:
            self._write(payload)
            return b""
        if kind == VERSION:
            return package(VERSION, bytes([payload == b"\x00\x02" and not self.protocol_refused]))
        if kind == URCONTROL_VERSION:
            return package(URCONTROL_VERSION, struct.pack(">4I", *(*self.robot.spec.version, 0, 0, 0)[:4]))
        if kind == OUTPUTS:
            return self._set_outputs(payload)
        if kind == INPUTS:
            return self._set_inputs(payload)
        if kind in (START, PAUSE):
            self._started = kind == START
            self._due_s = self.robot.time_s
            return package(kind, b"\x01")
        raise NotRtdeError(f"package type {kind}")

    def _set_outputs(self, payload: bytes) -> bytes:
        (rate_hz,) = struct.unpack_from(">d", payload)
        if not 0 < rate_hz < math.inf:
            raise NotRtdeError(f"an output rate of {rate_hz:g} Hz")
        self._period_s = 1.0 / min(rate_hz, self.rate_hz)
        names = _names(payload[8:])
        kinds = [(name, known_type(name, self.robot.spec.version)) for name in names]
        self._outputs = [name for name, kind in kinds if kind is not None]
        self._kinds = [kind for _, kind in kinds if kind is not None]
        missing = len(self._kinds) < len(kinds)
        listing = ",".join(kind or "NOT_FOUND" for _, kind in kinds)
        return package(OUTPUTS, bytes([0 if missing else 1]) + listing.encode())

    def _set_inputs(self, payload: bytes) -> bytes:
        names = _names(payload)
        kinds = [known_type(name, self.robot.spec.version) or "NOT_FOUND" for name in names]
        if self.robot.registers_taken:
            kinds = ["IN_USE" if "_register_" in name else kind for name, kind in zip(names, kinds, strict=True)]
        if {"IN_USE", "NOT_FOUND"} & set(kinds):
            return package(INPUTS, b"\x00" + ",".join(kinds).encode())
        self._inputs.append(names)
        return package(INPUTS, bytes([len(self._inputs)]) + ",".join(kinds).encode())

    def _write(self, payload: bytes) -> None:
        if not payload or not 1 <= payload[0] <= len(self._inputs):
            raise NotRtdeError("data for an input recipe that was not agreed on")
        names = self._inputs[payload[0] - 1]
        values = unpack([known_type(name, self.robot.spec.version) or "" for name in names], payload[1:])
        if values is None:
            # The client sends a vector of a wrong length as a short package; a controller drops it.
            return
        # Register 0 last: its command needs the arguments.
        pairs = list(zip(names, values, strict=False))
        for name, value in sorted(pairs, key=lambda pair: pair[0] == "input_int_register_0"):
            self.robot.write(name, value)


def package(kind: int, payload: bytes) -> bytes:
    """Return one RTDE package."""
    return _HEADER.pack(_HEADER.size + len(payload), kind) + payload


def _names(payload: bytes) -> list[str]:
    return [name for name in payload.decode("ascii").split(",") if name]
