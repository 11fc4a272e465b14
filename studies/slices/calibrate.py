"""Calibrates an estimator on folders of slices, and says what the user should know of it."""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from shearloop.errors import UserError
from shearloop.estimation import Physics
from shearloop.estimation.estimator_names import EstimatorName
from shearloop.studies.slices.calibration import SliceCalibration
from shearloop.studies.slices.fitting import fit_slices
from shearloop.studies.slices.hidden_values import SliceRange
from shearloop.studies.slices.series import SliceSeries, read_parts
from shearloop.tools.calibrate import source_text


@dataclass(frozen=True, slots=True)
class SliceResult:
    """A calibration, the slices that it was fitted to, and the time in s that the fit took."""

    calibration: SliceCalibration
    parts: Sequence[SliceSeries]
    fit_s: float

    @property
    def frames(self) -> int:
        """The number of slices."""
        return sum(len(part.t_s) for part in self.parts)

    @property
    def range(self) -> SliceRange | None:
        """The range of the torques, None without a torque."""
        return None if self.calibration.torque is None else self.calibration.torque.regressor.range

    @property
    def reads_beyond(self) -> bool | None:
        """Whether torques beyond the calibrated ones are seen to be beyond; None where that was not tested."""
        if (span := self.range) is None or self.calibration.assumptions:
            return None
        return not (span.low_end > span.low or span.high_end < span.high)

    def figures(self) -> dict[str, object]:
        """Return the result for scripts."""
        calibration = self.calibration
        found: dict[str, object] = {
            "estimator": calibration.estimator.name,
            "quantities": list(calibration.outputs),
            "frames": self.frames,
            "sides": list(calibration.sides),
            "source": calibration.source,
            "assumptions": list(calibration.assumptions),
        }
        if self.range is not None:
            # Slices are loads alone: there are no frames without a load to hide them.
            found["sees_loads"] = True
        if self.reads_beyond is not None:
            found["reads_beyond"] = self.reads_beyond
        return found

    def sentences(self) -> list[str]:
        """Return what the user should know of the calibration."""
        calibration = self.calibration
        outputs, sides = " and ".join(calibration.outputs), " and ".join(calibration.sides)
        sentences = [
            f"Estimator {calibration.estimator.name}, {outputs} from {self.frames} frames of the {sides} side."
        ]
        if self.range is not None and self.reads_beyond is False:
            sentences.append(_range_ends(self.range))
        return sentences


def calibrate_slices(
    folders: Sequence[Path],
    estimator: EstimatorName,
    physics: Physics,
    *,
    time_range: tuple[float, float],
    assume_full_range: bool = False,
) -> SliceResult:
    """Fit an estimator to these fractions (0 to 1) of folders of slices, oldest first.

    With `assume_full_range` no torque will exceed the calibrated range. Raises UserError for a folder that is given
    twice, and CalibrationError for slices that determine no calibration.
    """
    _, parts = read_parts(folders, time_range)
    begun = time.perf_counter()
    source = source_text(folders, time_range)
    calibration = fit_slices(estimator, parts, source, physics, full_range=assume_full_range)
    if assume_full_range and calibration.torque is None:
        raise UserError("--assume-full-range is about torques, and these slices have diameters only; leave it out")
    return SliceResult(calibration, parts, time.perf_counter() - begun)


def _range_ends(span: SliceRange) -> str:
    """Return which estimates may hide torques beyond the calibrated ones."""
    limits = (span.low, span.high, span.low_end, span.high_end, span.lowest, span.highest)
    low_nm, high_nm, below_nm, above_nm, lowest_nm, highest_nm = (round(limit, 3) + 0.0 for limit in limits)
    ends = (("below", below_nm, lowest_nm), ("above", above_nm, highest_nm))
    reach = [
        f"of estimates {side} {end_nm:g} N·m reach to {reached_nm:g} N·m at least"
        for side, end_nm, reached_nm in ends
        if math.isfinite(end_nm)
    ]
    where = f"intervals {', and '.join(reach)}"
    if below_nm >= high_nm and above_nm <= low_nm:
        where = f"all intervals reach from {lowest_nm:g} to {highest_nm:g} N·m at least, and the torque is useless"
    return (
        f"A torque beyond the calibrated {low_nm:g} to {high_nm:g} N·m may read as one within them: the outermost ones "
        f"did when they were left out. So {where}. Calibrate on all torques that will occur, and add "
        "--assume-full-range."
    )
