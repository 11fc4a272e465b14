"""What a session remembers of a grip: the gel's last positions, and its mean difference to idle."""

from collections import deque
from collections.abc import Sequence
from itertools import takewhile

import numpy as np

from shearloop.bank.arrays import BoolArray, FloatArray
from shearloop.estimation.fingertip_validator import FingertipValidator
from shearloop.words import counted

# Frames (half a minute) in the mean difference of a grip: twists come and go within it.
_HELD_FRAMES = 60
# The maximum of frames in a row that are interpolated, and of those remembered, as a fraction.
_LARGEST_BRIDGED, _LARGEST_BRIDGED_FRACTION = 3, 0.25


class Motion:
    """What a session remembers of the gel's motion: nothing, for estimators that read each frame alone."""

    @property
    def n_lags(self) -> int:
        """How many frames back the memory reaches."""
        return 0

    @property
    def n_needed(self) -> int:
        """How many positions of a grip an estimate needs."""
        return 1

    def project(self, channels: FloatArray) -> FloatArray:
        """Return the (…, p) positions of (…, m, c) frames."""
        return np.zeros((*channels.shape[:-2], 0))

    def features(self, _positions: Sequence[FloatArray], _from_idle: FloatArray) -> FloatArray:
        """Return the features of the last n_needed to n_lags + 1 (p,) positions, and of the newest one's from idle."""
        return np.zeros(0)

    def impute(
        self, moved: FloatArray, usable: BoolArray, _sides: Sequence[FingertipValidator], *, from_idle: bool
    ) -> FloatArray:
        """Return the motion (m, c) since the last frame, or since the idle one, with unusable channels imputed.

        Here the estimator imputes the channels of a motion since the idle frame.
        """
        return moved if from_idle else np.where(usable, moved, 0.0)


class GripMemory:
    """The last positions of this grip, some of them interpolated, and its mean (m, c) difference to idle."""

    def __init__(self, motion: Motion, shape: tuple[int, ...]) -> None:
        """Begin without a grip; frames have the shape (m, c)."""
        self._motion = motion
        self._n_needed = motion.n_needed
        self.positions: deque[FloatArray] = deque(maxlen=motion.n_lags + 1)
        self._bridged: deque[bool] = deque(maxlen=motion.n_lags + 1)
        self._skipped_in_a_row = 0
        # Features of the last frames' motion.
        self.features: FloatArray = np.zeros(0)
        # Over the last valid frames, and their number.
        self.mean_difference: FloatArray = np.zeros(shape)
        self.held_frames = 0
        self._why = ""

    def forget(self, why: str = "") -> None:
        """Forget the grip; `why` is the reason against an estimate until there are enough frames again."""
        self._why = why
        self.positions.clear()
        self._bridged.clear()
        self._skipped_in_a_row, self.held_frames = 0, 0
        self.mean_difference = np.zeros_like(self.mean_difference)

    def skip(self, missing: int) -> None:
        """Leave a frame out; after too many in a row the last position is too old."""
        self._skipped_in_a_row += 1
        if self._skipped_in_a_row > _LARGEST_BRIDGED:
            self.forget("too many frames in a row were disturbed or are missing")
        elif self.positions:
            self._repeat_position(1 + missing)

    def remember(self, channels: FloatArray, moved: FloatArray, difference: FloatArray, missing: int) -> str:
        """Take the next gripped frame, interpolate those before it, and return the reason against an estimate.

        moved (m, c) is its way from the idle frame, and difference the same at the calibration's gain.
        """
        position, from_idle = self._motion.project(np.array([channels, moved]))
        self._skipped_in_a_row = 0
        if missing and self.positions:
            self._repeat_position(missing)
        between = len(list(takewhile(bool, reversed(self._bridged))))
        if 0 < between < len(self.positions):
            begin = self.positions[-1 - between]
            for i in range(1, between + 1):
                self.positions[i - 1 - between] = begin + i / (between + 1) * (position - begin)
        self.positions.append(position)
        self._bridged.append(False)
        if len(self.positions) < self._n_needed:
            return self.waits()
        if sum(self._bridged) > max(_LARGEST_BRIDGED, _LARGEST_BRIDGED_FRACTION * (len(self.positions) - 1)):
            return "too many of the last frames were disturbed or are missing"
        self.held_frames = min(self.held_frames + 1, _HELD_FRAMES)
        self.mean_difference = self.mean_difference + (difference - self.mean_difference) / self.held_frames
        self.features = self._motion.features(self.positions, from_idle)
        return ""

    def waits(self) -> str:
        """Return the reason against an estimate while frames are missing."""
        wanted = self._n_needed - len(self.positions)
        return f"{self._why or 'gripped too recently'}: {counted(wanted, 'more frame is', 'more frames are')} needed"

    @property
    def interrupted(self) -> bool:
        """Whether something else than a new grip has ended the memory."""
        return self._why != ""

    def _repeat_position(self, times: int) -> None:
        """Repeat the last position for missing frames until the next frame allows interpolation."""
        self.positions.extend([self.positions[-1]] * times)
        self._bridged.extend([True] * times)
