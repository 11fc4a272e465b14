"""The gripper over the URCap's socket on the robot's controller, an ASCII protocol.

`SET POS 100 SPE 255 FOR 50 GTO 1` is answered with `ack`, without a line end; `GET POS` with `POS 100` and a line end,
or with `POS ?` when the controller has no value, for example because the gripper has no power.
"""

import asyncio
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial

from shearloop.drivers.errors import DeviceLostError, DeviceNotFoundError, ProtocolError
from shearloop.drivers.robotiq import messages

PORT = 63352
CONNECT_DEADLINE_S = 2.0
# A reply takes some milliseconds; the controller serves the socket with a low priority.
REPLY_DEADLINE_S = 0.5
MAX_REPLY_BYTES = 32
_ACK = b"ack"
# PRE before OBJ, and OBJ before POS: then OBJ is never older than the target, nor the position than the stop.
READ_ORDER = ("ACT", "STA", "GTO", "PRE", "OBJ", "POS", "FLT", "COU")
# Older URCaps have no motor current.
_OPTIONAL = ("COU",)


def set_lines(request: messages.Request) -> list[bytes]:
    """Return the lines of a request; each is acknowledged before the next."""
    match request:
        case messages.Reset():
            return [b"SET ACT 0\n", b"SET ATR 0\n"]
        case messages.Activate():
            return [b"SET ACT 1\n"]
        case messages.GripperHalt():
            return [b"SET GTO 0\n"]
        case messages.GripperMove(position, speed, force):
            return [f"SET POS {position} SPE {speed} FOR {force} GTO 1\n".encode()]


class ReplyParser:
    """Collects the bytes of one reply at a time. No I/O."""

    def __init__(self) -> None:
        self._buffer = b""

    def check_empty(self) -> None:
        """Raise ProtocolError when bytes are left that no request asked for."""
        if self._buffer.strip():
            raise ProtocolError(f"The gripper's socket sent {self._buffer!r} without a request.")

    def feed(self, data: bytes) -> None:
        """Add received bytes; ProtocolError when they are longer than any reply."""
        self._buffer += data
        if len(self._buffer) > MAX_REPLY_BYTES:
            raise ProtocolError(f"The gripper's socket answered with {self._buffer!r}; is this the URCap's port?")

    def take_ack(self) -> str | None:
        """Return "ack", or None while it is incomplete; ProtocolError for anything else."""
        text = self._buffer.lstrip()
        if not _ACK.startswith(text[: len(_ACK)]):
            raise ProtocolError(f"The gripper's socket answered a command with {text!r} instead of {_ACK!r}.")
        if len(text) < len(_ACK):
            return None
        self._buffer = text[len(_ACK) :]
        return _ACK.decode()

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
    """Return a variable's number, 0…255; None for `?` where the variable is optional, else DeviceLostError."""
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


def readout_of(values: dict[str, int | None]) -> messages.Readout:
    """Return the readout of the values of READ_ORDER; ProtocolError for a status that is not in the manual."""
    known = {name: value for name, value in values.items() if value is not None}
    try:
        return messages.Readout(
            act=bool(known["ACT"]),
            gto=bool(known["GTO"]),
            sta=messages.ActivationStatus(known["STA"]),
            obj=messages.ObjectStatus(known["OBJ"]),
            flt=known["FLT"],
            pre=known["PRE"],
            pos=known["POS"],
            current=known.get("COU"),
        )
    except ValueError as error:
        raise ProtocolError(f"The gripper's status is not in its manual: {error}.") from error


# A line to send, and a function that takes its answer from the parser.
_Question = tuple[bytes, Callable[[ReplyParser], str | None]]


class SocketClient:
    """One connection to the URCap. Any failure closes it: afterwards a reply could belong to another request."""

    def __init__(self, host: str, port: int = PORT, *, reply_deadline_s: float = REPLY_DEADLINE_S) -> None:
        """Name the controller; nothing is opened yet."""
        self._host = host
        self._port = port
        self._deadline_s = reply_deadline_s
        self._streams: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None
        self._parser = ReplyParser()

    @property
    def name(self) -> str:
        """The gripper's address, for messages."""
        return f"{self._host}:{self._port}"

    async def connect(self) -> None:
        """Open the connection; DeviceNotFoundError when nothing listens there."""
        await self.close()
        self._parser = ReplyParser()
        try:
            async with asyncio.timeout(CONNECT_DEADLINE_S):
                self._streams = await asyncio.open_connection(self._host, self._port)
        except OSError as error:  # a timeout is one
            raise DeviceNotFoundError(
                f"There is no gripper socket at {self.name} ({error or 'no answer'}); check the robot's address and "
                "that the Robotiq URCap is installed and runs."
            ) from error

    async def close(self) -> None:
        """Close the connection; closing twice is allowed."""
        streams, self._streams = self._streams, None
        if streams is not None:
            streams[1].transport.abort()
            with suppress(OSError):
                await streams[1].wait_closed()

    async def read(self) -> messages.Readout:
        """Return the status registers, requested one by one; DeviceLostError or ProtocolError."""
        answers = await self._ask(
            [(f"GET {name}\n".encode(), partial(ReplyParser.take_value, variable=name)) for name in READ_ORDER]
        )
        return readout_of({name: value_of(name, text) for name, text in zip(READ_ORDER, answers, strict=True)})

    async def write(self, request: messages.Request) -> None:
        """Send a request and wait for its acknowledgement; DeviceLostError or ProtocolError."""
        await self._ask([(line, ReplyParser.take_ack) for line in set_lines(request)])

    async def _ask(self, questions: Sequence[_Question]) -> list[str]:
        if self._streams is None:
            raise DeviceLostError(f"There is no connection to the gripper at {self.name} at present.")
        reader, writer = self._streams
        answers = []
        try:
            for line, take in questions:
                self._parser.check_empty()
                writer.write(line)
                until_s = asyncio.get_running_loop().time() + self._deadline_s
                while (answer := take(self._parser)) is None:
                    self._parser.feed(await self._receive(reader, line, until_s))
                answers.append(answer)
        except BaseException as error:
            await self.close()
            if isinstance(error, OSError):
                raise DeviceLostError(f"The connection to the gripper at {self.name} broke: {error}.") from error
            raise
        return answers

    async def _receive(self, reader: asyncio.StreamReader, line: bytes, until_s: float) -> bytes:
        data = b""
        for due_s in (until_s, 0.0):
            # Twice: when this process was paused, the answer may have arrived together with the deadline.
            with suppress(TimeoutError):
                async with asyncio.timeout_at(due_s):
                    data = await reader.read(MAX_REPLY_BYTES)
                    break
        else:
            raise DeviceLostError(
                f"The gripper's socket at {self.name} gave no whole answer to {line.decode().strip()!r} within "
                f"{self._deadline_s:g} s."
            )
        if not data:
            raise DeviceLostError(f"The controller closed the gripper's socket at {self.name}.")
        return data
