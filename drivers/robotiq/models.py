"""The gripper models: stroke, speeds, forces and counts, from the makers' data sheets."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Literal, NamedTuple

ModelName = Literal["2F-140", "2F-85", "Hand-E"]
DEFAULT_MODEL: Final = "2F-140"
# Positions, speeds and forces are counts from 0 to this one.
COUNTS_MAX: Final = 255


class Range(NamedTuple):
    """The smallest and the largest value of a quantity."""

    low: float
    high: float


@dataclass(frozen=True, slots=True)
class GripperModel:
    """One model: the width of its stroke, the ranges of its speed and force, and its counts without a calibration.

    The fingers stop before the motor's spindle does: bare ones are open at 3 to 13 counts and closed near 230
    (Robotiq knowledge base, "Encoder bytes, adaptive gripper"), and other fingertips change that. The width of a
    linkage bows away from a straight line over the counts; `bow_mm` is the largest error of the line.
    """

    name: ModelName
    stroke_mm: float
    speed_mm_per_s: Range
    force_n: Range
    bow_mm: float
    open_counts: float = 3.0
    closed_counts: float = 230.0

    @property
    def counts_per_mm(self) -> float:
        """How many counts the bare fingers move for a millimetre, on average."""
        return (self.closed_counts - self.open_counts) / self.stroke_mm

    def why_beyond(self, width_mm: float, speed_mm_per_s: float, force_n: float) -> str:
        """Return which value this model does not have, with its range, or an empty string."""
        for value, (low, high), name, unit in (
            (width_mm, (0.0, self.stroke_mm), "width", "mm"),
            (speed_mm_per_s, self.speed_mm_per_s, "speed", "mm/s"),
            (force_n, self.force_n, "force", "N"),
        ):
            if not low <= value <= high:
                return f"a {name} of {value:g} {unit}, and a {self.name} has {low:g} to {high:g} {unit}"
        return ""


# A crank of 57 mm that turns by 0.8 rad, as a 2F-85 has it, bows by 3 % of the stroke. A Hand-E is a rack.
MODELS: Mapping[ModelName, GripperModel] = {
    model.name: model
    for model in (
        GripperModel("2F-140", 140.0, Range(30.0, 250.0), Range(10.0, 125.0), bow_mm=0.03 * 140.0),
        GripperModel("2F-85", 85.0, Range(20.0, 150.0), Range(20.0, 235.0), bow_mm=0.03 * 85.0),
        GripperModel("Hand-E", 50.0, Range(20.0, 150.0), Range(20.0, 185.0), bow_mm=0.0),
    )
}
# What some model has.
LARGEST_STROKE_MM = max(model.stroke_mm for model in MODELS.values())
SPEEDS_MM_PER_S = Range(
    min(model.speed_mm_per_s.low for model in MODELS.values()),
    max(model.speed_mm_per_s.high for model in MODELS.values()),
)
FORCES_N = Range(
    min(model.force_n.low for model in MODELS.values()), max(model.force_n.high for model in MODELS.values())
)
