"""State of one session: the idle frame and the last few seconds.

A frame passes the timer, the checks of its channels, the idle frames, the grips, and the memory of this grip.
"""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import takewhile
from typing import Self

import numpy as np

from shearloop.bank.arrays import BoolArray, FloatArray
from shearloop.bank.matching import signal_above_noise
from shearloop.estimation.defaults import BASELINE_FRAMES
from shearloop.estimation.fingertip_validator import (
    LARGEST_JUMPING_SHARE,
    LEAST_NOISE_V,
    FingertipSet,
    FingertipValidator,
    GripDetector,
    mask_unmeasured,
)
from shearloop.estimation.values import TactileFrame
from shearloop.words import counted

# Frames (half a minute) in the mean difference of a grip: twists come and go within it.
_HELD_FRAMES = 60
# Longest step between frames while the period is unknown: two frames of 0.54 s are missing.
_LARGEST_GAP_S = 1.4
# The median of this many steps is the period, if the configured one is not shorter. A step longer than the first share
# of the period has one frame missing, a step longer than the second has more.
_STEPS, _MISSING_SHARE, _LARGEST_GAP_SHARE = 9, 1.5, 2.5
# A baseline of fewer frames accepts only grips of at least half the calibrated strength.
_LEAST_IDLE, _OUTRIGHT = 5, 0.5
# Most frames in a row that are interpolated, and most of those remembered, as a share.
_LARGEST_BRIDGED, _LARGEST_BRIDGED_SHARE = 3, 0.25
# The paper's method refuses frames with more unusable channels than this.
_PAPER_UNUSABLE_SHARE = 0.10
# Degrees of freedom of the mean variance of all channels in each channel's own.
_POOLED_FREEDOM = 30


@dataclass(frozen=True, slots=True, eq=False)
class ProcessedFrame:
    """A frame after the session's checks, with the reasons against it.

    difference (m, c) is to the idle frame, mean_difference its mean over the grip's last held_frames, 0 after a
    release. motion holds features of the last frames' motion. usable (m, c) excludes channels that the board or the
    frame itself shows to be lost or saturated. has_baseline is whether every fingertip was seen idle, lag_s the lag of
    an average.
    """

    difference: FloatArray
    reasons: tuple[str, ...]
    usable: BoolArray
    mean_difference: FloatArray = field(default_factory=lambda: np.zeros(0))
    motion: FloatArray = field(default_factory=lambda: np.zeros(0))
    held_frames: int = 1
    has_baseline: bool = True
    lag_s: float = 0.0

    @classmethod
    def refused(cls, usable: BoolArray, *reasons: str) -> Self:
        """Return a frame with reasons against it, without a difference."""
        return cls(np.zeros(usable.shape), reasons, usable)


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


