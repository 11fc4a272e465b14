"""The skin's instruments: a Keithley 6430 feeds the gauges; a scanner or a converter board reads their voltages.

SCPI instruments get one query at a time over a serial port or socket, at a steady rate, and are reconnected.
"""

import asyncio
import re
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import AsyncGenerator, Sequence
from contextlib import aclosing
from dataclasses import KW_ONLY, dataclass, field
from functools import partial
from time import monotonic_ns
from typing import ClassVar, Generic, TypeAlias, TypeVar

from shearloop.drivers.connection import Diagnostics, Link, Port
from shearloop.drivers.defaults import (
    ADC_FULL_SCALE_V,
    DAQ_RATE_HZ,
    SCANNER_CHANNELS,
    SCANNER_RANGE_V,
    SOURCE_COMPLIANCE_V,
    SOURCE_CURRENT_MA,
)
from shearloop.drivers.errors import DeviceLostError, DeviceSilentError, DriverError, ProtocolError
from shearloop.drivers.line_parser import LineParser, TimedLine
from shearloop.drivers.refused_lines import shown
from shearloop.drivers.serial_sensor import InputKind, InputRecorder, LineSplitter, RawEvent, SerialSensor
from shearloop.timeouts import timeout

# A reading of five elements is 70 characters long.
MAX_REPLY_BYTES = 512
REPLY_TIMEOUT_S = 2.0
# The values of an overload and of an unmeasured quantity (SCPI-1999, 7.2.1.4 and 7.2.1.5).
OVERLOAD, NOT_A_NUMBER = 9.9e37, 9.91e37
_NUMBER = re.compile(r" *[+-]?[0-9]{1,12}(\.[0-9]{0,12})?([Ee][+-]?[0-9]{1,2})? *")

# The current source. Commands and status word: manual 6430-901-01, section 17; the 2400 series understands them too.
MODELS = ("MODEL 6430", "MODEL 24")
CURRENT_A = SOURCE_CURRENT_MA * 1e-3
SOURCE_PERIOD_S = 0.5
# Stopping the daemon waits this long for a reading in progress and its reply.
SWITCH_OFF_S = 1.0
OUTPUT, READ = ":OUTP?", ":READ?"
# Bits of the status word (manual, page 17-47).
_OVERFLOW, _COMPLIANCE, _OVERVOLTAGE, _RANGE_COMPLIANCE = 1 << 0, 1 << 3, 1 << 4, 1 << 16

# The voltages.
SCAN = "READ?"
ADC_BAUD = 115200
# "-0.123456,-0.123456" has 19 characters.
MAX_PAIR_BYTES = 40
# Values above this fraction of the range are at its end.
_END_OF_RANGE = 0.9995
_PAIR = re.compile(rb"[+-]?[0-9]{1,3}\.[0-9]{1,9}, ?[+-]?[0-9]{1,3}\.[0-9]{1,9}")

ReadingT = TypeVar("ReadingT")


def split_replies(lines: LineSplitter, data: bytes) -> list[str]:
    """Return the replies that `data` completes; they end with CR, LF or both, and empty lines are ignored."""
    ended = lines.feed(data.replace(b"\r", b"\n"))
    texts = [line.decode("ascii", "replace").strip() for line in ended if line is not None]
    return [text for text in texts if text]


@dataclass(frozen=True, slots=True)
class Reply:
    """An instrument's answer, and the times of query and answer (monotonic, ns)."""

    text: str
    t_asked_ns: int
    t_arrival_ns: int


def parse_numbers(text: str, count: int, instrument: str) -> list[float]:
    """Return the comma-separated numbers of a reply; ProtocolError unless there are exactly `count`."""
    parts = text.split(",")
    if len(parts) != count or not all(map(_NUMBER.fullmatch, parts)):
        raise ProtocolError(f"{instrument} sent {text[:60]!r}, which is not {count} numbers; check the baud rate.")
    return [float(part) for part in parts]


