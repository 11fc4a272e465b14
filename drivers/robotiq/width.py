"""The gripper's counts and millimetres.

The fingers of a 2F-140 stop before the motor's spindle does: a real one goes from about 3 to about 230 counts, not from
0 to 255 (Robotiq knowledge base, "Encoder bytes, adaptive gripper"), and fingertips change that. The width is taken as
linear in counts; the residual is part of the uncertainty.
"""

import math
from collections.abc import Sequence
from typing import Self

import numpy as np
from pydantic import model_validator

from shearloop.drivers.calibration_files import CalibrationModel, Finite, Positive
from shearloop.drivers.errors import DeviceCalibrationError

COUNTS_MAX = 255
STROKE_MM = 140.0


class WidthCalibration(CalibrationModel):
    """The line through two positions of known width.

    `std_mm` is the standard deviation of the width about the line; `width_std_mm` adds the encoder's step of one count.
    """

    open_counts: Finite
    open_mm: Positive
    closed_counts: Finite
    closed_mm: Finite = 0.0
    std_mm: Positive

    @model_validator(mode="after")
    def _two_different_widths(self) -> Self:
        if self.open_counts >= self.closed_counts or self.open_mm <= self.closed_mm:
            raise ValueError("the open position must have fewer counts and more millimetres than the closed one")
        return self

    @classmethod
    def nominal(cls) -> Self:
        """Return the data sheet's line for a bare 2F-140: good enough to move, not to measure a diameter."""
        return cls(open_counts=3.0, open_mm=STROKE_MM, closed_counts=230.0, closed_mm=0.0, std_mm=3.0)

    @classmethod
    def of_gauges(cls, gauges: Sequence[tuple[float, float]]) -> Self:
        """Return the least-squares line through (counts, width in mm) pairs of gripped objects.

        From three pairs on, the scatter about the line is the standard deviation, and one count at least. Raises
        DeviceCalibrationError when no falling line fits.
        """
        if len({width for _, width in gauges}) < 2:
            raise DeviceCalibrationError("A width calibration needs objects of at least two different diameters.")
        counts, widths = (np.array(column, dtype=float) for column in zip(*gauges, strict=True))
        counts_per_mm, closed_counts = (float(value) for value in np.polyfit(widths, counts, 1))
        # Less than a quarter of the nominal slope means objects in the wrong order.
        if counts_per_mm > -0.25 * COUNTS_MAX / STROKE_MM:
            raise DeviceCalibrationError(
                "The fingers did not stop further closed on the smaller objects: were they measured in the order "
                "given, and did the fingers hold each of them?"
            )
        residuals = (counts - (closed_counts + counts_per_mm * widths)) / counts_per_mm
        scatter_mm = math.sqrt(float(residuals @ residuals) / (len(gauges) - 2)) if len(gauges) > 2 else 0.0
        if scatter_mm > 0.02 * STROKE_MM:
            raise DeviceCalibrationError(
                f"The diameters scatter by {scatter_mm:.1f} mm about a straight line: check them, and that each object "
                "was gripped at the same place of the fingertips."
            )
        return cls(
            open_counts=closed_counts + counts_per_mm * STROKE_MM,
            open_mm=STROKE_MM,
            closed_counts=closed_counts,
            std_mm=max(scatter_mm, -1 / counts_per_mm),
        )

    @property
    def mm_per_count(self) -> float:
        """The change of width per count, mm; negative."""
        return (self.open_mm - self.closed_mm) / (self.open_counts - self.closed_counts)

    def width_mm(self, counts: float) -> float:
        """Return the width at a position, mm."""
        return self.closed_mm + (counts - self.closed_counts) * self.mm_per_count

    def counts(self, width_mm: float) -> int:
        """Return the position nearest to a width, within 0…255."""
        exact = self.closed_counts + (width_mm - self.closed_mm) / self.mm_per_count
        return min(max(round(exact), 0), COUNTS_MAX)

    @property
    def width_std_mm(self) -> float:
        """The standard deviation of a measured width, mm: of the line and of the encoder's step."""
        return math.hypot(self.std_mm, self.mm_per_count / math.sqrt(12))