class FrameTimer:
    """Finds gaps and missing frames by the frames' times."""

    def __init__(self, period_s: float) -> None:
        """Begin with the board's period: one that drops half of its frames does not show it, so it is a bound."""
        self._period_s = period_s
        self._t_s = -np.inf
        self._steps_s: deque[float] = deque(maxlen=_STEPS)

    def missing_before(self, t_s: float) -> int | None:
        """Return how many frames are missing before the next one, None after a gap."""
        step_s, self._t_s = t_s - self._t_s, t_s
        learned_s = sorted(self._steps_s)[_STEPS // 2] if len(self._steps_s) == _STEPS else np.inf
        period_s = min(learned_s, self._period_s)
        if 0 < step_s <= _LARGEST_GAP_S:
            self._steps_s.append(step_s)
        if not 0 < step_s <= min(_LARGEST_GAP_S, _LARGEST_GAP_SHARE * period_s):
            return None
        return int(step_s > _MISSING_SHARE * period_s)


class IdleFrames:
    """The idle (m, c) frame: the calibration's until the session has its own, and (m, 1) gains over it."""

    def __init__(self, fingertips: FingertipSet, wanted: int) -> None:
        """Begin; the operator guarantees that the first `wanted` usable frames are untouched."""
        self._sides = fingertips.sides
        self.baselines: FloatArray = fingertips.idle.copy()
        self.gains: FloatArray = np.ones((len(self._sides), 1))
        # The score that a grip needs on each side: with a baseline of a few frames only a strong one counts.
        self.least_scores = [-np.inf] * len(self._sides)
        # Whether this session has seen every fingertip idle, and whether frames are averaged into the idle frame.
        self.complete, self.taring = False, wanted > 0
        self._frames: list[deque[FloatArray]] = [deque(maxlen=BASELINE_FRAMES) for _ in self._sides]
        self._followed = False
        self._wanted = wanted
        self._tare_frames: list[FloatArray] = []
        self._least = min(_LEAST_IDLE, wanted or _LEAST_IDLE)

    @property
    def begun(self) -> bool:
        """Whether any frame has been looked at."""
        return self._followed or bool(self._tare_frames)

    def last_tare_frame(self) -> FloatArray | None:
        """Return the last frame of a tare that is not complete."""
        return self._tare_frames[-1] if self._tare_frames and self.taring else None

    def add_to_tare(self, channels: FloatArray) -> str:
        """Take the tare's next frame and return how many there are."""
        self._tare_frames.append(channels)
        n = len(self._tare_frames)
        if n == self._wanted:
            self.baselines, self._followed, self.taring = np.mean(self._tare_frames, axis=0), True, False
            for layer, frames in enumerate(self._frames):
                frames.extend(one[layer] for one in self._tare_frames)
            self._update()
        return f"taking the idle frame, {n} of {self._wanted}"

    def restart_tare(self) -> None:
        """Forget the frames of a tare that is not complete."""
        if self.taring:
            self._tare_frames.clear()

    def idle_sides(self, channels: FloatArray) -> list[int]:
        """Return the sides where a frame without a grip is idle."""
        first, self._followed = not self._followed, True
        found = []
        for layer, one in enumerate(self._sides):
            frames = self._frames[layer]
            # One frame is a poor baseline: accept the first few unless they look clearly gripped.
            learned = len(frames) >= self._least
            limit = 0.5 * one.grip_threshold if learned else max(_OUTRIGHT, one.grip_threshold)
            following = bool(frames) and one.grip_score(channels[layer], self.baselines[layer]) < limit
            if following or (first and one.looks_idle(channels[layer])):
                found.append(layer)
        return found

    def follow(self, layer: int, channels: FloatArray, *, restart: bool) -> None:
        """Average an idle frame of one side, alone if the earlier ones lack some of its channels."""
        if restart:
            self._frames[layer].clear()
        self._frames[layer].append(channels)
        self.baselines[layer] = np.mean(self._frames[layer], axis=0)
        self._update()

    def _update(self) -> None:
        self.complete = all(self._frames)
        self.least_scores = [
            max(_OUTRIGHT, one.grip_threshold) if 0 < len(frames) < self._least else -np.inf
            for one, frames in zip(self._sides, self._frames, strict=True)
        ]
        if self.complete:
            gains = [one.gain(idle) for one, idle in zip(self._sides, self.baselines, strict=True)]
            self.gains = np.array(gains)[:, None]


class GripMemory:
    """The last positions of this grip, some of them interpolated, and its mean (m, c) difference to idle."""

    def __init__(self, motion: Motion, shape: tuple[int, ...]) -> None:
        """Begin without a grip; frames have the shape (m, n)."""
        self._motion = motion
        self.positions: deque[FloatArray] = deque(maxlen=motion.n_lags + 1)
        self._bridged: deque[bool] = deque(maxlen=motion.n_lags + 1)
        self._skipped_in_a_row = 0
        # Features of the last frames' motion.
        self.features: FloatArray = np.zeros(0)
        # Over the last valid frames, and their number.
        self.mean_difference: FloatArray = np.zeros(shape)
        self.held_frames = 0

    def forget(self) -> None:
        """Forget the grip."""
        self.positions.clear()
        self._bridged.clear()
        self._skipped_in_a_row, self.held_frames = 0, 0
        self.mean_difference = np.zeros_like(self.mean_difference)

    def skip(self, missing: int) -> None:
        """Leave a frame out; after too many in a row the last position is too old."""
        self._skipped_in_a_row += 1
        if self._skipped_in_a_row > _LARGEST_BRIDGED:
            self.forget()
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
        if (wanted := self._motion.n_needed - len(self.positions)) > 0:
            return f"gripped too recently: {counted(wanted, 'more frame is', 'more frames are')} needed"
        if sum(self._bridged) > max(_LARGEST_BRIDGED, _LARGEST_BRIDGED_SHARE * (len(self.positions) - 1)):
            return "too many of the last frames were disturbed or are missing"
        self.held_frames = min(self.held_frames + 1, _HELD_FRAMES)
        self.mean_difference = self.mean_difference + (difference - self.mean_difference) / self.held_frames
        self.features = self._motion.features(self.positions, from_idle)
        return ""

    def _repeat_position(self, times: int) -> None:
        """Repeat the last position for missing frames until the next frame allows interpolation."""
        self.positions.extend([self.positions[-1]] * times)
        self._bridged.extend([True] * times)


class SessionState:
    """State of one session of raw frames; every frame goes through `process` in order."""

    def __init__(
        self, validators: tuple[FingertipValidator, ...], motion: Motion, period_s: float = np.inf, idle_frames: int = 0
    ) -> None:
        """Begin a session; the operator guarantees that its first `idle_frames` usable frames are untouched."""
        self._fingertips = FingertipSet(validators)
        self._motion = motion
        self._timer = FrameTimer(period_s)
        self._idle = IdleFrames(self._fingertips, idle_frames)
        self._grips = [GripDetector(one) for one in validators]
        self._memory = GripMemory(motion, self._fingertips.idle.shape)
        self._before: FloatArray | None = None
        self._disturbed: FloatArray | None = None
        self._lost: BoolArray = np.zeros(self._fingertips.idle.shape, dtype=np.bool_)
        # Channels that were unusable when the session began: their idle voltages are unknown.
        self._unknown: BoolArray = self._lost

    @property
    def taring(self) -> bool:
        """Whether frames are being averaged into the idle frame."""
        return self._idle.taring

    def process(self, frame: TactileFrame) -> ProcessedFrame:
        """Take the next frame and return it with the reasons against it."""
        missing = self._timer.missing_before(frame.t_s)
        if missing is None:
            # The last frames do not show how the gel has moved. In a tare, compare with its last frame: a tool may
            # have been gripped or released in the gap.
            self._memory.forget()
            for grip in self._grips:
                grip.forget_steps()
            self._before, self._disturbed, missing = self._idle.last_tare_frame(), None, 0
        channels, usable, reasons, jumping_shares = self._check(frame)
        if any(reasons):
            # One garbled frame is no other fingertip: skip it like a disturbed one.
            self._disturbed = None
            self._memory.skip(missing)
            return ProcessedFrame.refused(usable, *filter(None, reasons))
        if (jumping_shares > LARGEST_JUMPING_SHARE).any():
            self._bridge(channels, missing)
            return ProcessedFrame.refused(usable, self._fingertips.disturbance(jumping_shares))
        is_first = self._before is None
        if is_first and not self._idle.begun:
            self._unknown = ~usable
        self._disturbed, self._before = None, channels
        if self._idle.taring:
            return ProcessedFrame.refused(usable, self._idle.add_to_tare(channels))
        if is_first:
            return ProcessedFrame.refused(usable, "there is no earlier frame to compare with")
        if not self._memory.positions:
            self._update_baseline(channels, frame)
        return self._finish(channels, usable, missing)

    def _check(self, frame: TactileFrame) -> tuple[FloatArray, BoolArray, list[str], FloatArray]:
        """Return the filled channels, the usable ones, each side's reason, and its share of jumping channels.

        There are no shares without an earlier frame.
        """
        usable = mask_unmeasured(frame.channels, frame.usable)
        channels = frame.channels if usable.all() else self._fill(frame.channels, usable)
        reasons, lost = self._fingertips.check(channels, usable)
        # Channels that stay lost are left out; while they are being lost they count as jumping.
        judged = usable & ~((lost & self._lost) | self._unknown)
        shares = np.zeros(0)
        if self._before is not None:
            shares = self._fingertips.jumping_shares(channels, self._before, judged)
        self._lost = lost
        if self._unknown.any() or lost.any():
            usable = usable & ~(lost | self._unknown)
            reasons = reasons if any(reasons) else self._fingertips.too_few_channels(usable)
            channels = self._fill(frame.channels, usable)
        return channels, usable, reasons, shares

    def _fill(self, channels: FloatArray, usable: BoolArray) -> FloatArray:
        """Return the channels with unusable ones moved on from the last frame as the usable ones moved."""
        if self._before is None:
            return np.where(usable, channels, self._fingertips.gripped)
        moved = self._motion.impute(channels - self._before, usable, self._fingertips.sides, from_idle=False)
        return np.where(usable, channels, self._before + moved)

    def _bridge(self, channels: FloatArray, missing: int) -> None:
        """Skip a disturbed frame; if the next one agrees with it, the change is real and the past is void."""
        confirmed = False
        if self._disturbed is not None:
            shares = self._fingertips.jumping_shares(channels, self._disturbed, self._fingertips.alive)
            confirmed = bool((shares <= LARGEST_JUMPING_SHARE).all())
        if confirmed:
            # In a tare, the tool was gripped or released meanwhile.
            self._memory.forget()
            self._disturbed, self._before = None, channels
            self._idle.restart_tare()
        else:
            self._disturbed = channels
            self._memory.skip(missing)

    def _update_baseline(self, channels: FloatArray, frame: TactileFrame) -> None:
        """Follow the idle frame while nothing is gripped; a session that begins gripped keeps the calibration's.

        Channels that were unknown and work again in an idle frame are restored in `channels` (m, c).
        """
        for layer in self._idle.idle_sides(channels):
            back = self._unknown[layer]
            if back.any():
                back = back & (mask_unmeasured(frame.channels, frame.usable) & ~self._lost)[layer]
                channels[layer, back] = frame.channels[layer, back]
                self._unknown[layer] &= ~back
            self._idle.follow(layer, channels[layer], restart=bool(back.any()))

    def _finish(self, channels: FloatArray, usable: BoolArray, missing: int) -> ProcessedFrame:
        idle, from_idle, loose = self._idle, channels - self._idle.baselines, []
        if not usable.all():
            from_idle = self._motion.impute(from_idle, usable, self._fingertips.sides, from_idle=True)
        # At the calibration's gain. It does not change while gripped.
        difference = from_idle / idle.gains
        for layer, (one, grip) in enumerate(zip(self._fingertips.sides, self._grips, strict=True)):
            known = idle.baselines[layer], idle.gains[layer], idle.least_scores[layer]
            if not grip.update(channels[layer], *known):
                loose.append(one.side)
        if loose:
            self._memory.forget()
            reason = f"no grip at the {' and '.join(loose)} fingertip"
            return ProcessedFrame(difference, (reason,), usable, held_frames=0)
        memory = self._memory
        # Motion is read in volts: after a release a gel's idle voltages recover for minutes, which is no gain.
        if reason := memory.remember(channels, from_idle, difference, missing):
            return ProcessedFrame(difference, (reason,), usable)
        return ProcessedFrame(
            difference, (), usable, memory.mean_difference, memory.features, memory.held_frames, self._idle.complete
        )


class PaperState:
    """State of one session of the paper's method: mean of the latest frames minus the idle frame.

    Trehan et al. 2025, section 2, where the idle frame is the homogeneous frame. Without a validator nothing is known
    of the fingertip but its first frames.
    """

    def __init__(self, baseline_frames: int, average_frames: int, max_gap_s: float) -> None:
        """Begin a session with `baseline_frames` untouched frames; a longer gap restarts the average."""
        self._baseline_frames = baseline_frames
        self._max_gap_s = max_gap_s
        self._tare_frames: list[FloatArray] = []
        self._latest: deque[tuple[float, FloatArray]] = deque(maxlen=average_frames)
        # The channels of the last frame; an unusable one keeps its last usable value.
        self._before: FloatArray | None = None
        # Channels that were unusable when the tare began: their idle voltages are unknown.
        self._unknown: BoolArray = np.zeros(0, dtype=np.bool_)

    @property
    def taring(self) -> bool:
        """Whether frames are being averaged into the idle frame."""
        return len(self._tare_frames) < self._baseline_frames

    def process(self, frame: TactileFrame) -> ProcessedFrame:
        """Take the next frame of one side and return it with the reasons against it."""
        usable = frame.usable & (frame.channels != 0.0)
        if self._before is not None:
            usable &= ~self._unknown
        unusable = int(np.count_nonzero(~usable))
        if unusable > _PAPER_UNUSABLE_SHARE * usable.size:
            return ProcessedFrame.refused(
                usable,
                f"{unusable} of {usable.size} channels are saturated or dead; "
                "check the ribbon cable and the gel's contact with the electrodes",
            )
        if self._before is None:
            self._unknown, self._before = ~usable[0], frame.channels[0]
        self._before = channels = np.where(usable[0], frame.channels[0], self._before)
        if self.taring:
            self._tare_frames.append(channels)
            n, wanted = len(self._tare_frames), self._baseline_frames
            return ProcessedFrame.refused(usable, f"taking the idle frame, {n} of {wanted}")
        if self._latest and frame.t_s - self._latest[-1][0] > self._max_gap_s:
            self._latest.clear()
        self._latest.append((frame.t_s, channels))
        mean = np.mean([one for _, one in self._latest], axis=0)
        difference = mean - self._idle_frame
        n = len(self._latest)
        noise = self._noise * math.sqrt(1.0 / n + 1.0 / self._baseline_frames)
        if (reason := signal_above_noise(difference, noise)) is not None:
            return ProcessedFrame.refused(usable, reason)
        lag_s = frame.t_s - sum(t_s for t_s, _ in self._latest) / n
        return ProcessedFrame(difference[None], (), usable, lag_s=lag_s)

    @cached_property
    def _idle_frame(self) -> FloatArray:
        # Deviations from the first frame keep the microvolts that sums of volts would lose.
        first = self._tare_frames[0]
        return np.asarray(first + np.mean(np.array(self._tare_frames) - first, axis=0))

    @cached_property
    def _noise(self) -> FloatArray:
        """Standard deviation of one frame, (c,) in volts, at least the converter's rounding.

        A few frames know the variance of one channel badly: each is drawn towards the mean of all (Smyth 2004).
        """
        freedom = self._baseline_frames - 1
        own = (np.array(self._tare_frames) - self._idle_frame).var(axis=0, ddof=1)
        variance = (freedom * own + _POOLED_FREEDOM * own.mean()) / (freedom + _POOLED_FREEDOM)
        return np.asarray(np.sqrt(np.maximum(variance, LEAST_NOISE_V**2)))


class SliceState:
    """State of slices, which are differences already: none."""

    taring = False

    def process(self, frame: TactileFrame) -> ProcessedFrame:
        """Take the next slice and return its magnitudes."""
        return ProcessedFrame(np.abs(frame.channels), (), frame.usable)
