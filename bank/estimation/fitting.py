"""Fitting an estimator to recordings: one function for all estimators, on raw frames or on slices.

Every choice is made on data later than the data fitted to. Nothing looks at the recordings that the calibration will
be evaluated on.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np

from shearloop.bank.eit.channels import N_CHANNELS
from shearloop.bank.errors import CalibrationError
from shearloop.bank.estimation import load_delay
from shearloop.bank.estimation.bank_match import image_matrix
from shearloop.bank.estimation.calibration import NEEDS_BANK, Calibration, Name
from shearloop.bank.estimation.fitting_raw import Physics, fit_raw, tools_of
from shearloop.bank.estimation.fitting_slices import fit_slices
from shearloop.bank.estimation.values import FrameSeries


def fit(
    name: Name,
    recordings: Sequence[FrameSeries],
    source: str,
    physics: Physics | None = None,
    *,
    trust_times: bool = False,
    full_range: bool = False,
    timed_by: Sequence[FrameSeries] = (),
    find_delay: load_delay.DelayFinder | None = None,
) -> Calibration:
    """Calibrate an estimator on recordings of one kind, in time order; `source` describes them in words.

    Slices with torque give a torque, those with diameters a diameter. `timed_by` are recordings of other fingertips,
    which show the torques' delay if these do not. `find_delay` may be a cached `find_load_delay`. With `full_range` the
    user guarantees that no torque exceeds the slices: intervals do not extend further.

    Raises CalibrationError for recordings that do not determine the calibration, for torques clearly stamped at other
    times than the frames unless `trust_times` is set, and for missing physics.
    """
    physics = physics or Physics()
    if not recordings:
        raise CalibrationError("there is no recording to calibrate on")
    _check_values(recordings)
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
    if trust_times:
        return replace(fit_raw(blank, chosen, physics, 0.0), assumptions=("load timing",))
    find_delay = find_delay or cache(load_delay.find_load_delay)
    references = load_delay.timing_references(recordings, timed_by, find_delay)
    load_delay.check_load_delay(references, find_delay)
    return fit_raw(blank, chosen, physics, load_delay.timing_uncertainty_s(references, find_delay))


def _check_values(recordings: Sequence[FrameSeries]) -> None:
    """Raise CalibrationError for a recording without frames, or with values that are not finite."""
    for number, one in enumerate(recordings, 1):
        which = f"recording {number} of {len(recordings)}"
        if not len(one.t_s):
            raise CalibrationError(f"{which} has no frames to calibrate on; leave it out, or use a longer part of it")
        # A slice without a torque may be of a cylinder.
        torque = one.torque_nm if one.kind == "raw" else np.zeros(0)
        wrong = sum(int(np.count_nonzero(~np.isfinite(values))) for values in (one.t_s, one.channels, torque))
        if wrong:
            raise CalibrationError(f"{which} holds {wrong} values that are not finite numbers; leave those frames out")
