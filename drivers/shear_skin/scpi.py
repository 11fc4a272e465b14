"""SCPI instruments over a serial port or socket: one query at a time, polled at a steady rate, reconnected."""

import asyncio
import re
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import AsyncGenerator, Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from time import monotonic_ns
from typing import Generic, TypeVar

from shearloop.drivers.connection import Diagnostics, Link, Port
from shearloop.drivers.errors import DeviceLostError, DeviceSilentError, DriverError, ProtocolError
from shearloop.drivers.serial_sensor import InputKind, InputRecorder, LineSplitter, RawEvent

# A reading of five elements is 70 characters long.
MAX_REPLY_BYTES = 512
# Replies to earlier queries, skipped before the answer to *IDN?.
MAX_STALE_REPLIES = 8
REPLY_TIMEOUT_S = 2.0
# Misunderstood replies in a row before the connection is reopened.
MAX_STRIKES = 3
# The values of an overload and of an unmeasured quantity (SCPI-1999, 7.2.1.4 and 7.2.1.5).
OVERLOAD, NOT_A_NUMBER = 9.9e37, 9.91e37
_NUMBER = re.compile(r" *[+-]?[0-9]{1,12}(\.[0-9]{0,12})?([Ee][+-]?[0-9]{1,2})? *")

ReadingT = TypeVar("ReadingT")


class ReplyLines(LineSplitter):
    """Splits bytes into replies, however they are sliced; instruments end them with CR, LF or both. No I/O."""

    def __init__(self) -> None:
        super().__init__(MAX_REPLY_BYTES)
        self._not_ascii = 0
        self.unasked = 0

    @property
    def errors(self) -> Counter[str]:
        """The number of rejected replies, by kind."""
        return +Counter(
            {
                "too long": self.too_long,
                "unfinished": self.unfinished,
                "unasked": self.unasked,
                "not ASCII": self._not_ascii,
            }
        )

    def replies(self, data: bytes) -> list[str]:
        """Return the replies that `data` completes, without line ends; empty lines are ignored."""
        replies = []
        for line in self.feed(data.replace(b"\r", b"\n")):
            if line is None:
                continue
            if not line.isascii():
                self._not_ascii += 1
            elif text := line.decode().strip():
                replies.append(text)
        return replies


@dataclass(frozen=True, slots=True)
class Reply:
    """An instrument's answer, and the times of query and answer (monotonic, ns)."""

    text: str
    t_asked_ns: int
    t_arrival_ns: int


class RecordedInstrument(Generic[ReadingT]):
    """Parses an instrument's recorded replies. No I/O."""

    def __init__(self, parsers: Mapping[str, Callable[[Reply], ReadingT | None]]) -> None:
        self._parsers = parsers
        self._query, self._asked_ns = "", 0

    def handle(self, event: RawEvent) -> list[ReadingT]:
        """Return the readings that an event completes; invalid replies give none, as they did live."""
        if event.kind is InputKind.ASKED:
            self._query, self._asked_ns = event.data.decode("latin-1"), event.t_ns
        elif event.kind is InputKind.DATA and self._query in self._parsers:
            parse, self._query = self._parsers[self._query], ""
            with suppress(ProtocolError):
                reading = parse(Reply(event.data.decode("latin-1"), self._asked_ns, event.t_ns))
                return [] if reading is None else [reading]
        return []


def parse_numbers(text: str, count: int, instrument: str) -> list[float]:
    """Return the comma-separated numbers of a reply; ProtocolError unless there are exactly `count`."""
    parts = text.split(",")
    if len(parts) != count or not all(map(_NUMBER.fullmatch, parts)):
        raise ProtocolError(f"{instrument} sent {text[:60]!r}, which is not {count} numbers; check the baud rate.")
    return [float(part) for part in parts]


