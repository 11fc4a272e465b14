"""The strength of a grip relative to the calibration's grips, and the limits beyond which the calibration is not valid.

In a stronger grip the same twist moves the gel differently, by an unknown factor. Intervals expect another grip of
about the same strength, so they miss the truth in a much stronger or weaker grip. The strength is measured along the
grip's discriminant, which ignores twists.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median
from typing import Self

from shearloop.bank.arrays import FloatArray

# On pairs of recorded grips where the calibration of one carries over to the other, the strength is 0.43 to 2.07 times
# the calibrated one; on others at most 0.17 or at least 2.47 (docs/decisions/0048). The limits lie between.
WEAKEST_RATIO, STRONGEST_RATIO = 0.25, 2.25


@dataclass(frozen=True, slots=True, eq=False)
class CalibratedStrength:
    """Weights (c,) of a frame's relative change that give a grip's strength, and the calibrated grips' strengths.

    A strength is the median over a grip's frames, and 1 for the calibration's mean frame; weakest and strongest are the
    least and the largest of the calibration's grips.
    """

    weights: FloatArray
    weakest: float
    strongest: float

    @classmethod
    def fit(cls, weights: FloatArray, grips: Sequence[FloatArray]) -> Self:
        """Fit to the (n, c) relative changes of each grip's frames."""
        strengths = [median((grip @ weights).tolist()) for grip in grips]
        return cls(weights, min(strengths), max(strengths))

    def ratio(self, strength: float) -> float:
        """Return a strength as a ratio of the nearest calibrated one, 1 between the weakest and the strongest."""
        if strength > self.strongest:
            return strength / self.strongest
        # Fingertips that grip tools of several shapes may leave no direction of strength in common.
        return strength / self.weakest if self.weakest > 0.0 and strength < self.weakest else 1.0


def strength_reasons(ratios: dict[str, float]) -> tuple[str, ...]:
    """Return why the calibration does not hold for a grip with these ratios of strength by side; none if it does."""
    strong = {side: f"{ratio:.1f}" for side, ratio in ratios.items() if ratio > STRONGEST_RATIO}
    # A ratio is 0 or less where the frames move another way.
    weak = {side: f"{max(ratio, 0.0):.2f}" for side, ratio in ratios.items() if ratio < WEAKEST_RATIO}
    found = (("strong", strong, "less"), ("weak", weak, "more"))
    return tuple(_reason(how, shown, cure) for how, shown, cure in found if shown)


def _reason(how: str, shown: dict[str, str], cure: str) -> str:
    """Return the reason against a grip; `shown` has each side's ratio as text."""
    sides, times = " and ".join(shown), " and ".join(shown.values())
    return (
        f"the grip at the {sides} fingertip is too {how}: {times} times as strong as in the calibration; grip with "
        f"{cure} force, or calibrate at this grip"
    )
