"""The controller's side of RTDE without I/O: bytes of one connection in, packages out (UR's RTDE guide, protocol 2)."""

import math
import struct
from dataclasses import dataclass, field

from shearloop.drivers.emulators.ur.registers import known_type, pack, unpack
from shearloop.drivers.emulators.ur.robot import Robot

VERSION, URCONTROL_VERSION, TEXT = ord("V"), ord("v"), ord("M")
DATA, OUTPUTS, INPUTS, START, PAUSE = ord("U"), ord("O"), ord("I"), ord("S"), ord("P")
_HEADER = struct.Struct(">HB")
# The largest input recipe has 25 registers; a longer package than this is no RTDE.
LARGEST_PACKAGE = 4096


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
    _every_s: float = 0.008
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
        self._due_s = max(self._due_s + self._every_s, self.robot.time_s)
        return package(DATA, b"\x01" + pack(self._kinds, [self.robot.variable(name) for name in self._outputs]))

    def _answer(self, kind: int, payload: bytes) -> bytes:
        if kind == DATA:
            self._write(payload)
            return b""
        if kind == VERSION:
            return package(VERSION, bytes([payload == b"\x00\x02" and not self.protocol_refused]))
        if kind == URCONTROL_VERSION:
            return package(URCONTROL_VERSION, struct.pack(">4I", *(*self.robot.make.version, 0, 0, 0)[:4]))
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
        self._every_s = 1.0 / min(rate_hz, self.rate_hz)
        self._outputs = _names(payload[8:])
        kinds = [known_type(name, self.robot.make.version) for name in self._outputs]
        self._kinds = [kind for kind in kinds if kind is not None]
        missing = len(self._kinds) < len(kinds)
        listing = ",".join(kind or "NOT_FOUND" for kind in kinds)
        return package(OUTPUTS, bytes([0 if missing else 1]) + listing.encode())

    def _set_inputs(self, payload: bytes) -> bytes:
        names = _names(payload)
        kinds = [known_type(name, self.robot.make.version) or "NOT_FOUND" for name in names]
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
        values = unpack([known_type(name, self.robot.make.version) or "" for name in names], payload[1:])
        if values is None:
            # The client sends a vector of a wrong length as a short package; a controller drops it.
            return
        # Register 0 last: the command must not be seen before its arguments.
        pairs = list(zip(names, values, strict=False))
        for name, value in sorted(pairs, key=lambda pair: pair[0] == "input_int_register_0"):
            self.robot.write(name, value)


def package(kind: int, payload: bytes) -> bytes:
    """Return one RTDE package."""
    return _HEADER.pack(_HEADER.size + len(payload), kind) + payload


def _names(payload: bytes) -> list[str]:
    return [name for name in payload.decode("ascii").split(",") if name]
