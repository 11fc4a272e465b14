"""A session: the state of one run with a calibration. Frames in, estimates out, causally.

A frame passes the timer, the checks of its channels, the idle frames, the grips, and the memory of this grip. Its
features then go through the models of the calibration.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from shearloop.bank.arrays import BoolArray, FloatArray
from shearloop.bank.errors import CalibrationError
from shearloop.estimation.adaptation import Adaptation, GripGain
from shearloop.estimation.calibration import Calibration
from shearloop.estimation.defaults import BASELINE_FRAMES
from shearloop.estimation.estimator import NO_ERRORS, OutputModel, Quantity, Reading, match_reasons
from shearloop.estimation.fingertip_validator import FingertipSet, FingertipValidator, GripDetector
from shearloop.estimation.frame_checks import ChannelChecks, FrameTimer
from shearloop.estimation.grip_memory import GripMemory
from shearloop.estimation.grip_strength import strength_reasons
from shearloop.estimation.idle_frames import IdleFrames
from shearloop.estimation.interval_regressor import Predicted
from shearloop.estimation.values import (
    TWO_SIDED_95,
    BeforeFrame,
    Estimate,
    GripState,
    Measured,
    ProcessedFrame,
    TactileFrame,
)
from shearloop.words import counted

if TYPE_CHECKING:
    from shearloop.bank.bank_file import Bank
    from shearloop.estimation.bank_match import BankMatch, BankMatcher, BankSearch

_REPEATED_FRAME = "the board sent the same frame again"
_REPEATED_SIDE = "a fingertip's frame is the one before: the next came late, or the board sent it again"
FINGERS_MOVED = "the fingers moved while this frame was acquired"
_NO_IDLE_FRAME = ("no idle frame: it took too long, or something was gripped; tare again with nothing gripped",)
_NEVER_IDLE = "it was not seen untouched since the start; if it holds a tool, release it, tare, and grip again"
UNITS: dict[Quantity, str] = {"torque": "N·m", "diameter": "mm"}
_UNKNOWN = (None, None, None)
_UNCALIBRATED = ("no calibration is configured: k and sigma have no torque",)
AMBIGUOUS = ("two positions of the bank far apart fit the frame equally well",)

# A frame is read half a period after its middle. One that is read this long after it waited for a reader that stood
# still, and the next frame is there, or nearly.
_WAITED_PERIODS = 1.25


class Session:
    """State of one run: `estimate` takes every frame of the calibration's sides, in order."""

    # Frames that an estimate averages.
    averaged_frames = 1

    def __init__(
        self,
        calibration: Calibration,
        bank: "Bank | None" = None,
        *,
        matcher: "BankMatcher | None" = None,
        search: "BankSearch | None" = None,
        period_s: float = np.inf,
        baseline_frames: int = BASELINE_FRAMES,
    ) -> None:
        """Begin a session; raises CalibrationError for a bank that is missing or another one.

        `matcher` replaces the calibration's own on the bank. `search` adds a position in a bank to estimates without
        one, and gives the heatmap. `period_s` is the board's frame period, where known. A tare averages
        `baseline_frames`.
        """
        self.calibration = calibration
        self.search = search
        self._period_s = period_s
        self._baseline_frames = baseline_frames
        self._matcher = matcher or calibration.matcher(bank)
        # Why the held tool leaves no torque, though there may be a diameter; empty where it does not.
        self.why_no_torque = ""
        # Whether the gripper holds something, as far as it says.
        self._gripper_holds = False
        self._gain = GripGain()
        self.set_tool(None)
        self.reset()

    def prepare(self, before: BeforeFrame) -> None:
        """Apply what comes before the next frame: first the tare, then the tool.

        Give `before.known_torques` to `adapt` after that, and `before.fingers_moved` to `estimate`, as a part of the
        frame.
        """
        if before.begins_tare:
            self.tare()
        if before.gives_up_tare:
            self.give_up_tare()
        if before.tool is not None:
            self._gripper_holds = before.tool.measured is not None
            self.set_tool(before.tool.diameter)
            self.why_no_torque = before.tool.conflict or self.why_no_torque

    def set_tool(self, tool: Measured | None) -> None:
        """Set the diameter in mm of the held tool, None where unknown."""
        self._tool = tool
        self.why_no_torque = ""
        try:
            self._calibration = self.calibration.for_tool(tool)
        except CalibrationError as error:
            self._calibration, self.why_no_torque = self.calibration, str(error)
        self._update_models()

    def _update_models(self) -> None:
        """Choose the model of each quantity, for the held tool and with the grip's gain."""
        self._models = self._gain.models(self._calibration, self._tool, self.calibration)

    def _forget_gain(self) -> None:
        """Forget the gain of the last grip, and its frames."""
        self._gain = GripGain()
        self._update_models()

    def tare(self, frames: int | None = None) -> None:
        """Forget the session; the next `frames` usable frames, of untouched fingertips, make the idle frame."""
        self.reset(frames or self._baseline_frames)

    def reset(self, idle_frames: int = 0) -> None:
        """Forget the session: the next frame is its first, and the next `idle_frames` usable ones are untouched."""
        self._lacks_idle_frame = False
        self._begin(idle_frames)
        # The (m, c) difference to the idle frame behind the last estimate, None where there was none.
        self.difference: FloatArray | None = None
        self._latest: FloatArray = np.full(self.calibration.estimator.scale.shape, np.nan)
        self._forget_gain()
        # The strength of the last grip by side, as a ratio of the calibrated ones.
        self.grip_strengths: dict[str, float] = {}

    def _begin(self, idle_frames: int) -> None:
        """Forget all frames."""
        calibration = self.calibration
        motion, fingertips = calibration.estimator.motion, FingertipSet(calibration.validators)
        self._fingertips = fingertips
        self._motion = motion
        self._timer = FrameTimer(self._period_s)
        self._checks = ChannelChecks(fingertips, motion)
        self._idle = IdleFrames(fingertips, idle_frames)
        self._grips = [GripDetector(validator) for validator in fingertips.sides]
        self._memory = GripMemory(motion, fingertips.idle.shape)

    def give_up_tare(self) -> None:
        """End a tare that is not complete: later frames could be of any load. None has an estimate until the next."""
        self._lacks_idle_frame = True

    @property
    def fixed(self) -> dict[str, object]:
        """What follows from the configuration, and is no state."""
        return {"calibration": self.calibration, "matcher": self._matcher, "search": self.search}

    @property
    def taring(self) -> bool:
        """Whether frames are being averaged into the idle frame."""
        return self._idle.taring and not self._lacks_idle_frame

    @property
    def grip_t_s(self) -> FloatArray:
        """The times (n,) of this grip's frames; `adapt` takes their torques."""
        return self._gain.t_s

    def adapt(self, torque_nm: FloatArray) -> Adaptation:
        """Correct the gain until the next grip or tare, by torques (n,) measured at `grip_t_s`, NaN where unknown.

        Raises CalibrationError as `GripGain.correct` does, for a tool without a torque, for torques that are not of
        this grip, and for a grip of a strength that the calibration does not hold for: twists do not cure that.
        """
        if len(torque_nm) != len(self._gain.frames):
            raise CalibrationError(
                f"{len(torque_nm)} known torques do not match the {len(self._gain.frames)} frames of this grip; twist "
                "again, then adapt"
            )
        if self.why_no_torque:
            raise CalibrationError(self.why_no_torque)
        if reasons := strength_reasons(self.grip_strengths):
            raise CalibrationError(reasons[0])
        adaptation = self._gain.correct(self._calibration, self._tool, self.calibration, torque_nm)
        self._update_models()
        return adaptation

    def heatmap(self) -> FloatArray | None:
        """Return the (K, S) scores of the first side's last difference, None without a bank or a difference."""
        difference = self._first_difference()
        return None if self.search is None or difference is None else self.search.heatmap(difference)

    def is_old(self, frame: TactileFrame) -> bool:
        """Return whether a newer frame waits behind this one: then its position, which is slow to find, is not needed.

        Its torque belongs to the history of the newer ones.
        """
        return frame.read_after_periods > _WAITED_PERIODS

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
        if self._lacks_idle_frame:
            return Estimate(valid=False, reasons=_NO_IDLE_FRAME)
        processed = self.process(frame)
        if processed.grip is GripState.NONE:
            self._forget_gain()
        if processed.reasons:
            return Estimate(valid=False, reasons=processed.reasons)
        self.difference = processed.difference
        estimate = self._predict(processed, frame.t_s)
        if self.search is not None and not self.is_old(frame):
            estimate = self._with_position(estimate, self.search)
        return replace(estimate, lag_s=processed.lag_s) if processed.lag_s else estimate

    def process(self, frame: TactileFrame) -> ProcessedFrame:
        """Take the next frame and return its difference to the idle frame, or the reasons against it.

        A fit takes its frames from here too, so every check that does not depend on the fit belongs here. A frame of
        moving fingers belongs to the grip's memory, and gives neither an estimate nor an idle frame.
        """
        if repeated := self._repeats(frame):
            return ProcessedFrame.refused(frame.usable, repeated)
        processed = self._process(frame)
        if not frame.fingers_moved:
            return processed
        return replace(processed, reasons=(FINGERS_MOVED, *processed.reasons))

    def _repeats(self, frame: TactileFrame) -> str:
        """Return why a frame is no new one; empty for a new one."""
        before, self._latest = self._latest, frame.channels
        if frame.repeated:
            return _REPEATED_FRAME
        # Noise makes every side of a new frame differ, except where no channel has a signal.
        is_before = (frame.channels == before).all(axis=1) & frame.channels.any(axis=1)
        if not is_before.any():
            return ""
        return _REPEATED_FRAME if len(frame.channels) == 1 else _REPEATED_SIDE

    def _process(self, frame: TactileFrame) -> ProcessedFrame:
        """Return the difference of a new frame, or the reasons against it other than moving fingers."""
        checks, idle = self._checks, self._idle
        missing = self._timer.missing_before(frame.t_s)
        if missing is None:
            # The last frames do not show how the gel has moved. In a tare, compare with its last frame: a tool may
            # have been gripped or released in the gap.
            self._memory.forget(self._timer.gap)
            for grip in self._grips:
                grip.forget_steps()
            checks.restart(idle.last_tare_frame())
            missing = 0
        checked = checks.check(frame)
        channels, usable = checked.channels, checked.usable
        if checked.reasons:
            # One garbled frame is no other fingertip: skip it like a disturbed one.
            checks.skip()
            self._memory.skip(missing)
            return ProcessedFrame.refused(usable, *checked.reasons)
        if checked.disturbance:
            self._bridge(channels, missing)
            return ProcessedFrame.refused(usable, checked.disturbance)
        is_first = checks.before is None
        if is_first and not idle.begun:
            checks.begin(usable)
        checks.accept(channels)
        if idle.taring and frame.fingers_moved:
            # Something may have been gripped or released.
            idle.restart_tare()
            return ProcessedFrame.refused(usable)
        if idle.taring:
            return ProcessedFrame.refused(usable, idle.add_to_tare(channels))
        if is_first:
            first = "there is no earlier frame to compare with"
            return ProcessedFrame.refused(usable, self._memory.waits() if self._memory.interrupted else first)
        if not (self._memory.positions or frame.fingers_moved or self._gripper_holds):
            # Follow the idle frame while nothing is gripped; a session that begins gripped keeps the calibration's.
            for layer in idle.idle_sides(channels):
                restored = checks.restore(layer, channels, frame)
                idle.follow(layer, channels[layer], restart=restored)
        return self._check_grip(channels, usable, missing)

    def _bridge(self, channels: FloatArray, missing: int) -> None:
        """Skip a disturbed frame; if it agrees with the one before, the change is real and the past is void."""
        if self._checks.confirm(channels):
            # In a tare, the tool was gripped or released meanwhile.
            self._memory.forget()
            self._idle.restart_tare()
        else:
            self._memory.skip(missing)

    def _check_grip(self, channels: FloatArray, usable: BoolArray, missing: int) -> ProcessedFrame:
        """Return the difference of a frame, with the memory of its grip."""
        idle, sides, loose = self._idle, self._fingertips.sides, []
        from_idle = channels - idle.baselines
        if not usable.all():
            from_idle = self._motion.impute(from_idle, usable, sides, from_idle=True)
        # At the calibration's gain. It does not change while gripped.
        difference = from_idle / idle.gains
        for layer, (validator, grip) in enumerate(zip(sides, self._grips, strict=True)):
            known = idle.baselines[layer], idle.gains[layer], idle.least_scores[layer]
            if not grip.update(channels[layer], *known):
                loose.append(validator.side)
        if loose:
            self._memory.forget()
            reason = f"no grip at the {' and '.join(loose)} fingertip"
            if not idle.complete:
                reason += f"; {_NEVER_IDLE}"
            return ProcessedFrame(difference, (reason,), usable, GripState.NONE)
        memory = self._memory
        # Motion is read in volts: after a release a gel's idle voltages recover for minutes, which is no gain.
        recent = memory.remember(channels, from_idle, difference, missing)
        self.grip_strengths = {
            validator.side: grip.strength_ratio for validator, grip in zip(sides, self._grips, strict=True)
        }
        if reasons := (recent,) if recent else strength_reasons(self.grip_strengths):
            return ProcessedFrame(difference, reasons, usable, GripState.HELD)
        return ProcessedFrame(
            difference,
            (),
            usable,
            GripState.HELD,
            mean_difference=memory.mean_difference,
            motion=memory.features,
            held_frames=memory.held_frames,
            has_baseline=idle.complete,
        )

    def _first_difference(self) -> FloatArray | None:
        return self.difference[0] if self.difference is not None and self.difference[0].any() else None

    def _with_position(self, estimate: Estimate, search: "BankSearch") -> Estimate:
        """Return an estimate with its position in the searched bank."""
        difference = self._first_difference()
        if not estimate.valid or estimate.k is not None or difference is None:
            return estimate
        match = search.match(difference)
        return replace(estimate, k=match.k, sigma=match.sigma, score=match.score, runner_up=match.runner_up)

    def _predict(self, frame: ProcessedFrame, t_s: float) -> Estimate:
        calibration = self.calibration
        outputs, reasons = self._select_outputs(frame)
        if not outputs and self._models:
            return Estimate(valid=False, reasons=tuple(reasons))
        errors = NO_ERRORS
        if not frame.usable.all():
            difference, errors = calibration.estimator.impute(frame.difference, frame.usable)
            self.difference, frame = difference, replace(frame, difference=difference)
        reading = Reading.of(frame, t_s, self._matcher)
        features, match = calibration.estimator.features(reading), next(iter(reading.matches), None)
        if reading.is_ambiguous:
            return estimate_of({}, AMBIGUOUS, match)
        if "torque" in outputs:
            self._gain.frames.append((t_s, features[calibration.estimator.columns["torque"]]))
        values: dict[Quantity, Predicted] = {}
        for quantity, model in outputs.items():
            predicted, against = self._predict_quantity(quantity, model, reading, features, errors)
            reasons |= dict.fromkeys(against)
            if not against:
                values[quantity] = predicted
        # Tools of several diameters have a diameter where they have no torque.
        several = calibration.tools is not None and self.why_no_torque != ""
        torque_missing = calibration.torque is not None and "torque" not in values and not several
        if torque_missing:
            # A frame beyond the calibrated torques is beyond the calibrated diameters too.
            values.clear()
        return estimate_of(values, reasons, match)

    def _select_outputs(self, frame: ProcessedFrame) -> tuple[dict[Quantity, OutputModel], dict[str, None]]:
        """Return the models to apply to a frame, and the reasons against the others, in order."""
        outputs = dict(self._models)
        reasons: dict[str, None] = dict.fromkeys(() if outputs else _UNCALIBRATED)
        if not frame.has_baseline:
            # The gel's position means nothing without its idle position.
            outputs.pop("diameter", None)
        if self.why_no_torque and outputs.pop("torque", None) is not None:
            reasons[self.why_no_torque] = None
        return outputs, reasons

    def _predict_quantity(
        self, quantity: Quantity, model: OutputModel, reading: Reading, features: FloatArray, errors: FloatArray
    ) -> tuple[Predicted, tuple[str, ...]]:
        """Return one quantity with its interval, and the reasons against it.

        Imputed channels have the (k, m, c) errors, one standard deviation each.
        """
        frame, estimator = reading.frame, self.calibration.estimator
        features = estimator.inputs(quantity, features, reading)
        usable_share = np.count_nonzero(frame.usable) / frame.usable.size
        predicted = model.regressor.predict(features, usable_share)
        dead: tuple[str, ...] = ()
        if len(errors):
            changed = [self._regressor_inputs(quantity, reading, frame.difference + error) for error in errors]
            moved = (model.regressor.predict(inputs).value - predicted.value for inputs in changed)
            error = TWO_SIDED_95 * math.hypot(*moved)
            # The gain's error is the same with all channels.
            down, up = model.regressor.gain.reach(predicted.value)
            own_below = math.sqrt(max(predicted.below**2 - down**2, 0.0))
            own_above = math.sqrt(max(predicted.above**2 - up**2, 0.0))
            if 2 * error > own_below + own_above:
                # The dead channels carried the value; the imputed ones are a guess.
                dead = _dead_channel_reasons(self.calibration.validators, frame.usable)
            predicted = predicted.widened(error)
        if quantity == "diameter":
            noise_mm = estimator.position_noise_mm(model.regressor) / math.sqrt(frame.held_frames)
            predicted = predicted.widened(noise_mm)
        against = dead or tuple(why for match in reading.matches[:1] for why in match_reasons(model.k_range, match))
        beyond = model.regressor.range_reasons(predicted.value, features, quantity, UNITS[quantity])
        return predicted, against or beyond

    def _regressor_inputs(self, quantity: Quantity, reading: Reading, difference: FloatArray) -> FloatArray:
        """Return the regressor's inputs if this were the frame's difference."""
        changed = Reading.of(replace(reading.frame, difference=difference), reading.t_s, self._matcher)
        estimator = self.calibration.estimator
        return estimator.inputs(quantity, estimator.features(changed), changed)


