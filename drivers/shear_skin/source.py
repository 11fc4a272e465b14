"""The Keithley 6430 as the current source of the gauges: 5 mA through both in series, at no more than 1 V.

Commands and the status word are those of its manual (6430-901-01, section 17; the 2400 series understands them too).
Voltage and current are both measured: the current of a source that sits in compliance is not the one it was told.
"""

from dataclasses import dataclass

from shearloop.drivers.errors import DeviceLostError, DeviceSilentError, DriverError, ProtocolError
from shearloop.drivers.raw_event import RawEvent, Tap, no_tap
from shearloop.drivers.serial_port import Link
from shearloop.drivers.shear_skin.polled import PolledInstrument
from shearloop.drivers.shear_skin.scpi import NOT_A_NUMBER, REPLY_DEADLINE_S, RecordedAnswers, Reply, numbers

MODELS = ("MODEL 6430", "MODEL 24")
# The factory's rate of the RS-232 interface.
BAUD_RATE = 9600
CURRENT_A = 5e-3
# Twice two gauges of 25 Ω and their leads; too little to hurt anybody or to heat anything.
COMPLIANCE_V = 1.0
# Two readings a second leave the RS-232 interface time to spare, and a current source does not change in between.
PERIOD_S = 0.5
# A reading that was under way and its reply take some tenths of a second; whoever stops the daemon waits for this.
SWITCH_OFF_S = 1.0
OUTPUT, READ = ":OUTP?", ":READ?"
# The status word (manual, page 17-47).
_OVERFLOW, _COMPLIANCE, _OVERVOLTAGE, _RANGE_COMPLIANCE = 1 << 0, 1 << 3, 1 << 4, 1 << 16


@dataclass(frozen=True, slots=True)
class SourceReading:
    """What the source says of itself at t_ns (monotonic); voltage and current are nan while its output is off."""

    t_ns: int
    output_on: bool
    voltage_v: float = float("nan")
    current_a: float = float("nan")
    compliance: bool = False


def read_elements(text: str, t_ns: int) -> SourceReading:
    """Return the reading in a reply to :READ? with the elements VOLT, CURR, STAT; ProtocolError for anything else."""
    voltage_v, current_a, status = numbers(text, 3, "The current source")
    if not 0 <= status < 1 << 24 or max(abs(voltage_v), abs(current_a)) >= NOT_A_NUMBER:
        raise ProtocolError(f"The current source sent {text[:60]!r}, which is no reading; was it set by hand?")
    word = int(status)
    bad = _OVERFLOW | _COMPLIANCE | _OVERVOLTAGE | _RANGE_COMPLIANCE
    return SourceReading(t_ns, True, voltage_v, current_a, compliance=bool(word & bad))


def read_reply(query: str, reply: Reply) -> SourceReading | None:
    """Return the reading in the reply to OUTPUT or READ; None where the output is on and its reading is still to come.

    Raises ProtocolError for a reply that answers neither.
    """
    if query == READ:
        return read_elements(reply.text, reply.t_arrival_ns)
    if reply.text == "0":
        return SourceReading(reply.t_arrival_ns, output_on=False)
    if reply.text != "1":
        raise ProtocolError(f"The current source sent {reply.text[:60]!r} where 0 or 1 was to be expected.")
    return None


class RecordedSource:
    """Reads again what a source was recorded to have answered. No I/O."""

    def __init__(self) -> None:
        """Know of no answer."""
        self._answers = RecordedAnswers()

    def take(self, told: RawEvent) -> list[SourceReading]:
        """Return the readings that an input leads to; one that was not understood then leads to none now either."""
        answer = self._answers.take(told)
        if answer is None or answer[0] not in (OUTPUT, READ):
            return []
        try:
            reading = read_reply(*answer)
        except ProtocolError:
            return []
        return [] if reading is None else [reading]


class Keithley6430(PolledInstrument[SourceReading]):
    """One source behind a link: set up, switched on, and read until it is no longer wanted; then switched off."""

    def __init__(
        self,
        link: Link,
        current_a: float = CURRENT_A,
        compliance_v: float = COMPLIANCE_V,
        period_s: float = PERIOD_S,
        reply_deadline_s: float = REPLY_DEADLINE_S,
        tap: Tap = no_tap,
    ) -> None:
        """Take the link to it; nothing is opened yet. `tap` hears what it is asked and answers."""
        super().__init__(link, "The current source", period_s, reply_deadline_s, tap)
        self.current_a = current_a
        self.compliance_v = compliance_v
        self._was_reset = False
        self._may_be_on = False

    async def _set_up(self) -> str:
        name = await self._session.identified(*MODELS)
        if not self._was_reset:
            await self._session.tell("*RST")
        self._may_be_on = True
        # After a break all that matters is told again, without the reset, which would interrupt the current.
        await self._session.tell(
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
        off = read_reply(OUTPUT, await self._session.ask(OUTPUT))
        if off is not None:
            return off
        try:
            reply = await self._session.ask(READ)
        except DeviceSilentError:
            # With its output off it answers READ with an error, which is silence: so where somebody switched it off
            # since it was asked. It must not be opened anew for that, and thereby switched on again.
            off = read_reply(OUTPUT, await self._session.ask(OUTPUT))
            if off is None:
                raise
            return off
        return read_elements(reply.text, reply.t_arrival_ns)

    async def _leave(self) -> None:
        """Switch the output off and see it go off: what is only sent is lost where the port is closed too soon."""
        if not self._may_be_on:
            return
        try:
            # Twice: whoever was interrupted in the middle of a command has left its beginning on the line.
            await self._session.tell(":OUTP OFF", ":OUTP OFF")
            await self._session.ask_until(OUTPUT, "0", SWITCH_OFF_S)
            self._may_be_on = False
        except DriverError as error:
            self._errors["not switched off"] += 1
            self._link.given_up(
                DeviceLostError(
                    "The current source has not confirmed that its output is off; press its OUTPUT key, "
                    f"or the current flows on through the gauges. {error}"
                )
            )
