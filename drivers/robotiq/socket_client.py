"""The gripper over the URCap's socket on the robot's controller, an ASCII protocol.

`SET POS 100 SPE 255 FOR 50 GTO 1` is answered with `ack`, without a line end; `GET POS` with `POS 100` and a line end,
or with `POS ?` when the controller has no value, for example because the gripper has no power.
"""

import asyncio
from collections.abc import Callable

from shearloop.drivers.connection import TcpPort
from shearloop.drivers.defaults import URCAP_PORT
from shearloop.drivers.errors import DeviceLostError, DeviceNotFoundError, ProtocolError, system_reason
from shearloop.drivers.refused_lines import shown
from shearloop.drivers.robotiq import messages
from shearloop.words import is_whole_number

# A reply takes some milliseconds; the controller serves the socket with a low priority.
REPLY_DEADLINE_S = 0.5
MAX_REPLY_BYTES = 32
_ACK = b"ack"
# In each readout, after the others: then OBJ is never older than the target, nor the position than the stop.
ALWAYS = ("OBJ", "POS")
# Controllers were reported that take 32 ms a variable: eight of them would be older than the loop accepts.
IN_TURN = ("PRE", "GTO", "ACT", "STA", "FLT", "COU")
# Those in turn are asked for within this time, and at least one.
IN_TURN_S = 0.02
# Older URCaps have no motor current.
_OPTIONAL = ("COU",)


def set_lines(request: messages.Request) -> list[str]:
    """Return the lines of a request; each is acknowledged before the next."""
    match request:
        case messages.GripperAction.RESET:
            # Without GTO: else the fingers would go to the position of the last move as soon as they are active.
            return ["SET GTO 0", "SET ACT 0", "SET ATR 0"]
        case messages.GripperAction.ACTIVATE:
            return ["SET ACT 1"]
        case messages.GripperAction.HALT:
            return ["SET GTO 0"]
        case messages.GripperMove(position, speed, force):
            return [f"SET POS {position} SPE {speed} FOR {force} GTO 1"]


def take_answer(line: str, received: bytes) -> tuple[str, bytes] | None:
    """Return the value asked for, or `ack`, and the bytes after it; None while the answer is incomplete.

    Raises ProtocolError for an answer to something else.
    """
    text = received.lstrip()
    if len(text) > MAX_REPLY_BYTES:
        raise ProtocolError(f"The gripper's socket answered {text[:MAX_REPLY_BYTES]!r}; is this the URCap's port?")
    if line.startswith("SET"):
        if not _ACK.startswith(text[: len(_ACK)]):
            raise ProtocolError(f"The gripper's socket answered a command with {text!r} instead of {_ACK!r}.")
        return (_ACK.decode(), text[len(_ACK) :]) if len(text) >= len(_ACK) else None
    answer, end, rest = text.partition(b"\n")
    if not end:
        return None
    name, _, value = answer.strip().decode("ascii", "replace").partition(" ")
    if f"GET {name}" != line or not value:
        raise ProtocolError(f"The gripper's socket answered {answer!r} to {line!r}.")
    return value, rest


def value_of(variable: str, text: str) -> int | None:
    """Return a variable's number, 0…255; None for `?` where the variable is optional, else DeviceLostError."""
    if text == "?":
        if variable in _OPTIONAL:
            return None
        raise DeviceLostError(
            "The robot's controller answers but has no data of the gripper: check its power and cable, and select it "
            "in the URCap's installation page; on an e-Series set Tool I/O, Controlled by, to the Robotiq URCap, and "
            "uninstall an RS-485 URCap."
        )
    if not (is_whole_number(text, MAX_REPLY_BYTES) and int(text) <= 255):
        raise ProtocolError(f"The gripper's socket gave {variable} as {text!r}, which is no number from 0 to 255.")
    return int(text)


def changed_by(request: messages.Request) -> tuple[str, ...]:
    """Return the variables that a request changes."""
    match request:
        case messages.GripperAction.HALT:
            return ("GTO",)
        case messages.GripperMove():
            return ("PRE",)
    return ("ACT", "STA", "GTO", "FLT")


