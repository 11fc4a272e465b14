"""The EIT-kit, a Teensy on USB: checks its lines, turns them into frames, starts it and reconnects to it.

The board sends a line per frame: values with four decimals, each followed by `, `, then a newline. L electrodes have
L² values (v), some of them channels (c). The board computes each from 10-bit samples as floor(√(mean of (sample −
512)²)) × 2.2 V / 1024 (`read_signal` of the EIT-kit's open-source firmware), hence the steps of 2.2/1024 V. It writes 0
where the measuring pair touches a driven electrode, and where a channel has less signal than one step: that channel is
dead in this frame. Values are below 10 V, so a line has cells of eight bytes.
"""

import re
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from shearloop.drivers.connection import Diagnostics, Link, Port
from shearloop.drivers.defaults import FRAME_PERIOD_S
from shearloop.drivers.frame_clock import LATE_NS, LONGEST_GAP, FrameClock
from shearloop.drivers.refused_lines import CABLE, refusal_of
from shearloop.drivers.serial_sensor import InputRecorder, Parser, SerialSensor
from shearloop.errors import Hint

CELL_BYTES = len(b"0.1234, ")
# Twice a line of 32 electrodes: a line with a wrong count is shorter, a stream without newlines is longer.
MAX_LINE_BYTES = 2 * 32 * 32 * CELL_BYTES
EXCERPT_BYTES = 60

# The board's period until the clock has learned the real one.
NOMINAL_PERIOD_NS = round(1e9 * FRAME_PERIOD_S)
NEVER_NS = -(2**63)
# A line of 8 kB over the high-speed USB of a Teensy 4.
TRANSFER_NS = 1_000_000
ADC_REFERENCE_V = 2.2
ADC_STEP_V = ADC_REFERENCE_V / 1024
# The RMS of the largest sine between the ADC's rails; larger readings are clipped.
FULL_SCALE_SINE_RMS_V = ADC_REFERENCE_V / 2 / 2**0.5
# The longest run of equal readings of a live channel in the recordings is 168 frames.
DEAD_AFTER_FRAMES = 200

START = b"y"
# A board that sends no frame for this many periods is opened and started again.
SILENT_FRAMES = 4
# Frames that follow each other sooner, in periods, waited on their way together.
TOGETHER = 0.5
# No EIT-kit is faster. A faster sender plays a recording faster than it was made, and waits for a late reader.
FASTEST_NS = 50_000_000
# At fast frame rates a shorter silence may come from a busy computer.
MIN_SILENCE_S = 0.5

_SEPARATOR = b", "
_VALUE = re.compile(rb"\d\.\d{4}")
# Of a cell: the places of the digits with their values in 0.0001 V, and the other bytes.
_DIGITS, _STEPS = [0, 2, 3, 4, 5], np.array([10_000, 1_000, 100, 10, 1])
_OTHERS, _PUNCTUATION = [1, 6, 7], np.frombuffer(b"., ", np.uint8)


class FrameErrorKind(Enum):
    """Why a line is rejected; the value is the operator's sentence."""

    TOO_LONG = f"a line of more than {MAX_LINE_BYTES} bytes: newlines are lost, or this is not an EIT-kit"
    WRONG_COUNT = "a line without all of its values, each followed by a comma and a space: bytes were lost"
    NOT_A_NUMBER = "a value that is not written as 0.1234: bytes were lost or changed"
    NAN = "a value that is NaN: the board divided by zero"
    OUT_OF_RANGE = f"a value above the ADC's {ADC_REFERENCE_V} V: bytes were changed"
    NONZERO_SLOT = "a value where the pair touches a driven electrode and 0 belongs: a different injection pattern"
    TOO_SOON = "a frame less than half a period after the one before: it waited on its way, and its time is unknown"


@dataclass(frozen=True, slots=True)
class FrameError:
    """A rejected line: the reason, its beginning or its first bad value, and that one's position, counted from 0.

    `count` is the number of values.
    """

    kind: FrameErrorKind
    excerpt: bytes
    position: int | None = None
    count: str = ""

    def hint(self, in_a_row: int) -> Hint:
        """Return the line for health and log with the reason, and the cure; of whole lines in a row who sends them."""
        if self.position is None or b"," in self.excerpt:
            return refusal_of(self.excerpt, f"{self.kind.value}{self.count}", "EIT-kit", in_a_row)
        read = repr(self.excerpt)[1:]
        return Hint(f"refused {read} at value {self.position + 1}: {self.kind.value}", _CURES.get(self.kind, CABLE))


# Of a value; those of others are a cable's.
_CURES = {
    FrameErrorKind.NAN: "restart the board so that it calibrates again",
    FrameErrorKind.NONZERO_SLOT: "give `injection` of the fingertip's file as the board drives it",
}
# Lines without their ends, whose number is unknown.
_LOST_BYTES = (FrameErrorKind.TOO_LONG, FrameErrorKind.WRONG_COUNT)
# What remains of a line that was under way when the port was opened.
_PARTIAL_ERRORS = (FrameErrorKind.WRONG_COUNT, FrameErrorKind.NOT_A_NUMBER)


