"""Digests of the frames that a calibration has learned from: a frame that is used twice adds nothing new."""

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Self

import numpy as np

from shearloop.bank.arrays import BoolArray, FloatArray, IntArray

# Digests that a calibration keeps: 512 KB, the frames of two fingertips for five hours. Of more frames the least
# digests stay, which are a sample by chance, so that a recording that is used again is still found.
MAX_DIGESTS = 1 << 16
_DIGEST_BYTES = 8


@dataclass(frozen=True, slots=True, eq=False)
class LearnedFrames:
    """Rising digests (d,) of the frames of each fingertip that a calibration has learned from.

    They are `complete` unless the calibration's file was written without them.
    """

    digests: IntArray
    complete: bool = True

    @classmethod
    def of(cls, frames: Iterable[FloatArray]) -> Self:
        """Return what learned from series of channels, each of n frames of m fingertips (n, m, c)."""
        return cls(np.zeros(0, dtype=np.int64)).with_frames(frames)

    def with_frames(self, frames: Iterable[FloatArray]) -> Self:
        """Return these frames and the frames of further series of channels."""
        every = [self.digests, *(frame_digests(channels).ravel() for channels in frames)]
        return type(self)(np.unique(np.concatenate(every))[:MAX_DIGESTS], self.complete)

    @property
    def is_sample(self) -> bool:
        """Whether more frames were learned from than are kept: then fewer are found than were used."""
        return len(self.digests) == MAX_DIGESTS

    def include(self, channels: FloatArray) -> BoolArray:
        """Return which of n frames (n, m, c) are among these, by the signals of one fingertip or more."""
        return np.asarray(np.isin(frame_digests(channels), self.digests).any(axis=1))


CANNOT_TELL_FRAMES = (
    "the calibration's file does not list the frames of its fit, so it is not known whether it has learned from these; "
    "calibrate again to have it checked"
)
# Of a file without digests.
UNKNOWN_FRAMES = LearnedFrames(np.zeros(0, dtype=np.int64), complete=False)


def frame_digests(channels: FloatArray) -> IntArray:
    """Return a digest (n, m) of each fingertip's signals, which no name and no time changes."""
    n, m, _ = channels.shape
    # 0 and -0 are one value.
    values = np.ascontiguousarray(channels, dtype="<f8") + 0.0
    found = b"".join(
        hashlib.blake2b(signals.tobytes(), digest_size=_DIGEST_BYTES).digest() for frame in values for signals in frame
    )
    return np.frombuffer(found, dtype="<i8").astype(np.int64).reshape(n, m)
