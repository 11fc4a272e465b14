"""A scanning multimeter on a socket (Keysight 34970A/34972A/DAQ970A and what speaks like them): two channels a scan."""

from shearloop.drivers.errors import ProtocolError
from shearloop.drivers.raw_event import RawEvent, Tap, no_tap
from shearloop.drivers.serial_port import Link
from shearloop.drivers.shear_skin.daq import RATE_HZ, Voltages
from shearloop.drivers.shear_skin.polled import PolledInstrument
from shearloop.drivers.shear_skin.scpi import OVERLOAD, REPLY_DEADLINE_S, RecordedAnswers, Reply, numbers

SOCKET_PORT = 5025
CHANNELS = (101, 102)
# The range above 5 mA × 25 Ω; with its overrange it also reads the source's whole compliance.
RANGE_V = 1.0
READ = "READ?"


def read_scan(reply: Reply) -> Voltages:
    """Return the voltages in the reply to READ?; ProtocolError when they are not two numbers.

    The scan lies somewhere between question and answer: its middle is taken to be theirs.
    """
    v1_v, v2_v = numbers(reply.text, 2, "The scanner")
    return Voltages(
        v1_v,
        v2_v,
        t_mid_ns=(reply.t_asked_ns + reply.t_arrival_ns) // 2,
        t_arrival_ns=reply.t_arrival_ns,
        over_1=abs(v1_v) >= OVERLOAD,
        over_2=abs(v2_v) >= OVERLOAD,
    )


class RecordedScanner:
    """Reads again what a scanner was recorded to have answered. No I/O."""

    def __init__(self) -> None:
        """Know of no answer."""
        self._answers = RecordedAnswers()

    def take(self, told: RawEvent) -> list[Voltages]:
        """Return the voltages that an input leads to; a scan that was not understood then is none now either."""
        answer = self._answers.take(told)
        if answer is None or answer[0] != READ:
            return []
        try:
            return [read_scan(answer[1])]
        except ProtocolError:
            return []


class ScpiScanner(PolledInstrument[Voltages]):
    """One scanner behind a link, asked for a scan at a steady rate; see `Daq`."""

    def __init__(
        self,
        link: Link,
        channels: tuple[int, int] = CHANNELS,
        rate_hz: float = RATE_HZ,
        range_v: float = RANGE_V,
        reply_deadline_s: float = REPLY_DEADLINE_S,
        tap: Tap = no_tap,
    ) -> None:
        """Take the link to it; nothing is opened yet. `tap` hears what it is asked and answers."""
        super().__init__(link, "The scanner", 1.0 / rate_hz, reply_deadline_s, tap)
        self._channels = f"(@{channels[0]},{channels[1]})"
        self._range_v = range_v

    async def _set_up(self) -> str:
        name = await self._session.identified()
        await self._session.tell(
            "*CLS",
            f"CONF:VOLT:DC {self._range_v:g},{self._channels}",
            # One period of the mains takes its hum out.
            f"VOLT:DC:NPLC 1,{self._channels}",
            f"ROUT:SCAN {self._channels}",
        )
        await self._session.check()
        return name

    async def _read(self) -> Voltages:
        return read_scan(await self._session.ask(READ))
