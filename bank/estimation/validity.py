"""The guards of all sides side by side, for the frames of a session: what does not change is computed once.

Frames come half a second apart, when others have had the processor's caches, and a call into NumPy then takes longer
than what it computes: so all sides are compared in the same calls.
"""

import math

import numpy as np

from shearloop.bank.arrays import BoolArray, FloatArray
from shearloop.bank.eit.channels import N_CHANNELS
from shearloop.bank.estimation.fingertip_validator import (
    LARGEST_DEVIATION,
    LARGEST_UNUSABLE_SHARE,
    FingertipValidator,
    Known,
    relative_to,
)
from shearloop.bank.estimation.values import everywhere

# A channel that jumps from frame to frame by more than this many times its noise, and this much, is disturbed.
JUMP_NOISES, JUMP_V = 6.0, 0.008
# A channel that is off by more than this share of what it should read, beyond the common gain, has lost its electrode.
# Recorded frames stay within 0.4, but for single channels while the grip closes.
_LOST_SHARE = 0.6


class Guards:
    """All that is known of the m sides' fingertips; frames are (m, 896) in volts."""

    def __init__(self, sides: tuple[FingertipValidator, ...]) -> None:
        """Take the guards in the order of a frame's sides."""
        self.sides = sides
        self.idle: FloatArray = np.array([guard.idle for guard in sides])
        self.gripped: FloatArray = np.array([guard.gripped for guard in sides])
        noise = np.array([guard.noise for guard in sides])
        # Channels that were not dead at calibration.
        self.alive: BoolArray = np.isfinite(noise)
        self._jump_limits_v = np.maximum(JUMP_NOISES * np.sqrt(2.0) * noise, JUMP_V)
        self._frames = np.stack([self.idle, self.gripped], axis=1)
        self._known = Known(self._frames)
        # The numbers of the sides at which a step in the frames tells a release.
        self.stepping = [i for i, one in enumerate(sides) if max(one.step_limit, one.fall_limit) < math.inf]

    def too_few(self, usable: BoolArray) -> list[str]:
        """Return for each side why it has too few usable channels, empty texts where it has enough."""
        return [_too_few(guard.side, one) for guard, one in zip(self.sides, usable, strict=True)]

    def seen(self, frame: FloatArray, usable: BoolArray) -> tuple[list[str], BoolArray]:
        """Return for each side why it says nothing, or an empty text, and which (m, 896) channels are lost.

        It has too few usable channels, or is another fingertip. Lost ones read what neither grip nor twist explains: a
        lost electrode, a crossed wire.
        """
        complete = everywhere(usable)
        known = self._known if complete else Known(self._frames, usable[:, None])
        off, deviations = known.compare(frame)
        lost = off > _LOST_SHARE
        why = [_foreign(guard.side, *deviations[2 * i : 2 * i + 2]) for i, guard in enumerate(self.sides)]
        if not complete:
            why = [few or other for few, other in zip(self.too_few(usable), why, strict=True)]
        return why, lost[:, 0] & lost[:, 1]

    def jumping_shares(self, frame: FloatArray, before: FloatArray, usable: BoolArray) -> list[float]:
        """Return the share of each side's usable channels that jump further than their noise explains; 1 of none."""
        jumping = (np.abs(frame - before) > self._jump_limits_v) & usable
        counts = [(np.count_nonzero(one), np.count_nonzero(of)) for one, of in zip(jumping, usable, strict=True)]
        return [jumped / n if n else 1.0 for jumped, n in counts]

    def grips(self, frame: FloatArray, idle: FloatArray) -> list[float]:
        """Return each side's score as `FingertipValidator.grip` does."""
        relative = relative_to(frame, idle)
        return [float(one @ guard.grip_weights) for guard, one in zip(self.sides, relative, strict=True)]


def _too_few(side: str, usable: BoolArray) -> str:
    unusable = 1.0 - np.count_nonzero(usable) / N_CHANNELS
    if unusable <= LARGEST_UNUSABLE_SHARE:
        return ""
    return (
        f"{side} fingertip: {100 * unusable:.0f} % of the channels are dead or saturated; look at the ribbon cable and "
        "the gel's contact with the electrodes"
    )


def _foreign(side: str, from_idle: float, from_gripped: float) -> str:
    deviation = min(from_idle, from_gripped)
    if deviation <= LARGEST_DEVIATION:
        return ""
    return (
        f"{side} fingertip: the voltages deviate by {100 * deviation:.0f} % from those at calibration, more than "
        f"{100 * LARGEST_DEVIATION:.0f} %; this is another fingertip or another gel, calibrate it"
    )