def read_line(line: bytes, zero_slots: NDArray[np.bool_]) -> NDArray[np.float64] | FrameError:
    """Return the (v,) values in volts of a line without its end, or the reason to reject it.

    `zero_slots` (v,) is true where the board writes 0. Values must have the board's own form, `d.dddd`.
    """
    if len(line) != zero_slots.size * CELL_BYTES:
        return _find_error(line, zero_slots.size)
    cells = np.frombuffer(line, np.uint8).reshape(-1, CELL_BYTES)
    # Bytes below "0" wrap around to large numbers.
    digits = cells[:, _DIGITS] - np.uint8(ord("0"))
    if (digits > 9).any() or (cells[:, _OTHERS] != _PUNCTUATION).any():
        return _find_error(line, zero_slots.size)
    # The quotient of whole numbers is the float nearest to the decimal.
    values: NDArray[np.float64] = digits @ _STEPS / 10_000
    for kind, bad in (
        (FrameErrorKind.OUT_OF_RANGE, values > ADC_REFERENCE_V),
        (FrameErrorKind.NONZERO_SLOT, (values != 0.0) & zero_slots),
    ):
        if bad.any():
            position = int(bad.argmax())
            return FrameError(kind, line.split(_SEPARATOR)[position], position)
    return values


def _find_error(line: bytes, n_values: int) -> FrameError:
    *values, rest = line.split(_SEPARATOR)
    if rest or len(values) != n_values:
        count = f" ({len(values)} of {n_values} values)"
        return FrameError(FrameErrorKind.WRONG_COUNT, line[:EXCERPT_BYTES], count=count)
    for position, value in enumerate(values):
        if not _VALUE.fullmatch(value):
            is_nan = value.lower().lstrip(b"-") == b"nan"
            kind = FrameErrorKind.NAN if is_nan else FrameErrorKind.NOT_A_NUMBER
            return FrameError(kind, value[:EXCERPT_BYTES], position)
    raise AssertionError("the line has no error")


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One frame of the board; its arrays are read-only.

    `channels` (c,) and `raw` (v,) are in volts and line order.
    `t_mid_ns` is the middle of the acquisition, `t_arrival_ns` the arrival of the last byte (monotonic clock).
    `seq` counts frames from 0 across reconnections. `saturated` (c,): the signal exceeds the ADC's range; `dead`
    (c,): exactly 0, or unchanged for DEAD_AFTER_FRAMES, so nothing is connected; `repeated`: the same line as
    the frame before, so no new measurement.
    """

    channels: NDArray[np.float64]
    raw: NDArray[np.float64]
    t_begin_ns: int
    t_mid_ns: int
    t_arrival_ns: int
    seq: int
    saturated: NDArray[np.bool_]
    dead: NDArray[np.bool_]
    repeated: bool


class FrameParser(Parser[Frame]):
    """Turns chunks of bytes into frames. No I/O.

    `zero_slots` (v,) is true where the injection pattern makes the value 0. A cut line at the opening of the port is
    not an error. Lines that may have waited before the opening are dropped: their time is unknown. `patience` is the
    factor on the pause after which the board counts as stopped. It is above 1 only on an emulated rig, because a busy
    computer delays the emulated boards.
    """

    def __init__(
        self, zero_slots: NDArray[np.bool_], *, nominal_period_ns: int = NOMINAL_PERIOD_NS, patience: float = 1.0
    ) -> None:
        super().__init__(MAX_LINE_BYTES)
        self.clock = FrameClock(nominal_period_ns, patience * LONGEST_GAP)
        self.frames = 0
        self._zero_slots = zero_slots
        self._first_line = True
        # Lines; None once bytes were lost, which may be those of many.
        self._rejected_since_frame: int | None = 0
        # When the last frame of this connection was sent, by the clock, and when it can have been sent at the earliest.
        self._sent_ns = self._earliest_ns = NEVER_NS
        self._last_mid_ns = NEVER_NS
        self._last_channels = np.full(np.count_nonzero(~zero_slots), np.nan)
        self._equal_readings = np.zeros(len(self._last_channels), np.int64)

    def restart(self) -> None:
        """Begin with a connection, perhaps in the middle of a line."""
        self._sent_ns = NEVER_NS
        self._first_line, self._rejected_since_frame = True, 0
        self.clock.restart()

    def feed(self, data: bytes, t_arrival_ns: int) -> list[Frame]:
        """Return the frames that `data` completes, in order; all of it had arrived at `t_arrival_ns`."""
        read = [self._read(line) for line in self._split(data, t_arrival_ns, self.clock.period_ns)]
        behind = sum(isinstance(one, np.ndarray) for one in read)
        frames = []
        for one in read:
            if isinstance(one, FrameError):
                self._reject(one)
            elif one is not None:
                behind -= 1
                sent_ns = self.clock.arrived(t_arrival_ns, self._rejected_since_frame, self._waited_since_ns, behind)
                if self._has_known_time(sent_ns):
                    frames.append(self._frame(one, sent_ns, t_arrival_ns))
                # A whole frame is of this board, even if its time is not known.
                self._rejected_since_frame = self._refused_in_a_row = 0
        return frames

    def _has_known_time(self, sent_ns: int) -> bool:
        """Return whether the clock's time of the next frame is at most LATE_NS late; refuse the frame otherwise.

        Of frames that come together, each was sent a period after the one before, and the first one at most LATE_NS
        before it came. A frame that comes sooner than that shows that the first one was older, and may be as old.
        """
        after_ns, period_ns = sent_ns - self._sent_ns, self.clock.period_ns
        # The configured period may be another board's.
        is_timed = self.clock.learned_from > 0 and period_ns >= FASTEST_NS
        together = is_timed and after_ns < TOGETHER * period_ns
        self._sent_ns = sent_ns
        self._earliest_ns = self._earliest_ns + period_ns if together else sent_ns - LATE_NS
        if sent_ns >= self._earliest_ns:
            return True
        self._count_refused(FrameErrorKind.TOO_SOON)
        every = f"after {max(after_ns, 0) / 1e9:.3f} s, where one comes every {period_ns / 1e9:.2g} s"
        cure = "if that goes on, see `frame_period_s`, and what keeps the board or its computer busy"
        self.refusal = Hint(f"refused {FrameErrorKind.TOO_SOON.value} ({every})", cure)
        return False

    def _read(self, line: bytes | None) -> NDArray[np.float64] | FrameError | None:
        """Return the values of a line, or the reason to reject it; None for the rest of a line at an opening."""
        is_first, self._first_line = self._first_line, False
        if line is None:
            return FrameError(FrameErrorKind.TOO_LONG, self._lines.too_long_start)
        line = line.removesuffix(b"\r")
        found = read_line(line, self._zero_slots)
        whole = len(line) >= self._zero_slots.size * CELL_BYTES
        if isinstance(found, FrameError) and is_first and not whole and found.kind in _PARTIAL_ERRORS:
            return None
        return found

    def _reject(self, error: FrameError) -> None:
        self.refusal = error.hint(self._count_refused(error.kind))
        if error.kind in _LOST_BYTES:
            self._rejected_since_frame = None
        elif self._rejected_since_frame is not None:
            self._rejected_since_frame += 1

    def _frame(self, values: NDArray[np.float64], sent_ns: int, t_arrival_ns: int) -> Frame:
        channels = values[~self._zero_slots]
        repeated = np.array_equal(channels, self._last_channels)
        if not repeated:
            self._equal_readings = np.where(channels == self._last_channels, self._equal_readings + 1, 1)
        self._last_channels = channels
        saturated = channels > FULL_SCALE_SINE_RMS_V
        dead = (channels == 0.0) | (self._equal_readings >= DEAD_AFTER_FRAMES)
        # Time stays in order when the clock learns a new period.
        self._last_mid_ns = max(sent_ns - TRANSFER_NS - self.clock.period_ns // 2, self._last_mid_ns + 1)
        for array in (channels, values, saturated, dead):
            array.setflags(write=False)
        self.frames += 1
        return Frame(
            channels=channels,
            raw=values,
            t_begin_ns=self._last_mid_ns - self.clock.period_ns // 2,
            t_mid_ns=self._last_mid_ns,
            t_arrival_ns=t_arrival_ns,
            seq=self.frames - 1,
            saturated=saturated,
            dead=dead,
            repeated=repeated,
        )


class EitKit(SerialSensor[Frame]):
    """One board.

    `zero_slots` (v,) is true where its injection pattern makes a value 0. `frame_period_s` is used until the period
    is measured. `inputs` keeps every input of the parser.
    """

    silence_hint = "see that it has power and that it is an EIT-kit."

    def __init__(
        self,
        link: Link,
        zero_slots: NDArray[np.bool_],
        frame_period_s: float = FRAME_PERIOD_S,
        inputs: InputRecorder | None = None,
        patience: float = 1.0,
    ) -> None:
        self._frame_parser = FrameParser(zero_slots, nominal_period_ns=round(frame_period_s * 1e9), patience=patience)
        super().__init__(link, frame_period_s, self._frame_parser, inputs, patience)

    @property
    def period_s(self) -> float:
        """The board's measured period, or the configured one until then."""
        return self._frame_parser.clock.period_ns / 1e9

    def diagnostics(self) -> Diagnostics:
        """Return the board's values for `health`; counts are since the process began."""
        parser, found = self._frame_parser, super().diagnostics()
        is_measured = found["connected"] and parser.clock.learned_from
        return {
            **found,
            "frames": parser.frames,
            "errors": {kind.name.lower(): count for kind, count in parser.errors.items()},
            "expected_hz": 1.0 / self._period_s,
            "measured_hz": 1.0 / self.period_s if is_measured else None,
        }

    @property
    def longest_silence_s(self) -> float:
        """The silence after which the board counts as lost."""
        return max(SILENT_FRAMES * self.period_s, MIN_SILENCE_S)

    async def _on_open(self, port: Port) -> None:
        await port.write(START)