def readout_of(values: dict[str, int | None]) -> messages.Readout:
    """Return the readout of the values of all variables; ProtocolError for a status that is not in the manual."""
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


class SocketClient:
    """One connection to the URCap. Any failure closes it: afterwards a reply could belong to another request."""

    def __init__(self, host: str, port: int = URCAP_PORT, *, reply_deadline_s: float = REPLY_DEADLINE_S) -> None:
        """Name the controller; nothing is opened yet."""
        self._host = host
        self._port = port
        self._deadline_s = reply_deadline_s
        self._connection: TcpPort | None = None
        self._received = b""
        # The latest value of each variable, and the order in which the client reads the variables that come in turn.
        self._values: dict[str, int | None] = {}
        self._turn = list(IN_TURN)

    @property
    def name(self) -> str:
        """The gripper's address, for messages."""
        return f"{self._host}:{self._port}"

    async def connect(self) -> None:
        """Open the connection; DeviceNotFoundError when nothing listens there."""
        await self.close()
        self._received = b""
        self._values.clear()
        try:
            self._connection = await TcpPort.connect(self._host, self._port)
        except OSError as error:  # a timeout is one
            raise DeviceNotFoundError(
                f"There is no gripper socket at {self.name} ({system_reason(error)}); check the robot's address, that "
                "the Robotiq URCap is installed and runs, and on an e-Series from PolyScope 5.17 on that Settings → "
                "Security → General allows this computer and the port."
            ) from error

    async def close(self) -> None:
        """Close the connection; closing twice is allowed."""
        connection, self._connection = self._connection, None
        if connection is not None:
            connection.close()

    async def read(self, *, whole: bool = False) -> messages.Readout:
        """Return the status registers, requested one by one; DeviceLostError or ProtocolError.

        Object and position are of now. On a slow connection the others are up to six readouts old, unless the last
        request has changed them or `whole` asks for all of them.
        """
        if whole:
            self._values.clear()
        loop = asyncio.get_running_loop()
        until_s = loop.time() + IN_TURN_S
        # Unknown variables come first.
        for number, name in enumerate(sorted(self._turn, key=self._values.__contains__)):
            if number and name in self._values and loop.time() > until_s:
                break
            self._turn.remove(name)
            self._turn.append(name)
            await self._get(name)
        for name in ALWAYS:
            await self._get(name)
        return readout_of(self._values)

    async def write(self, request: messages.Request, before: Callable[[], None] = lambda: None) -> None:
        """Send a request and wait for its acknowledgement; DeviceLostError or ProtocolError.

        `before` is called as the last act before it is sent.
        """
        before()
        for name in changed_by(request):
            self._values.pop(name, None)
        if isinstance(request, messages.GripperMove) and self._values.get("GTO") != 1:
            self._values.pop("GTO", None)
        for line in set_lines(request):
            await self._ask(line)

    async def _get(self, name: str) -> None:
        self._values[name] = value_of(name, await self._ask(f"GET {name}"))

    def _came_instead(self) -> str:
        return f", only {shown(self._received)}" if self._received else ""

    async def _ask(self, line: str) -> str:
        """Send a line and return the value asked for, or `ack`."""
        connection = self._connection
        if connection is None:
            raise DeviceLostError(f"There is no connection to the gripper at {self.name} at present.")
        loop = asyncio.get_running_loop()
        try:
            if self._received.strip():
                raise ProtocolError(f"The gripper's socket sent {self._received!r} without a request.")
            await connection.write(f"{line}\n".encode())
            until_s = loop.time() + self._deadline_s
            while (taken := take_answer(line, self._received)) is None:
                received = await connection.read(until_s - loop.time())
                if received is None:
                    raise DeviceLostError(
                        f"The gripper's socket at {self.name} gave no whole answer to {line!r} within "
                        f"{self._deadline_s:g} s{self._came_instead()}; check that the URCap runs."
                    )
                self._received += received.data
        except BaseException:
            await self.close()
            raise
        answer, self._received = taken
        return answer
