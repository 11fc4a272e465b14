"""The idle frame of a session: the calibration's until every fingertip was seen idle, and then the session's own."""

from collections import deque

import numpy as np

from shearloop.bank.arrays import FloatArray
from shearloop.estimation.defaults import BASELINE_FRAMES
from shearloop.estimation.fingertip_validator import FingertipSet

# A baseline of fewer frames accepts only grips of at least half the calibrated strength.
_MIN_IDLE, _OUTRIGHT = 5, 0.5


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
        # The idle frame goes on as a mean of as many frames as a tare has asked for.
        averaged = max(BASELINE_FRAMES, wanted)
        self._frames: list[deque[FloatArray]] = [deque(maxlen=averaged) for _ in self._sides]
        self._followed = False
        self._wanted = wanted
        self._tare_frames: list[FloatArray] = []
        self._least = min(_MIN_IDLE, wanted or _MIN_IDLE)

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
                frames.extend(frame[layer] for frame in self._tare_frames)
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
        for layer, validator in enumerate(self._sides):
            frames = self._frames[layer]
            # One frame is a poor baseline: accept the first few unless they look clearly gripped.
            learned = len(frames) >= self._least
            limit = 0.5 * validator.grip_threshold if learned else max(_OUTRIGHT, validator.grip_threshold)
            following = bool(frames) and validator.grip_score(channels[layer], self.baselines[layer]) < limit
            if following or (first and validator.looks_idle(channels[layer])):
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
            max(_OUTRIGHT, validator.grip_threshold) if 0 < len(frames) < self._least else -np.inf
            for validator, frames in zip(self._sides, self._frames, strict=True)
        ]
        if self.complete:
            gains = [validator.gain(idle) for validator, idle in zip(self._sides, self.baselines, strict=True)]
            self.gains = np.array(gains)[:, None]
