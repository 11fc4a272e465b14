"""What the controller says of itself, on an RTDE connection of our own that waits to be asked.

ur-rtde has an interface for it, and with that a thread which looks at its socket five hundred times a second: a third
of what the robot's process costs at rest. Here samples wait in the kernel until one is wanted, and each is taken whole.
UR's RTDE guide, protocol 2: setting up outputs, start, and the data package.
"""

import select
import socket
import struct
from dataclasses import dataclass

from shearloop.drivers.errors import ProtocolError
from shearloop.drivers.ur.messages import Sample
from shearloop.drivers.ur.probe import HEADER, RTDE_PORT, agree_on_protocol, explained, request

_OUTPUTS, _START, _DATA = ord("O"), ord("S"), ord("U")
# The outputs, with their types, in the order of a sample's fields.
_TYPES = {
    "timestamp": "DOUBLE",
    "actual_q": "VECTOR6D",
    "actual_qd": "VECTOR6D",
    "actual_TCP_pose": "VECTOR6D",
    "actual_TCP_force": "VECTOR6D",
    "robot_mode": "INT32",
    "safety_mode": "INT32",
    "runtime_state": "UINT32",
    "speed_scaling": "DOUBLE",
    "output_int_register_0": "INT32",
}
# The same after the header and the number of the recipe.
_VALUES = struct.Struct(">d24d2iIdi")
_PACKAGE_BYTES = HEADER.size + 1 + _VALUES.size
_RATE = struct.Struct(">d")
# A second's worth of samples.
_READ_BYTES = 1 << 15


@dataclass(frozen=True, slots=True)
class Received(Sample):
    """A sample, and what ur-rtde's control script says there of itself: 1 for ready, 2 for done with a command."""

    script_state: int


class SampleParser:
    """Finds the newest sample in what a controller sends, however it was cut. No I/O."""

    def __init__(self) -> None:
        """Start with nothing received."""
        self._begun = b""

    def feed(self, data: bytes) -> Received | None:
        """Return the newest sample that is complete by now, and was not before; None where there is none.

        Raises:
            ProtocolError: a package that cannot be one; where the next one begins is not known then.
        """
        # Nearly always nothing had begun, and nothing is copied.
        data = self._begun + data
        start, newest, received = 0, -1, len(data)
        while received - start >= HEADER.size:
            size, kind = HEADER.unpack_from(data, start)
            if size < HEADER.size or (kind == _DATA and size != _PACKAGE_BYTES):
                raise ProtocolError(f"The controller sent a package of kind {kind} with {size} bytes.")
            if received - start < size:
                break
            if kind == _DATA:
                newest = start
            start += size
        self._begun = data[start:]
        return _sample(data, newest + HEADER.size + 1) if newest >= 0 else None


class Receiver:
    """A connection on which the controller sends samples; `connected` is False once it has ended."""

    def __init__(self, host: str, rate_hz: float, timeout_s: float) -> None:
        """Connect, and wait for the first sample.

        Raises:
            ProbeError: the controller is not there, stays silent, or does not send what is needed.
        """
        self._parser = SampleParser()
        self.connected = True
        with explained(host, timeout_s, "asking for its state"):
            self._connection = socket.create_connection((host, RTDE_PORT), timeout=timeout_s)
            try:
                self._sample = self._first_sample(rate_hz)
            except BaseException:
                self.close()
                raise
        self._connection.setblocking(False)

    def close(self) -> None:
        """Close the connection."""
        self.connected = False
        self._connection.close()

    def _first_sample(self, rate_hz: float) -> Received:
        agree_on_protocol(self._connection)
        answer = request(self._connection, _OUTPUTS, _RATE.pack(rate_hz) + ",".join(_TYPES).encode())
        types = answer[1:].decode(errors="replace")
        if types != ",".join(_TYPES.values()):
            raise OSError(f"its outputs are of the types {types}")
        if request(self._connection, _START) != b"\x01":
            raise OSError("it does not send its state")
        while self.connected:
            sample = self._received()
            if sample is not None:
                return sample
        raise OSError("it closed the connection on which it was to send its state")

    def latest(self) -> Received:
        """Return the newest sample that has arrived, which is the last one again where none has; never waits."""
        if self.connected:
            self._sample = self._received() or self._sample
        return self._sample

    def wait(self, seconds: float) -> bool:
        """Return whether something has come that `latest` has not taken, waiting for it for so long at most."""
        return self.connected and bool(select.select([self._connection], [], [], max(0.0, seconds))[0])

    def _received(self) -> Received | None:
        """Return the newest sample of all that has arrived since the last call."""
        newest, more = None, True
        while more:
            try:
                data = self._connection.recv(_READ_BYTES)
                newest = self._parser.feed(data) or newest
            except BlockingIOError:
                break
            except (OSError, ProtocolError) as error:
                if isinstance(error, TimeoutError) and self._connection.gettimeout():
                    # The first one is waited for; afterwards it is the network that has given up.
                    raise
                data = b""
            self.connected, more = bool(data), len(data) == _READ_BYTES
        return newest


def _sample(data: bytes, start: int) -> Received:
    values = _VALUES.unpack_from(data, start)
    return Received(values[0], values[1:7], values[7:13], values[13:19], values[19:25], *values[25:])
