"""How a gel moves: the few directions along which frames change while a tool is held, and what is read along them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from shearloop.bank.arrays import BoolArray, FloatArray
from shearloop.bank.eit.channels import N_CHANNELS
from shearloop.bank.estimation.fingertip_validator import FingertipValidator


@dataclass(frozen=True, slots=True, eq=False)
class TemporalFeatures:
    """The directions (m, p, 896) that each side's motion is measured along, in units of noise, and how far back.

    placed says that the place relative to the idle frame is a feature too.
    """

    directions: FloatArray
    n_lags: int
    placed: bool = False

    @classmethod
    def fit(
        cls, parts: list[FloatArray], guards: tuple[FingertipValidator, ...], n_directions: int, n_lags: int
    ) -> Self:
        """Fit to (n, m, 896) gripped frames of each recording: the main directions of motion within the memory."""
        directions = []
        for layer, guard in enumerate(guards):
            moved = np.vstack([(part[n_lags:, layer] - part[:-n_lags, layer]) / guard.noise for part in parts])
            rows = np.linalg.svd(moved, full_matrices=False)[2][:n_directions] / guard.noise
            directions.append(rows * np.sign(rows.sum(axis=1, keepdims=True)))
        return cls(np.array(directions), n_lags)

    def places(self, channels: FloatArray) -> FloatArray:
        """Return the (…, m·p) places of (…, m, 896) frames along the directions."""
        found = np.einsum("...mc,mpc->...mp", channels, self.directions)
        return np.asarray(found.reshape(*found.shape[:-2], -1))

    def step(self, layer: int, moved: FloatArray, usable: BoolArray, noise: FloatArray) -> FloatArray:
        """Return how far all (896,) channels of a side moved, going by the usable ones and the known directions."""
        return _along(self._shapes(layer, noise), moved, usable, noise)

    def gripped_step(self, layer: int, moved: FloatArray, usable: BoolArray, guard: FingertipValidator) -> FloatArray:
        """Return the same of how far (896,) channels are from idle, where the grip's own step is one more direction."""
        return _along(self._gripped_shapes(layer, guard), moved, usable, guard.noise)

    def readings(self, layer: int, usable: BoolArray, guard: FingertipValidator) -> tuple[FloatArray, FloatArray]:
        """Return what `step` and, below it, `gripped_step` are made of while the same (896,) channels are usable.

        Products of the first (2p + 1, 896) with what moved are how far it moved along the second.
        """
        kinds = (self._shapes(layer, guard.noise), self._gripped_shapes(layer, guard))
        reads = [_reading(shapes, usable, guard.noise) for shapes in kinds]
        return np.vstack(reads), np.vstack(kinds)

    def _gripped_shapes(self, layer: int, guard: FingertipValidator) -> FloatArray:
        return np.vstack([self._shapes(layer, guard.noise), guard.gripped - guard.idle])

    def _shapes(self, layer: int, noise: FloatArray) -> FloatArray:
        return np.asarray(self.directions[layer] * np.where(np.isfinite(noise), noise, 0.0) ** 2)

    def features(self, places: Sequence[FloatArray], from_idle: FloatArray) -> FloatArray:
        """Return the features of the n_lags + 1 last (m·p,) places and of the newest one's from idle.

        n_lags · m·p of motion, the nearest lag first, and m·p of place after them where `placed` is true.
        """
        rows = np.array(places)
        moved = (rows[-1] - rows[-2::-1]).ravel()
        return np.concatenate([moved, from_idle]) if self.placed else moved


def _along(shapes: FloatArray, moved: FloatArray, usable: BoolArray, noise: FloatArray) -> FloatArray:
    weights = _weights(usable, noise)
    found = np.linalg.lstsq((shapes * weights).T, moved * weights, rcond=None)[0]
    return np.asarray(found @ shapes)


def _reading(shapes: FloatArray, usable: BoolArray, noise: FloatArray) -> FloatArray:
    """Return the (k, 896) rows whose products with what moved are what `_along` finds along (k, 896) shapes."""
    weights = _weights(usable, noise)
    # Below this share of the largest one `lstsq` takes singular values for nothing.
    least = N_CHANNELS * np.finfo(np.float64).eps
    return np.asarray(np.linalg.pinv((shapes * weights).T, rcond=least) * weights)


def _weights(usable: BoolArray, noise: FloatArray) -> FloatArray:
    return np.where(usable & np.isfinite(noise), 1.0 / noise, 0.0)
