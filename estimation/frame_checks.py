"""Checks of a frame against the frames before it: times, channels that are lost, and disturbances."""

from collections import deque
from dataclasses import dataclass

import numpy as np

from shearloop.bank.arrays import BoolArray, FloatArray
from shearloop.estimation.fingertip_validator import FingertipSet, mask_unmeasured
from shearloop.estimation.grip_memory import Motion
from shearloop.estimation.values import TactileFrame

# Longest step between frames while the period is unknown: two frames of 0.54 s are missing.
_LARGEST_GAP_S = 1.4
# The median of this many steps is the period, if the configured one is not shorter. A step longer than the first number
# of periods has one frame missing, a step longer than the second has more.
_STEPS, _MISSING_PERIODS, _LARGEST_GAP_PERIODS = 9, 1.5, 2.5


class FrameTimer:
    """Finds gaps and missing frames by the frames' times."""

    def __init__(self, period_s: float) -> None:
        """Begin with the board's period: one that drops half of its frames does not show it, so it is a bound."""
        self._period_s = period_s
        self._t_s = -np.inf
        self._steps_s: deque[float] = deque(maxlen=_STEPS)
        # What happened before the latest frame, if that was a gap.
        self.gap = ""

    def missing_before(self, t_s: float) -> int | None:
        """Return how many frames are missing before the next one, None after a gap."""
        step_s, self._t_s = t_s - self._t_s, t_s
        learned_s = sorted(self._steps_s)[_STEPS // 2] if len(self._steps_s) == _STEPS else np.inf
        period_s = min(learned_s, self._period_s)
        if 0 < step_s <= _LARGEST_GAP_S:
            self._steps_s.append(step_s)
        self.gap = ""
        if not 0 < step_s <= min(_LARGEST_GAP_S, _LARGEST_GAP_PERIODS * period_s):
            if np.isfinite(step_s):
                every = f" where one comes every {period_s:.2g} s" if np.isfinite(period_s) else ""
                happened = (
                    f"no frame came for {step_s:.1f} s{every} (a loose cable or a busy computer)"
                    if step_s > 0
                    else "the frames' times step back"
                )
                self.gap = f"{happened}, and the gel's motion in between is not known"
            return None
        return int(step_s > _MISSING_PERIODS * period_s)


@dataclass(frozen=True, slots=True, eq=False)
class CheckedFrame:
    """A frame's (m, c) channels, unusable ones filled in, the usable ones, and the reasons against the frame.

    `disturbance` is why its channels jumped since the last frame, empty where they did not.
    """

    channels: FloatArray
    usable: BoolArray
    reasons: tuple[str, ...]
    disturbance: str


class ChannelChecks:
    """Which channels of a frame count, and whether it is disturbed, by the frames before it."""

    def __init__(self, fingertips: FingertipSet, motion: Motion) -> None:
        """Begin without a frame."""
        self._fingertips = fingertips
        self._motion = motion
        # The last frame that was accepted, and a disturbed one after it.
        self.before: FloatArray | None = None
        self._disturbed: FloatArray | None = None
        self._lost: BoolArray = np.zeros(fingertips.idle.shape, dtype=np.bool_)
        # Channels that were unusable when the session began.
        self.unknown: BoolArray = self._lost

    def restart(self, before: FloatArray | None) -> None:
        """Compare the next frame with this one instead of the last."""
        self.before, self._disturbed = before, None

    def check(self, frame: TactileFrame) -> CheckedFrame:
        """Return the frame's channels and what speaks against it; without an earlier frame there is no disturbance."""
        usable = mask_unmeasured(frame.channels, frame.usable)
        channels = frame.channels if usable.all() else self._fill(frame.channels, usable)
        reasons, lost = self._fingertips.check(channels, usable)
        # Channels that stay lost are left out; while they are being lost they count as jumping.
        judged = usable & ~((lost & self._lost) | self.unknown)
        disturbance = ""
        if self.before is not None:
            disturbance = self._fingertips.disturbance(channels, self.before, judged)
        self._lost = lost
        if self.unknown.any() or lost.any():
            usable = usable & ~(lost | self.unknown)
            reasons = reasons if any(reasons) else self._fingertips.too_few_channels(usable)
            channels = self._fill(frame.channels, usable)
        return CheckedFrame(channels, usable, tuple(filter(None, reasons)), disturbance)

    def _fill(self, channels: FloatArray, usable: BoolArray) -> FloatArray:
        """Return the channels with unusable ones moved on from the last frame as the usable ones moved."""
        if self.before is None:
            return np.where(usable, channels, self._fingertips.gripped)
        moved = self._motion.impute(channels - self.before, usable, self._fingertips.sides, from_idle=False)
        return np.where(usable, channels, self.before + moved)

    def skip(self) -> None:
        """Leave out a frame that was refused."""
        self._disturbed = None

    def confirm(self, channels: FloatArray) -> bool:
        """Return whether a frame that jumped agrees with one before it that jumped too; then the change is real."""
        confirmed = False
        if self._disturbed is not None:
            confirmed = not self._fingertips.disturbance(channels, self._disturbed, self._fingertips.alive)
        if confirmed:
            self._disturbed, self.before = None, channels
        else:
            self._disturbed = channels
        return confirmed

    def begin(self, usable: BoolArray) -> None:
        """Begin with a frame of these usable channels: the idle voltages of the others are unknown."""
        self.unknown = ~usable

    def accept(self, channels: FloatArray) -> None:
        """Compare the next frame with this one."""
        self._disturbed, self.before = None, channels

    def restore(self, layer: int, channels: FloatArray, frame: TactileFrame) -> bool:
        """Restore channels of an idle frame's side that were unknown and work again; return whether there are any.

        The values are written into `channels` (m, c).
        """
        back = self.unknown[layer]
        if back.any():
            back = back & (mask_unmeasured(frame.channels, frame.usable) & ~self._lost)[layer]
            channels[layer, back] = frame.channels[layer, back]
            self.unknown[layer] &= ~back
        return bool(back.any())
