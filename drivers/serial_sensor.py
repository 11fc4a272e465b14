"""Sensors on serial lines: raw events, lines, and the loop that reads a board and reconnects to it."""

import contextlib
import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import AsyncGenerator, Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any, Generic, Protocol, TypeVar

from shearloop.drivers.connection import Diagnostics, Link, Port
from shearloop.drivers.errors import DeviceLostError, DriverError
from shearloop.drivers.refused_lines import shown
from shearloop.errors import Hint

# Opening the port resets an Uno; its boot loader waits before it starts the sketch.
BOOT_S = 4.0
# A board that sends no value for this many periods is opened again.
SILENT_PERIODS = 8
# After a timeout, the next wait is twice as long, up to this factor: the board's period can be longer than
# configured. This many values in time end that.
LONGEST_PATIENCE, PROMPT_VALUES = 16, 20
# After this many values without a refused line the last one is history: it stays in the counts.
FORGET_REFUSAL_VALUES = 100
# Values in a row that agree with each other and become the new level.
SETTLE_VALUES = 3

ValueT = TypeVar("ValueT")


class InputKind(Enum):
    """What a source's parser or estimator is given; the value is the name in recordings."""

    # To a parser.
    OPENED = "opened"  # the port was opened, a half-received line is void
    ASKED = "asked"  # an instrument was sent the query in `data`; its reply follows
    WAITED = "waited"  # the next bytes may have waited since the time in `data`: their reader was away
    DATA = "data"  # bytes arrived
    # To a load cell's parser, with the zero, or to an estimator.
    TARE = "tare"  # a new zero was asked for, or found
    # To the estimator alone.
    TOOL = "tool"  # the gripped tool changed
    MOVED = "moved"  # the fingers moved while a frame was acquired
    ADAPT = "adapt"  # the gain was corrected by the torques in `data`
    # To both.
    STATE = "state"  # what both know, in a recording that begins in the middle of a run


@dataclass(frozen=True, slots=True)
class RawEvent:
    """One input of a source at `t_ns` (monotonic), as it is recorded and replayed; `data` depends on the kind."""

    kind: InputKind
    t_ns: int
    data: bytes = b""


class InputRecorder(Protocol):
    """Keeps the inputs of one source, so that a replay can repeat them."""

    @property
    def wants_state(self) -> bool:
        """Whether its events begin in the middle of a run, and it has no state yet."""

    def record(self, event: RawEvent) -> None:
        """Keep the next input; never blocks."""

    def record_state(self, state: Mapping[str, object], fixed: Mapping[str, object], t_ns: int) -> None:
        """Keep the state's objects at t_ns; `fixed` are the parts that follow from the configuration, by name."""


class LineSplitter:
    """Splits a byte stream into lines, however it is sliced. A line that is too long is counted once and dropped whole.

    `too_long` counts lines of more than `max_bytes`, without the newline, since the beginning; `too_long_start` is the
    beginning of the last one.
    """

    def __init__(self, max_bytes: int) -> None:
        self._max_bytes = max_bytes
        self._dropping = False
        self.partial = b""
        self.too_long = 0
        self.too_long_start = b""

    @property
    def dropping(self) -> bool:
        """Whether the line under way is too long."""
        return self._dropping

    def restart(self) -> None:
        """Drop a half-received line: the port was reopened."""
        self.partial = b""
        self._dropping = False

    def feed(self, data: bytes) -> list[bytes | None]:
        """Return the lines that `data` completes, without newlines; None for each line found to be too long."""
        *ends, rest = (self.partial + data).split(b"\n")
        lines: list[bytes | None] = []
        for end in ends:
            if not self._dropping:
                lines.append(end if len(end) <= self._max_bytes else self._drop(end))
            self._dropping = False
        self.partial = b"" if self._dropping else rest
        if len(self.partial) > self._max_bytes:
            lines.append(self._drop(rest))
            self.partial, self._dropping = b"", True
        return lines

    def _drop(self, line: bytes) -> bytes | None:
        self.too_long += 1
        self.too_long_start = line[:60]
        return None


