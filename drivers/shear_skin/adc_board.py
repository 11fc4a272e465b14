"""A cheap converter board on a serial port: it sends a line `v1,v2` in volts for each pair of conversions, unasked."""

import re
from collections import Counter
from collections.abc import AsyncGenerator, Mapping
from contextlib import aclosing

from shearloop.drivers.line_splitter import LineSplitter, transfer_ns
from shearloop.drivers.raw_event import InputKind, RawEvent, Tap, no_tap
from shearloop.drivers.serial_port import Link
from shearloop.drivers.shear_skin.daq import RATE_HZ, Voltages
from shearloop.drivers.streaming_sensor import StreamingSensor

BAUD_RATE = 115200
# "-0.123456,-0.123456" is 19 characters; anything longer than this is several lines run together.
MAX_LINE_BYTES = 40
# The range of an ADS1220 at gain 4 with its own reference: 5 mA × 100 Ω.
FULL_SCALE_V = 0.512
# A value this near the end of the range is at the end of the range.
_AT_THE_END = 0.9995

_PAIR = re.compile(rb"([+-]?[0-9]{1,3}\.[0-9]{1,9}), ?([+-]?[0-9]{1,3}\.[0-9]{1,9})")

REFUSED_LINES = {
    "not two decimals": "The converter board sent a line that is not two decimals; check the baud rate and the sketch.",
    "too long": f"The converter board sent more than {MAX_LINE_BYTES} bytes without a line end; check the baud rate.",
    "empty": "The converter board sent an empty line; bytes were lost on the way, check the cable.",
    "unfinished": "The converter board broke off in the middle of a line; check its plug and its power.",
}


class PairParser:
    """Turns the board's bytes, in whatever slices they come, into voltages; counts by kind what it refuses. No I/O.

    Counted apart, being nobody's fault: `partial_lines`, lines that may have been under way when listening began.
    """

    def __init__(self, rate_hz: float = RATE_HZ, full_scale_v: float = FULL_SCALE_V) -> None:
        self._lines = LineSplitter(MAX_LINE_BYTES)
        self._refused: Counter[str] = Counter()
        self.partial_lines = 0
        self._period_ns = round(1e9 / rate_hz)
        self._end_v = _AT_THE_END * full_scale_v
        self._last_mid_ns: int | None = None
        self.restart()

    def restart(self) -> None:
        """Begin anew: the port was opened, perhaps in the middle of a line."""
        self._lines.restart()
        self._first = True

    @property
    def refused(self) -> Counter[str]:
        """What was not made voltages, by kind."""
        return self._refused + Counter({"too long": self._lines.too_long, "unfinished": self._lines.unfinished})

    def take(self, told: RawEvent) -> list[Voltages]:
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
        lines = self._lines.feed(data)
        found = []
        for age, line in zip(range(len(lines) - 1, -1, -1), lines, strict=True):
            pair = None if line is None else self._pair(line)
            first, self._first = self._first, False
            if first:
                self.partial_lines += 1
            elif line is not None and pair is not None:
                found.append(self._voltages(*pair, len(line) + 1, t_arrival_ns - age * self._period_ns, t_arrival_ns))
        return found

    def _pair(self, line: bytes) -> tuple[float, float] | None:
        text = line.strip(b"\r")
        match = _PAIR.fullmatch(text)
        if match is None:
            if not self._first:
                self._refused["not two decimals" if text else "empty"] += 1
            return None
        return float(match[1]), float(match[2])

    def _voltages(self, v1_v: float, v2_v: float, n_bytes: int, t_sent_ns: int, t_arrival_ns: int) -> Voltages:
        t_mid_ns = t_sent_ns - transfer_ns(n_bytes, BAUD_RATE) - self._period_ns // 2
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
        self._period_s = 1.0 / rate_hz
        self._parser = PairParser(rate_hz, full_scale_v)
        self._board = StreamingSensor(link, self._parser.take, period_s=self._period_s, silent=_silent, tap=tap)
        self._lines = 0

    @property
    def period_s(self) -> float:
        """How often a line is to be expected."""
        return self._period_s

    async def readings(self) -> AsyncGenerator[Voltages]:
        """Yield every line's voltages, for ever; see `Daq`."""
        async with aclosing(self._board.values()) as readings:
            async for voltages in readings:
                self._lines += 1
                yield voltages

    def facts(self) -> Mapping[str, bool | int | float | str | Mapping[str, int] | None]:
        """Return what health tells of the board."""
        refused = self._parser.refused
        refusals = (f"{REFUSED_LINES[kind]} ({count} times)" for kind, count in sorted(refused.items()))
        return {
            **self._board.facts(),
            "lines": self._lines,
            "partial_lines": self._parser.partial_lines,
            "errors": dict(refused),
            "refusals": " ".join(refusals),
        }


def _silent(path: str, waited_s: float) -> str:
    return (
        f"{path} is open but has sent nothing for {waited_s:.1f} s; "
        "check that it is the skin's converter board and that it has power."
    )
