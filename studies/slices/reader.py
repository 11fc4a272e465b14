"""Estimates of slices, each by itself: nothing is remembered between them."""

from dataclasses import replace

import numpy as np

from shearloop.bank.arrays import BoolArray, FloatArray
from shearloop.bank.bank_file import Bank
from shearloop.bank.errors import CalibrationError
from shearloop.estimation import Estimate, TactileFrame
from shearloop.estimation.estimator import Quantity, Reading, match_reasons
from shearloop.estimation.interval_regressor import Predicted
from shearloop.estimation.session import AMBIGUOUS, UNITS, estimate_of
from shearloop.estimation.values import ProcessedFrame
from shearloop.studies.slices.calibration import SliceCalibration, SliceModel
from shearloop.studies.slices.estimators import ignores_nan, uses_amplitude


class SliceReader:
    """Reads slices with a calibration."""

    def __init__(self, calibration: SliceCalibration, bank: Bank | None = None) -> None:
        """Take the calibration; raises CalibrationError for a bank that is missing or another one."""
        self.calibration = calibration
        self._matcher = calibration.matcher(bank)

    def estimate(self, frame: TactileFrame) -> Estimate:
        """Return the estimate of a slice; raises CalibrationError for slices of several fingertips."""
        calibration, estimator = self.calibration, self.calibration.estimator
        if frame.channels.shape != estimator.scale.shape:
            raise CalibrationError(
                f"the calibration is of {estimator.scale.shape[0]} sides ({', '.join(calibration.sides)}), and the "
                f"frame has the shape {frame.channels.shape}"
            )
        differences, usable = np.abs(frame.channels), frame.usable
        reasons: dict[str, None] = {}
        models: dict[Quantity, SliceModel] = {}
        for quantity, model in calibration.outputs.items():
            against = model.novelty.reasons(differences[0], usable[0])
            reasons |= dict.fromkeys(against)
            if not against:
                models[quantity] = model
        if not models:
            return Estimate(valid=False, reasons=tuple(reasons))
        if not usable.all():
            novelty = next(iter(models.values())).novelty
            imputed = np.nan if ignores_nan(estimator) else novelty.impute(differences[0], usable[0])
            differences = np.where(usable, differences, imputed)
        reading = self._read(differences, usable, frame.t_s)
        match = next(iter(reading.matches), None)
        if reading.is_ambiguous:
            return estimate_of({}, AMBIGUOUS, match)
        values: dict[Quantity, Predicted] = {}
        for quantity, model in models.items():
            predicted = self._predict(quantity, model, reading)
            against = () if match is None else match_reasons(model.k_range, match)
            against = against or model.regressor.range.reasons(predicted.value, quantity, UNITS[quantity])
            reasons |= dict.fromkeys(against)
            if not against:
                values[quantity] = predicted
        return estimate_of(values, reasons, match)

    def _read(self, differences: FloatArray, usable: BoolArray, t_s: float) -> Reading:
        return Reading.of(ProcessedFrame(differences, (), usable), t_s, self._matcher)

    def _predict(self, quantity: Quantity, model: SliceModel, reading: Reading) -> Predicted:
        """Return one quantity with its interval."""
        estimator, frame = self.calibration.estimator, reading.frame
        features, complete = estimator.inputs(quantity, estimator.features(reading), reading), None
        if quantity == "torque" and uses_amplitude(estimator):
            missing = model.novelty.missing_share(frame.difference[0], frame.usable[0])
            if missing:
                whole = Reading.of(
                    replace(frame, difference=frame.difference / (1.0 - missing)), reading.t_s, self._matcher
                )
                complete = estimator.inputs(quantity, estimator.features(whole), whole)
        usable_share = np.count_nonzero(frame.usable) / frame.usable.size
        return model.regressor.predict(features, usable_share, complete)
