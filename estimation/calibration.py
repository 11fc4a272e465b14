"""Calibration of one estimator: its fingertips, its outputs, and its file."""

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal, Self

import numpy as np

from shearloop.bank.arrays import BoolArray, FloatArray
from shearloop.bank.channels import PAPER_TABLE, ChannelTable
from shearloop.bank.errors import CalibrationError
from shearloop.estimation.archive import Format
from shearloop.estimation.estimator import Estimator, OutputModel, Quantity
from shearloop.estimation.estimator_names import estimator_class
from shearloop.estimation.fingertip_validator import FingertipValidator
from shearloop.estimation.gain import ToolLaw
from shearloop.estimation.interval_regressor import IntervalRegressor
from shearloop.estimation.learned_frames import UNKNOWN_FRAMES, LearnedFrames
from shearloop.estimation.ridge import CensoredRidge
from shearloop.estimation.torque_profile import TorqueProfile
from shearloop.estimation.values import INLINE, Measured, is_another_tool

if TYPE_CHECKING:
    from shearloop.bank.bank_file import Bank
    from shearloop.estimation.bank_match import BankMatcher
    from shearloop.estimation.gain_correction import GainCorrection

FORMAT_VERSION = 11
_FORMAT = Format("estimator calibration", FORMAT_VERSION, estimator_class)