class ScpiSession:
    """Queries and commands over a link that may break; after an error call `link.lost`."""

    def __init__(self, link: Link, instrument: str, timeout_s: float, inputs: InputRecorder | None) -> None:
        """Use the link; `instrument` names it in messages, `inputs` keeps queries and their replies."""
        self._inputs = inputs
        self._link = link
        self._instrument = instrument
        self._timeout_s = timeout_s
        self.lines = ReplyLines()
        self._waiting: list[tuple[str, int]] = []

    async def identify(self, *models: str) -> str:
        """Return the reply to *IDN?, skipping stale replies; ProtocolError unless it names one of the models."""
        self.lines.restart()
        self._waiting.clear()
        name = (await self.ask("*IDN?")).text
        for _ in range(MAX_STALE_REPLIES):
            # A name has four fields; the first is not a number.
            if name.count(",") >= 3 and not name.lstrip("+-")[:1].isdigit():
                break
            name = (await self._next(0, "*IDN?")).text
        if models and not any(model in name for model in models):
            raise ProtocolError(
                f"{self._instrument} says it is {name!r}, and not {' or '.join(models)}; see which instrument is there."
            )
        return name

    async def send(self, *commands: str) -> None:
        """Send commands; `check` reports errors."""
        for command in commands:
            await self._port.write(f"{command}\n".encode())

    async def ask(self, query: str) -> Reply:
        """Return the answer to a query; DeviceSilentError if none comes, DeviceLostError if the port is gone."""
        # An unasked reply must not pass for the answer.
        self.lines.unasked += len(self._waiting)
        self._waiting.clear()
        asked_ns = monotonic_ns()
        await self.send(query)
        reply = await self._next(asked_ns, query)
        if self._inputs is not None:
            self._inputs.record(RawEvent(InputKind.ASKED, asked_ns, query.encode()))
            self._inputs.record(RawEvent(InputKind.DATA, reply.t_arrival_ns, reply.text.encode()))
        return reply

    async def ask_until(self, query: str, answer: str, timeout_s: float) -> None:
        """Send a query and skip replies until `answer` comes; DeviceSilentError after `timeout_s`."""
        await self.send(query)
        deadline_ns = monotonic_ns() + int(timeout_s * 1e9)
        while (await self._next(0, query, deadline_ns)).text != answer:
            pass

    async def check(self) -> None:
        """Raise ProtocolError if the instrument rejected a command."""
        reply = (await self.ask(":SYST:ERR?")).text
        try:
            accepted = int(reply.split(",")[0]) == 0
        except ValueError:
            accepted = False
        if not accepted:
            raise ProtocolError(
                f"{self._instrument} refused its settings: {reply}; see whether it is the model that is meant."
            )

    @property
    def _port(self) -> Port:
        if self._link.port is None:
            raise DeviceLostError(f"There is no connection to {self._instrument} at present.")
        return self._link.port

    async def _next(self, asked_ns: int, query: str, deadline_ns: int | None = None) -> Reply:
        begin_ns = monotonic_ns()
        if deadline_ns is None:
            deadline_ns = begin_ns + int(self._timeout_s * 1e9)
        while not self._waiting:
            left_s = (deadline_ns - monotonic_ns()) / 1e9
            try:
                received = await self._port.read(left_s) if left_s > 0 else None
            except DeviceLostError as error:
                if not self.lines.in_line:
                    raise
                raise DeviceLostError(
                    f"{self._instrument} broke off in the middle of its answer to {query!r}: {error}"
                ) from error
            if received is None:
                waited_s = (deadline_ns - begin_ns) / 1e9
                raise DeviceSilentError(
                    f"{self._instrument} at {self._port.path} has not answered {query!r} within {waited_s:.2g} s; "
                    "see that it is on, and that baud rate and line end are as configured."
                )
            self._waiting += [(text, received.t_arrival_ns) for text in self.lines.replies(received.data)]
        text, arrival_ns = self._waiting.pop(0)
        return Reply(text, asked_ns, arrival_ns)


class PolledInstrument(ABC, Generic[ReadingT]):
    """One SCPI instrument behind a link: set up once, then asked at a steady rate, and reconnected when lost."""

    def __init__(
        self, link: Link, instrument: str, period_s: float, timeout_s: float, inputs: InputRecorder | None
    ) -> None:
        self._link = link
        self.period_s = period_s
        self._session = ScpiSession(link, instrument, timeout_s, inputs)
        self._strikes = 0
        self._count = 0
        self._errors: Counter[str] = Counter()
        self._name = ""

    @abstractmethod
    async def _set_up(self) -> str:
        """Configure a freshly opened instrument; return its name."""

    @abstractmethod
    async def _read(self) -> ReadingT:
        """Ask for one reading."""

    async def _shut_down(self) -> None:
        """Leave the instrument in a safe state; its port may be gone."""

    async def readings(self) -> AsyncGenerator[ReadingT]:
        """Yield a reading every period, without end; reconnects when the instrument disappears.

        Iterate within `contextlib.aclosing`, which leaves the instrument in a safe state.
        """
        loop = asyncio.get_running_loop()
        due_s = loop.time()
        with self._link:
            try:
                while True:
                    try:
                        if self._link.port is None:
                            await self._link.open()
                            self._name = await self._set_up()
                        # Late polls are skipped: the phase is kept.
                        now_s = loop.time()
                        if due_s < now_s:
                            due_s += (now_s - due_s) // self.period_s * self.period_s
                        await asyncio.sleep(max(due_s - now_s, 0.0))
                        due_s += self.period_s
                        reading = await self._read()
                    except DriverError as error:
                        await self._handle_error(error)
                        continue
                    self._strikes = 0
                    self._count += 1
                    yield reading
            finally:
                await self._shut_down()

    def diagnostics(self) -> Diagnostics:
        """Return the instrument's values for `health`; counts are since the process began."""
        return {
            **self._link.diagnostics(),
            "instrument": self._name,
            "readings": self._count,
            "errors": dict(self._errors + self._session.lines.errors),
        }

    async def _handle_error(self, error: DriverError) -> None:
        """Ignore a few misunderstood replies as line noise; otherwise reopen the connection."""
        not_understood = isinstance(error, ProtocolError)
        self._errors["not understood" if not_understood else "lost"] += 1
        self._strikes += 1
        if self._name and not_understood and self._strikes < MAX_STRIKES:
            return
        self._strikes, self._name = 0, ""
        self._session.lines.restart()
        await self._link.lost(error)
