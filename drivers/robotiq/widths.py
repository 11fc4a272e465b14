"""The gripper's width over its counts: the maker's line, or a measured line or bow (`width_fit.py`)."""

import math
from itertools import pairwise
from typing import Self

from pydantic import model_validator

from shearloop.drivers.calibration_files import CalibrationModel, Finite, Positive
from shearloop.drivers.robotiq.models import COUNTS_MAX, DEFAULT_MODEL, MODELS, ModelName

# Without a calibration, the width of a gripper of unknown fingertips.
_NOMINAL_STD_MM = 3.0


class WidthCalibration(CalibrationModel):
    """The width over the counts: the line through two positions of known width, and its bow.

    `bow_mm` is how much wider than the line the fingers are half-way between the two positions, on a parabola.
    `std_mm` is the standard deviation of the width about the curve; `width_std_mm` adds the step of one count.
    """

    model: ModelName = DEFAULT_MODEL
    open_counts: Finite
    open_mm: Positive
    closed_counts: Finite
    closed_mm: Finite = 0.0
    bow_mm: Finite = 0.0
    std_mm: Positive

    @model_validator(mode="after")
    def _two_different_widths(self) -> Self:
        if self.open_counts >= self.closed_counts or self.open_mm <= self.closed_mm:
            raise ValueError("the open position must have fewer counts and more millimetres than the closed one")
        widths = [self.width_mm(counts) for counts in range(COUNTS_MAX + 1)]
        if any(width <= other for width, other in pairwise(widths)):
            raise ValueError(
                f"with a bow of {self.bow_mm:g} mm the width would not fall with the counts: measure it again with "
                "`shearloop calibrate gripper`"
            )
        return self

    @classmethod
    def nominal(cls, model: ModelName = DEFAULT_MODEL) -> Self:
        """Return the data sheet's line for bare fingers: good enough to move, not to measure a diameter."""
        own = MODELS[model]
        ends = {"open_counts": own.open_counts, "closed_counts": own.closed_counts, "open_mm": own.stroke_mm}
        return cls(model=model, std_mm=max(own.bow_mm, _NOMINAL_STD_MM), **ends)

    @property
    def mm_per_count(self) -> float:
        """The mean change of width per count, mm; negative."""
        return (self.open_mm - self.closed_mm) / (self.open_counts - self.closed_counts)

    def width_mm(self, counts: float) -> float:
        """Return the width at a position, mm."""
        part = (counts - self.open_counts) / (self.closed_counts - self.open_counts)
        return self.closed_mm + (counts - self.closed_counts) * self.mm_per_count + 4 * self.bow_mm * part * (1 - part)

    def counts(self, width_mm: float) -> int:
        """Return the position nearest to a width, within 0…255."""
        return min(range(COUNTS_MAX + 1), key=lambda counts: abs(self.width_mm(counts) - width_mm))

    @property
    def width_std_mm(self) -> float:
        """The standard deviation of a measured width, mm: of the curve and of the encoder's step."""
        return math.hypot(self.std_mm, self.mm_per_count / math.sqrt(12))