class Parser(ABC, Generic[ValueT]):
    """Turns events into values, and counts the refused lines by their kind, since the beginning. No I/O.

    `refusal` says why the last refused line was refused, and what helps; None without one.
    """

    def __init__(self, max_bytes: int) -> None:
        """Accept lines of at most `max_bytes`."""
        self.errors: Counter[Any] = Counter()
        self.refusal: Hint | None = None
        self._lines = LineSplitter(max_bytes)
        # Without a value in between.
        self._refused_in_a_row = 0
        # Lines that came at once after an opening, since the beginning: they may have waited before it.
        self.dropped_at_opening = 0
        # When the port was opened, until all that waited before has come; and when the last line came since.
        self._opened_ns: int | None = None
        self._before_ns = 0
        # Since when the next bytes may have waited for their reader; None if it was not away.
        self._waited_since_ns: int | None = None

    @property
    def refused(self) -> int:
        """The number of refused lines since the beginning."""
        return self.errors.total()

    @property
    def unfinished(self) -> bytes:
        """The received beginning of the next line."""
        return self._lines.partial

    def handle(self, event: RawEvent) -> list[ValueT]:
        """Process a live or recorded event; return the values that it completes."""
        match event.kind:
            case InputKind.OPENED:
                self._lines.restart()
                self._opened_ns = self._before_ns = event.t_ns
                self._refused_in_a_row, self._waited_since_ns = 0, None
                self.restart()
            case InputKind.WAITED:
                self._waited_since_ns = int(event.data)
            case InputKind.DATA:
                values = self.feed(event.data, event.t_ns)
                self._waited_since_ns = None
                return values
        return []

    @abstractmethod
    def restart(self) -> None:
        """Forget what belongs to the connection before: the port was opened, perhaps in the middle of a line."""

    @abstractmethod
    def feed(self, data: bytes, t_arrival_ns: int) -> list[ValueT]:
        """Return the values that `data` completes, in order; all of it had arrived then."""

    def _split(self, data: bytes, t_arrival_ns: int, period_ns: int) -> list[bytes | None]:
        """Return the lines that `data` completes; all of it had arrived then.

        Lines that may have waited before the opening have no known time and are dropped. They come at once. What comes
        half a period after the opening or the line before is new, and so is everything a period after the opening.
        """
        lines = self._lines.feed(data)
        if self._opened_ns is None or not lines:
            return lines
        arrival_ns = t_arrival_ns if self._waited_since_ns is None else self._waited_since_ns
        first_ns = arrival_ns - (len(lines) - 1) * period_ns
        if first_ns - self._before_ns >= period_ns / 2 or first_ns - self._opened_ns >= period_ns:
            self._opened_ns = None
            return lines
        self._before_ns = arrival_ns
        self.dropped_at_opening += len(lines)
        return []

    def _count_refused(self, kind: Hashable) -> int:
        """Count a refused line; return how many were refused in a row."""
        self.errors[kind] += 1
        self._refused_in_a_row += 1
        return self._refused_in_a_row


class StepFilter(Generic[ValueT]):
    """Separates disturbances from real steps, causally.

    Both jump further than the device can. A few values in a row that agree with each other become the new level.
    """

    def __init__(self) -> None:
        """Trust the first value."""
        self._good: ValueT | None = None
        self._candidates: list[ValueT] = []

    def is_spike(self, value: ValueT, is_reachable: Callable[[ValueT, ValueT], bool]) -> bool:
        """Judge the next value; `is_reachable` compares an earlier value with it."""
        if self._good is not None and not is_reachable(self._good, value):
            if self._candidates and not is_reachable(self._candidates[-1], value):
                self._candidates.clear()
            self._candidates.append(value)
            if len(self._candidates) < SETTLE_VALUES:
                return True
        self._good, self._candidates = value, []
        return False

    def restart_step(self) -> None:
        """Forget the beginning of a step."""
        self._candidates.clear()


