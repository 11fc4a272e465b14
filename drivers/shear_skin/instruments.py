"""The skin's instruments: a Keithley 6430 feeds the gauges; a scanner or a converter board reads their voltages."""

import re
from collections import Counter
from dataclasses import dataclass
from typing import TypeAlias

from shearloop.drivers import serial_sensor
from shearloop.drivers.connection import Diagnostics, Link
from shearloop.drivers.errors import DeviceLostError, DeviceSilentError, DriverError, ProtocolError
from shearloop.drivers.load_cell import describe_errors
from shearloop.drivers.shear_skin import scpi

# The current source. Commands and status word: manual 6430-901-01, section 17; the 2400 series understands them too.
MODELS = ("MODEL 6430", "MODEL 24")
# The factory setting of the RS-232 interface.
SOURCE_BAUD = 9600
CURRENT_A = 5e-3
# Twice two gauges of 25 Ω and their leads; harmless for people and gauges.
COMPLIANCE_V = 1.0
SOURCE_PERIOD_S = 0.5
# Stopping the daemon waits this long for a reading in progress and its reply.
SWITCH_OFF_S = 1.0
OUTPUT, READ = ":OUTP?", ":READ?"
# Bits of the status word (manual, page 17-47).
_OVERFLOW, _COMPLIANCE, _OVERVOLTAGE, _RANGE_COMPLIANCE = 1 << 0, 1 << 3, 1 << 4, 1 << 16

# The voltages.
DAQ_RATE_HZ = 10.0
SCAN = "READ?"
SCANNER_CHANNELS = (101, 102)
# The range above 5 mA × 25 Ω; its overrange covers the source's compliance.
SCANNER_RANGE_V = 1.0
ADC_BAUD = 115200
# "-0.123456,-0.123456" has 19 characters.
MAX_PAIR_BYTES = 40
# The range of an ADS1220 at gain 4 with its own reference.
ADC_FULL_SCALE_V = 0.512
# Values above this share of the range are at its end.
_END_OF_RANGE = 0.9995
_PAIR = re.compile(rb"([+-]?[0-9]{1,3}\.[0-9]{1,9}), ?([+-]?[0-9]{1,3}\.[0-9]{1,9})")
_PAIR_ERRORS = {
    "not two decimals": "The converter board sent a line that is not two decimals; check the baud rate and the sketch.",
    "too long": f"The converter board sent more than {MAX_PAIR_BYTES} bytes without a line end; check the baud rate.",
    "empty": "The converter board sent an empty line; bytes were lost, check the cable.",
    "unfinished": "The converter board broke off in the middle of a line; check its plug and its power.",
}


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


def read_elements(reply: scpi.Reply) -> SourceReading:
    """Return the reading in a reply to READ with the elements VOLT, CURR, STAT; ProtocolError for a bad reply."""
    voltage_v, current_a, status = scpi.parse_numbers(reply.text, 3, "The current source")
    if not 0 <= status < 1 << 24 or max(abs(voltage_v), abs(current_a)) >= scpi.NOT_A_NUMBER:
        raise ProtocolError(f"The current source sent {reply.text[:60]!r}, which is not a reading; was it set by hand?")
    bad = _OVERFLOW | _COMPLIANCE | _OVERVOLTAGE | _RANGE_COMPLIANCE
    return SourceReading(reply.t_arrival_ns, True, voltage_v, current_a, compliance=bool(int(status) & bad))


def read_output(reply: scpi.Reply) -> SourceReading | None:
    """Return a reading if a reply to OUTPUT says off, None if on; ProtocolError for a bad reply."""
    if reply.text not in ("0", "1"):
        raise ProtocolError(f"The current source sent {reply.text[:60]!r} instead of 0 or 1.")
    return SourceReading(reply.t_arrival_ns, output_on=False) if reply.text == "0" else None


def recorded_source() -> scpi.RecordedInstrument[SourceReading]:
    """Return a parser for the recorded replies of a source."""
    return scpi.RecordedInstrument({OUTPUT: read_output, READ: read_elements})


