"""A session with a calibration: frames in, estimates out, causally."""

import math
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from shearloop.bank.arrays import BoolArray, FloatArray
from shearloop.bank.bank_file import Bank
from shearloop.bank.errors import CalibrationError
from shearloop.estimation.bank_match import BankMatch, BankMatcher
from shearloop.estimation.calibration import Calibration
from shearloop.estimation.confidence import TWO_SIDED_95
from shearloop.estimation.defaults import BASELINE_FRAMES, MAX_GAP_S
from shearloop.estimation.estimator import NO_ERRORS, OutputModel, Quantity, Reading
from shearloop.estimation.fingertip_validator import FingertipValidator
from shearloop.estimation.gain import GainCorrection, find_twists, first_twists
from shearloop.estimation.session_state import PaperState, ProcessedFrame, SessionState, SliceState
from shearloop.estimation.values import Estimate, Measured, TactileFrame
from shearloop.words import counted

REPEATED_FRAME = ("the board sent the same frame again",)
_UNITS: dict[Quantity, str] = {"torque": "N·m", "diameter": "mm"}
_UNKNOWN = (None, None, None)
_UNCALIBRATED = ("no calibration is configured: k and sigma have no torque",)
_AMBIGUOUS = ("two positions of the bank far apart fit the frame equally well",)

# Frames of a grip that can correct its gain: ten minutes.
_ADAPTED_FRAMES = 1200

# A value, and its 95 % interval: how far it extends below and above, or its ends.
_Interval = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class LoadedFit:
    """Estimates under load against a known torque: mean estimate over the torque, and root mean square error.

    spread is the standard deviation of the gain's logarithm that the intervals allow for.
    """

    gain: float
    rmse_nm: float
    spread: float

    @classmethod
    def of(cls, model: OutputModel, features: FloatArray, torque_nm: FloatArray) -> Self:
        """Compare the model on (n, d) features with the torques (n,)."""
        found = np.array([model.regressor.predict(row)[0] for row in features])
        gain = float((found * np.sign(torque_nm)).sum() / np.abs(torque_nm).sum())
        return cls(gain, float(np.sqrt(((found - torque_nm) ** 2).mean())), model.regressor.gain.between)


@dataclass(frozen=True, slots=True, eq=False)
class Adaptation:
    """A correction of this grip's gain, and the loaded frames that it was made from, before and after it."""

    correction: GainCorrection
    before: LoadedFit
    after: LoadedFit


@dataclass(slots=True, eq=False)
class _Grip:
    """The latest frames of a grip with a torque: times and features; and the correction of its gain."""

    frames: deque[tuple[float, FloatArray]] = field(default_factory=lambda: deque(maxlen=_ADAPTED_FRAMES))
    corrected: "_Corrected | None" = None


@dataclass(frozen=True, slots=True, eq=False)
class _Corrected:
    """The torque's model with the gain of a grip, and the held tool that it was made with."""

    model: OutputModel
    tool: Measured | None

    def for_tool(self, tool: Measured | None, whole: Calibration) -> OutputModel:
        """Return the model for a newly measured tool, by the law of the tools in the `whole` calibration.

        The correction is the fingertip's, and the law the tool's: a torque on another diameter is as much larger as
        without the correction. A diameter within the uncertainty of the earlier one is the same tool's.
        """
        law, before, regressor = whole.tools, self.tool, self.model.regressor
        if law is None or tool is None or before is None or tool == before:
            return self.model
        gain_before, gain = law.gain(before.value), law.gain(tool.value)
        if gain_before is None or gain is None:
            # Such a tool has no torque.
            return self.model
        same_tool = abs(tool.value - before.value) <= tool.half_width + before.half_width
        spread = regressor.gain.between if same_tool else math.hypot(regressor.gain.between, law.spread)
        return replace(self.model, regressor=regressor.scaled(gain / gain_before, spread))