@dataclass(eq=False)
class PolledInstrument(ABC, Generic[ReadingT]):
    """One SCPI instrument behind a link: set up once, then asked at a steady rate, and reconnected when lost.

    The link is not yet open; `inputs` keeps queries and their replies.
    """

    link: Link
    _: KW_ONLY
    period_s: float
    timeout_s: float = REPLY_TIMEOUT_S
    inputs: InputRecorder | None = None
    # Its name in messages.
    instrument: ClassVar[str] = ""
    # Parts of the names that it may give itself; empty for any.
    models: ClassVar[tuple[str, ...]] = ()
    _lines: LineSplitter = field(default_factory=partial(LineSplitter, MAX_REPLY_BYTES), init=False)
    _count: int = field(default=0, init=False)
    _errors: Counter[str] = field(default_factory=Counter, init=False)
    _name: str = field(default="", init=False)

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
        with self.link:
            try:
                while True:
                    try:
                        if self.link.port is None:
                            await self.link.open()
                            self._name = await self._set_up()
                        # Late polls are skipped: the phase is kept.
                        now_s = loop.time()
                        if due_s < now_s:
                            due_s += (now_s - due_s) // self.period_s * self.period_s
                        await asyncio.sleep(max(due_s - now_s, 0.0))
                        due_s += self.period_s
                        reading = await self._read()
                    except DriverError as error:
                        self._errors["not understood" if isinstance(error, ProtocolError) else "lost"] += 1
                        self._name = ""
                        await self.link.lost(error)
                        continue
                    self._count += 1
                    yield reading
            finally:
                await self._shut_down()

    async def batches(self) -> AsyncGenerator[Sequence[ReadingT]]:
        """Yield each reading as a separate batch; a board yields the readings of one read as a batch."""
        async with aclosing(self.readings()) as readings:
            async for reading in readings:
                yield (reading,)

    def diagnostics(self) -> Diagnostics:
        """Return the instrument's values for `health`; counts are since the process began."""
        return {
            **self.link.diagnostics(),
            "instrument": self._name,
            "readings": self._count,
            "errors": dict(self._errors + Counter({"too long": self._lines.too_long})),
        }

    async def ask_name(self) -> str:
        """Open the connection once and return the instrument's name, without any setting; DriverError if it fails."""
        with self.link:
            await self.link.open_once()
            return await self._identify()

    async def _identify(self) -> str:
        """Return the reply to *IDN?; ProtocolError unless it names one of the models."""
        name = (await self.ask("*IDN?")).text
        if self.models and not any(model in name for model in self.models):
            models = " or ".join(self.models)
            raise ProtocolError(
                f"{self.instrument} says it is {name!r}, and not {models}; see which instrument is there."
            )
        return name

    async def _send(self, *commands: str) -> None:
        """Send commands; `check` reports errors."""
        for command in commands:
            await self._port.write(f"{command}\n".encode())

    async def ask(self, query: str) -> Reply:
        """Return the answer to a query; DeviceSilentError if none comes, DeviceLostError if the port is gone."""
        self._lines.restart()
        asked_ns = arrival_ns = monotonic_ns()
        until_ns = asked_ns + int(self.timeout_s * 1e9)
        await self._send(query)
        replies: list[str] = []
        while not replies:
            left_s = (until_ns - monotonic_ns()) / 1e9
            received = await self._port.read(left_s) if left_s > 0 else None
            if received is None:
                raise DeviceSilentError(self._no_answer(query))
            replies, arrival_ns = split_replies(self._lines, received.data), received.t_arrival_ns
        reply = Reply(replies[0], asked_ns, arrival_ns)
        if self.inputs is not None:
            self.inputs.record(RawEvent(InputKind.ASKED, asked_ns, query.encode()))
            self.inputs.record(RawEvent(InputKind.DATA, reply.t_arrival_ns, reply.text.encode()))
        return reply

    def _no_answer(self, query: str) -> str:
        where = f"{self.instrument} at {self._port.path}"
        if came := self._lines.partial or (self._lines.too_long_start if self._lines.dropping else b""):
            return (
                f"{where} answered {query!r} with {shown(came)} and no line end within {self.timeout_s:.2g} s; see "
                "that baud rate and line end are as configured, and that it is this instrument."
            )
        return (
            f"{where} has not answered {query!r} within {self.timeout_s:.2g} s; see that it is on, and that baud rate "
            "and line end are as configured."
        )

    async def _check(self) -> None:
        """Raise ProtocolError if the instrument rejected a command."""
        reply = (await self.ask(":SYST:ERR?")).text
        if not re.match(r"[+-]?0+(,|$)", reply):
            raise ProtocolError(
                f"{self.instrument} refused its settings: {reply}; see whether it is the model that is meant."
            )

    @property
    def _port(self) -> Port:
        if self.link.port is None:
            raise DeviceLostError(f"There is no connection to {self.instrument} at present.")
        return self.link.port