def _dead_channel_reasons(validators: tuple[FingertipValidator, ...], usable: BoolArray) -> tuple[str, ...]:
    """Return which fingertips lack channels that worked at calibration, as reasons against an estimate."""
    missing = [
        int(np.sum(~mask & np.isfinite(validator.noise))) for validator, mask in zip(validators, usable, strict=True)
    ]
    return tuple(
        f"{validator.side} fingertip: the estimate depends on every channel that worked at calibration, and "
        f"{counted(n, 'is', 'are')} dead or saturated; check the ribbon cable, calibrate again, or use the "
        "estimator motion_regression"
        for validator, n in zip(validators, missing, strict=True)
        if n
    )


def estimate_of(values: Mapping[Quantity, Predicted], reasons: Iterable[str], match: "BankMatch | None") -> Estimate:
    """Return the estimate of values with the ends of their intervals."""
    known = {quantity: (predicted.value, *predicted.ends) for quantity, predicted in values.items()}
    torque, diameter = known.get("torque", _UNKNOWN), known.get("diameter", _UNKNOWN)
    estimate = Estimate(bool(values), () if values else tuple(reasons), *torque, *diameter)
    if match is None:
        return estimate
    return replace(estimate, k=match.k, sigma=match.sigma, score=match.score, runner_up=match.runner_up)
