"""State of one session: the idle frame and the last few seconds.

The state makes two kinds of features. The difference to the idle frame serves estimators without memory. The temporal
features are how far the frame has moved since each of the last frames, in a few directions per fingertip: the gel
creeps for seconds under a held twist, so its speed shows torque that its position does not, and slow drift of the
baseline leaves no trace. Where the gel holds its position, that position is a feature too and shows a long twist.
"""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np

from shearloop.bank.arrays import BoolArray, FloatArray
from shearloop.bank.eit.channels import N_CHANNELS
from shearloop.bank.eit.matching import signal_above_noise
from shearloop.bank.estimation.fingertip_validator import (
    LARGEST_JUMPING_SHARE,
    LEAST_NOISE_V,
    STEP_FRAMES,
    FingertipSet,
    FingertipValidator,
    GripDetector,
    mask_saturated,
)
from shearloop.bank.estimation.values import TactileFrame

# Frames in the mean of the idle baseline.
BASELINE_FRAMES = 10
# Frames (half a minute) in the mean difference of a grip: twists come and go within it.
_HELD_FRAMES = 60
# Longest step between frames while the period is unknown: two frames of 0.54 s are missing.
_LARGEST_GAP_S = 1.4
# The median of this many steps is the period, if the configured one is not shorter. A step longer than the first share
# of the period has one frame missing, a step longer than the second has more.
_STEPS, _MISSING_SHARE, _LARGEST_GAP_SHARE = 9, 1.5, 2.5
# A baseline of fewer frames accepts only grips of at least half the calibrated strength.
_LEAST_IDLE, _OUTRIGHT = 5, 0.5
# Most interpolated frames among those remembered.
_LARGEST_BRIDGED = 3
# The paper's method refuses frames with more unusable channels than this.
_PAPER_UNUSABLE_SHARE = 0.10
# Degrees of freedom of the mean variance of all channels in each channel's own.
_POOLED_FREEDOM = 30


@dataclass(frozen=True, slots=True, eq=False)
class ProcessedFrame:
    """A frame after the session's checks, with the reasons against it.

    difference (m, 896) is to the idle frame. usable (m, 896) excludes channels that the board or the frame itself
    shows to be lost or saturated. lag_s is the lag of an average.
    """

    difference: FloatArray
    reasons: tuple[str, ...]
    usable: BoolArray
    lag_s: float = 0.0

    @classmethod
    def refused(cls, usable: BoolArray, *reasons: str) -> Self:
        """Return a frame with reasons against it, without a difference."""
        return cls(np.zeros(usable.shape), reasons, usable)


@dataclass(frozen=True, slots=True, eq=False)
class TemporalFeatures:
    """Directions (m, p, 896) along which each side's motion is measured, in units of noise, and how far back.

    With uses_position the position relative to the idle frame is a feature too.
    """

    directions: FloatArray
    n_lags: int
    uses_position: bool = False

    @classmethod
    def fit(
        cls, parts: Sequence[FloatArray], validators: tuple[FingertipValidator, ...], n_directions: int, n_lags: int
    ) -> Self:
        """Fit the main directions of motion to each recording's (n, m, 896) gripped frames."""
        directions = []
        for layer, one in enumerate(validators):
            moved = np.vstack([(part[n_lags:, layer] - part[:-n_lags, layer]) / one.noise for part in parts])
            rows = np.linalg.svd(moved, full_matrices=False)[2][:n_directions] / one.noise
            directions.append(rows * np.sign(rows.sum(axis=1, keepdims=True)))
        return cls(np.array(directions), n_lags)

    def project(self, channels: FloatArray) -> FloatArray:
        """Return the (…, m·p) positions of (…, m, 896) frames along the directions."""
        found = np.einsum("...mc,mpc->...mp", channels, self.directions)
        return np.asarray(found.reshape(*found.shape[:-2], -1))

    def complete(self, difference: FloatArray, usable: BoolArray, sides: Sequence[FingertipValidator]) -> FloatArray:
        """Return a (m, 896) difference to the idle frame with unusable channels imputed along motion and grip."""
        if usable.all():
            return difference
        imputed = [
            self.impute(layer, difference[layer], usable[layer], one.noise, one.gripped - one.idle)
            for layer, one in enumerate(sides)
        ]
        return np.where(usable, difference, imputed)

    def impute(
        self, layer: int, moved: FloatArray, usable: BoolArray, noise: FloatArray, *grip: FloatArray
    ) -> FloatArray:
        """Return the motion of all (896,) channels of a side, from the usable ones.

        It is along the directions and along the (896,) grip, if given.
        """
        alive = np.isfinite(noise)
        modes = np.vstack([self.directions[layer] * np.where(alive, noise, 0.0) ** 2, *grip])
        weights = np.where(usable & alive, 1.0 / noise, 0.0)
        found = np.linalg.lstsq((modes * weights).T, moved * weights, rcond=None)[0]
        return np.asarray(found @ modes)

    def features(self, positions: Sequence[FloatArray], from_idle: FloatArray) -> FloatArray:
        """Return n_lags · m·p features of motion, nearest lag first, and m·p of position where it is used.

        positions are the last n_lags + 1 (m·p,) positions; from_idle (m·p,) is the newest one relative to idle.
        """
        rows = np.array(positions)
        moved = (rows[-1] - rows[-2::-1]).ravel()
        return np.concatenate([moved, from_idle]) if self.uses_position else moved


