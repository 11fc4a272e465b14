"""Fits the gripper's width over its counts, a line or a bow through gauges."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from shearloop.drivers.errors import DeviceCalibrationError
from shearloop.drivers.robotiq.models import COUNTS_MAX, MODELS, GripperModel, ModelName
from shearloop.drivers.robotiq.widths import WidthCalibration

# This many diameters over this fraction of the stroke show whether the width bows.
_BOW_GAUGES, _BOW_SPREAD = 4, 0.5
# The next model has 1.6 times as many counts per millimetre, or as few.
_OTHER_MODEL = 1.5


def fit_width(gauges: Sequence[tuple[float, float]], model: ModelName) -> WidthCalibration:
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
    line = _line(counts, widths, own)
    spread_mm = max(diameters) - min(diameters)
    found, unseen_mm = line, 0.0
    if len(diameters) < _BOW_GAUGES or spread_mm < _BOW_SPREAD * own.stroke_mm:
        # The error of a line between gauges with an unknown bow.
        unseen_mm = own.bow_mm * (spread_mm / own.stroke_mm) ** 2
    elif (bowed := _bowed(counts, widths, own)) is not None and bowed.std_mm < line.std_mm:
        found = bowed
    if found.std_mm > 0.02 * own.stroke_mm:
        raise DeviceCalibrationError(
            f"The diameters scatter by {found.std_mm:.1f} mm about a smooth curve: check them, and that each "
            "object was gripped at the same place of the fingertips."
        )
    return found.model_copy(update={"std_mm": max(found.std_mm, unseen_mm)})


def _line(counts: NDArray[np.float64], widths: NDArray[np.float64], model: GripperModel) -> WidthCalibration:
    """Return the line through counts (n,) and widths (n,); from three pairs on with its scatter."""
    counts_per_mm, closed_counts = (float(value) for value in np.polyfit(widths, counts, 1))
    # Less than a quarter of the nominal slope means objects in the wrong order.
    if counts_per_mm > -0.25 * COUNTS_MAX / model.stroke_mm:
        raise DeviceCalibrationError(
            "The fingers did not stop further closed on the smaller objects: were they measured in the order "
            "given, and did the fingers hold each of them?"
        )
    times = -counts_per_mm / model.counts_per_mm
    if not _is_like(times):
        like = (one.name for one in MODELS.values() if _is_like(-counts_per_mm / one.counts_per_mm))
        similar = "".join(f", which is more like a {name}" for name in like)
        raise DeviceCalibrationError(
            f"Between the objects the fingers moved {times:.1f} times as far as a {model.name} does for these "
            f"diameters{similar}: correct `gripper.model` or `--model`, and give the diameters in mm."
        )
    residuals = (counts - (closed_counts + counts_per_mm * widths)) / counts_per_mm
    scatter_mm = math.sqrt(float(residuals @ residuals) / (len(counts) - 2)) if len(counts) > 2 else 0.0
    return WidthCalibration(
        model=model.name,
        open_counts=closed_counts + counts_per_mm * model.stroke_mm,
        open_mm=model.stroke_mm,
        closed_counts=closed_counts,
        std_mm=max(scatter_mm, -1 / counts_per_mm),
    )


def _is_like(times: float) -> bool:
    """Return whether a model's bow and its encoder's steps explain so much more, or less, motion of its fingers."""
    return 1.0 / _OTHER_MODEL < times < _OTHER_MODEL


def _bowed(counts: NDArray[np.float64], widths: NDArray[np.float64], model: GripperModel) -> WidthCalibration | None:
    """Return the parabola through counts (n,) and widths (n,), or None where it does not fall over the stroke."""
    # `polyfit` keeps a bend of exactly 0, which `Polynomial.fit(…).convert()` drops.
    curve = np.polynomial.Polynomial(np.polyfit(counts, widths, 2)[::-1])
    residuals = widths - curve(counts)
    opened, closed = (_falls_through(curve, width_mm) for width_mm in (model.stroke_mm, 0.0))
    if opened is None or closed is None or opened >= closed:
        return None
    try:
        return WidthCalibration(
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