@dataclass(frozen=True, slots=True)
class SourceReading:
    """The source's state at t_ns (monotonic); voltage and current are nan while its output is off.

    Both are measured: a source in compliance does not deliver the current that was set.
    """

    t_ns: int
    output_on: bool
    voltage_v: float = float("nan")
    current_a: float = float("nan")
    compliance: bool = False


def read_elements(reply: Reply) -> SourceReading:
    """Return the reading in a reply to READ with the elements VOLT, CURR, STAT; ProtocolError for a bad reply."""
    voltage_v, current_a, status = parse_numbers(reply.text, 3, "The current source")
    if not 0 <= status < 1 << 24 or max(abs(voltage_v), abs(current_a)) >= NOT_A_NUMBER:
        raise ProtocolError(f"The current source sent {reply.text[:60]!r}, which is not a reading; was it set by hand?")
    bad = _OVERFLOW | _COMPLIANCE | _OVERVOLTAGE | _RANGE_COMPLIANCE
    return SourceReading(reply.t_arrival_ns, True, voltage_v, current_a, compliance=bool(int(status) & bad))


def read_output(reply: Reply) -> SourceReading | None:
    """Return a reading if a reply to OUTPUT says off, None if on; ProtocolError for a bad reply."""
    if reply.text not in ("0", "1"):
        raise ProtocolError(f"The current source sent {reply.text[:60]!r} instead of 0 or 1.")
    return SourceReading(reply.t_arrival_ns, output_on=False) if reply.text == "0" else None


@dataclass(eq=False, kw_only=True)
class Keithley6430(PolledInstrument[SourceReading]):
    """The current source: set up, switched on, read until the iteration ends, then switched off."""

    instrument = "The current source"
    models = MODELS
    period_s: float = SOURCE_PERIOD_S
    current_a: float = CURRENT_A
    compliance_v: float = SOURCE_COMPLIANCE_V
    _was_reset: bool = field(default=False, init=False)
    _may_be_on: bool = field(default=False, init=False)

    async def _set_up(self) -> str:
        name = await self._identify()
        if not self._was_reset:
            await self._send("*RST")
        self._may_be_on = True
        # After a reconnection without the reset, which would interrupt the current.
        await self._send(
            "*CLS",
            ":SOUR:FUNC CURR",
            ":SOUR:CURR:MODE FIX",
            f":SOUR:CURR:RANG {self.current_a:.6E}",
            ":SENS:FUNC:CONC ON",
            ":SENS:FUNC 'VOLT','CURR'",
            f":SENS:VOLT:PROT {self.compliance_v:.6E}",
            f":SENS:VOLT:RANG {self.compliance_v:.6E}",
            ":SENS:VOLT:NPLC 1",
            ":FORM:ELEM VOLT,CURR,STAT",
            f":SOUR:CURR {self.current_a:.6E}",
            ":OUTP ON",
        )
        await self._check()
        self._was_reset = True
        return name

    async def _read(self) -> SourceReading:
        off = read_output(await self.ask(OUTPUT))
        if off is not None:
            return off
        try:
            reply = await self.ask(READ)
        except DeviceSilentError:
            # The operator may have switched the output off in between: then READ has no reply. Reopening the
            # connection would switch it on again.
            off = read_output(await self.ask(OUTPUT))
            if off is None:
                raise
            return off
        return read_elements(reply)

    async def _shut_down(self) -> None:
        """Switch the output off and wait for the confirmation."""
        if not self._may_be_on:
            return
        try:
            # Twice: an interrupted command may have left its beginning on the line.
            await self._send(":OUTP OFF", ":OUTP OFF")
            async with timeout(SWITCH_OFF_S):
                # The first answer can belong to a reading in progress.
                while (await self.ask(OUTPUT)).text != "0":
                    pass
            self._may_be_on = False
        except (DriverError, TimeoutError) as error:
            self._errors["not switched off"] += 1
            self.link.give_up(
                DeviceLostError(
                    "The current source has not confirmed that its output is off; press its OUTPUT key, "
                    f"or the current flows on through the gauges. {error}".rstrip()
                )
            )


@dataclass(frozen=True, slots=True)
class Voltages:
    """The voltages of gauge 1 and gauge 2, and whether each exceeds the instrument's range.

    `t_mid_ns` is the middle of the conversions, `t_arrival_ns` the arrival of the numbers (both monotonic). `missed`: a
    board's lines that are found missing by these. `t_asked_ns`: when a scanner was asked for them; None for a board.
    """

    v1_v: float
    v2_v: float
    t_mid_ns: int
    t_arrival_ns: int
    over_1: bool = False
    over_2: bool = False
    missed: int = 0
    t_asked_ns: int | None = None


