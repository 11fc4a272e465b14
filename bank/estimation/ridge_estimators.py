"""Estimators by a ridge: on differences, on an image of the conductivity, and on a bank match."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar, Literal, Self

import numpy as np

from shearloop.bank.arrays import FloatArray
from shearloop.bank.eit.bank_file import Bank
from shearloop.bank.estimation.bank_match import (
    NOT_TURNED,
    BankMatch,
    BankMatcher,
    ElectrodeNumbering,
    PaperMatcher,
    RefinedMatcher,
    find_numbering,
    image_matrix,
    resolve_half_turn,
)
from shearloop.bank.estimation.estimator import Estimator, Material, Quantity, Reading
from shearloop.bank.estimation.regressors import Ridge


class Regression(Estimator):
    """A ridge on the difference of each channel."""

    name: ClassVar[str] = "regression"

    def features(self, reading: Reading) -> tuple[FloatArray, BankMatch | None]:
        """Return the channels' differences."""
        return (reading.difference / self.scale).ravel(), None


@dataclass(frozen=True, eq=False)
class Reconstruction(Estimator):
    """A ridge on an image of the conductivity; image (p, 896) maps a difference to pixels."""

    name: ClassVar[str] = "reconstruction"
    needs: ClassVar[Literal["bank", "mesh", ""]] = "mesh"

    image: FloatArray = field(kw_only=True)

    @classmethod
    def prepare(cls, material: Material) -> Self:
        """Return the estimator with the mesh's image."""
        if material.physics.mesh is None:
            raise ValueError("a reconstruction needs a mesh")
        return cls(material.scale, image=image_matrix(material.physics.mesh))

    def features(self, reading: Reading) -> tuple[FloatArray, BankMatch | None]:
        """Return the pixels of each side."""
        return (reading.difference @ self.image.T).ravel(), None


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
        if not material.validators or bank is None:
            return cls(material.scale)
        first = material.validators[0]
        found = find_numbering(first.idle, bank.homogeneous)
        return cls(material.scale, numbering=resolve_half_turn(found, first.gripped - first.idle, bank))

    def matcher(self, bank: Bank) -> BankMatcher:
        """Return the refined match on the bank."""
        return RefinedMatcher(bank, self.numbering)

    def features(self, reading: Reading) -> tuple[FloatArray, BankMatch | None]:
        """Return each side's match, and the first one."""
        matches = [reading.match(layer) for layer in range(len(reading.difference))]
        return np.concatenate([one.features for one in matches]), matches[0]


class PaperEstimator(_OnBank):
    """The paper's curves on one fingertip: torque over σ and σ², diameter over k; the amplitude is ignored."""

    name: ClassVar[str] = "paper"
    columns: ClassVar[Mapping[Quantity, slice]] = {"torque": slice(1, 3), "diameter": slice(0, 1)}
    strengths: ClassVar[tuple[float, ...]] = (1e-9,)
    uses_amplitude: ClassVar[bool] = False
    # A heatmap over all lags takes most of a second.
    most_frames: ClassVar[float] = 120

    def matcher(self, bank: Bank) -> BankMatcher:
        """Return the paper's match on the bank."""
        return PaperMatcher(bank)

    def features(self, reading: Reading) -> tuple[FloatArray, BankMatch | None]:
        """Return k, σ and σ² of the first side, and its match."""
        match = reading.match()
        return np.array([match.k, match.sigma, match.sigma**2]), match
