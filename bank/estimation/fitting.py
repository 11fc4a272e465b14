"""Fitting an estimator to recordings: one function, five estimators, each on raw frames or on slices.

Everything that is chosen is chosen on data later than what it was fitted to; nothing looks at the recordings that the
calibration will be judged on.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np

from shearloop.bank.eit.channels import N_CHANNELS
from shearloop.bank.errors import CalibrationError
from shearloop.bank.estimation.alignment import Aligned, alignment, check_alignment, telling, unchecked_s
from shearloop.bank.estimation.bank_match import NOT_TURNED, image_matrix
from shearloop.bank.estimation.calibrated import NEEDS_BANK, Calibration, Name
from shearloop.bank.estimation.fitting_choices import Physics
from shearloop.bank.estimation.fitting_raw import fit_raw, tools_of
from shearloop.bank.estimation.fitting_slices import fit_slices
from shearloop.bank.estimation.values import FrameSeries


def fit(
    name: Name,
    recordings: Sequence[FrameSeries],
    source: str,
    physics: Physics | None = None,
    *,
    trust_times: bool = False,
    all_torques: bool = False,
    timed_by: Sequence[FrameSeries] = (),
    aligned: Aligned | None = None,
) -> Calibration:
    """Calibrate an estimator on recordings of one kind, in time order; `source` says in words what they are.

    Slices with torque give a torque, those with diameters a diameter. `timed_by` may be what was recorded beside by
    other fingertips, by which the torques' times are checked where these hardly move with the load; `aligned` may be
    `alignment` with what it has found for whoever asks it too. `all_torques` vouches that no torque will come beyond
    those of the slices: intervals are then not stretched to hold such ones.

    Raises CalibrationError for recordings that do not determine the calibration, for torques clearly stamped at
    other times than the frames unless `trust_times` is set, and for physics that the estimator needs and did not get.
    """
    physics = physics or Physics()
    if not recordings:
        raise CalibrationError("there is no recording to calibrate on")
    _check_values(recordings)
    kinds = {one.kind for one in recordings}
    if len(kinds) > 1:
        raise CalibrationError("raw frames and slices of differences do not go into one calibration; make two")
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
        tool_mm=tools[0].value if len(tools := tools_of(recordings)) == 1 else np.nan,
        registration=NOT_TURNED,
        scale=np.ones((len(sides), N_CHANNELS)),
        guards=(),
        motion=None,
        image=image_matrix(physics.mesh) if name == "reconstruction" and physics.mesh is not None else None,
        torque=None,
        diameter=None,
        vouched=(),
    )
    chosen = [one.of_sides(sides) for one in recordings]
    if blank.kind != "raw":
        fitted = fit_slices(blank, chosen, physics, all_torques=all_torques)
        return replace(fitted, vouched=("all torques",)) if all_torques and fitted.torque is not None else fitted
    if trust_times:
        return replace(fit_raw(blank, chosen, physics, 0.0), vouched=("load times",))
    aligned = aligned or cache(alignment)
    timed = telling(recordings, timed_by, aligned)
    check_alignment(timed, aligned)
    return fit_raw(blank, chosen, physics, unchecked_s(timed, aligned))


def _check_values(recordings: Sequence[FrameSeries]) -> None:
    """Raise CalibrationError for a recording without frames, or with values that are no numbers."""
    for number, one in enumerate(recordings, 1):
        which = f"recording {number} of {len(recordings)}"
        if not len(one.t_s):
            raise CalibrationError(f"{which} has no frames to calibrate on; leave it out, or use a longer part of it")
        # A slice without a torque of its own may be of a cylinder.
        torque = one.torque_nm if one.kind == "raw" else np.zeros(0)
        wrong = sum(int(np.count_nonzero(~np.isfinite(values))) for values in (one.t_s, one.channels, torque))
        if wrong:
            raise CalibrationError(f"{which} holds {wrong} values that are not finite numbers; leave those frames out")
