"""SCPI instruments, emulated: headers in long or short form, an error queue, outages. Over a socket or RS-232."""

import asyncio
import re
import sys
from collections import deque
from collections.abc import Callable, Mapping

from shearloop.drivers.emulators import number_between
from shearloop.drivers.emulators.ports import PtyServer, SocketServer

# Returns the answer to a query, or None for a command; the argument is the text after the header.
Handler = Callable[[str], str | None]

MAX_LINE_BYTES = 512
MAX_ERRORS = 10
UNDEFINED_HEADER = '-113,"Undefined header"'
SETTINGS_CONFLICT = '-221,"Settings conflict"'
OUT_OF_RANGE = '-222,"Parameter data out of range"'
ILLEGAL_VALUE = '-224,"Illegal parameter value"'
OUTAGE_COMMANDS = (
    "silence [SECONDS], unplug [SECONDS], break-off (the next answer stops half-way, with the connection), normal"
)


class ScpiError(Exception):
    """A handler's refusal; its text goes into the error queue."""


class ScpiInterpreter:
    """One instrument's command interpreter; refused commands go into the error queue and get no reply. No I/O."""

    def __init__(self, identity: str, commands: Mapping[str, Handler], no_error: str) -> None:
        """Map headers, as manuals write them (`SOURce:CURRent[:LEVel]`, a query with `?`), to handlers."""
        self._commands = [(_pattern(header), handler) for header, handler in commands.items()]
        self._commands += [
            (_pattern("*IDN?"), lambda _: identity),
            (_pattern("*CLS"), lambda _: self.errors.clear()),
            (_pattern("*OPC?"), lambda _: "1"),
            (_pattern("SYSTem:ERRor[:NEXT]?"), lambda _: self.errors.popleft() if self.errors else no_error),
        ]
        self._buffer = b""
        self.errors: deque[str] = deque(maxlen=MAX_ERRORS)

    def feed(self, data: bytes) -> bytes:
        """Return the replies to the lines that `data` completes."""
        *lines, self._buffer = (self._buffer + data).replace(b"\r", b"\n").split(b"\n")
        self._buffer = self._buffer[-MAX_LINE_BYTES:]
        return b"".join(self._line(line.decode("ascii", "replace").strip()) for line in lines)

    def _line(self, line: str) -> bytes:
        answers = [answer for unit in filter(None, line.split(";")) if (answer := self._unit(unit.strip())) is not None]
        return ";".join(answers).encode() + b"\n" if answers else b""

    def _unit(self, unit: str) -> str | None:
        header, _, argument = unit.partition(" ")
        for pattern, handler in self._commands:
            if pattern.fullmatch(header):
                try:
                    return handler(argument.strip())
                except ScpiError as error:
                    self.errors.append(str(error))
                    return None
        self.errors.append(UNDEFINED_HEADER)
        return None


def parse_number(text: str, low: float, high: float) -> float:
    """Return a command's number; ScpiError for other text or out of range."""
    try:
        value = float(text)
    except ValueError:
        raise ScpiError(ILLEGAL_VALUE) from None
    if not low <= value <= high:
        raise ScpiError(OUT_OF_RANGE)
    return value


def accept_number(low: float, high: float) -> Handler:
    """Return a handler that checks a number and ignores it."""

    def check(text: str) -> None:
        parse_number(text.split(",", 1)[0], low, high)

    return check


def accept_word(*words: str) -> Handler:
    """Return a handler that refuses other words."""

    def check(text: str) -> None:
        if text.upper() not in words:
            raise ScpiError(ILLEGAL_VALUE)

    return check


def parse_boolean(text: str) -> bool:
    """Return a command's truth value; ScpiError for other text."""
    values = {"ON": True, "1": True, "OFF": False, "0": False}
    if text.upper() not in values:
        raise ScpiError(ILLEGAL_VALUE)
    return values[text.upper()]


def _pattern(header: str) -> re.Pattern[str]:
    """Return the pattern of a header: each word in long form or as its capitals, brackets optional."""

    def word(match: re.Match[str]) -> str:
        text = match[0]
        short = "".join(letter for letter in text if letter.isupper())
        return f"(?:{text}|{short})1?" if short != text else text

    words = re.sub(r"[A-Za-z]{2,}", word, header.replace("*", r"\*").replace("?", r"\?"))
    return re.compile(":?" + words.replace("[", "(?:").replace("]", ")?"), re.IGNORECASE)


class FaultyServer:
    """A server that can fall silent or disappear, for a time or until `normal`, or break off once."""

    def __init__(self, server: SocketServer | PtyServer) -> None:
        self._server = server
        self._connected = True
        self._changed = asyncio.Event()
        self._timer: asyncio.TimerHandle | None = None

    def command(self, text: str) -> None:
        """Execute a command; ValueError, with a sentence, for an unknown one."""
        match text.split():
            case ["silence" | "unplug" as kind, *seconds] if len(seconds) < 2:
                duration_s = (
                    number_between(seconds[0], 0.0, sys.float_info.max, "no time in seconds; write for instance 2.5")
                    if seconds
                    else None
                )
                self._recover()
                self._server.silent = kind == "silence"
                self._connect(kind == "silence")
                if duration_s is not None:
                    self._timer = asyncio.get_running_loop().call_later(duration_s, self._recover)
            case ["break-off"]:
                self._server.breaks_off = True
            case ["normal"]:
                self._recover()
            case _:
                raise ValueError(f"{text!r} is no fault of the instrument; there are {OUTAGE_COMMANDS}")

    async def run(self) -> None:
        """Serve until cancelled."""
        async with asyncio.TaskGroup() as group:
            group.create_task(self._server.run())
            while True:
                await self._changed.wait()
                self._changed.clear()
                await (self._server.restore() if self._connected else self._server.disconnect())

    def _connect(self, connected: bool) -> None:
        if connected != self._connected:
            self._connected = connected
            self._changed.set()

    def _recover(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self._server.silent = self._server.breaks_off = False
        self._connect(True)
