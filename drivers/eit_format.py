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

# A frame comes after half a second in which others had the processor's caches: then a function of bytes costs much less
# than one of numpy, and each one of numpy alike, whatever it computes.
_DIGITS_TO_0 = bytes.maketrans(b"0123456789", b"0" * 10)
_DIGITS_TO_NUMBERS = bytes(byte - ord("0") if byte in b"0123456789" else 0 for byte in range(256))
_ZERO_LINE = b"0.0000, " * N_VALUES
# The sum of a cell's numbers times these is its value in ten thousandths: whole, and exact in float32.
_PLACES = np.array([10_000, 0, 1_000, 100, 10, 1, 0, 0], dtype=np.float32)
_TEN_THOUSANDTHS = 10_000.0


class FrameErrorKind(Enum):
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
class FrameError:
    """A refused line: why, from which value on (0…1023) where that can be said, and what stands there."""

    kind: FrameErrorKind
    excerpt: bytes
    position: int | None = None

    def __str__(self) -> str:
        """Return the sentence for health and log."""
        where = "" if self.position is None else f" at value {self.position + 1}"
        return f"refused {self.kind.value} (read {self.excerpt.decode('ascii', 'backslashreplace')!r}{where})"


def read_line(line: bytes, zero_slots: NDArray[np.bool_]) -> NDArray[np.float64] | FrameError:
    """Return the (1024,) values, in volts, of a line without its end, or why it is refused.

    `zero_slots` (1024,) is true where the board writes 0. A value is read only in the board's own form, `d.dddd`.
    """
    values = _cells(line)
    if values is None:
        return _what_is_wrong(line)
    zeros = values == 0.0
    if zeros.tobytes() == zero_slots.tobytes() and np.maximum.reduce(values) <= ADC_REFERENCE_V:
        return values
    for kind, bad in (
        (FrameErrorKind.OUT_OF_RANGE, values > ADC_REFERENCE_V),
        (FrameErrorKind.NONZERO_SLOT, ~zeros & zero_slots),
        (FrameErrorKind.ZERO_CHANNEL, zeros & ~zero_slots),
    ):
        if bad.any():
            return _refusal_at(kind, line, int(bad.argmax()))
    return values


def _cells(line: bytes) -> NDArray[np.float64] | None:
    """Return the values of a line of 1024 cells `d.dddd, `, or None for any other bytes."""
    if len(line) != LINE_BYTES or line.translate(_DIGITS_TO_0) != _ZERO_LINE:
        return None
    numbers = np.frombuffer(line.translate(_DIGITS_TO_NUMBERS), np.uint8).reshape(N_VALUES, CELL_BYTES)
    # The quotient of whole numbers below 10⁵ is the same double that float() reads.
    return np.asarray(np.divide(numbers.astype(np.float32).dot(_PLACES), _TEN_THOUSANDTHS, dtype=np.float64))


def _what_is_wrong(line: bytes) -> FrameError:
    *values, rest = line.split(_SEPARATOR)
    if rest or len(values) != N_VALUES:
        return FrameError(FrameErrorKind.WRONG_COUNT, line[:EXCERPT_BYTES])
    for position, value in enumerate(values):
        if value.lower().lstrip(b"-") == b"nan":
            return FrameError(FrameErrorKind.NAN, value, position)
        if not _DECIMAL.fullmatch(value):
            return FrameError(FrameErrorKind.NOT_A_NUMBER, value[:EXCERPT_BYTES], position)
        if value.startswith(b"-"):
            return FrameError(FrameErrorKind.NEGATIVE, value[:EXCERPT_BYTES], position)
        if len(value) + len(_SEPARATOR) != CELL_BYTES:
            return FrameError(FrameErrorKind.OUT_OF_RANGE, value[:EXCERPT_BYTES], position)
    raise AssertionError("a line of sound cells only is read, not refused")


def _refusal_at(kind: FrameErrorKind, line: bytes, position: int) -> FrameError:
    start = position * CELL_BYTES
    return FrameError(kind, line[start : start + CELL_BYTES - len(_SEPARATOR)], position)
