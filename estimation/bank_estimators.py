"""The estimators that read a frame's match in a bank: the refined one, and the paper's."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal, Self

import numpy as np

from shearloop.bank.arrays import FloatArray
from shearloop.bank.bank_file import Bank
from shearloop.estimation.bank_match import (
    NOT_TURNED,
    BankMatcher,
    ElectrodeNumbering,
    PaperMatcher,
    RefinedMatcher,
    find_numberings,
    resolve_symmetry,
)
from shearloop.estimation.estimator import Estimator, Material, Quantity, Reading
from shearloop.estimation.ridge import Ridge


class _OnBank(Estimator):
    """A ridge on a match in the bank, which lies within the bank's grid: its features need no limit."""

    needs: ClassVar[Literal["bank", "mesh", ""]] = "bank"
    limits_features: ClassVar[bool] = False

    def ridge(self, features: FloatArray, values: FloatArray, strength: float) -> Ridge:
        """Fit a ridge; the features of a match have different units and are scaled."""
        return Ridge.fit_scaled(features, values, strength)


@dataclass(frozen=True, eq=False)
class BankEstimator(_OnBank):
    """A ridge on a refined match of each side."""

    name: ClassVar[str] = "bank"

    numbering: ElectrodeNumbering = NOT_TURNED

    @classmethod
    def prepare(cls, material: Material) -> Self:
        """Return the estimator with the numbering of the first side's electrodes."""
        bank = material.physics.bank
        if bank is None:
            raise ValueError("a match needs a bank")
        first = material.validators[0]
        found = find_numberings(first.idle, bank.homogeneous, material.table)
        return cls(material.scale, material.table, numbering=resolve_symmetry(found, first.gripped - first.idle, bank))

    def matcher(self, bank: Bank) -> BankMatcher:
        """Return the refined match on the bank."""
        return RefinedMatcher(bank, self.numbering)

    def features(self, reading: Reading) -> FloatArray:
        """Return the features of each side's match."""
        return np.concatenate([match.features for match in reading.matches])

    def feature_width(self, _quantity: Quantity) -> int:
        """Return the number of features of all sides: k, σ, σ² and the logarithm of the amplitude of each."""
        return 4 * len(self.scale)


class PaperEstimator(_OnBank):
    """The paper's curves on one fingertip: torque over σ and σ², diameter over k; the amplitude is ignored."""

    name: ClassVar[str] = "paper"
    columns: ClassVar[Mapping[Quantity, slice]] = {"torque": slice(1, 3), "diameter": slice(0, 1)}
    strengths: ClassVar[tuple[float, ...]] = (1e-9,)

    def matcher(self, bank: Bank) -> BankMatcher:
        """Return the paper's match on the bank."""
        return PaperMatcher(bank)

    def features(self, reading: Reading) -> FloatArray:
        """Return k, σ and σ² of the first side."""
        return reading.matches[0].features[:3]

    def feature_width(self, quantity: Quantity) -> int:
        """Return 2 for the torque, σ and σ², and 1 for the diameter, k."""
        return {"torque": 2, "diameter": 1}[quantity]
