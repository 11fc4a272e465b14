"""Talking SCPI to a bench instrument: one question at a time, over a serial port or a socket."""

import re
from collections import Counter
from dataclasses import dataclass
from time import monotonic_ns

from shearloop.drivers.errors import DeviceLostError, DeviceSilentError, ProtocolError
from shearloop.drivers.line_splitter import LineSplitter
from shearloop.drivers.raw_event import InputKind, RawEvent, Tap, no_tap
from shearloop.drivers.serial_port import Link, Port

# A reading of five elements is 70 characters long; what is longer without an end is no reply.
LONGEST_REPLY = 512
# Replies to questions asked before the port was opened, read past before the answer to *IDN? comes.
MOST_STALE_REPLIES = 8
# A reading takes some tenths of a second at the most.
REPLY_DEADLINE_S = 2.0
# What stands for an overload, and for a quantity that is not measured (SCPI-1999, 7.2.1.4 and 7.2.1.5).
OVERLOAD, NOT_A_NUMBER = 9.9e37, 9.91e37
_NUMBER = re.compile(r" *[+-]?[0-9]{1,12}(\.[0-9]{0,12})?([Ee][+-]?[0-9]{1,2})? *")


class ReplyLines:
    """Cuts bytes, in whatever slices they come, into replies: instruments end them with CR, LF or both. No I/O."""

    def __init__(self) -> None:
        self._lines = LineSplitter(LONGEST_REPLY)
        self._refused: Counter[str] = Counter()
        self.unasked = 0

    @property
    def refused(self) -> Counter[str]:
        """What was not taken for a reply, by kind."""
        counts = {"too long": self._lines.too_long, "unfinished": self._lines.unfinished, "unasked": self.unasked}
        return self._refused + Counter(counts)

    @property
    def begun(self) -> bool:
        """Whether a reply has begun to come and not ended."""
        return self._lines.begun

    def restart(self) -> None:
        """Forget what was half received."""
        self._lines.restart()

    def feed(self, data: bytes) -> list[str]:
        """Return the replies that `data` completes, without their ends; empty lines are none."""
        replies = []
        for line in self._lines.feed(data.replace(b"\r", b"\n")):
            if line is None:
                continue
            if not line.isascii():
                self._refused["not ASCII"] += 1
            elif text := line.decode().strip():
                replies.append(text)
        return replies


@dataclass(frozen=True, slots=True)
class Reply:
    """What an instrument answered, when it was asked and when the answer was there (monotonic, ns)."""

    text: str
    t_asked_ns: int
    t_arrival_ns: int


class RecordedAnswers:
    """Pairs the questions and answers of a recording again. No I/O."""

    def __init__(self) -> None:
        """Know of no question."""
        self._query, self._asked_ns = "", 0

    def take(self, told: RawEvent) -> tuple[str, Reply] | None:
        """Return the question and its reply, once it is there."""
        if told.kind is InputKind.ASKED:
            self._query, self._asked_ns = told.data.decode("latin-1"), told.t_ns
        elif told.kind is InputKind.DATA and self._query:
            query, self._query = self._query, ""
            return query, Reply(told.data.decode("latin-1"), self._asked_ns, told.t_ns)
        return None


def numbers(text: str, count: int, what: str) -> list[float]:
    """Return the comma-separated numbers of a reply; ProtocolError when it has not exactly so many."""
    parts = text.split(",")
    if len(parts) != count or not all(map(_NUMBER.fullmatch, parts)):
        raise ProtocolError(f"{what} sent {text[:60]!r}, which is not {count} numbers; check the baud rate.")
    return [float(part) for part in parts]


class ScpiSession:
    """Questions and commands over a link that may break; after a failure the link is to be closed by `lost`."""

    def __init__(self, link: Link, what: str, deadline_s: float = REPLY_DEADLINE_S, tap: Tap = no_tap) -> None:
        """Take the link, and what the instrument is called in sentences; `tap` hears questions and their answers."""
        self._tap = tap
        self._link = link
        self._what = what
        self._deadline_s = deadline_s
        self.lines = ReplyLines()
        self._waiting: list[tuple[str, int]] = []

    async def identified(self, *models: str) -> str:
        """Return the reply to *IDN?, read past what was said before; ProtocolError unless it names one of the models.

        Without `models` every instrument will do.
        """
        self.lines.restart()
        self._waiting.clear()
        name = (await self.ask("*IDN?")).text
        for _ in range(MOST_STALE_REPLIES):
            # A name has four fields, of which the first is no number.
            if name.count(",") >= 3 and not name.lstrip("+-")[:1].isdigit():
                break
            name = (await self._next(0, "*IDN?")).text
        if models and not any(model in name for model in models):
            raise ProtocolError(
                f"{self._what} says it is {name!r}, and not {' or '.join(models)}; see which instrument is there."
            )
        return name

    async def tell(self, *commands: str) -> None:
        """Send commands; what an instrument thinks of them is told by `check`."""
        for command in commands:
            await self._port.write(f"{command}\n".encode())

    async def ask(self, query: str) -> Reply:
        """Return the answer to a query; DeviceSilentError when none comes, DeviceLostError when the port has gone."""
        # What comes without having been asked for must not be taken for the answer.
        self.lines.unasked += len(self._waiting)
        self._waiting.clear()
        asked_ns = monotonic_ns()
        await self.tell(query)
        reply = await self._next(asked_ns, query)
        # Both together: a question without an answer says nothing.
        self._tap(RawEvent(InputKind.ASKED, asked_ns, query.encode()))
        self._tap(RawEvent(InputKind.DATA, reply.t_arrival_ns, reply.text.encode()))
        return reply

    async def ask_until(self, query: str, answer: str, deadline_s: float) -> None:
        """Read past replies to older questions until a query is answered so, DeviceSilentError when it never is."""
        await self.tell(query)
        deadline_ns = monotonic_ns() + int(deadline_s * 1e9)
        while (await self._next(0, query, deadline_ns)).text != answer:
            pass

    async def check(self) -> None:
        """Raise ProtocolError when the instrument refused something that it was told."""
        reply = (await self.ask(":SYST:ERR?")).text
        code = reply.split(",")[0]
        try:
            refused = int(code) != 0
        except ValueError:
            refused = True
        if refused:
            raise ProtocolError(
                f"{self._what} refused its settings: {reply}; see whether it is the model that is meant."
            )

    @property
    def _port(self) -> Port:
        if self._link.port is None:
            raise DeviceLostError(f"There is no connection to {self._what} at present.")
        return self._link.port

    async def _next(self, asked_ns: int, query: str, deadline_ns: int | None = None) -> Reply:
        begin_ns = monotonic_ns()
        if deadline_ns is None:
            deadline_ns = begin_ns + int(self._deadline_s * 1e9)
        while not self._waiting:
            left_s = (deadline_ns - monotonic_ns()) / 1e9
            try:
                received = await self._port.read(left_s) if left_s > 0 else None
            except DeviceLostError as error:
                if not self.lines.begun:
                    raise
                raise DeviceLostError(
                    f"{self._what} broke off in the middle of its answer to {query!r}: {error}"
                ) from error
            if received is None:
                waited_s = (deadline_ns - begin_ns) / 1e9
                raise DeviceSilentError(
                    f"{self._what} at {self._port.path} has not answered {query!r} within {waited_s:.2g} s; "
                    "see that it is on, and that baud rate and line end are as configured."
                )
            self._waiting += [(text, received.t_arrival_ns) for text in self.lines.feed(received.data)]
        text, arrival_ns = self._waiting.pop(0)
        return Reply(text, asked_ns, arrival_ns)