class _NoMotion(TemporalFeatures):
    """No motion: for estimators that read each frame alone."""

    def project(self, channels: FloatArray) -> FloatArray:
        """Return no position."""
        return np.zeros((*channels.shape[:-2], 0))

    def complete(self, difference: FloatArray, _usable: BoolArray, _sides: Sequence[FingertipValidator]) -> FloatArray:
        """Return the difference: the estimator imputes channels."""
        return difference

    def impute(self, _layer: int, moved: FloatArray, *_: object) -> FloatArray:
        """Return no motion."""
        return np.zeros_like(moved)


NO_MOTION = _NoMotion(np.zeros((0, 0, N_CHANNELS)), 0)


class SessionState:
    """State of one session of raw frames; every frame goes through `process` in order."""

    curves_only, refuses_repeats = False, True

    def __init__(
        self,
        validators: tuple[FingertipValidator, ...],
        motion: TemporalFeatures = NO_MOTION,
        period_s: float = np.inf,
        idle_frames: int = 0,
    ) -> None:
        """Begin a session; the operator guarantees that its first `idle_frames` usable frames are untouched."""
        self._fingertips = FingertipSet(validators)
        # A board that drops half of its frames does not show its period, so the configured one is a bound.
        self._period_s = period_s
        self._motion = motion
        n_lags = motion.n_lags
        # Positions of the last frames along the directions, and which of them are interpolated.
        self._positions: deque[FloatArray] = deque(maxlen=n_lags + 1)
        self._bridged: deque[bool] = deque(maxlen=n_lags + 1)
        self._from_idle: FloatArray = np.zeros(0)
        self._skipped_in_a_row = 0
        self._idle: list[deque[FloatArray]] = [deque(maxlen=BASELINE_FRAMES) for _ in validators]
        # The calibration's idle frame until the session has its own, and (m, 1) gains of the session's over it.
        self._baselines = self._fingertips.idle.copy()
        self._gains: FloatArray = np.ones((len(validators), 1))
        # Mean (m, 896) difference to the idle frame over this grip's last valid frames, and their number.
        self.mean_difference: FloatArray = np.zeros_like(self._baselines)
        self.held_frames = 0
        self._begun = False
        self._before: FloatArray | None = None
        self._disturbed: FloatArray | None = None
        self._t_s = -np.inf
        self._steps_s: deque[float] = deque(maxlen=_STEPS)
        self._frame_missing = False
        self._passed: deque[FloatArray] = deque(maxlen=STEP_FRAMES + 1)
        self._released = [False for _ in validators]
        self._grips = [GripDetector(one.grip_threshold) for one in validators]
        self._lost: BoolArray = np.zeros((len(validators), N_CHANNELS), dtype=np.bool_)
        # Channels that were unusable when the session began: their idle voltages are unknown.
        self._unknown: BoolArray = self._lost
        self._idle_wanted = idle_frames
        self._tare_frames: list[FloatArray] = []
        self._least_idle = min(_LEAST_IDLE, idle_frames or _LEAST_IDLE)

    @property
    def taring(self) -> bool:
        """Whether frames are being averaged into the idle frame."""
        return len(self._tare_frames) < self._idle_wanted

    @property
    def has_baseline(self) -> bool:
        """Whether this session has seen every fingertip idle."""
        return all(self._idle)

    @property
    def motion(self) -> FloatArray:
        """Features of the last frames' motion."""
        return self._motion.features(self._positions, self._from_idle)

    def process(self, frame: TactileFrame) -> ProcessedFrame:
        """Take the next frame and return it with the reasons against it."""
        self._advance_time(frame.t_s)
        channels, usable, reasons, jumping_shares = self._check(frame)
        if any(reasons):
            # One garbled frame is no other fingertip: skip it like a disturbed one.
            self._disturbed = None
            self._skip()
            return ProcessedFrame.refused(usable, *filter(None, reasons))
        if jumping_shares and (disturbance := self._fingertips.disturbance(jumping_shares)):
            return self._bridge(channels, disturbance, usable)
        if self._before is None and not self._begun and not self._tare_frames:
            self._unknown = ~usable
        if self.taring:
            return self._add_to_tare(channels, usable)
        if self._before is None:
            self._before = channels
            return ProcessedFrame.refused(usable, "there is no earlier frame to compare with")
        self._disturbed, self._before, self._skipped_in_a_row = None, channels, 0
        self._update_baseline(channels, frame)
        self._detect_release(channels)
        return self._finish(channels, usable)

    def _check(self, frame: TactileFrame) -> tuple[FloatArray, BoolArray, list[str], list[float]]:
        """Return the filled channels, the usable ones, each side's reason, and its share of jumping channels.

        There are no shares without an earlier frame.
        """
        usable = mask_saturated(frame.channels, frame.usable)
        channels = self._fill(frame.channels, usable)
        reasons, lost = self._fingertips.check(channels, usable)
        # Channels that stay lost are left out; while they are being lost they count as jumping.
        judged = usable & ~((lost & self._lost) | self._unknown)
        shares = self._fingertips.jumping_shares(channels, self._before, judged) if self._before is not None else []
        self._lost = lost
        if self._unknown.any() or lost.any():
            usable = usable & ~(lost | self._unknown)
            reasons = reasons if any(reasons) else self._fingertips.too_few_channels(usable)
            channels = self._fill(frame.channels, usable)
        return channels, usable, reasons, shares

    def _advance_time(self, t_s: float) -> None:
        step_s, self._t_s, self._frame_missing = t_s - self._t_s, t_s, False
        learned_s = sorted(self._steps_s)[_STEPS // 2] if len(self._steps_s) == _STEPS else np.inf
        period_s = min(learned_s, self._period_s)
        if 0 < step_s <= _LARGEST_GAP_S:
            self._steps_s.append(step_s)
        if not 0 < step_s <= min(_LARGEST_GAP_S, _LARGEST_GAP_SHARE * period_s):
            # After a gap the last frames do not show how the gel has moved.
            self._forget_grip()
            self._before = self._disturbed = None
            self._passed.clear()
            if self._tare_frames and self.taring:
                # Compare with the tare's last frame: a tool may have been gripped or released in the gap.
                self._before = self._tare_frames[-1]
            return
        self._frame_missing = step_s > _MISSING_SHARE * period_s

    def _remember(self, position: FloatArray) -> None:
        """Append a position; interpolate the skipped or missing ones before it."""
        if self._frame_missing and self._positions:
            self._repeat_position()
        between = 0
        while between < len(self._bridged) and self._bridged[-1 - between]:
            between += 1
        if 0 < between < len(self._positions):
            begin = self._positions[-1 - between]
            for i in range(1, between + 1):
                self._positions[i - 1 - between] = begin + i / (between + 1) * (position - begin)
        self._positions.append(position)
        self._bridged.append(False)

    def _repeat_position(self) -> None:
        """Repeat the last position for a missing frame until the next frame allows interpolation."""
        self._positions.append(self._positions[-1])
        self._bridged.append(True)

    def _skip(self) -> None:
        """Leave a frame out; after too many in a row the last position is too old."""
        self._skipped_in_a_row += 1
        if self._skipped_in_a_row > _LARGEST_BRIDGED:
            self._forget_grip()
        elif self._positions:
            for _ in range(1 + self._frame_missing):
                self._repeat_position()

    def _add_to_tare(self, channels: FloatArray, usable: BoolArray) -> ProcessedFrame:
        self._disturbed, self._before = None, channels
        self._tare_frames.append(channels)
        n, wanted = len(self._tare_frames), self._idle_wanted
        if n == wanted:
            self._baselines, self._begun = np.mean(self._tare_frames, axis=0), True
            for layer, idle in enumerate(self._idle):
                idle.extend(one[layer] for one in self._tare_frames)
            self._update_gains()
        return ProcessedFrame.refused(usable, f"taking the homogeneous frame, {n} of {wanted}")

    def _difference(self, channels: FloatArray, usable: BoolArray) -> FloatArray:
        """Return the (m, 896) difference to the idle frame, unusable channels imputed."""
        return self._motion.complete(channels - self._baselines, usable, self._fingertips.sides)

    def _finish(self, channels: FloatArray, usable: BoolArray) -> ProcessedFrame:
        # At the calibration's gain. It does not change while gripped.
        difference = self._difference(channels, usable) / self._gains
        loose, reason = [], ""
        for layer, one in enumerate(self._fingertips.sides):
            gripped = self._is_gripped(layer, one.grip_score(channels[layer], self._baselines[layer]))
            if self._released[layer] or not gripped:
                loose.append(one.side)
        if loose:
            self._forget_grip()
            reason = f"no grip at the {' and '.join(loose)} fingertip"
        else:
            position, self._from_idle = self._motion.project(np.array([channels / self._gains, difference]))
            self._remember(position)
            if missing := (self._positions.maxlen or 0) - len(self._positions):
                reason = f"gripped too recently: {missing} more frames are needed"
            elif sum(self._bridged) > _LARGEST_BRIDGED:
                reason = "too many of the last frames were disturbed or are missing"
        if reason:
            return ProcessedFrame(difference, (reason,), usable)
        self.held_frames = min(self.held_frames + 1, _HELD_FRAMES)
        self.mean_difference = self.mean_difference + (difference - self.mean_difference) / self.held_frames
        return ProcessedFrame(difference, (), usable)

    def _is_gripped(self, layer: int, score: float) -> bool:
        """Return whether a fingertip is gripped; with a baseline of a few frames only a strong grip counts."""
        grip = self._grips[layer]
        learning = 0 < len(self._idle[layer]) < self._least_idle and not grip.gripped
        strong = max(_OUTRIGHT, self._fingertips.sides[layer].grip_threshold)
        return grip.update(score) if not learning or score > strong else False

    def _detect_release(self, channels: FloatArray) -> None:
        self._passed.append(channels)
        if len(self._passed) <= STEP_FRAMES:
            return
        for layer, one in enumerate(self._fingertips.sides):
            if max(one.step_limit, one.fall_limit) == math.inf:
                continue
            now, then, idle = (
                each[layer] / self._gains[layer] for each in (channels, self._passed[0], self._baselines)
            )
            released = one.released(now, then, idle)
            if released is not None:
                self._released[layer] = released

    def _bridge(self, channels: FloatArray, disturbance: str, usable: BoolArray) -> ProcessedFrame:
        """Skip a disturbed frame; if the next one agrees with it, the change is real and the past is void."""
        confirmed = self._disturbed is not None and all(
            share <= LARGEST_JUMPING_SHARE
            for share in self._fingertips.jumping_shares(channels, self._disturbed, self._fingertips.alive)
        )
        if confirmed:
            self._forget_grip()
            self._disturbed, self._before = None, channels
            if self.taring:
                # The tool was gripped or released meanwhile: start the tare again.
                self._tare_frames.clear()
        else:
            self._disturbed = channels
            self._skip()
        return ProcessedFrame.refused(usable, disturbance)

    def _fill(self, channels: FloatArray, usable: BoolArray) -> FloatArray:
        """Return the channels with unusable ones moved on from the last frame as the usable ones moved."""
        if usable.all():
            return channels
        if self._before is None:
            return np.where(usable, channels, self._fingertips.gripped)
        moved = channels - self._before
        assumed = [
            self._motion.impute(layer, moved[layer], usable[layer], one.noise)
            for layer, one in enumerate(self._fingertips.sides)
        ]
        return np.where(usable, channels, self._before + assumed)

    def _update_baseline(self, channels: FloatArray, frame: TactileFrame) -> None:
        """Follow the idle frame while nothing is gripped; a session that begins gripped keeps the calibration's.

        Channels that were unknown and work again in an idle frame are restored in `channels` (m, 896).
        """
        first, self._begun = not self._begun, True
        if self._positions:
            return
        for layer, one in enumerate(self._fingertips.sides):
            idle = self._idle[layer]
            begun = first and one.looks_idle(channels[layer])
            # One frame is a poor baseline: accept the first few unless they look clearly gripped.
            learned = len(idle) >= self._least_idle
            limit = 0.5 * one.grip_threshold if learned else max(_OUTRIGHT, one.grip_threshold)
            following = bool(idle) and one.grip_score(channels[layer], self._baselines[layer]) < limit
            if begun or following:
                self._restore_channels(layer, channels, frame)
                idle.append(channels[layer])
                self._baselines[layer] = np.mean(idle, axis=0)
                self._update_gains()

    def _restore_channels(self, layer: int, channels: FloatArray, frame: TactileFrame) -> None:
        if not self._unknown[layer].any():
            return
        working = mask_saturated(frame.channels, frame.usable) & ~self._lost
        back = self._unknown[layer] & working[layer]
        if back.any():
            # Earlier idle frames lack these channels.
            self._idle[layer].clear()
            channels[layer, back] = frame.channels[layer, back]
            self._unknown[layer] &= ~back

    def _update_gains(self) -> None:
        if self.has_baseline:
            gains = [one.gain(idle) for one, idle in zip(self._fingertips.sides, self._baselines, strict=True)]
            self._gains = np.array(gains)[:, None]

    def _forget_grip(self) -> None:
        self._positions.clear()
        self._bridged.clear()
        self.mean_difference, self.held_frames = np.zeros_like(self._baselines), 0


class PaperState:
    """State of one session of the paper's method: mean of the latest frames minus the homogeneous frame.

    Trehan et al. 2025, section 2. Without a validator nothing is known of the fingertip but its first frames.
    """

    curves_only, refuses_repeats, has_baseline = True, False, True
    held_frames = 1
    motion: FloatArray = np.zeros(0)

    def __init__(self, baseline_frames: int, average_frames: int, max_gap_s: float) -> None:
        """Begin a session with `baseline_frames` untouched frames; a longer gap restarts the average."""
        self._baseline_frames = baseline_frames
        self._max_gap_s = max_gap_s
        self._tare_frames: list[FloatArray] = []
        self._latest: deque[tuple[float, FloatArray]] = deque(maxlen=average_frames)
        self.mean_difference: FloatArray = np.zeros((1, N_CHANNELS))

    @property
    def taring(self) -> bool:
        """Whether frames are being averaged into the homogeneous frame."""
        return len(self._tare_frames) < self._baseline_frames

    def process(self, frame: TactileFrame) -> ProcessedFrame:
        """Take the next frame of one side and return it with the reasons against it."""
        channels = frame.channels
        unusable = int(np.count_nonzero(~frame.usable))
        if unusable > _PAPER_UNUSABLE_SHARE * channels.size:
            return ProcessedFrame.refused(
                frame.usable,
                f"{unusable} of {channels.size} channels are saturated or dead; "
                "check the ribbon cable and the gel's contact with the electrodes",
            )
        if self.taring:
            self._tare_frames.append(channels[0])
            n, wanted = len(self._tare_frames), self._baseline_frames
            return ProcessedFrame.refused(frame.usable, f"taking the homogeneous frame, {n} of {wanted}")
        if self._latest and frame.t_s - self._latest[-1][0] > self._max_gap_s:
            self._latest.clear()
        self._latest.append((frame.t_s, channels[0]))
        mean = np.mean([one for _, one in self._latest], axis=0)
        difference = mean - self._homogeneous
        n = len(self._latest)
        noise = self._noise * math.sqrt(1.0 / n + 1.0 / self._baseline_frames)
        if (reason := signal_above_noise(difference, noise)) is not None:
            return ProcessedFrame.refused(frame.usable, reason)
        lag_s = frame.t_s - sum(t_s for t_s, _ in self._latest) / n
        return ProcessedFrame(difference[None], (), frame.usable, lag_s)

    @cached_property
    def _homogeneous(self) -> FloatArray:
        # Deviations from the first frame keep the microvolts that sums of volts would lose.
        first = self._tare_frames[0]
        return np.asarray(first + np.mean(np.array(self._tare_frames) - first, axis=0))

    @cached_property
    def _noise(self) -> FloatArray:
        """Standard deviation of one frame, (896,) in volts, at least the converter's rounding.

        A few frames know the variance of one channel badly: each is drawn towards the mean of all (Smyth 2004).
        """
        freedom = self._baseline_frames - 1
        own = (np.array(self._tare_frames) - self._homogeneous).var(axis=0, ddof=1)
        variance = (freedom * own + _POOLED_FREEDOM * own.mean()) / (freedom + _POOLED_FREEDOM)
        return np.asarray(np.sqrt(np.maximum(variance, LEAST_NOISE_V**2)))


class SliceState:
    """State of slices, which are differences already: nothing but the last one."""

    curves_only, refuses_repeats, has_baseline, taring = False, False, True, False
    held_frames = 1
    motion: FloatArray = np.zeros(0)
    mean_difference: FloatArray = np.zeros((1, N_CHANNELS))

    def process(self, frame: TactileFrame) -> ProcessedFrame:
        """Take the next slice and return its magnitudes."""
        self.mean_difference = np.abs(frame.channels)
        return ProcessedFrame(self.mean_difference, (), frame.usable)
