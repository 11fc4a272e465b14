"""Boards that send a line for each conversion: bytes become values with the times of their measurement. No I/O."""

import re
from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar, TypeVar

from shearloop.drivers.line_clock import LineClock
from shearloop.drivers.refused_lines import BoardKind, refusal_of
from shearloop.drivers.serial_sensor import Parser

ValueT = TypeVar("ValueT")


@dataclass(frozen=True, slots=True)
class TimedLine:
    """A line without its end, and when it arrived and the middle of its conversion was (monotonic, ns).

    `missed`: so many lines are found missing by it. `partial`: the first one after opening may lack its beginning.
    """

    text: bytes
    t_arrival_ns: int
    t_mid_ns: int
    missed: int
    partial: bool


class LineParser(Parser[ValueT]):
    """Turns the bytes of a board that sends a line for each conversion, in any slices, into values. No I/O."""

    # The board that should send the lines.
    board: ClassVar[BoardKind]

    def __init__(self, pattern: re.Pattern[bytes], max_bytes: int, baud: int, rate_hz: float) -> None:
        """Accept lines that match the pattern, of at most `max_bytes`; the board sends `rate_hz` lines a second."""
        super().__init__(max_bytes)
        self.count = 0
        self._pattern = pattern
        self._byte_ns = 10 * 10**9 // baud  # with start and stop bit
        self._period_ns = round(1e9 / rate_hz)
        self._clock = LineClock(self._period_ns)
        self._last_mid_ns = -(2**63)
        self._first = True

    @abstractmethod
    def _value(self, line: TimedLine) -> ValueT | None:
        """Return the value in a line that matches the pattern, or None where that is not certain."""

    def restart(self) -> None:
        """Begin with a connection, perhaps in the middle of a line."""
        self._clock.restart()
        self._first = True

    def feed(self, data: bytes, t_arrival_ns: int) -> list[ValueT]:
        """Return the values that `data` completes; of several lines each is a period older than the next."""
        values = []
        lines = self._split(data, t_arrival_ns, self._clock.period_ns)
        for waiting, line in zip(range(len(lines) - 1, -1, -1), lines, strict=True):
            partial, self._first = self._first, False
            if line is None:
                self._refuse(self._lines.too_long_start, "too long")
                continue
            text = line.strip(b"\r")
            if self._pattern.fullmatch(text):
                value = self._value(self._timed(text, len(line) + 1, t_arrival_ns, waiting, partial=partial))
                if value is not None:
                    values.append(value)
                    self.count += 1
                    self._refused_in_a_row = 0
            elif not partial:
                self._refuse(text, "not a number" if text else "empty")
        return values

    def _timed(self, text: bytes, n_bytes: int, read_ns: int, waiting: int, *, partial: bool) -> TimedLine:
        """Return a line of so many bytes, its end included, that was read with `waiting` lines behind it."""
        arrived_ns = read_ns - waiting * self._clock.period_ns
        # What may lack its beginning may be no reading.
        sent_ns, missed = (arrived_ns, 0) if partial else self._clock.arrived(read_ns, waiting)
        t_mid_ns = sent_ns - n_bytes * self._byte_ns - self._clock.period_ns // 2
        # Time stays in order when the clock learns a new schedule.
        self._last_mid_ns = max(t_mid_ns, self._last_mid_ns + 1)
        return TimedLine(text, arrived_ns, self._last_mid_ns, missed, partial)

    def _refuse(self, line: bytes, kind: str) -> None:
        self._clock.refused()
        self.refusal = refusal_of(line, kind, self.board, self._count_refused(kind))