# What the user guarantees, with the end of a sentence that says so.
Assumption = Literal["load timing"]
_ASSUMPTION_TEXTS: dict[Assumption, str] = {"load timing": "the load cell's delay is as given (--load-cell-delay-s)"}
_UNKNOWN_STRENGTH = (
    "every grip is about as strong as in the calibration, because the file does not hold that strength (calibrate "
    "again to have it checked)"
)
_ONE_SIGN = {
    sign: f"no torque is {other}, because its recordings have {recorded} torques alone"
    for sign, recorded, other in ((1, "positive", "negative"), (-1, "negative", "positive"))
}


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """An estimator with its fingertips and the models of its outputs; `source` describes the data in words.

    sides is empty where nothing is known of the fingertip (`uncalibrated`). bank_identity is empty for an estimator
    without a bank. tool_mm is the diameter of the only tool in the recordings, else NaN. With `tools` the torque is in
    units of their gain (`for_tool`). `profile` is the torque without a sensor, `learned` the frames behind all of this.
    """

    estimator: Estimator = field(metadata=INLINE)
    sides: tuple[str, ...]
    source: str
    bank_identity: str
    tool_mm: float = np.nan
    validators: tuple[FingertipValidator, ...] = ()
    torque: OutputModel | None = None
    diameter: OutputModel | None = None
    assumptions: tuple[Assumption, ...] = ()
    tools: ToolLaw | None = None
    profile: TorqueProfile | None = None
    learned: LearnedFrames = UNKNOWN_FRAMES
    # Whether a recording behind it is of emulated devices: it says nothing about a real fingertip.
    emulated: bool = False

    def for_tool(self, tool: Measured | None) -> Self:
        """Return the calibration for a tool, itself where it is made for that tool; else raises CalibrationError.

        On a tool of another diameter the same motion of the gel is another torque: four times as much on one of 10 mm
        as on one of 20 mm.
        """
        law, own_mm = self.tools, self.tool_mm
        if law is None or self.torque is None:
            if tool is None or not is_another_tool(own_mm, tool):
                return self
            raise CalibrationError(
                f"the tool has {tool.value:.3g} mm, and the calibration was made with a tool of {own_mm:g} mm; its "
                "torque differs: calibrate with this tool"
            )
        tools = f"tools of {law.low_mm:g} to {law.high_mm:g} mm, whose torques differ"
        if tool is None:
            raise CalibrationError(
                f"there is no torque without the tool's diameter, because the calibration is of {tools}: name the "
                "tool's diameter, or let a calibrated gripper measure it"
            )
        if (gain := law.gain(tool.value)) is None:
            raise CalibrationError(
                f"the tool has {tool.value:.3g} mm, too far from the calibration's {tools}: calibrate with this tool"
            )
        regressor = self.torque.regressor.scaled(gain, law.spread)
        return replace(self, torque=replace(self.torque, regressor=regressor), tools=None, tool_mm=tool.value)

    def tool_note(self, source: str, *, tool_known: bool, cure: str = "state `tool_mm` in the experiment") -> str:
        """Return what the torque of a source rests on that nothing checks about the held tool; empty for nothing.

        A calibration of several tools has no torque without a diameter.
        """
        if self.torque is None or self.tools is not None:
            return ""
        if math.isnan(self.tool_mm):
            again = "calibrate on one tool, and name its diameter"
            return (
                f"the calibration of {source} names no single tool, so nothing checks that it holds for this: {again}"
            )
        if not tool_known:
            only = f"the torque of {source} holds for a tool of {self.tool_mm:g} mm alone"
            return f"the tool's diameter is not known, and {only}: {cure}"
        return ""

    def gain_regressor(self) -> IntervalRegressor:
        """Return the torque's regressor, for a correction of its gain; raises CalibrationError without one."""
        if self.torque is None:
            raise CalibrationError(
                "the calibration has no torque, and so no gain to correct; calibrate with a load cell"
            )
        return self.torque.regressor

    def correct_gain(
        self, features: FloatArray, torque_nm: FloatArray, first: BoolArray | None = None
    ) -> tuple[Self, "GainCorrection"]:
        """Return the calibration with the gain of each side corrected by (n, d) features of known torques (n,).

        `first` (n,) marks frames of the first twist after a grip. Raises CalibrationError as `gain_regressor` does,
        without a load that is large enough to show the gain, and for twists that do not narrow it.
        """
        # Few runs correct a gain.
        from shearloop.estimation.gain_correction import adapt_regressor

        torque, regressor = self.torque, self.gain_regressor()
        sides = self.estimator.side_of_features(len(regressor.mean_feature))
        adapted, correction = adapt_regressor(regressor, features, torque_nm, sides, first)
        return replace(self, torque=torque and replace(torque, regressor=adapted)), correction

    @classmethod
    def uncalibrated(cls, bank_identity: str, table: ChannelTable = PAPER_TABLE) -> Self:
        """Return the paper's estimator on a bank without any fit: it gives k and sigma alone."""
        paper = estimator_class("paper")(np.ones((1, table.n_channels)), table)
        return cls(paper, (), "", bank_identity, learned=LearnedFrames.of([]))

    @property
    def table(self) -> ChannelTable:
        """The fingertip's channels."""
        return self.estimator.table

    @property
    def measures_torque(self) -> bool:
        """Whether it gives torques, and not only diameters or positions in a bank."""
        return self.torque is not None

    @property
    def only_sign(self) -> int:
        """The sign of the only torques that it measures: its load cell was pushed from one side; 0 for both signs.

        A tool that is twisted the other way may read as 0.
        """
        point = self.torque.regressor.point if self.torque is not None else None
        return round(point.sign) if isinstance(point, CensoredRidge) else 0

    @property
    def outputs(self) -> dict[Quantity, OutputModel]:
        """The model of each quantity that the estimator gives."""
        models: dict[Quantity, OutputModel | None] = {"torque": self.torque, "diameter": self.diameter}
        return {quantity: model for quantity, model in models.items() if model is not None}

    @property
    def assumption_text(self) -> str:
        """The user's guarantees, and what this file cannot check, as part of a sentence; empty without any."""
        texts = [_ASSUMPTION_TEXTS[assumption] for assumption in self.assumptions]
        if any(validator.strength is None for validator in self.validators):
            texts.append(_UNKNOWN_STRENGTH)
        if self.only_sign:
            texts.append(_ONE_SIGN[self.only_sign])
        return " and ".join(texts)

    def save(self, path: str | Path) -> None:
        """Write the file, the same bytes for the same calibration; CalibrationError where that fails."""
        _FORMAT.save(Path(path), self, self.table.digest)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a calibration.

        Raises CalibrationError, naming the file, where it is missing, truncated, damaged, foreign, of another format
        version, or made with another channel table.
        """
        return _FORMAT.load(Path(path), cls, cls.check_shapes, lambda one: one.table.digest)

    def check_shapes(self) -> None:
        """Raise ValueError where arrays do not fit together, as in a file that another program wrote."""
        c, m = self.estimator.table.n_channels, max(len(self.sides), 1)
        rows = [
            a
            for validator in self.validators
            for a in (validator.idle, validator.gripped, validator.noise, validator.grip_weights)
        ]
        rows += [validator.strength.weights for validator in self.validators if validator.strength is not None]
        whole = self.estimator.scale.shape == (m, c) and all(row.shape == (c,) for row in rows)
        if not whole or len(self.validators) not in (0, len(self.sides)):
            raise ValueError(f"it is of {len(self.sides)} sides of {c} channels, and its arrays have other shapes")
        if self.estimator.imputer is not None:
            self.estimator.imputer.check_shapes(m, c)
        for quantity, model in self.outputs.items():
            width, found = self.estimator.feature_width(quantity), len(model.regressor.mean_feature)
            if width not in (None, found):
                raise ValueError(f"the regressor of the {quantity} has {found} inputs, expected {width}")
            if model.k_range.shape not in ((0,), (2,)):
                raise ValueError(f"k_range has the shape {model.k_range.shape}, expected two values")
            regressor = model.regressor
            value, below, above = regressor.predict(regressor.mean_feature)
            regressor.range_reasons(value, regressor.mean_feature, "torque", "")
            if not math.isfinite(value) or math.isnan(below + above):
                raise ValueError("its coefficients give no finite value")

    def check_bank(self, bank: "Bank | None") -> "Bank":
        """Return the bank; raises CalibrationError where it is missing or not the calibration's."""
        return check_bank(self.estimator, self.bank_identity, bank)

    def matcher(self, bank: "Bank | None") -> "BankMatcher | None":
        """Return the matcher of an estimator that needs a bank, None for others; raises as `check_bank` does."""
        return self.estimator.matcher(self.check_bank(bank)) if self.estimator.needs == "bank" else None


def check_bank_table(bank: "Bank", table: ChannelTable, what: str) -> None:
    """Raise CalibrationError for a bank of another kind of fingertip than this table, which is of `what`, in words."""
    if bank.table != table:
        raise CalibrationError(
            f"{bank.path} is the bank of another kind of fingertip: it has {bank.table.description}, and {what} "
            f"{table.description}; build a bank of this fingertip with `shearloop bank build`"
        )


def check_bank(estimator: Estimator, identity: str, bank: "Bank | None") -> "Bank":
    """Return the bank of an estimator; raises CalibrationError where it is missing or has another identity."""
    if bank is None:
        raise CalibrationError(f"the estimator {estimator.name} needs its bank: --bank, in Python `bank`")
    if bank.identity != identity:
        raise CalibrationError(
            f"the calibration was made with the bank {identity[:12]}…, and {bank.path} is {bank.identity[:12]}…; name "
            "the bank it was made with, or calibrate again"
        )
    return bank
