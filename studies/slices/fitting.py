"""Fits an estimator to slices."""

from collections.abc import Sequence

import numpy as np

from shearloop.bank.arrays import FloatArray
from shearloop.bank.errors import CalibrationError
from shearloop.estimation import Physics
from shearloop.estimation.bank_match import BankMatcher
from shearloop.estimation.estimator import Estimator, Quantity, Reading
from shearloop.estimation.estimator_names import EstimatorName
from shearloop.estimation.fitting import check_physics
from shearloop.estimation.learned_frames import LearnedFrames
from shearloop.estimation.values import ProcessedFrame
from shearloop.studies.slices.calibration import SliceCalibration, SliceModel
from shearloop.studies.slices.estimators import fits_of, least_slices, prepared, slice_estimator_class
from shearloop.studies.slices.levels import later_levels
from shearloop.studies.slices.novelty import NoveltyDetector
from shearloop.studies.slices.profile import SliceProfile
from shearloop.studies.slices.regressor import fit_slice_regressor
from shearloop.studies.slices.series import SliceSeries, check_slices, torques_of


def fit_slices(
    name: EstimatorName,
    recordings: Sequence[SliceSeries],
    source: str,
    physics: Physics | None = None,
    *,
    full_range: bool = False,
) -> SliceCalibration:
    """Calibrate an estimator on slices of one fingertip, in time order; `source` describes them in words.

    Slices with torque give a torque, those with diameters a diameter. With `full_range` the user guarantees that no
    torque exceeds the slices: intervals do not extend further. Raises CalibrationError for slices that do not determine
    the calibration, and for missing physics.
    """
    physics = physics or Physics()
    side = check_slices(recordings)
    table = recordings[0].table
    check_physics(slice_estimator_class(name), physics, table)
    estimator = prepared(name, physics, table)
    with_bank = estimator.needs == "bank" and physics.bank is not None
    matcher = estimator.matcher(physics.bank) if with_bank and physics.bank is not None else None
    slices = np.abs(np.concatenate([recording.differences for recording in recordings]))
    times = _consecutive([recording.t_s for recording in recordings])
    truths: dict[Quantity, FloatArray] = {
        "torque": np.concatenate([torques_of(recording) for recording in recordings]),
        "diameter": np.concatenate([recording.diameter_mm for recording in recordings]),
    }
    models: dict[Quantity, SliceModel] = {}
    for quantity, values in truths.items():
        known = np.isfinite(values)
        if known.any():
            model = _fit_model(estimator, matcher, quantity, slices[known], times[known], values[known], full_range)
            models[quantity] = model
    if not models:
        raise CalibrationError("the slices come with neither torque nor diameter")
    return SliceCalibration(
        estimator,
        (side,),
        source,
        physics.bank.identity if with_bank and physics.bank is not None else "",
        models.get("torque"),
        models.get("diameter"),
        ("full range",) if full_range and "torque" in models else (),
        SliceProfile.fit(recordings),
        LearnedFrames.of(recording.channels for recording in recordings),
    )


def _fit_model(
    estimator: Estimator,
    matcher: BankMatcher | None,
    quantity: Quantity,
    slices: FloatArray,
    times: FloatArray,
    values: FloatArray,
    full_range: bool,
) -> SliceModel:
    """Return the model of one quantity from (n, c) slices at times (n,) with known values (n,)."""
    n = len(values)
    if quantity == "torque" and n < least_slices(estimator):
        raise CalibrationError(
            f"too few slices with a torque for the estimator {estimator.name}: {n}; record {least_slices(estimator)} "
            "or more"
        )
    # First, because it checks that a board sent the slices.
    novelty = NoveltyDetector.fit(slices, estimator.table)
    every = np.ones((1, slices.shape[1]), dtype=np.bool_)
    readings = (
        Reading.of(ProcessedFrame(frame[None], (), every), t_s, matcher)
        for frame, t_s in zip(slices, times.tolist(), strict=True)
    )
    features = np.array([estimator.features(reading) for reading in readings])
    of_value, line = fits_of(estimator, quantity, values)
    regressor = fit_slice_regressor(
        features[:, estimator.columns[quantity]],
        values,
        of_value,
        strengths=estimator.strengths,
        left_out=later_levels(values) if quantity == "torque" else (),
        fit_line=line if quantity == "torque" else None,
        full_range=full_range,
    )
    return SliceModel(regressor, novelty, estimator.k_range(features))


def _consecutive(times: list[FloatArray]) -> FloatArray:
    """Return the times of several series one after another; each starts one after the end of the last, or later."""
    shifted: list[FloatArray] = []
    for t_s in times:
        begins_early = bool(shifted) and t_s[0] <= shifted[-1][-1]
        shifted.append(t_s - t_s[0] + shifted[-1][-1] + 1.0 if begins_early else t_s)
    return np.concatenate(shifted)
