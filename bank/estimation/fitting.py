"""Fitting an estimator to recordings: one function for all estimators, on raw frames or on slices.

Every choice is made on data later than the data fitted to. Nothing looks at the recordings that the calibration will
be evaluated on.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from shearloop.bank.eit.channels import N_CHANNELS
from shearloop.bank.errors import CalibrationError
from shearloop.bank.estimation.bank_match import image_matrix
from shearloop.bank.estimation.calibration import NEEDS_BANK, Calibration, Name
from shearloop.bank.estimation.fitting_raw import Physics, fit_raw, tools_of
from shearloop.bank.estimation.fitting_slices import fit_slices
from shearloop.bank.estimation.load_delay import LoadTiming, measure_timing
from shearloop.bank.estimation.values import FrameSeries, check_finite


def fit(
    name: Name,
    recordings: Sequence[FrameSeries],
    source: str,
    physics: Physics | None = None,
    *,
    timing: LoadTiming | None = None,
    full_range: bool = False,
) -> Calibration:
    """Calibrate an estimator on recordings of one kind, in time order; `source` describes them in words.

    Slices with torque give a torque, those with diameters a diameter. `timing` is measured on the recordings where it
    is not given. With `full_range` the user guarantees that no torque exceeds the slices: intervals do not extend
    further. Raises CalibrationError for recordings that do not determine the calibration, and for missing physics.
    """
    physics = physics or Physics()
    if not recordings:
        raise CalibrationError("there is no recording to calibrate on")
    check_finite(recordings)
    kinds = {one.kind for one in recordings}
    if len(kinds) > 1:
        raise CalibrationError("raw frames and slices of differences do not fit into one calibration; make two")
    sides = tuple(side for side in recordings[0].sides if all(side in one.sides for one in recordings))
    if not sides:
        raise CalibrationError("the recordings have no side in common; name the side of each when importing")
    if name in NEEDS_BANK and physics.bank is None:
        raise CalibrationError(f"the estimator {name} needs a bank; name it with --bank")
    if name == "reconstruction" and physics.mesh is None:
        raise CalibrationError("the estimator reconstruction needs a mesh; name it with --mesh")
    blank = Calibration(
        estimator=name,
        kind=recordings[0].kind,
        sides=sides,
        source=source,
        bank_identity=physics.bank.identity if physics.bank is not None and name in NEEDS_BANK else "",
        scale=np.ones((len(sides), N_CHANNELS)),
        tool_mm=tools[0].value if len(tools := tools_of(recordings)) == 1 else np.nan,
        image=image_matrix(physics.mesh) if name == "reconstruction" and physics.mesh is not None else None,
    )
    chosen = [one.select_sides(sides) for one in recordings]
    if blank.kind != "raw":
        fitted = fit_slices(blank, chosen, physics, full_range=full_range)
        assumed = full_range and fitted.torque is not None
        return replace(fitted, assumptions=("full range",)) if assumed else fitted
    timing = timing or measure_timing(recordings)
    fitted = fit_raw(blank, chosen, physics, timing.uncertainty_s)
    return fitted if timing.references else replace(fitted, assumptions=("load timing",))
