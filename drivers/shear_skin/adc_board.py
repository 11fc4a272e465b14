"""A cheap converter board on a serial port: it sends a line `v1,v2` in volts for each pair of conversions, unasked."""

import re
import time
from collections import Counter
from collections.abc import AsyncGenerator, Mapping

from drivers.errors import DeviceLostError, DriverError
from drivers.raw_input import InputKind, RawInput, Tap, no_tap
from drivers.serial_port import Link, Received
from drivers.shear_skin.daq import RATE_HZ, Voltages

BAUD_RATE = 115200
# "-0.123456,-0.123456" is 19 characters; anything longer than this is several lines run together.
MAX_LINE_BYTES = 40
NS_PER_BYTE = 10 * 10**9 // BAUD_RATE
# The range of an ADS1220 at gain 4 with its own reference: 5 mA × 100 Ω.
FULL_SCALE_V = 0.512
# A value this near the end of the range is at the end of the range.
_AT_THE_END = 0.9995
# An Uno waits for its boot loader when the port is opened.
BOOT_S = 4.0
SILENT_PERIODS = 8

_PAIR = re.compile(rb"([+-]?[0-9]{1,3}\.[0-9]{1,9}), ?([+-]?[0-9]{1,3}\.[0-9]{1,9})")

REFUSED_LINES = {
    "not two decimals": "The converter board sent a line that is not two decimals; check the baud rate and the sketch.",
    "too long": f"The converter board sent more than {MAX_LINE_BYTES} bytes without a line end; check the baud rate.",
    "empty": "The converter board sent an empty line; bytes were lost on the way, check the cable.",
}


class PairParser:
    """Turns the board's bytes, in whatever slices they come, into voltages; counts by kind what it refuses. No I/O."""

    def __init__(self, rate_hz: float = RATE_HZ, full_scale_v: float = FULL_SCALE_V) -> None:
        self.refused: Counter[str] = Counter()
        self.first_partials = 0
        self._period_ns = round(1e9 / rate_hz)
        self._end_v = _AT_THE_END * full_scale_v
        self._last_mid_ns: int | None = None
        self.restart()

    def restart(self) -> None:
        """Begin anew: the port was opened, perhaps in the middle of a line."""
        self._pending = b""
        self._overlong = False
        self._first = True

    def take(self, told: RawInput) -> list[Voltages]:
        """Be told what happened, live or from a recording; return the voltages that it leads to."""
        if told.kind is InputKind.OPENED:
            self.restart()
        elif told.kind is InputKind.DATA:
            return self.feed(told.data, told.t_ns)
        return []

    def feed(self, data: bytes, t_arrival_ns: int) -> list[Voltages]:
        """Return the voltages that `data` completes. Of several lines at once, the earlier are a period older each.

        The first line after the port was opened is left out: its beginning may be lost, and what is left of a number
        may be a number.
        """
        *lines, rest = (self._pending + data).split(b"\n")
        found = []
        for age, line in zip(range(len(lines) - 1, -1, -1), lines, strict=True):
            pair = self._pair(line)
            first, self._first = self._first, False
            if first:
                self.first_partials += 1
            elif pair is not None:
                found.append(self._voltages(*pair, len(line) + 1, t_arrival_ns - age * self._period_ns, t_arrival_ns))
        if len(rest) > MAX_LINE_BYTES:
            self._refuse_overlong()
            self._overlong, rest = True, b""
        self._pending = rest
        return found

    def _refuse_overlong(self) -> None:
        if not self._overlong:
            self.refused["too long"] += 1

    def _pair(self, line: bytes) -> tuple[float, float] | None:
        if self._overlong or len(line) > MAX_LINE_BYTES:
            # What is left of a line whose beginning is gone is not a line.
            self._refuse_overlong()
            self._overlong = False
            return None
        text = line.strip(b"\r")
        match = _PAIR.fullmatch(text)
        if match is None:
            if not self._first:
                self.refused["not two decimals" if text else "empty"] += 1
            return None
        return float(match[1]), float(match[2])

    def _voltages(self, v1_v: float, v2_v: float, n_bytes: int, t_sent_ns: int, t_arrival_ns: int) -> Voltages:
        t_mid_ns = t_sent_ns - n_bytes * NS_PER_BYTE - self._period_ns // 2
        # Where lines waited for the reader by pairs, time still goes forward.
        self._last_mid_ns = t_mid_ns if self._last_mid_ns is None else max(t_mid_ns, self._last_mid_ns + 1)
        return Voltages(
            v1_v,
            v2_v,
            t_mid_ns=self._last_mid_ns,
            t_arrival_ns=t_arrival_ns,
            over_1=abs(v1_v) >= self._end_v,
            over_2=abs(v2_v) >= self._end_v,
        )


class AdcBoard:
    """One board behind a link. It only ever sends; there is nothing to command."""

    def __init__(
        self, link: Link, rate_hz: float = RATE_HZ, full_scale_v: float = FULL_SCALE_V, tap: Tap = no_tap
    ) -> None:
        """Take the link to it; nothing is opened yet. `tap` hears of all that the parser is told."""
        self._link = link
        self._tap = tap
        self._period_s = 1.0 / rate_hz
        self._parser = PairParser(rate_hz, full_scale_v)
        self._patience_s = BOOT_S
        self._lines = 0

    @property
    def period_s(self) -> float:
        """How often a line is to be expected."""
        return self._period_s

    async def readings(self) -> AsyncGenerator[Voltages]:
        """Yield every line's voltages, for ever; see `Daq`."""
        with self._link:
            while True:
                try:
                    received = await self._receive()
                except DriverError as error:
                    await self._link.lost(error)
                    continue
                for voltages in self._told(InputKind.DATA, received.t_arrival_ns, received.data):
                    self._lines += 1
                    yield voltages

    def _told(self, kind: InputKind, t_ns: int, data: bytes = b"") -> list[Voltages]:
        told = RawInput(kind, t_ns, data)
        self._tap(told)
        return self._parser.take(told)

    def facts(self) -> Mapping[str, bool | int | float | str | Mapping[str, int] | None]:
        """Return what health tells of the board."""
        refusals = (f"{REFUSED_LINES[kind]} ({count} times)" for kind, count in sorted(self._parser.refused.items()))
        return {
            "connected": self._link.port is not None,
            "lines": self._lines,
            "errors": dict(self._parser.refused),
            "refusals": " ".join(refusals),
            "openings": self._link.openings,
            "last_loss": self._link.last_error,
        }

    async def _receive(self) -> Received:
        port = self._link.port
        if port is None:
            port = await self._link.open()
            self._told(InputKind.OPENED, time.monotonic_ns())
            self._patience_s = BOOT_S
        received = await port.read(self._patience_s)
        if received is None:
            raise DeviceLostError(
                f"{port.path} is open but has sent nothing for {self._patience_s:.1f} s; "
                "check that it is the skin's converter board and that it has power."
            )
        self._patience_s = SILENT_PERIODS * self._period_s
        return received
