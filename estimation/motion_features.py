"""The features of the gel's motion over the last seconds, in a few directions per fingertip."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from shearloop.bank.arrays import BoolArray, FloatArray, IntArray
from shearloop.estimation.fingertip_validator import FingertipValidator
from shearloop.estimation.grip_memory import Motion

# An estimate needs this many frames of the grip before its own, 6.5 s. An older part of the memory counts as the oldest
# of them, so that the memory costs no twist.
_MIN_LAGS = 12


@dataclass(frozen=True, slots=True, eq=False)
class TemporalFeatures(Motion):
    """Directions (m, p, c) along which each side's motion is measured, in units of noise, and how far back.

    edges (s + 1,) are the ends of the memory's s steps in frames back. With uses_position the position relative to the
    idle frame is a feature too.
    """

    directions: FloatArray
    edges: IntArray
    uses_position: bool = False

    @property
    def n_lags(self) -> int:
        """How many frames back the memory reaches."""
        return int(self.edges[-1]) - 1

    @property
    def n_needed(self) -> int:
        """How many positions of a grip an estimate needs."""
        return min(self.n_lags, _MIN_LAGS) + 1

    def project(self, channels: FloatArray) -> FloatArray:
        """Return the (…, m·p) positions of (…, m, c) frames along the directions."""
        found = np.einsum("...mc,mpc->...mp", channels, self.directions)
        return np.asarray(found.reshape(*found.shape[:-2], -1))

    def impute(
        self, moved: FloatArray, usable: BoolArray, sides: Sequence[FingertipValidator], *, from_idle: bool
    ) -> FloatArray:
        """Return a motion (m, c), unusable channels along the directions, and from idle along the grip too."""
        imputed = []
        for layer, validator in enumerate(sides):
            alive = np.isfinite(validator.noise)
            modes = self.directions[layer] * np.where(alive, validator.noise, 0.0) ** 2
            if from_idle:
                modes = np.vstack([modes, validator.gripped - validator.idle])
            weights = np.where(usable[layer] & alive, 1.0 / validator.noise, 0.0)
            found = np.linalg.lstsq((modes * weights).T, moved[layer] * weights, rcond=None)[0]
            imputed.append(found @ modes)
        return np.where(usable, moved, imputed)

    def features(self, positions: Sequence[FloatArray], from_idle: FloatArray) -> FloatArray:
        """Return s · m·p features of motion, nearest step first, and m·p of position where it is used.

        positions are the last (m·p,) positions, up to n_lags + 1; from_idle (m·p,) is the newest one relative to idle.
        """
        missing = self.n_lags + 1 - len(positions)
        rows = np.array([*[positions[0]] * missing, *positions])
        starts, counts = self.edges[:-1] - 1, np.diff(self.edges)
        before = np.add.reduceat(rows[-2::-1], starts, axis=0) / counts[:, None]
        moved = (rows[-1] - before).ravel()
        return np.concatenate([moved, from_idle]) if self.uses_position else moved
