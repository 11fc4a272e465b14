"""The URCap's ASCII language as text in and values out, without a socket.

`SET POS 100 SPE 255 FOR 50 GTO 1` is answered with `ack`, without a line end; `GET POS` with `POS 100` and a line end,
or with `POS ?` when the controller has no value, for example because the gripper has no power.
"""

from shearloop.drivers.errors import DeviceLostError, ProtocolError
from shearloop.drivers.robotiq.messages import (
    Activate,
    ActivationStatus,
    GripperHalt,
    GripperMove,
    ObjectStatus,
    Readout,
    Request,
    Reset,
)

PORT = 63352
_ACK = b"ack"
# The longest reply is "POS 255" and a line end.
MAX_REPLY_BYTES = 32
# PRE before OBJ, and OBJ before POS: what OBJ says is then never older than the target, nor the position than the stop.
READ_ORDER = ("ACT", "STA", "GTO", "PRE", "OBJ", "POS", "FLT", "COU")
# What tells whether a gripper that stands still does, still is active and still does what it was asked to: all that a
# state tells but the current, which has an age of its own.
STANDING_ORDER = ("STA", "GTO", "PRE", "OBJ", "POS", "FLT")
# Older URCaps have no motor current.
_OPTIONAL = ("COU",)


def set_lines(request: Request) -> list[bytes]:
    """Return the lines that carry a request, each to be acknowledged before the next."""
    match request:
        case Reset():
            return [b"SET ACT 0\n", b"SET ATR 0\n"]
        case Activate():
            return [b"SET ACT 1\n"]
        case GripperHalt():
            return [b"SET GTO 0\n"]
        case GripperMove(position, speed, force):
            return [f"SET POS {position} SPE {speed} FOR {force} GTO 1\n".encode()]


def get_line(variable: str) -> bytes:
    """Return the line that asks for a variable."""
    return f"GET {variable}\n".encode()


class ReplyParser:
    """Collects the bytes of one reply at a time; what a reply looks like depends on what was asked."""

    def __init__(self) -> None:
        """Start with nothing received."""
        self._buffer = b""

    def expect_nothing(self) -> None:
        """Check, before something is asked, that no bytes are left that nobody asked for; else ProtocolError."""
        if self._buffer.strip():
            raise ProtocolError(f"The gripper's socket sent {self._buffer!r} without being asked.")

    def feed(self, data: bytes) -> None:
        """Add received bytes; ProtocolError when they are more than any reply."""
        self._buffer += data
        if len(self._buffer) > MAX_REPLY_BYTES:
            raise ProtocolError(f"The gripper's socket answered with {self._buffer!r}; is this the URCap's port?")

    def take_ack(self) -> bool:
        """Return whether the acknowledgement is complete; ProtocolError when it is something else."""
        text = self._buffer.lstrip()
        if not _ACK.startswith(text[: len(_ACK)]):
            raise ProtocolError(f"The gripper's socket answered a command with {text!r} instead of {_ACK!r}.")
        if len(text) < len(_ACK):
            return False
        self._buffer = text[len(_ACK) :]
        return True

    def take_value(self, variable: str) -> str | None:
        """Return the variable's value as sent, or None while the line is incomplete; ProtocolError for another."""
        line, end, rest = self._buffer.lstrip().partition(b"\n")
        if not end:
            return None
        self._buffer = rest
        name, _, value = line.strip().decode("ascii", "replace").partition(" ")
        if name != variable or not value:
            raise ProtocolError(f"The gripper's socket answered {line!r} when asked for {variable}.")
        return value


def value_of(variable: str, text: str) -> int | None:
    """Return a variable's number, 0…255; None for a `?` where that may be, DeviceLostError where it may not."""
    if text == "?":
        if variable in _OPTIONAL:
            return None
        raise DeviceLostError(
            "The robot's controller answers but has no data of the gripper; check its power and cable, and that it is "
            "selected in the URCap's installation page."
        )
    if not (text.isascii() and text.isdigit() and int(text) <= 255):
        raise ProtocolError(f"The gripper's socket gave {variable} as {text!r}, which is no number from 0 to 255.")
    return int(text)


def readout_of(values: dict[str, int | None]) -> Readout:
    """Return the readout that the values of READ_ORDER make; ProtocolError for one that the manual does not know."""
    known = {name: value for name, value in values.items() if value is not None}
    try:
        return Readout(
            act=bool(known["ACT"]),
            gto=bool(known["GTO"]),
            sta=ActivationStatus(known["STA"]),
            obj=ObjectStatus(known["OBJ"]),
            flt=known["FLT"],
            pre=known["PRE"],
            pos=known["POS"],
            current=known.get("COU"),
        )
    except ValueError as error:
        raise ProtocolError(f"The gripper's status is not in its manual: {error}.") from error
