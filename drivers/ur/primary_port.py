"""The controller's error codes, from its Primary Client Interface: why it stopped, in the words of the pendant's log.

Packages: UR's page "Overview of client interfaces" and the primary interface's descriptions. A code like C204A3 is
explained in UR's list of error codes. Without this port, which an e-Series may not serve, only these codes are missing.
"""

import select
import socket
import struct
from typing import Final

from shearloop.drivers.defaults import PRIMARY_PORT
from shearloop.drivers.errors import ProtocolError, system_reason
from shearloop.drivers.ur.messages import ControllerError
from shearloop.drivers.ur.ports import SERVICES_MENU, lose_dead_peers
from shearloop.errors import Hint

# Its size and kind; then, of a message: the controller's time, the source and the kind of message.
_PACKAGE: Final = struct.Struct(">iB")
_MESSAGE: Final = struct.Struct(">QbB")
_CODE: Final = struct.Struct(">iii")
_ROBOT_MESSAGE, _ERROR_CODE = 20, 6
_LARGEST_PACKAGE: Final = 1 << 20
# Above these levels of a code are those for UR's developers.
LEVELS: Final = {0: "debug", 1: "info", 2: "warning", 3: "violation", 4: "fault"}
_DEBUG: Final = 0
_READ_BYTES: Final = 1 << 16


class ErrorCodeParser:
    """Finds error codes in the controller's byte stream. No I/O."""

    def __init__(self) -> None:
        self._buffer = b""

    def feed(self, data: bytes) -> list[ControllerError]:
        """Return the error codes that `data` completes, without those for debugging.

        Raises:
            ProtocolError: a package is invalid, so that the start of the next one is unknown.
        """
        self._buffer += data
        found = []
        while len(self._buffer) >= _PACKAGE.size:
            size, kind = _PACKAGE.unpack_from(self._buffer)
            if not _PACKAGE.size <= size <= _LARGEST_PACKAGE:
                raise ProtocolError(f"The controller sent a package of {size} bytes on port {PRIMARY_PORT}.")
            if len(self._buffer) < size:
                break
            package, self._buffer = self._buffer[_PACKAGE.size : size], self._buffer[size:]
            if kind == _ROBOT_MESSAGE and (error := _error_in(package)) is not None:
                found.append(error)
        return found


def _error_in(package: bytes) -> ControllerError | None:
    """Return the error code in a robot message, or None for another message."""
    if len(package) < _MESSAGE.size + _CODE.size or _MESSAGE.unpack_from(package)[2] != _ERROR_CODE:
        return None
    code, argument, level = _CODE.unpack_from(package, _MESSAGE.size)
    return ControllerError(code, argument, LEVELS[level]) if level in LEVELS and level != _DEBUG else None


class PrimaryPort:
    """A connection that only reads; `missing` says why there is none, and is None while it is open."""

    def __init__(self, host: str, timeout_s: float) -> None:
        """Connect; a controller that does not serve the port is no error."""
        self._parser = ErrorCodeParser()
        self._connection: socket.socket | None = None
        self.missing: Hint | None = None
        try:
            self._connection = socket.create_connection((host, PRIMARY_PORT), timeout_s)
        except OSError as error:
            self.missing = Hint(
                f"The controller does not serve port {PRIMARY_PORT} (Primary Client Interface: "
                f"{system_reason(error)}), so that its error codes are not in the log",
                f"on an e-Series enable it under {SERVICES_MENU}",
            )
        else:
            lose_dead_peers(self._connection)

    def read(self) -> list[ControllerError]:
        """Return the error codes that have come, without waiting; after the end of the connection none."""
        found: list[ControllerError] = []
        while self._connection is not None and select.select([self._connection], [], [], 0.0)[0]:
            try:
                data = self._connection.recv(_READ_BYTES)
                found += self._parser.feed(data)
            except (OSError, ProtocolError):
                data = b""
            if not data:
                self.close()
        return found

    def close(self) -> None:
        """Close the connection; closing twice is allowed."""
        if self._connection is not None:
            self._connection.close()
        self._connection = None
