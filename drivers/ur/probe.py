"""A first look at a controller, with deadlines of our own: is it there, does it answer, does it speak our RTDE?

ur-rtde does not look at the answer to its protocol request, and waits for ever for a peer that stays silent.
"""

import socket
import struct
from collections.abc import Iterator
from contextlib import contextmanager

from shearloop.drivers.errors import DriverError
from shearloop.drivers.ur import error_messages as sentences
from shearloop.drivers.ur.messages import FailureKind

RTDE_PORT = 30004
_PROTOCOL, _CONTROLLER_VERSION = ord("V"), ord("v")
HEADER = struct.Struct(">HB")
_OTHER_PACKAGES = 20


class ProbeError(DriverError):
    """A controller that cannot be worked with; `kind` says why."""

    def __init__(self, kind: FailureKind, sentence: str) -> None:
        """Keep the kind beside the sentence."""
        super().__init__(sentence)
        self.kind: FailureKind = kind


def probe(host: str, timeout_s: float) -> str:
    """Return the controller's version, as 5.17.3.0, after agreeing on protocol 2.

    Raises:
        ProbeError: it is not there, stays silent, or refuses the protocol.
    """
    with (
        explained(host, timeout_s, "greeting it"),
        socket.create_connection((host, RTDE_PORT), timeout=timeout_s) as connection,
    ):
        answer = request(connection, _CONTROLLER_VERSION)
        version = ".".join(str(number) for number in struct.unpack(">4I", answer[:16]))
        accepted = agree_on_protocol(connection)
    if not accepted:
        raise ProbeError("version", sentences.version_refused(host, version))
    return version


@contextmanager
def explained(host: str, timeout_s: float, doing: str) -> Iterator[None]:
    """Raise ProbeError for a conversation with a controller that fails, or stays without an answer."""
    try:
        yield
    except TimeoutError as error:
        raise ProbeError("silent", sentences.silent(host, timeout_s, doing)) from error
    except (OSError, struct.error) as error:
        raise ProbeError("unreachable", sentences.unreachable(host, str(error) or type(error).__name__)) from error


def agree_on_protocol(connection: socket.socket) -> bool:
    """Ask for version 2 of the protocol, and return whether the controller accepts it."""
    return request(connection, _PROTOCOL, b"\x00\x02")[:1] == b"\x01"


def request(connection: socket.socket, kind: int, payload: bytes = b"") -> bytes:
    """Send an RTDE package, and return the next one of its kind; OSError where none comes among the first twenty."""
    connection.sendall(HEADER.pack(HEADER.size + len(payload), kind) + payload)
    for _ in range(_OTHER_PACKAGES):
        size, got = HEADER.unpack(_exactly(connection, HEADER.size))
        answer = _exactly(connection, size - HEADER.size)
        if got == kind:
            return answer
    raise OSError("something else than RTDE listens on its port")


def _exactly(connection: socket.socket, size: int) -> bytes:
    data = b""
    while len(data) < size:
        part = connection.recv(size - len(data))
        if not part:
            raise OSError("the connection was closed")
        data += part
    return data