class SerialSensor(Generic[ValueT]):
    """One board behind a link, kept connected, with a parser for its bytes.

    A board counts as lost when it is silent, and when it sends only lines that are refused.
    """

    # The operator's checklist when nothing comes.
    silence_hint = ""

    def __init__(
        self,
        link: Link,
        period_s: float,
        parser: Parser[ValueT],
        inputs: InputRecorder | None = None,
        patience: float = 1.0,
    ) -> None:
        """Use the link, not yet open, of a board with a line every `period_s`; `inputs` keeps every parser input.

        `patience` is the factor on the longest silence: above 1 for an emulated board, which a busy computer delays.
        """
        self._link = link
        self._period_s = period_s
        self._parser = parser
        self._inputs = inputs
        self._silence_s = BOOT_S
        self._least_patience = self.patience = patience
        self._prompt_values = 0
        self._value_ns = 0
        self._values_since_refusal = 0

    async def readings(self) -> AsyncGenerator[ValueT]:
        """Yield the values of every line, in order and without end, as `batches` does."""
        async with contextlib.aclosing(self.batches()) as batches:
            async for values in batches:
                for value in values:
                    yield value

    async def batches(self) -> AsyncGenerator[Sequence[ValueT]]:
        """Yield the values that each read completes, in order and without end; reconnects when the board disappears.

        An empty batch means that all bytes so far are processed. It comes before a read if a recording needs the state
        before that read. While the receiver is busy, nothing is lost: the bytes wait in the kernel, then on the board.
        Iterate within `contextlib.aclosing`, which closes the port at the end.
        """
        with self._link:
            while True:
                try:
                    port = self._link.port or await self._open()
                    received = await port.read(self._silence_s)
                    if received is None:
                        self.patience = min(2 * self.patience, LONGEST_PATIENCE)
                        raise DeviceLostError(
                            f"{port.path} is open but has sent nothing for {self._silence_s:.1f} s; {self.silence_hint}"
                        )
                    if self._inputs is not None and self._inputs.wants_state:
                        yield ()
                    if received.waited_since_ns is not None:
                        since = str(received.waited_since_ns).encode()
                        self._dispatch(InputKind.WAITED, received.t_arrival_ns, since)
                    values = self._dispatch(InputKind.DATA, received.t_arrival_ns, received.data)
                    self._check_use(port, received.t_arrival_ns, useful=bool(values))
                except DriverError as error:
                    await self._link.lost(error)
                    continue
                self._silence_s = self.patience * self.longest_silence_s
                yield values

    @property
    def inputs(self) -> InputRecorder | None:
        """The recorder of its inputs, where there is one."""
        return self._inputs

    @property
    def parser(self) -> Parser[ValueT]:
        """What turns its bytes into values."""
        return self._parser

    def diagnostics(self) -> Diagnostics:
        """Return the board's values for `health`; counts are since the process began."""
        refusal = self._parser.refusal if self._values_since_refusal < FORGET_REFUSAL_VALUES else None
        return {
            **self._link.diagnostics(),
            "dropped_at_opening": self._parser.dropped_at_opening,
            "last_refusal": "" if refusal is None else refusal.clause,
        }

    def _check_use(self, port: Port, now_ns: int, *, useful: bool) -> None:
        """Raise DeviceLostError if no value has come for long although bytes come."""
        waited_s = (now_ns - self._value_ns) / 1e9
        if not useful:
            if waited_s > max(BOOT_S, self._silence_s):
                unended = Hint(f"no line end in {shown(self._parser.unfinished)}", "see its program")
                why = self._parser.refusal or unended
                raise DeviceLostError(f"{port.path} has sent nothing of use for {waited_s:.1f} s: {why.clause}")
            return
        self._value_ns = now_ns
        self._prompt_values = self._prompt_values + 1 if waited_s < 0.5 * self.longest_silence_s else 0
        if self._prompt_values >= PROMPT_VALUES:
            self.patience = self._least_patience

    def _dispatch(self, kind: InputKind, t_ns: int, data: bytes = b"") -> Sequence[ValueT]:
        event = RawEvent(kind, t_ns, data)
        if self._inputs is not None:
            self._inputs.record(event)
        before = self._parser.refused
        values = self._parser.handle(event)
        self._values_since_refusal += len(values)
        if self._parser.refused > before and self._parser.refusal is not None:
            self._values_since_refusal = 0
            self._link.monitor.refused(self._parser.refusal.clause)
        return values

    async def _open(self) -> Port:
        port = await self._link.open()
        self._value_ns = time.monotonic_ns()
        self._dispatch(InputKind.OPENED, self._value_ns)
        self._silence_s = max(BOOT_S, self.patience * self.longest_silence_s)
        await self._on_open(port)
        return port

    @property
    def longest_silence_s(self) -> float:
        """The silence after which the board counts as lost."""
        return SILENT_PERIODS * self._period_s

    async def _on_open(self, port: Port) -> None:
        """Set up a board after its port was opened."""
