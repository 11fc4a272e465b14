"""What an estimator of raw frames remembers, and nothing more: the idle frame, and the last few seconds.

Two kinds of feature are made from it. `difference` is to the idle frame, for what has no memory. `motion` is how far
the frame has moved, in a few directions per fingertip, since each of the last frames: the gel creeps under a held
twist for seconds, so how fast it moves tells of the torque what its place does not, and a slow drift of the baseline
leaves no trace in it. Where the gel holds its place, `placed` adds that place to the motion: what a twist that is held
for long is told by.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from shearloop.bank.arrays import BoolArray, FloatArray
from shearloop.bank.eit.channels import N_CHANNELS
from shearloop.bank.estimation.fingertip_validator import (
    LARGEST_JUMPING_SHARE,
    STEP_FRAMES,
    FingertipValidator,
    unsaturated,
)
from shearloop.bank.estimation.grip import Grip
from shearloop.bank.estimation.temporal_features import TemporalFeatures
from shearloop.bank.estimation.validity import Guards
from shearloop.bank.estimation.values import TactileFrame, everywhere

# Frames that an idle baseline is averaged over at the most recent end.
BASELINE_FRAMES = 10
# Frames, half a minute of them, that the mean place of a grip reaches back over: twists come and go within it, and the
# gel's creep does not add up.
_HELD_FRAMES = 60
# Frames further apart than this have lost the thread, as long as the period is not known: two of 0.54 s are missing.
_LARGEST_GAP_S = 1.4
# Of so many steps in time the middle one is the period, if that is not known to be shorter; a step longer than the
# first share of it has one frame missing, and longer than the second more than one.
_STEPS, _MISSING_SHARE, _LARGEST_GAP_SHARE = 9, 1.5, 2.5
# A session's baseline is made of at least so many frames before a grip is looked for that is not half as strong as the
# calibration's.
_LEAST_IDLE, _OUTRIGHT = 5, 0.5
# Bridged frames among those remembered: more, and the memory is made up.
_LARGEST_BRIDGED = 3


@dataclass(frozen=True, slots=True, eq=False)
class ProcessedFrame:
    """A frame that passed: channels (m, 896) with unusable ones filled in, differences to the idle frame, reasons.

    usable (m, 896) leaves out what the frame itself shows to be lost or saturated, beside what the board told.
    """

    channels: FloatArray
    difference: FloatArray
    why: tuple[str, ...]
    usable: BoolArray


class _Placed(NamedTuple):
    """Where a frame lies: the score of each side's grip, and the (m, 896) difference to the idle frame.

    At the calibration's gain, as are the (m·p,) places of the frame and of its difference along the directions.
    """

    grips: list[float]
    difference: FloatArray
    place: FloatArray
    from_idle: FloatArray


class SessionState:
    """The state of one session; every frame goes through `see` in order."""

    def __init__(
        self,
        guards: tuple[FingertipValidator, ...],
        motion: TemporalFeatures | None,
        period_s: float = np.inf,
        idle_frames: int = 0,
    ) -> None:
        """Begin a session; its first `idle_frames` usable frames are, on somebody's word, of untouched fingertips."""
        self._guards = Guards(guards)
        # The board's, where it is known beforehand: of one that leaves out half of its frames it cannot be learned.
        self._period_s = period_s
        self._motion = motion
        n_lags = motion.n_lags if motion is not None else 0
        # Where the last frames were along the directions, and the last of these frames.
        self._recent: deque[FloatArray] = deque(maxlen=n_lags + 1)
        self._bridged: deque[bool] = deque(maxlen=n_lags + 1)
        # Where the last of them is from idle.
        self._from_idle: FloatArray = np.zeros(0)
        # How many frames in a row were left out until now.
        self._left_out = 0
        self._idle: list[deque[FloatArray]] = [deque(maxlen=BASELINE_FRAMES) for _ in guards]
        # The calibration's, until the session has its own.
        self._baselines = self._guards.idle.copy()
        # (m, 1) of each fingertip's idle frame of this session against the calibration's.
        self._gains: FloatArray = np.ones((len(guards), 1))
        # The mean difference to the idle frame since the grip, and of how many frames.
        self._held: FloatArray = np.zeros_like(self._baselines)
        self._n_held = 0
        self._begun = False
        self._before: FloatArray | None = None
        self._refused: FloatArray | None = None
        self._t_s = -np.inf
        self._steps_s: deque[float] = deque(maxlen=_STEPS)
        # Whether a frame is missing between the last two.
        self._missing = False
        self._passed: deque[FloatArray] = deque(maxlen=STEP_FRAMES + 1)
        self._let_go = [False for _ in guards]
        self._grips = [Grip(guard.grip_threshold) for guard in guards]
        self._lost: BoolArray = np.zeros((len(guards), N_CHANNELS), dtype=np.bool_)
        # Channels that the session began without: their idle voltages are not known.
        self._unknown: BoolArray = self._lost
        self._some_unknown = False
        # Frames that are to be taken for idle ones, and those taken.
        self._idle_wanted = idle_frames
        self._idle_taken: list[FloatArray] = []
        self._least_idle = min(_LEAST_IDLE, idle_frames or _LEAST_IDLE)

    @property
    def taking_idle(self) -> bool:
        """Whether frames are being taken for idle ones."""
        return len(self._idle_taken) < self._idle_wanted

    @property
    def own_baseline(self) -> bool:
        """Whether every fingertip was seen idle in this session, so that the difference is this session's."""
        return all(self._idle)

    @property
    def moved(self) -> FloatArray | None:
        """The features of the last frames' motion, None while these are not complete, or no motion is read."""
        if self._motion is None or len(self._recent) < self._motion.n_lags + 1:
            return None
        return self._motion.features(self._recent, self._from_idle)

    @property
    def held(self) -> FloatArray:
        """The (m, 896) mean difference to the idle frame of this grip's last frames that nothing spoke against.

        It goes on changing, in its place. What does not change while a tool is held is read from it: a single frame
        has several times the noise.
        """
        return self._held

    @property
    def held_frames(self) -> int:
        """Of how many frames `held` is the mean."""
        return self._n_held

    def see(self, frame: TactileFrame) -> ProcessedFrame:
        """Take a frame in and return what it looks like with what speaks against it."""
        self._pass_time(frame.t_s)
        channels, usable, why, jumping_shares = self._looked_at(frame)
        disturbed = self._disturbed(jumping_shares)
        if any(why):
            # One garbled frame is no other fingertip: it is left out like one that is disturbed.
            self._refused = None
            self._leave_out()
            return ProcessedFrame(channels, np.zeros_like(channels), tuple(filter(None, why)), usable)
        if disturbed:
            return self._bridge(channels, disturbed, usable)
        if self._before is None and not self._begun and not self._idle_taken:
            self._unknown = ~usable
            self._some_unknown = not everywhere(usable)
        if self.taking_idle:
            return self._taken_for_idle(channels, usable)
        if self._before is None:
            self._before = channels
            return ProcessedFrame(
                channels, np.zeros_like(channels), ("there is no frame before to compare with",), usable
            )
        self._refused, self._before, self._left_out = None, channels, 0
        self._learn_baseline(channels, frame)
        self._notice_release(channels)
        return self._judged(channels, usable)

    def _looked_at(self, frame: TactileFrame) -> tuple[FloatArray, BoolArray, Sequence[str], Sequence[float]]:
        """Return the channels, which are usable, why a side says nothing, and which share of each side's jumps.

        Without a frame before there are no shares.
        """
        usable = unsaturated(frame.channels, frame.usable)
        channels = self._filled(frame.channels, usable)
        why, lost = self._guards.seen(channels, usable)
        # Channels that are lost for longer are left out; while they are being lost they count as jumping.
        judged = usable & ~((lost & self._lost) | self._unknown)
        shares = self._guards.jumping_shares(channels, self._before, judged) if self._before is not None else ()
        self._lost = lost
        if self._some_unknown or np.count_nonzero(lost):
            usable = usable & ~(lost | self._unknown)
            why = why if any(why) else self._guards.too_few(usable)
            channels = self._filled(frame.channels, usable)
        return channels, usable, why, shares

    def _pass_time(self, t_s: float) -> None:
        step_s, self._t_s, self._missing = t_s - self._t_s, t_s, False
        learned_s = sorted(self._steps_s)[_STEPS // 2] if len(self._steps_s) == _STEPS else np.inf
        period_s = min(learned_s, self._period_s)
        if 0 < step_s <= _LARGEST_GAP_S:
            self._steps_s.append(step_s)
        if not 0 < step_s <= min(_LARGEST_GAP_S, _LARGEST_GAP_SHARE * period_s):
            # A frame from before the last one says nothing of how the gel has moved since that.
            self._forget()
            if self._idle_taken and self.taking_idle:
                # A tool that was let go or gripped in the gap shows against the zero's last frame.
                self._before = self._idle_taken[-1]
            return
        self._missing = step_s > _MISSING_SHARE * period_s

    def _remember(self, place: FloatArray) -> None:
        """Add a place to the last ones; those that were left out or are missing before it lie on the way to it."""
        if self._missing and self._recent:
            self._stand_in()
        between = 0
        while between < len(self._bridged) and self._bridged[-1 - between]:
            between += 1
        if 0 < between < len(self._recent):
            # Left where the gel was, they would say that it has moved in one step as far as in all of these.
            begin = self._recent[-1 - between]
            for i in range(1, between + 1):
                self._recent[i - 1 - between] = begin + i / (between + 1) * (place - begin)
        self._recent.append(place)
        self._bridged.append(False)

    def _stand_in(self) -> None:
        """Put the last frame in the place of one that is not there, until the next one tells where that was."""
        self._recent.append(self._recent[-1])
        self._bridged.append(True)

    def _leave_out(self) -> None:
        """Put the last frame that passed in the place of one that did not; after too many in a row it is too old."""
        self._left_out += 1
        if self._left_out > _LARGEST_BRIDGED:
            self._forget_grip()
        elif self._recent:
            for _ in range(1 + self._missing):
                self._stand_in()

    def _placed(self, channels: FloatArray, usable: BoolArray) -> _Placed:
        """Return where a frame lies at the calibration's gain, which does not change while it is gripped."""
        grips, difference = self._guards.grips(channels, self._baselines), self._difference(channels, usable)
        at_gain = np.array([channels, difference]) / self._gains
        places = self._motion.places(at_gain) if self._motion is not None else np.zeros((2, 0))
        return _Placed(grips, at_gain[1], *places)

    def _taken_for_idle(self, channels: FloatArray, usable: BoolArray) -> ProcessedFrame:
        self._refused, self._before = None, channels
        self._idle_taken.append(channels)
        taken, wanted = len(self._idle_taken), self._idle_wanted
        if taken == wanted:
            self._baselines, self._begun = np.mean(self._idle_taken, axis=0), True
            for layer, idle in enumerate(self._idle):
                idle.extend(one[layer] for one in self._idle_taken)
            self._take_gains()
        return ProcessedFrame(
            channels, np.zeros_like(channels), (f"taking the homogeneous frame, {taken} of {wanted}",), usable
        )

    def _difference(self, channels: FloatArray, usable: BoolArray) -> FloatArray:
        """Return the (m, 896) difference to the idle frame; what is not usable goes by what is."""
        difference = channels - self._baselines
        if self._motion is not None and not everywhere(usable):
            for layer, guard in enumerate(self._guards.sides):
                said = self._motion.gripped_step(layer, difference[layer], usable[layer], guard)
                difference[layer] = np.where(usable[layer], difference[layer], said)
        return difference

    def _judged(self, channels: FloatArray, usable: BoolArray) -> ProcessedFrame:
        grips, difference, place, from_idle = self._placed(channels, usable)
        held = [self._holds(layer, score) for layer, score in enumerate(grips)]
        loose = [one.side for layer, one in enumerate(self._guards.sides) if self._let_go[layer] or not held[layer]]
        if loose:
            self._forget_grip()
            return ProcessedFrame(channels, difference, (f"no grip at the {' and '.join(loose)} fingertip",), usable)
        self._remember(place)
        self._from_idle = from_idle
        missing = (self._recent.maxlen or 0) - len(self._recent)
        if missing:
            return ProcessedFrame(
                channels, difference, (f"gripped too lately: {missing} more frames are needed",), usable
            )
        if sum(self._bridged) > _LARGEST_BRIDGED:
            return ProcessedFrame(
                channels, difference, ("too many of the last frames were disturbed, or are missing",), usable
            )
        self._hold(difference)
        return ProcessedFrame(channels, difference, (), usable)

    def _hold(self, difference: FloatArray) -> None:
        self._n_held = min(self._n_held + 1, _HELD_FRAMES)
        if self._n_held == 1:
            self._held = difference.copy()
        else:
            self._held += (difference - self._held) / self._n_held

    def _holds(self, layer: int, score: float) -> bool:
        """Return whether a fingertip is gripped; with a baseline of a few frames only an outright grip is one."""
        guard, grip = self._guards.sides[layer], self._grips[layer]
        learning = 0 < len(self._idle[layer]) < self._least_idle and not grip.held
        return grip.see(score) if not learning or score > max(_OUTRIGHT, guard.grip_threshold) else False

    def _notice_release(self, channels: FloatArray) -> None:
        self._passed.append(channels)
        if len(self._passed) <= STEP_FRAMES:
            return
        for layer in self._guards.stepping:
            now, then, idle = (one[layer] / self._gains[layer] for one in (channels, self._passed[0], self._baselines))
            released = self._guards.sides[layer].released(now, then, idle)
            if released is not None:
                self._let_go[layer] = released

    def _bridge(self, channels: FloatArray, disturbed: str, usable: BoolArray) -> ProcessedFrame:
        """Leave a disturbed frame out; when the next one agrees with it, the change is real and the past is not."""
        if self._refused is not None and all(
            share <= LARGEST_JUMPING_SHARE
            for share in self._guards.jumping_shares(channels, self._refused, self._guards.alive)
        ):
            self._forget_grip()
            self._refused, self._before = None, channels
            if self.taking_idle:
                # A tool was let go or gripped meanwhile: the mean of before and after is neither.
                self._idle_taken.clear()
        else:
            self._refused = channels
            self._leave_out()
        return ProcessedFrame(channels, np.zeros_like(channels), (disturbed,), usable)

    def _disturbed(self, jumping_shares: Sequence[float]) -> str | None:
        if not jumping_shares:
            # There is no frame before to jump from.
            return None
        for guard, share in zip(self._guards.sides, jumping_shares, strict=True):
            if share > LARGEST_JUMPING_SHARE:
                return (
                    f"{guard.side} fingertip: {100 * share:.0f} % of the channels jumped since the frame before; "
                    "the tool was gripped, released or knocked, or the board is disturbed"
                )
        return None

    def _filled(self, channels: FloatArray, usable: BoolArray) -> FloatArray:
        """Return the channels with unusable ones moved on from where they were as the usable ones say."""
        if everywhere(usable):
            return channels
        if self._before is None:
            return np.where(usable, channels, self._guards.gripped)
        assumed = self._before.copy()
        if self._motion is not None:
            for layer, guard in enumerate(self._guards.sides):
                moved = channels[layer] - self._before[layer]
                assumed[layer] += self._motion.step(layer, moved, usable[layer], guard.noise)
        return np.where(usable, channels, assumed)

    def _learn_baseline(self, channels: FloatArray, frame: TactileFrame) -> None:
        """Follow the idle frame while nothing is gripped; a session that begins gripped has the calibration's.

        Channels that were unknown and have come back in an idle frame are taken up into (m, 896) channels with it.
        """
        first, self._begun = not self._begun, True
        if self._recent:
            return
        for layer, guard in enumerate(self._guards.sides):
            idle = self._idle[layer]
            begun = first and guard.idle_like(channels[layer])
            # One frame is a poor baseline: the first few are taken unless they look gripped outright.
            learned = len(idle) >= self._least_idle
            limit = 0.5 * guard.grip_threshold if learned else max(_OUTRIGHT, guard.grip_threshold)
            following = bool(idle) and guard.grip(channels[layer], self._baselines[layer]) < limit
            if begun or following:
                if self._some_unknown:
                    self._take_up(layer, channels, frame)
                idle.append(channels[layer])
                self._baselines[layer] = np.mean(idle, axis=0)
                self._take_gains()

    def _take_up(self, layer: int, channels: FloatArray, frame: TactileFrame) -> None:
        alive = unsaturated(frame.channels, frame.usable) & ~self._lost
        back = self._unknown[layer] & alive[layer]
        if np.count_nonzero(back):
            # Idle frames before this one had none of them.
            self._idle[layer].clear()
            channels[layer, back] = frame.channels[layer, back]
            self._unknown[layer] &= ~back
            self._some_unknown = bool(np.count_nonzero(self._unknown))

    def _take_gains(self) -> None:
        if self.own_baseline:
            gains = [guard.gain(idle) for guard, idle in zip(self._guards.sides, self._baselines, strict=True)]
            self._gains = np.array(gains)[:, None]

    def _forget_grip(self) -> None:
        self._recent.clear()
        self._bridged.clear()
        self._n_held = 0

    def _forget(self) -> None:
        self._forget_grip()
        self._before = self._refused = None
        self._passed.clear()
