"""Whether a fingertip is gripped, told frame by frame."""

# A grip has ended when its score is below this share of its mean over so many frames.
_LOOSE_SHARE, _LEVEL_FRAMES = 0.5, 60


class Grip:
    """Whether one fingertip is gripped, from the grip's score (0 idle, 1 as at calibration), frame by frame.

    A grip begins with a rise by the threshold above the lowest score since the last one (a gel that recovers from a
    release scores less and less), and ends below half of that, or below a share of this grip's own mean score: today's
    grip may be a fifth or three times as strong as the one at calibration.
    """

    def __init__(self, threshold: float) -> None:
        self._threshold = threshold
        self._floor = 0.0
        self._level: float | None = None
        self._frames = 0

    @property
    def held(self) -> bool:
        """Whether it was gripped at the last frame."""
        return self._level is not None

    def see(self, score: float) -> bool:
        """Take the next frame's score and return whether it is gripped."""
        if self._level is None:
            self._floor = min(self._floor, max(score, 0.0))
            if score - self._floor > self._threshold:
                self._level, self._frames = score, 1
            return self._level is not None
        if score < max(self._floor + 0.5 * self._threshold, _LOOSE_SHARE * self._level):
            self._level, self._floor = None, max(score, 0.0)
            return False
        self._frames = min(self._frames + 1, _LEVEL_FRAMES)
        self._level += (score - self._level) / self._frames
        return True
