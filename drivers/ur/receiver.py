"""Receives the controller's samples over RTDE, and writes the deadline of a motion into our register."""

import math
import select
import socket
import struct
from typing import Final

from shearloop.drivers.defaults import RTDE_PORT
from shearloop.drivers.errors import ProtocolError
from shearloop.drivers.ur.messages import RtdeOutputs
from shearloop.drivers.ur.ports import explain_failure, lose_dead_peers
from shearloop.drivers.ur.rtde import (
    DATA,
    HEADER,
    INPUT_PACKAGE,
    INPUTS,
    OUTPUTS,
    START,
    agree_on_protocol,
    registers_in_use,
    request,
)
from shearloop.drivers.ur.script import UPPER, ScriptRegisters

# The outputs and their types, in the order of a sample's fields; the script's registers come last.
_TYPES: Final = {
    "timestamp": "DOUBLE",
    "actual_q": "VECTOR6D",
    "actual_qd": "VECTOR6D",
    "actual_TCP_pose": "VECTOR6D",
    "actual_TCP_speed": "VECTOR6D",
    "actual_TCP_force": "VECTOR6D",
    "robot_mode": "INT32",
    "safety_mode": "INT32",
    "runtime_state": "UINT32",
    "target_speed_fraction": "DOUBLE",
    "speed_scaling": "DOUBLE",
}
# Outputs that controllers have from PolyScope 3.12 and 5.5.1 on.
_TOOL_TYPES: Final = {"payload": "DOUBLE", "payload_cog": "VECTOR3D", "tcp_offset": "VECTOR6D"}
# The same outputs, after the header and the recipe's number.
_VALUES: Final = struct.Struct(">d30d2iI2d2id")
_TOOL_VALUES: Final = struct.Struct(">d3d6d")
_PACKAGE_BYTES: Final = HEADER.size + 1 + _VALUES.size
_PACKAGE_SIZES: Final = (_PACKAGE_BYTES, _PACKAGE_BYTES + _TOOL_VALUES.size)
_NO_TOOL: Final = (math.nan,) * 10
# One second of samples.
_READ_BYTES = 1 << 15


class SampleParser:
    """Finds the newest sample in the controller's byte stream. No I/O."""

    def __init__(self) -> None:
        self._buffer = b""

    def feed(self, data: bytes) -> RtdeOutputs | None:
        """Return the newest sample that `data` completes, or None.

        Raises:
            ProtocolError: a package is invalid, so that the start of the next one is unknown.
        """
        data, starts = self.split(data)
        return outputs_at(data, starts[-1]) if starts else None

    def split(self, data: bytes) -> tuple[bytes, list[int]]:
        """Return all bytes, and where a whole sample begins in them; keep the rest for later. Raises as `feed` does."""
        data = self._buffer + data
        start, starts, received = 0, [], len(data)
        while received - start >= HEADER.size:
            size, kind = HEADER.unpack_from(data, start)
            if size < HEADER.size or (kind == DATA and size not in _PACKAGE_SIZES):
                raise ProtocolError(f"The controller sent a package of kind {kind} with {size} bytes.")
            if received - start < size:
                break
            if kind == DATA:
                starts.append(start)
            start += size
        self._buffer = data[start:]
        return data, starts


def outputs_at(data: bytes, start: int) -> RtdeOutputs:
    """Return the sample in the package that begins at `start`."""
    (size, _), start = HEADER.unpack_from(data, start), start + HEADER.size + 1
    v = _VALUES.unpack_from(data, start)
    tool = _NO_TOOL if size == _PACKAGE_BYTES else _TOOL_VALUES.unpack_from(data, start + _VALUES.size)
    motion = v[0], v[1:7], v[7:13], v[13:19], v[19:25], v[25:31]
    modes, scalings, script = (v[31], v[32], v[33]), (v[34], v[35]), (v[36], v[37], v[38])
    return RtdeOutputs(*motion, *modes, *scalings, *script, tool[0], tool[1:4], tool[4:])


class RtdeReceiver:
    """A connection for the controller's samples and our register; `connected` is False once it has ended.

    Samples wait in the kernel until `latest` takes the newest one. ur-rtde's interface polls its socket instead, which
    takes a third of the worker's processor time at rest.
    """

    def __init__(
        self,
        host: str,
        rate_hz: float,
        timeout_s: float,
        registers: ScriptRegisters = UPPER,
        *,
        writes: bool = True,
        parser: SampleParser | None = None,
    ) -> None:
        """Connect and wait for the first sample. One that only observes leaves our register to others.

        `parser` gets all bytes; without one, only the newest samples are read.

        Raises:
            RobotLostError: the controller is absent or silent, does not send the outputs, or our register is in use.
        """
        self._host, self._writes = host, writes
        self._registers = registers
        self._recipe = 0
        self._parser = parser or SampleParser()
        self.connected = True
        with explain_failure(host, timeout_s, "asking for its state"):
            self.connection = socket.create_connection((host, RTDE_PORT), timeout=timeout_s)
            lose_dead_peers(self.connection)
            try:
                self._sample = self._first_sample(rate_hz)
            except BaseException:
                self.close()
                raise
        self.connection.setblocking(False)

    def close(self) -> None:
        """Close the connection."""
        self.connected = False
        self.connection.close()

    def _first_sample(self, rate_hz: float) -> RtdeOutputs:
        agree_on_protocol(self.connection)
        registers = self._registers
        known = _TYPES | {registers.state: "INT32", registers.clock: "INT32", registers.step: "DOUBLE"}
        for outputs in (known | _TOOL_TYPES, known):
            answer = request(self.connection, OUTPUTS, struct.pack(">d", rate_hz) + ",".join(outputs).encode())
            types = answer[1:].decode(errors="replace")
            if types == ",".join(outputs.values()):
                break
        else:
            raise OSError(f"its outputs are of the types {types}")
        if self._writes:
            answer = request(self.connection, INPUTS, self._registers.deadline.encode())
            if b"IN_USE" in answer:
                raise registers_in_use(self._host)
            self._recipe = answer[0]
        if request(self.connection, START) != b"\x01":
            raise OSError("it does not send its state")
        while self.connected:
            sample = self._receive()
            if sample is not None:
                return sample
        raise OSError("it closed the connection for its states")

    def latest(self) -> RtdeOutputs:
        """Return the newest sample received, without waiting."""
        if self.connected:
            self._sample = self._receive() or self._sample
        return self._sample

    def write_deadline(self, script_ticks: int) -> None:
        """Write when the motion has to end, by the script's clock."""
        try:
            self.connection.send(INPUT_PACKAGE.pack(INPUT_PACKAGE.size, DATA, self._recipe, script_ticks))
        except OSError:
            # Also where the socket is full: the controller has read nothing for long.
            self.connected = False

    def wait(self, seconds: float) -> bool:
        """Wait for data, at most this long, and return whether there is any."""
        return self.connected and bool(select.select([self.connection], [], [], max(0.0, seconds))[0])

    def _receive(self) -> RtdeOutputs | None:
        """Return the newest sample received, if any."""
        newest, more = None, True
        while more:
            try:
                data = self.connection.recv(_READ_BYTES)
                newest = self._parser.feed(data) or newest
            except BlockingIOError:
                break
            except (OSError, ProtocolError) as error:
                if isinstance(error, TimeoutError) and self.connection.gettimeout():
                    # Only the first sample has a timeout of ours; a later one is the network's.
                    raise
                data = b""
            self.connected, more = bool(data), len(data) == _READ_BYTES
        return newest
