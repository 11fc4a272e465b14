"""A session of the paper's method, without a calibrated fingertip.

Trehan et al. 2025, section 2, where the idle frame is the homogeneous frame.
"""

import math
from collections import deque
from functools import cached_property

import numpy as np

from shearloop.bank.arrays import BoolArray, FloatArray
from shearloop.bank.matching import signal_above_noise
from shearloop.estimation.bank_match import BankMatcher, BankSearch
from shearloop.estimation.calibration import Calibration
from shearloop.estimation.defaults import BASELINE_FRAMES, MAX_GAP_S
from shearloop.estimation.fingertip_validator import MIN_NOISE_V
from shearloop.estimation.session import Session
from shearloop.estimation.values import ProcessedFrame, TactileFrame

# Frames with more unusable channels than this are refused.
_UNUSABLE_FRACTION = 0.10
# Degrees of freedom of the mean variance of all channels in each channel's own.
_POOLED_FREEDOM = 30


class PaperSession(Session):
    """State of one run of the paper's method: mean of the latest frames minus the idle frame.

    Without a validator nothing is known of the fingertip but its first frames.
    """

    def __init__(
        self,
        calibration: Calibration,
        matcher: BankMatcher,
        *,
        search: BankSearch | None = None,
        baseline_frames: int = BASELINE_FRAMES,
        average_frames: int = 1,
        max_gap_s: float = MAX_GAP_S,
    ) -> None:
        """Begin with `baseline_frames` untouched frames; a longer gap restarts the mean of `average_frames`."""
        self.averaged_frames = average_frames
        self._max_gap_s = max_gap_s
        super().__init__(calibration, matcher=matcher, search=search, baseline_frames=baseline_frames)

    def _begin(self, idle_frames: int) -> None:
        """Forget all frames: the next ones are untouched."""
        self._untouched = UntouchedFrames(idle_frames or self._baseline_frames)
        self._averaged: deque[tuple[float, FloatArray]] = deque(maxlen=self.averaged_frames)
        # The channels of the last frame; an unusable one keeps its last usable value.
        self._before: FloatArray | None = None
        # Channels that were unusable when the tare began: their idle voltages are unknown.
        self._unknown: BoolArray = np.zeros(0, dtype=np.bool_)

    @property
    def taring(self) -> bool:
        """Whether frames are being averaged into the idle frame."""
        return self._untouched.missing and not self._lacks_idle_frame

    def _process(self, frame: TactileFrame) -> ProcessedFrame:
        """Return the difference of the next frame of one side to the idle frame, or the reasons against it."""
        if frame.fingers_moved:
            # Neither the idle frame nor a mean has frames from before and after a motion.
            self._untouched.restart()
            self._averaged.clear()
            return ProcessedFrame.refused(frame.usable)
        usable = frame.usable & (frame.channels != 0.0)
        if self._before is not None:
            usable &= ~self._unknown
        unusable = int(np.count_nonzero(~usable))
        if unusable > _UNUSABLE_FRACTION * usable.size:
            return ProcessedFrame.refused(
                usable,
                f"{unusable} of {usable.size} channels are saturated or dead; "
                "check the ribbon cable and the gel's contact with the electrodes",
            )
        if self._before is None:
            self._unknown, self._before = ~usable[0], frame.channels[0]
        self._before = channels = np.where(usable[0], frame.channels[0], self._before)
        untouched, averaged = self._untouched, self._averaged
        if untouched.missing:
            untouched.frames.append(channels)
            n = len(untouched.frames)
            return ProcessedFrame.refused(usable, f"taking the idle frame, {n} of {untouched.wanted}")
        if averaged and frame.t_s - averaged[-1][0] > self._max_gap_s:
            averaged.clear()
        averaged.append((frame.t_s, channels))
        mean = np.mean([signals for _, signals in averaged], axis=0)
        difference = mean - untouched.idle_frame
        n = len(averaged)
        noise = untouched.noise * math.sqrt(1.0 / n + 1.0 / untouched.wanted)
        if (reason := signal_above_noise(difference, noise)) is not None:
            return ProcessedFrame.refused(usable, reason)
        lag_s = frame.t_s - sum(t_s for t_s, _ in averaged) / n
        return ProcessedFrame(difference[None], (), usable, lag_s=lag_s)


class UntouchedFrames:
    """The frames that a run or a tare begins with: the idle frame is their mean, and they show the noise."""

    def __init__(self, wanted: int) -> None:
        """Begin without a frame."""
        self.wanted = wanted
        self.frames: list[FloatArray] = []

    @property
    def missing(self) -> bool:
        """Whether there are fewer than wanted."""
        return len(self.frames) < self.wanted

    def restart(self) -> None:
        """Forget the frames, unless there are as many as wanted."""
        if self.missing:
            self.frames.clear()

    @cached_property
    def idle_frame(self) -> FloatArray:
        """Their mean (c,) in volts."""
        # Deviations from the first frame keep the microvolts that sums of volts would lose.
        first = self.frames[0]
        return np.asarray(first + np.mean(np.array(self.frames) - first, axis=0))

    @cached_property
    def noise(self) -> FloatArray:
        """Standard deviation of one frame, (c,) in volts, at least the converter's rounding.

        A few frames know the variance of one channel badly: each is drawn towards the mean of all (Smyth 2004).
        """
        freedom = self.wanted - 1
        own = (np.array(self.frames) - self.idle_frame).var(axis=0, ddof=1)
        variance = (freedom * own + _POOLED_FREEDOM * own.mean()) / (freedom + _POOLED_FREEDOM)
        return np.asarray(np.sqrt(np.maximum(variance, MIN_NOISE_V**2)))
