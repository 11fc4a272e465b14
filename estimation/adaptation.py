"""The correction of a grip's gain by twists of known torque, while a session runs."""

import math
from collections import deque
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Self

import numpy as np

from shearloop.bank.arrays import FloatArray
from shearloop.bank.errors import CalibrationError
from shearloop.estimation.calibration import Calibration
from shearloop.estimation.estimator import OutputModel, Quantity
from shearloop.estimation.twists import find_twists, first_twists
from shearloop.estimation.values import Measured

if TYPE_CHECKING:
    from shearloop.estimation.gain_correction import GainCorrection

# Frames of a grip that can correct its gain: ten minutes.
_ADAPTED_FRAMES = 1200


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
        found = np.array([model.regressor.predict(row).value for row in features])
        gain = float((found * np.sign(torque_nm)).sum() / np.abs(torque_nm).sum())
        return cls(gain, float(np.sqrt(((found - torque_nm) ** 2).mean())), model.regressor.gain.between)


@dataclass(frozen=True, slots=True, eq=False)
class Adaptation:
    """A correction of this grip's gain, and the loaded frames that it was made from, before and after it."""

    correction: "GainCorrection"
    before: LoadedFit
    after: LoadedFit


@dataclass(slots=True, eq=False)
class GripGain:
    """The latest frames of a grip with a torque: times and features; and the correction of its gain."""

    frames: deque[tuple[float, FloatArray]] = field(default_factory=lambda: deque(maxlen=_ADAPTED_FRAMES))
    corrected: "CorrectedGain | None" = None

    @property
    def t_s(self) -> FloatArray:
        """The times (n,) of the frames."""
        return np.array([t_s for t_s, _ in self.frames])

    def models(
        self, calibration: Calibration, tool: Measured | None, whole: Calibration
    ) -> dict[Quantity, OutputModel]:
        """Return the model of each quantity, of a calibration for the held tool; the torque's has the grip's gain.

        `whole` is the calibration of all tools.
        """
        models, corrected = calibration.outputs, self.corrected
        return models if corrected is None else models | {"torque": corrected.for_tool(tool, whole)}

    def correct(
        self, calibration: Calibration, tool: Measured | None, whole: Calibration, torque_nm: FloatArray
    ) -> Adaptation:
        """Correct the gain by torques (n,) measured at the frames' times, NaN where unknown.

        The first twist after the grip settles the gel and is left out. Always starts from the calibration's gain.
        Raises CalibrationError as `Calibration.correct_gain` does, and without a second twist.
        """
        known = np.isfinite(torque_nm)
        width = len(calibration.gain_regressor().mean_feature)
        # Without a frame the rows have no width of their own.
        every = np.array([row for _, row in self.frames]).reshape(-1, width)
        features, truth = every[known], torque_nm[known]
        settling = first_twists(truth, np.zeros(len(truth), dtype=np.int64))
        largest_nm = float(np.abs(truth).max(initial=0.0))
        features, truth = features[~settling], truth[~settling]
        if settling.any() and not find_twists(truth, largest_nm):
            unknown = "" if known.all() else f" ({(~known).sum()} of its {len(known)} frames have no known torque)"
            raise CalibrationError(
                f"this grip has no second twist of known torque{unknown}, and the first one settles the gel and shows "
                "another gain than the later ones; twist again, then adapt"
            )
        before = self.models(calibration, tool, whole)["torque"]
        adapted, correction = calibration.correct_gain(features, truth)
        after = adapted.outputs["torque"]
        self.corrected = CorrectedGain(after, tool)
        rows = np.concatenate(find_twists(truth))
        return Adaptation(
            correction,
            LoadedFit.of(before, features[rows], truth[rows]),
            LoadedFit.of(after, features[rows], truth[rows]),
        )


@dataclass(frozen=True, slots=True, eq=False)
class CorrectedGain:
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