def read_scan(reply: Reply) -> Voltages:
    """Return the voltages in a reply to SCAN, stamped between query and answer; ProtocolError for a bad reply."""
    v1_v, v2_v = parse_numbers(reply.text, 2, "The scanner")
    return Voltages(
        v1_v,
        v2_v,
        t_mid_ns=(reply.t_asked_ns + reply.t_arrival_ns) // 2,
        t_arrival_ns=reply.t_arrival_ns,
        over_1=abs(v1_v) >= OVERLOAD,
        over_2=abs(v2_v) >= OVERLOAD,
        t_asked_ns=reply.t_asked_ns,
    )


class PollClock:
    """Counts the polls that were skipped. `PolledInstrument.readings` keeps the phase, and asks late but never early.

    No I/O.
    """

    def __init__(self, period_s: float) -> None:
        """Expect a poll every `period_s`."""
        self._period_ns = period_s * 1e9
        self._number = 0
        # When the poll of number 0 was due, by the earliest poll in its period; None before the first.
        self._due_ns: float | None = None

    def skipped(self, asked_ns: int) -> int:
        """Return how many polls were skipped before the one that asked then."""
        if self._due_ns is None:
            self._due_ns = float(asked_ns)
            return 0
        skipped = max(int((asked_ns - self._due_ns) // self._period_ns) - self._number - 1, 0)
        self._number += 1 + skipped
        self._due_ns = min(self._due_ns, asked_ns - self._number * self._period_ns)
        return skipped


@dataclass(eq=False, kw_only=True)
class ScpiScanner(PolledInstrument[Voltages]):
    """A scanning multimeter on a socket (Keysight 34970A/34972A/DAQ970A and compatible): two channels a scan."""

    instrument = "The scanner"
    channels: tuple[int, int] = SCANNER_CHANNELS
    period_s: float = 1.0 / DAQ_RATE_HZ
    range_v: float = SCANNER_RANGE_V

    async def _set_up(self) -> str:
        name = await self._identify()
        channels = f"(@{self.channels[0]},{self.channels[1]})"
        await self._send(
            "*CLS",
            f"CONF:VOLT:DC {self.range_v:g},{channels}",
            # One mains period removes its hum.
            f"VOLT:DC:NPLC 1,{channels}",
            f"ROUT:SCAN {channels}",
        )
        await self._check()
        return name

    async def _read(self) -> Voltages:
        return read_scan(await self.ask(SCAN))


class PairParser(LineParser[Voltages]):
    """Turns a converter board's bytes into voltages."""

    board = "skin's converter board"

    def __init__(self, rate_hz: float = DAQ_RATE_HZ, full_scale_v: float = ADC_FULL_SCALE_V) -> None:
        super().__init__(_PAIR, MAX_PAIR_BYTES, ADC_BAUD, rate_hz)
        self._end_v = _END_OF_RANGE * full_scale_v

    def _value(self, line: TimedLine) -> Voltages | None:
        if line.partial:
            # The rest of a number may look like a number.
            return None
        v1_v, v2_v = map(float, line.text.split(b","))
        over_1, over_2 = abs(v1_v) >= self._end_v, abs(v2_v) >= self._end_v
        return Voltages(v1_v, v2_v, line.t_mid_ns, line.t_arrival_ns, over_1, over_2, line.missed)


class AdcBoard(SerialSensor[Voltages]):
    """A cheap converter board on a serial port: sends a line `v1,v2` in volts for each pair of conversions."""

    silence_hint = "check that it is the skin's converter board and that it has power."

    def __init__(
        self,
        link: Link,
        rate_hz: float = DAQ_RATE_HZ,
        full_scale_v: float = ADC_FULL_SCALE_V,
        inputs: InputRecorder | None = None,
    ) -> None:
        self.period_s = 1.0 / rate_hz
        self._pair_parser = PairParser(rate_hz, full_scale_v)
        super().__init__(link, self.period_s, self._pair_parser, inputs)

    def diagnostics(self) -> Diagnostics:
        """Return the board's values for `health`; counts are since the process began."""
        return {**super().diagnostics(), "lines": self._pair_parser.count, "errors": dict(self._pair_parser.errors)}


Daq: TypeAlias = ScpiScanner | AdcBoard
