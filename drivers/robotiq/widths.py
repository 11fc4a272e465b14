"""The gripper's width over its counts: the maker's line, or a measured line or bow through gauges."""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Self

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError, model_validator

from shearloop.drivers.calibration_files import CalibrationModel, Finite, Positive
from shearloop.drivers.errors import DeviceCalibrationError
from shearloop.drivers.robotiq.models import COUNTS_MAX, DEFAULT_MODEL, MODELS, GripperModel, ModelName

# Without a calibration, the width of a gripper of unknown fingertips.
_NOMINAL_STD_MM = 3.0
# This many diameters over this fraction of the stroke show whether the width bows.
_BOW_GAUGES, _BOW_SPREAD = 4, 0.5
# Of the nominal counts per millimetre: more means diameters in another unit, or another model.
_STEEPEST = 2.5


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

    @classmethod
    def of_gauges(cls, gauges: Sequence[tuple[float, float]], model: ModelName = DEFAULT_MODEL) -> Self:
        """Return the curve through (counts, width in mm) pairs of gripped objects.

        Four diameters or more show whether it bows; the scatter about it is then its standard deviation, and one count
        at least. Raises DeviceCalibrationError when no falling curve fits.
        """
        own = MODELS[model]
        diameters = {width for _, width in gauges}
        if len(diameters) < 2:
            raise DeviceCalibrationError("A width calibration needs objects of at least two different diameters.")
        if max(diameters) > own.stroke_mm:
            raise DeviceCalibrationError(
                f"An object of {max(diameters):g} mm does not fit between the fingers of a {model}: its stroke is "
                f"{own.stroke_mm:g} mm. Measure without it, or correct `--model`."
            )
        counts, widths = (np.array(column, dtype=float) for column in zip(*gauges, strict=True))
        line = cls._line(counts, widths, own)
        spread_mm = max(diameters) - min(diameters)
        found, unseen_mm = line, 0.0
        if len(diameters) < _BOW_GAUGES or spread_mm < _BOW_SPREAD * own.stroke_mm:
            # The error of a line between gauges with an unknown bow.
            unseen_mm = own.bow_mm * (spread_mm / own.stroke_mm) ** 2
        elif (bowed := cls._bowed(counts, widths, own)) is not None and bowed.std_mm < line.std_mm:
            found = bowed
        if found.std_mm > 0.02 * own.stroke_mm:
            raise DeviceCalibrationError(
                f"The diameters scatter by {found.std_mm:.1f} mm about a smooth curve: check them, and that each "
                "object was gripped at the same place of the fingertips."
            )
        return found.model_copy(update={"std_mm": max(found.std_mm, unseen_mm)})

    @classmethod
    def _line(cls, counts: NDArray[np.float64], widths: NDArray[np.float64], model: GripperModel) -> Self:
        """Return the line through counts (n,) and widths (n,); from three pairs on with its scatter."""
        counts_per_mm, closed_counts = (float(value) for value in np.polyfit(widths, counts, 1))
        # Less than a quarter of the nominal slope means objects in the wrong order.
        if counts_per_mm > -0.25 * COUNTS_MAX / model.stroke_mm:
            raise DeviceCalibrationError(
                "The fingers did not stop further closed on the smaller objects: were they measured in the order "
                "given, and did the fingers hold each of them?"
            )
        times = -counts_per_mm * model.stroke_mm / COUNTS_MAX
        if times > _STEEPEST:
            raise DeviceCalibrationError(
                f"Between the objects the fingers moved {times:.1f} times as far as a {model.name} does for these "
                "diameters: give the diameters in mm, and the model with --model."
            )
        residuals = (counts - (closed_counts + counts_per_mm * widths)) / counts_per_mm
        scatter_mm = math.sqrt(float(residuals @ residuals) / (len(counts) - 2)) if len(counts) > 2 else 0.0
        return cls(
            model=model.name,
            open_counts=closed_counts + counts_per_mm * model.stroke_mm,
            open_mm=model.stroke_mm,
            closed_counts=closed_counts,
            std_mm=max(scatter_mm, -1 / counts_per_mm),
        )

    @classmethod
    def _bowed(cls, counts: NDArray[np.float64], widths: NDArray[np.float64], model: GripperModel) -> Self | None:
        """Return the parabola through counts (n,) and widths (n,), or None where it does not fall over the stroke."""
        # `polyfit` keeps a bend of exactly 0, which `Polynomial.fit(…).convert()` drops.
        curve = np.polynomial.Polynomial(np.polyfit(counts, widths, 2)[::-1])
        residuals = widths - curve(counts)
        opened, closed = (_falls_through(curve, width_mm) for width_mm in (model.stroke_mm, 0.0))
        if opened is None or closed is None or opened >= closed:
            return None
        try:
            return cls(
                model=model.name,
                open_counts=opened,
                open_mm=model.stroke_mm,
                closed_counts=closed,
                bow_mm=float(curve(0.5 * (opened + closed))) - 0.5 * model.stroke_mm,
                std_mm=max(
                    math.sqrt(float(residuals @ residuals) / (len(counts) - 3)), model.stroke_mm / (closed - opened)
                ),
            )
        except ValidationError:
            return None

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


def _falls_through(parabola: np.polynomial.Polynomial, width_mm: float) -> float | None:
    """Return the counts at which a x² + b x + c falls through a width, mm, or None where it nowhere does.

    The slope there is -sqrt(b² - 4 a (c - width)). The root has two forms. In each branch stands the one that does not
    subtract nearly equal numbers: the other one loses all digits where the parabola is almost straight.
    """
    c, b, a = (float(value) for value in parabola.coef)
    c -= width_mm
    squared = b**2 - 4 * a * c
    if squared <= 0:
        return None
    steepness = math.sqrt(squared)
    if b < 0:
        return 2 * c / (steepness - b)
    return -(b + steepness) / (2 * a) if a else None
