"""Calibration of one estimator on slices, and its file, which the daemon refuses."""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, Self

import numpy as np

from shearloop.bank.arrays import FloatArray
from shearloop.bank.bank_file import Bank
from shearloop.estimation.archive import Format
from shearloop.estimation.bank_match import BankMatcher
from shearloop.estimation.calibration import check_bank
from shearloop.estimation.estimator import Estimator, Quantity
from shearloop.estimation.learned_frames import UNKNOWN_FRAMES, LearnedFrames
from shearloop.estimation.values import INLINE
from shearloop.studies.slices.estimators import slice_estimator_class
from shearloop.studies.slices.novelty import NoveltyDetector
from shearloop.studies.slices.profile import SliceProfile
from shearloop.studies.slices.regressor import SliceRegressor

KIND = "calibration of slices"
FORMAT_VERSION = 1
_FORMAT = Format(KIND, FORMAT_VERSION, slice_estimator_class)


@dataclass(frozen=True, slots=True, eq=False)
class SliceModel:
    """How one quantity is predicted: its regressor, and the detector of slices unlike the calibration's.

    k_range holds the least and largest matched k in cm, or nothing without a bank.
    """

    regressor: SliceRegressor
    novelty: NoveltyDetector
    k_range: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class SliceCalibration:
    """An estimator with the models of its outputs; `source` describes the slices in words.

    sides names their fingertip. bank_identity is empty for an estimator without a bank. `profile` is the torque without
    a sensor, `learned` the slices behind all of this. assumptions are what the user guarantees.
    """

    estimator: Estimator = field(metadata=INLINE)
    sides: tuple[str, ...]
    source: str
    bank_identity: str
    torque: SliceModel | None = None
    diameter: SliceModel | None = None
    assumptions: tuple[Literal["full range"], ...] = ()
    profile: SliceProfile | None = None
    learned: LearnedFrames = UNKNOWN_FRAMES

    @property
    def outputs(self) -> dict[Quantity, SliceModel]:
        """The model of each quantity that the estimator gives."""
        models: dict[Quantity, SliceModel | None] = {"torque": self.torque, "diameter": self.diameter}
        return {quantity: model for quantity, model in models.items() if model is not None}

    @property
    def assumption_text(self) -> str:
        """The user's guarantee as part of a sentence, empty without one."""
        return "no torque exceeds its slices (--assume-full-range)" if self.assumptions else ""

    def matcher(self, bank: Bank | None) -> BankMatcher | None:
        """Return the matcher of an estimator that needs a bank, None for others.

        Raises CalibrationError for a bank that is missing or not the calibration's.
        """
        if self.estimator.needs != "bank":
            return None
        return self.estimator.matcher(check_bank(self.estimator, self.bank_identity, bank))

    def save(self, path: str | Path) -> None:
        """Write the file, the same bytes for the same calibration; CalibrationError where that fails."""
        _FORMAT.save(Path(path), self, self.estimator.table.digest)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a calibration; raises CalibrationError as `Calibration.load` does."""
        return _FORMAT.load(Path(path), cls, cls.check_shapes, lambda one: one.estimator.table.digest)

    def check_shapes(self) -> None:
        """Raise ValueError where arrays do not fit together, as in a file that another program wrote."""
        c = self.estimator.table.n_channels
        if self.estimator.scale.shape != (1, c) or len(self.sides) != 1:
            raise ValueError(
                f"it is of {len(self.sides)} sides, and its scale has the shape {self.estimator.scale.shape}"
            )
        for quantity, model in self.outputs.items():
            if model.k_range.shape not in ((0,), (2,)):
                raise ValueError(f"k_range has the shape {model.k_range.shape}, expected two values")
            if model.novelty.mean.shape != (c,):
                raise ValueError(f"the mean slice of the {quantity} has the shape {model.novelty.mean.shape}")
            model.novelty.reasons(np.ones(c), np.ones(c, dtype=np.bool_))
            value, below, above = model.regressor.predict(model.regressor.mean_feature)
            if not math.isfinite(value) or math.isnan(below + above):
                raise ValueError("its coefficients give no finite value")