class Keithley6430(scpi.PolledInstrument[SourceReading]):
    """The current source: set up, switched on, read until the iteration ends, then switched off."""

    def __init__(
        self,
        link: Link,
        current_a: float = CURRENT_A,
        compliance_v: float = COMPLIANCE_V,
        period_s: float = SOURCE_PERIOD_S,
        timeout_s: float = scpi.REPLY_TIMEOUT_S,
        inputs: serial_sensor.InputRecorder | None = None,
    ) -> None:
        super().__init__(link, "The current source", period_s, timeout_s, inputs)
        self.current_a = current_a
        self.compliance_v = compliance_v
        self._was_reset = False
        self._may_be_on = False

    async def _set_up(self) -> str:
        name = await self._session.identify(*MODELS)
        if not self._was_reset:
            await self._session.send("*RST")
        self._may_be_on = True
        # After a reconnection without the reset, which would interrupt the current.
        await self._session.send(
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
        await self._session.check()
        self._was_reset = True
        return name

    async def _read(self) -> SourceReading:
        off = read_output(await self._session.ask(OUTPUT))
        if off is not None:
            return off
        try:
            reply = await self._session.ask(READ)
        except DeviceSilentError:
            # The operator may have switched the output off in between: then READ has no reply. Reopening the
            # connection would switch it on again.
            off = read_output(await self._session.ask(OUTPUT))
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
            await self._session.send(":OUTP OFF", ":OUTP OFF")
            await self._session.ask_until(OUTPUT, "0", SWITCH_OFF_S)
            self._may_be_on = False
        except DriverError as error:
            self._errors["not switched off"] += 1
            self._link.give_up(
                DeviceLostError(
                    "The current source has not confirmed that its output is off; press its OUTPUT key, "
                    f"or the current flows on through the gauges. {error}"
                )
            )


@dataclass(frozen=True, slots=True)
class Voltages:
    """The voltages of gauge 1 and gauge 2, and whether each exceeds the instrument's range.

    `t_mid_ns` is the middle of the conversions, `t_arrival_ns` the arrival of the numbers (both monotonic).
    """

    v1_v: float
    v2_v: float
    t_mid_ns: int
    t_arrival_ns: int
    over_1: bool = False
    over_2: bool = False


def read_scan(reply: scpi.Reply) -> Voltages:
    """Return the voltages in a reply to SCAN, stamped between query and answer; ProtocolError for a bad reply."""
    v1_v, v2_v = scpi.parse_numbers(reply.text, 2, "The scanner")
    return Voltages(
        v1_v,
        v2_v,
        t_mid_ns=(reply.t_asked_ns + reply.t_arrival_ns) // 2,
        t_arrival_ns=reply.t_arrival_ns,
        over_1=abs(v1_v) >= scpi.OVERLOAD,
        over_2=abs(v2_v) >= scpi.OVERLOAD,
    )


class ScpiScanner(scpi.PolledInstrument[Voltages]):
    """A scanning multimeter on a socket (Keysight 34970A/34972A/DAQ970A and compatible): two channels a scan."""

    def __init__(
        self,
        link: Link,
        channels: tuple[int, int] = SCANNER_CHANNELS,
        rate_hz: float = DAQ_RATE_HZ,
        range_v: float = SCANNER_RANGE_V,
        timeout_s: float = scpi.REPLY_TIMEOUT_S,
        inputs: serial_sensor.InputRecorder | None = None,
    ) -> None:
        super().__init__(link, "The scanner", 1.0 / rate_hz, timeout_s, inputs)
        self._channels = f"(@{channels[0]},{channels[1]})"
        self._range_v = range_v

    async def _set_up(self) -> str:
        name = await self._session.identify()
        await self._session.send(
            "*CLS",
            f"CONF:VOLT:DC {self._range_v:g},{self._channels}",
            # One mains period removes its hum.
            f"VOLT:DC:NPLC 1,{self._channels}",
            f"ROUT:SCAN {self._channels}",
        )
        await self._session.check()
        return name

    async def _read(self) -> Voltages:
        return read_scan(await self._session.ask(SCAN))


def recorded_scanner() -> scpi.RecordedInstrument[Voltages]:
    """Return a parser for the recorded replies of a scanner."""
    return scpi.RecordedInstrument({SCAN: read_scan})


class PairParser:
    """Turns a converter board's bytes, however they are sliced, into voltages; counts rejected lines by kind. No I/O.

    `partial_lines` may have been under way when the port was opened; they are not errors.
    """

    def __init__(self, rate_hz: float = DAQ_RATE_HZ, full_scale_v: float = ADC_FULL_SCALE_V) -> None:
        self._lines = serial_sensor.LineSplitter(MAX_PAIR_BYTES)
        self._errors: Counter[str] = Counter()
        self.partial_lines = 0
        self._period_ns = round(1e9 / rate_hz)
        self._end_v = _END_OF_RANGE * full_scale_v
        self._last_mid_ns: int | None = None
        self._first = True

    @property
    def errors(self) -> Counter[str]:
        """The number of rejected lines, by kind."""
        return self._errors + Counter({"too long": self._lines.too_long, "unfinished": self._lines.unfinished})

    def restart(self) -> None:
        """Drop a half-received line: the port was opened, perhaps in the middle of one."""
        self._lines.restart()
        self._first = True

    def handle(self, event: serial_sensor.RawEvent) -> list[Voltages]:
        """Process a live or recorded event; return the voltages that it completes."""
        if event.kind is serial_sensor.InputKind.OPENED:
            self.restart()
        elif event.kind is serial_sensor.InputKind.DATA:
            return self.feed(event.data, event.t_ns)
        return []

    def feed(self, data: bytes, t_arrival_ns: int) -> list[Voltages]:
        """Return the voltages that `data` completes; of several lines each is a period older than the next.

        The first line after opening is dropped: the rest of a number may look like a number.
        """
        lines = self._lines.feed(data)
        found = []
        for age, line in zip(range(len(lines) - 1, -1, -1), lines, strict=True):
            first, self._first = self._first, False
            if first:
                self.partial_lines += 1
            elif line is not None:
                text = line.strip(b"\r")
                if match := _PAIR.fullmatch(text):
                    sent_ns = t_arrival_ns - age * self._period_ns - serial_sensor.transfer_ns(len(line) + 1, ADC_BAUD)
                    found.append(self._voltages(float(match[1]), float(match[2]), sent_ns, t_arrival_ns))
                else:
                    self._errors["not two decimals" if text else "empty"] += 1
        return found

    def _voltages(self, v1_v: float, v2_v: float, t_sent_ns: int, t_arrival_ns: int) -> Voltages:
        t_mid_ns = t_sent_ns - self._period_ns // 2
        # Time stays in order when lines arrive in bursts.
        self._last_mid_ns = t_mid_ns if self._last_mid_ns is None else max(t_mid_ns, self._last_mid_ns + 1)
        return Voltages(
            v1_v,
            v2_v,
            t_mid_ns=self._last_mid_ns,
            t_arrival_ns=t_arrival_ns,
            over_1=abs(v1_v) >= self._end_v,
            over_2=abs(v2_v) >= self._end_v,
        )


class AdcBoard(serial_sensor.SerialSensor[Voltages]):
    """A cheap converter board on a serial port: sends a line `v1,v2` in volts for each pair of conversions."""

    silence_hint = "check that it is the skin's converter board and that it has power."

    def __init__(
        self,
        link: Link,
        rate_hz: float = DAQ_RATE_HZ,
        full_scale_v: float = ADC_FULL_SCALE_V,
        inputs: serial_sensor.InputRecorder | None = None,
    ) -> None:
        super().__init__(link, 1.0 / rate_hz, inputs)
        self.period_s = 1.0 / rate_hz
        self._parser = PairParser(rate_hz, full_scale_v)
        self._count = 0

    def diagnostics(self) -> Diagnostics:
        """Return the board's values for `health`; counts are since the process began."""
        errors = self._parser.errors
        return {
            **super().diagnostics(),
            "lines": self._count,
            "partial_lines": self._parser.partial_lines,
            "errors": dict(errors),
            "error_details": describe_errors(errors, _PAIR_ERRORS),
        }

    def _parse(self, event: serial_sensor.RawEvent) -> list[Voltages]:
        found = self._parser.handle(event)
        self._count += len(found)
        return found


Daq: TypeAlias = ScpiScanner | AdcBoard
