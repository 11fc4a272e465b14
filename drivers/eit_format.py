"""What a line of the EIT-kit looks like, and how to tell a sound one.

The board sends a line per frame: 1024 values with four decimals, each followed by `, `, then a newline. It computes
each value from its 10-bit samples as floor(√(mean of (sample − 512)²)) × 2.2 V / 1024 (`read_signal` of the EIT-kit's
open-source firmware), hence the steps of 2.2/1024 V, and writes 0 where the measuring pair touches a driven electrode.
All values are below 10 V, so a sound line is 1024 cells of eight bytes: quick to check strictly and to read.
"""

import re
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

N_VALUES = 1024
CELL_BYTES = len(b"0.1234, ")
LINE_BYTES = N_VALUES * CELL_BYTES
# Twice a sound line: a wrong count is still told from a flood without newline, and no more than this is ever kept.
LONGEST_LINE_BYTES = 2 * LINE_BYTES
EXCERPT_BYTES = 60

# The mean over two recordings of 832 frames each.
FRAME_PERIOD_S = 0.5408
ADC_REFERENCE_V = 2.2
ADC_STEP_V = ADC_REFERENCE_V / 1024
# The largest sine about mid-scale that the ADC can follow peaks at its rails; whatever reads more is clipped by them.
FULL_SCALE_SINE_RMS_V = ADC_REFERENCE_V / 2 / 2**0.5

_SEPARATOR = b", "
_DECIMAL = re.compile(rb"-?\d+\.\d{4}")

# A cell is one word of eight bytes. Less the bits of "0.0000, " its digits are 0 to 9 and its punctuation 0; whatever
# else stands there makes the highest bit of its byte 1, by itself or when this is added.
_WORD = np.dtype("<u8")
_ZERO_CELL = np.frombuffer(b"0.0000, ", _WORD)[0]
_ROOM = np.frombuffer(bytes(0x76 if byte == ord("0") else 0x7F for byte in b"0.0000, "), _WORD)[0]
_HIGHEST_BITS = np.uint64(0x8080_8080_8080_8080)
# Neighbouring digits become numbers below 100 (ten times the one and the other), those one number below 10 000.
_TO_PAIRS, _PAIRS, _BYTE = np.uint64(10 * 256 + 1), np.uint64(0x00FF_00FF_00FF_00FF), np.uint64(8)
_TO_FOUR, _FOUR, _HALF = np.uint64(100 * 65536 + 1), np.uint64(0xFFFF), np.uint64(32)
_FIRST_DIGIT, _ONE_VOLT = np.uint64(0xFF), np.uint64(10_000)
_TEN_THOUSANDTHS = 10_000.0


class RefusalKind(Enum):
    """Why a line was refused; the value is the sentence for the operator."""

    TOO_LONG = f"a line of more than {LONGEST_LINE_BYTES} bytes: newlines are being lost, or this is not an EIT-kit"
    WRONG_COUNT = f"a line without {N_VALUES} values, each followed by a comma and a space: bytes were lost on the way"
    NOT_A_NUMBER = "a value that is not a decimal with four places: bytes were lost or changed on the way"
    NAN = "a value that is NaN: the board divided by zero, restart it so that it calibrates anew"
    NEGATIVE = "a negative value, which an amplitude cannot be: bytes were changed on the way"
    OUT_OF_RANGE = f"a value above the ADC's {ADC_REFERENCE_V} V: bytes were changed on the way"
    ZERO_CHANNEL = "a channel that reads exactly 0: an electrode is shorted, or values stand in the wrong places"
    NONZERO_SLOT = "a value where the pair touches a driven electrode and 0 belongs: not the injection pattern expected"


@dataclass(frozen=True, slots=True)
class Refusal:
    """A refused line: why, from which value on (0…1023) where that can be said, and what stands there."""

    kind: RefusalKind
    excerpt: bytes
    position: int | None = None

    def __str__(self) -> str:
        """Return the sentence for health and log."""
        where = "" if self.position is None else f" at value {self.position + 1}"
        return f"refused {self.kind.value} (read {self.excerpt.decode('ascii', 'backslashreplace')!r}{where})"


def read_line(line: bytes, zero_slots: NDArray[np.bool_]) -> NDArray[np.float64] | Refusal:
    """Return the (1024,) values, in volts, of a line without its end, or why it is refused.

    `zero_slots` (1024,) is true where the board writes 0. A value is read only in the board's own form, `d.dddd`.
    """
    values = _cells(line)
    if values is None:
        return _what_is_wrong(line)
    zeros = values == 0.0
    if np.array_equal(zeros, zero_slots) and values.max() <= ADC_REFERENCE_V:
        return values
    for kind, bad in (
        (RefusalKind.OUT_OF_RANGE, values > ADC_REFERENCE_V),
        (RefusalKind.NONZERO_SLOT, ~zeros & zero_slots),
        (RefusalKind.ZERO_CHANNEL, zeros & ~zero_slots),
    ):
        if bad.any():
            return _refusal_at(kind, line, int(bad.argmax()))
    return values


def _cells(line: bytes) -> NDArray[np.float64] | None:
    """Return the values of a line of 1024 cells `d.dddd, `, or None for any other bytes."""
    if len(line) != LINE_BYTES:
        return None
    words = np.frombuffer(line, _WORD) ^ _ZERO_CELL
    # What overflows into the next byte has had its own highest bit.
    if (((words + _ROOM) | words) & _HIGHEST_BITS).any():
        return None
    pairs = ((words * _TO_PAIRS) >> _BYTE) & _PAIRS
    four = ((pairs * _TO_FOUR) >> _HALF) & _FOUR
    # Whole numbers below 10⁵ are exact, and so their quotient is the same double that float() reads.
    return np.asarray((four + (words & _FIRST_DIGIT) * _ONE_VOLT) / _TEN_THOUSANDTHS)


def _what_is_wrong(line: bytes) -> Refusal:
    *values, rest = line.split(_SEPARATOR)
    if rest or len(values) != N_VALUES:
        return Refusal(RefusalKind.WRONG_COUNT, line[:EXCERPT_BYTES])
    for position, value in enumerate(values):
        if value.lower().lstrip(b"-") == b"nan":
            return Refusal(RefusalKind.NAN, value, position)
        if not _DECIMAL.fullmatch(value):
            return Refusal(RefusalKind.NOT_A_NUMBER, value[:EXCERPT_BYTES], position)
        if value.startswith(b"-"):
            return Refusal(RefusalKind.NEGATIVE, value[:EXCERPT_BYTES], position)
        if len(value) + len(_SEPARATOR) != CELL_BYTES:
            return Refusal(RefusalKind.OUT_OF_RANGE, value[:EXCERPT_BYTES], position)
    raise AssertionError("a line of sound cells only is read, not refused")


def _refusal_at(kind: RefusalKind, line: bytes, position: int) -> Refusal:
    start = position * CELL_BYTES
    return Refusal(kind, line[start : start + CELL_BYTES - len(_SEPARATOR)], position)