class EstimatorSession:
    """One session: `estimate` takes every frame in order and keeps the state that it needs."""

    def __init__(
        self,
        calibration: Calibration,
        bank: Bank | None = None,
        *,
        matcher: BankMatcher | None = None,
        period_s: float = np.inf,
        baseline_frames: int = BASELINE_FRAMES,
        average_frames: int = 1,
        max_gap_s: float = MAX_GAP_S,
    ) -> None:
        """Begin a session; raises CalibrationError for a bank that is missing or another one.

        `matcher` replaces the calibration's own on the bank. `period_s` is the board's frame period, where known. The
        paper's method averages the first `baseline_frames` and the latest `average_frames`.
        """
        self.calibration = calibration
        self._period_s = period_s
        self._averaging = (average_frames, max_gap_s)
        self._baseline_frames = baseline_frames
        self._matcher = matcher or calibration.matcher(bank)
        self.set_tool(None)
        self.reset()

    def set_tool(self, tool: Measured | None) -> None:
        """Set the diameter in mm of the held tool, None where unknown."""
        self._tool = tool
        self._tool_reasons: tuple[str, ...] = ()
        try:
            self._calibration = self.calibration.for_tool(tool)
        except CalibrationError as error:
            self._calibration, self._tool_reasons = self.calibration, (str(error),)

    def tare(self, frames: int | None = None) -> None:
        """Forget the session and average the next `frames` usable frames, of untouched fingertips, into the idle frame.

        Raises CalibrationError for a calibration of slices, which have no idle frame.
        """
        if self.calibration.kind != "raw":
            raise CalibrationError("slices are differences already: they have no zero")
        self.reset(frames or self._baseline_frames)

    def reset(self, idle_frames: int = 0) -> None:
        """Forget the session: the next frame is its first, and the next `idle_frames` usable ones are untouched."""
        calibration = self.calibration
        self._state: SessionState | PaperState | SliceState
        if calibration.kind != "raw":
            self._state = SliceState()
        elif not calibration.sides:
            self._state = PaperState(idle_frames or self._baseline_frames, *self._averaging)
        else:
            motion = calibration.estimator.motion
            self._state = SessionState(calibration.validators, motion, self._period_s, idle_frames)
        # The (m, c) difference to the idle frame behind the last estimate, None where there was none.
        self.difference: FloatArray | None = None
        self._latest: FloatArray = np.full(calibration.estimator.scale.shape, np.nan)
        self._grip = _Grip()

    @property
    def fixed(self) -> dict[str, object]:
        """What follows from the configuration, and is no state."""
        return {"calibration": self.calibration, "matcher": self._matcher}

    @property
    def why_no_torque(self) -> str:
        """Why the held tool leaves no torque, though there may be a diameter; empty where it does not."""
        return "; ".join(self._tool_reasons)

    @property
    def taring(self) -> bool:
        """Whether frames are being averaged into the idle frame."""
        return self._state.taring

    @property
    def grip_t_s(self) -> FloatArray:
        """The times (n,) of this grip's frames; `adapt` takes their torques."""
        return np.array([t_s for t_s, _ in self._grip.frames])

    def adapt(self, torque_nm: FloatArray) -> Adaptation:
        """Correct the gain until the next grip or tare, by torques (n,) measured at `grip_t_s`, NaN where unknown.

        The first twist after the grip settles the gel and is left out. Always starts from the calibration's gain.
        Raises CalibrationError as `Calibration.correct_gain` does, for a tool without a torque, and without a second
        twist.
        """
        if self._tool_reasons:
            raise CalibrationError(self._tool_reasons[0])
        calibration, grip, known = self._calibration, self._grip, np.isfinite(torque_nm)
        width = len(calibration.gain_regressor().mean_feature)
        # Without a frame the rows have no width of their own.
        every = np.array([row for _, row in grip.frames]).reshape(-1, width)
        features, truth = every[known], torque_nm[known]
        settling = first_twists(truth, np.zeros(len(truth), dtype=np.int64))
        largest_nm = float(np.abs(truth).max(initial=0.0))
        features, truth = features[~settling], truth[~settling]
        if settling.any() and not find_twists(truth, largest_nm):
            raise CalibrationError(
                "the first twist after a grip settles the gel and shows another gain than the later ones; twist again, "
                "then adapt"
            )
        before = self._models()["torque"]
        adapted, correction = calibration.correct_gain(features, truth)
        after = adapted.outputs["torque"]
        grip.corrected = _Corrected(after, self._tool)
        rows = np.concatenate(find_twists(truth))
        return Adaptation(
            correction,
            LoadedFit.of(before, features[rows], truth[rows]),
            LoadedFit.of(after, features[rows], truth[rows]),
        )

    def estimate(self, frame: TactileFrame) -> Estimate:
        """Return the estimate of a frame of the calibration's sides.

        Raises CalibrationError for a frame of another number of sides.
        """
        shape = self.calibration.estimator.scale.shape
        if frame.channels.shape != shape:
            raise CalibrationError(
                f"the calibration is of {shape[0]} sides ({', '.join(self.calibration.sides)}), and the frame has the "
                f"shape {frame.channels.shape}"
            )
        self.difference = None
        # Noise makes every side of a new frame differ, except where no channel has a signal.
        repeats = ((frame.channels == self._latest).all(axis=1) & frame.channels.any(axis=1)).any()
        self._latest = frame.channels
        if repeats and self.calibration.kind == "raw":
            return Estimate(valid=False, reasons=REPEATED_FRAME)
        processed = self._state.process(frame)
        if not processed.held_frames:
            self._grip = _Grip()
        if processed.reasons:
            return Estimate(valid=False, reasons=processed.reasons)
        self.difference = processed.difference
        estimate = self._predict(processed, frame.t_s)
        return replace(estimate, lag_s=processed.lag_s) if processed.lag_s else estimate

    def _predict(self, frame: ProcessedFrame, t_s: float) -> Estimate:
        calibration = self.calibration
        outputs, reasons = self._select_outputs(frame)
        if not outputs and calibration.outputs:
            return Estimate(valid=False, reasons=tuple(reasons))
        errors = NO_ERRORS
        if not frame.usable.all():
            novelty = next((one.novelty for one in outputs.values() if one.novelty is not None), None)
            difference, errors = calibration.estimator.impute(frame.difference, frame.usable, novelty)
            self.difference, frame = difference, replace(frame, difference=difference)
        reading = Reading.of(frame, t_s, self._matcher)
        features, match = calibration.estimator.features(reading), next(iter(reading.matches), None)
        if match is not None and match.ambiguous:
            return _estimate({}, _AMBIGUOUS, match)
        if "torque" in outputs:
            self._grip.frames.append((t_s, features[calibration.estimator.columns["torque"]]))
        values: dict[Quantity, _Interval] = {}
        for quantity, model in outputs.items():
            value, against = self._predict_quantity(quantity, model, reading, features, errors)
            reasons |= dict.fromkeys(against)
            if not against:
                values[quantity] = value[0], value[0] - value[1], value[0] + value[2]
        # Tools of several diameters have a diameter where they have no torque.
        several = calibration.tools is not None and bool(self._tool_reasons)
        torque_missing = calibration.torque is not None and "torque" not in values and not several
        if calibration.kind == "raw" and torque_missing:
            # A frame beyond the calibrated torques is beyond the calibrated diameters too.
            values.clear()
        return _estimate(values, reasons, match)

    def _models(self) -> dict[Quantity, OutputModel]:
        """Return the model of each quantity for the held tool, with the grip's gain."""
        models, corrected = self._calibration.outputs, self._grip.corrected
        return models if corrected is None else models | {"torque": corrected.for_tool(self._tool, self.calibration)}

    def _select_outputs(self, frame: ProcessedFrame) -> tuple[dict[Quantity, OutputModel], dict[str, None]]:
        """Return the models to apply to a frame, and the reasons against the others, in order."""
        outputs: dict[Quantity, OutputModel] = {}
        reasons: dict[str, None] = dict.fromkeys(() if self.calibration.outputs else _UNCALIBRATED)
        for quantity, model in self._models().items():
            if quantity == "diameter" and not frame.has_baseline:
                # The gel's position means nothing without its idle position.
                continue
            against = self._tool_reasons if quantity == "torque" else ()
            if model.novelty is not None:
                against = (*model.novelty.reasons(frame.difference[0], frame.usable[0]), *against)
            reasons |= dict.fromkeys(against)
            if not against:
                outputs[quantity] = model
        return outputs, reasons

    def _predict_quantity(
        self, quantity: Quantity, model: OutputModel, reading: Reading, features: FloatArray, errors: FloatArray
    ) -> tuple[_Interval, tuple[str, ...]]:
        """Return one quantity with its interval, and the reasons against it.

        Imputed channels have the (k, m, c) errors, one standard deviation each.
        """
        frame, estimator = reading.frame, self.calibration.estimator
        features, complete = estimator.inputs(quantity, features, reading), None
        if quantity == "torque" and model.novelty is not None and estimator.uses_amplitude:
            missing = model.novelty.missing_share(frame.difference[0], frame.usable[0])
            if missing:
                complete = self._regressor_inputs(quantity, reading, frame.difference / (1.0 - missing))
        usable_share = np.count_nonzero(frame.usable) / frame.usable.size
        value = model.regressor.predict(features, usable_share, complete)
        dead: tuple[str, ...] = ()
        if len(errors):
            changed = [self._regressor_inputs(quantity, reading, frame.difference + one) for one in errors]
            error = TWO_SIDED_95 * math.hypot(*(model.regressor.predict(one)[0] - value[0] for one in changed))
            # The gain's error is the same with all channels.
            reach = model.regressor.gain.reach(value[0])
            own = [math.sqrt(max(ends[0] ** 2 - ends[1] ** 2, 0.0)) for ends in zip(value[1:], reach, strict=True)]
            if 2 * error > sum(own):
                # The dead channels carried the value; the imputed ones are a guess.
                dead = _dead_channel_reasons(self.calibration.validators, frame.usable)
            value = value[0], math.hypot(value[1], error), math.hypot(value[2], error)
        if quantity == "diameter":
            error = estimator.position_noise_mm(model.regressor) / math.sqrt(frame.held_frames)
            value = value[0], math.hypot(value[1], error), math.hypot(value[2], error)
        against = dead or tuple(why for match in reading.matches[:1] for why in model.match_reasons(match))
        return value, against or model.regressor.range_reasons(value[0], features, quantity, _UNITS[quantity])

    def _regressor_inputs(self, quantity: Quantity, reading: Reading, difference: FloatArray) -> FloatArray:
        """Return the regressor's inputs if this were the frame's difference."""
        changed = Reading.of(replace(reading.frame, difference=difference), reading.t_s, self._matcher)
        estimator = self.calibration.estimator
        return estimator.inputs(quantity, estimator.features(changed), changed)


def _dead_channel_reasons(validators: tuple[FingertipValidator, ...], usable: BoolArray) -> tuple[str, ...]:
    """Return which fingertips lack channels that worked at calibration, as reasons against an estimate."""
    missing = [int(np.sum(~mask & np.isfinite(one.noise))) for one, mask in zip(validators, usable, strict=True)]
    return tuple(
        f"{one.side} fingertip: the estimate depends on every channel that worked at calibration, and "
        f"{counted(n, 'is', 'are')} dead or saturated; check the ribbon cable, calibrate again, or use the "
        "estimator motion_regression"
        for one, n in zip(validators, missing, strict=True)
        if n
    )


def _estimate(values: Mapping[Quantity, _Interval], reasons: Iterable[str], match: BankMatch | None) -> Estimate:
    """Return the estimate of values with the ends of their intervals."""
    torque, diameter = values.get("torque", _UNKNOWN), values.get("diameter", _UNKNOWN)
    estimate = Estimate(bool(values), () if values else tuple(reasons), *torque, *diameter)
    if match is None:
        return estimate
    return replace(estimate, k=match.k, sigma=match.sigma, score=match.score, runner_up=match.runner_up)
