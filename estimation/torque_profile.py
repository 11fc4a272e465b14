"""The torque without any sensor: the calibration's mean twist at the same phase of the motion.

A program that repeats its twists predicts much of the torque from its clock alone. A sensor must beat that.
The profile is given the moment of each judged twist, so it is a stopwatch that starts at the right time.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

import numpy as np

from shearloop.bank.arrays import FloatArray
from shearloop.estimation.twists import find_twists
from shearloop.estimation.values import torque_at

if TYPE_CHECKING:
    from shearloop.estimation.series import FrameSeries

# Step of a twist's profile, and how far it reaches either way from the twist's middle: a twist of the paper takes 5 s.
_STEP_S, _REACH_S = 0.25, 15.0


@dataclass(frozen=True, slots=True, eq=False)
class TorqueProfile:
    """Mean torque_nm (p,) at rising offsets (p,): seconds from a twist's middle."""

    offsets: FloatArray
    torque_nm: FloatArray

    @classmethod
    def fit(cls, recordings: "Sequence[FrameSeries]") -> Self | None:
        """Return the profile of recordings, None without a known torque."""
        offsets = np.arange(-_REACH_S, _REACH_S + _STEP_S / 2, _STEP_S)
        twists = [
            torque_at(middle + offsets, recording.torque_t_s, recording.torque_nm)
            for recording in recordings
            for middle in _middles(recording)
        ]
        rows = np.array(twists).reshape(-1, len(offsets))
        known = np.isfinite(rows).any(axis=0) if len(rows) else np.zeros(len(offsets), dtype=np.bool_)
        return cls(offsets[known], np.nanmean(rows[:, known], axis=0)) if known.any() else None

    def predict(self, series: "FrameSeries") -> FloatArray:
        """Return the (n,) torques of a series' frames by the moments of its twists."""
        predicted, middles = np.zeros(len(series.t_s)), np.array(_middles(series))
        if len(middles):
            nearest = middles[np.abs(series.t_s[:, None] - middles).argmin(axis=1)]
            predicted = np.interp(series.t_s - nearest, self.offsets, self.torque_nm, left=0.0, right=0.0)
        return predicted


def _middles(series: "FrameSeries") -> list[float]:
    """Return the times of the middles of a recording's twists, weighted by their torque."""
    torque_nm = np.nan_to_num(series.torque_at_frames())
    return [float(np.average(series.t_s[rows], weights=np.abs(torque_nm[rows]))) for rows in find_twists(torque_nm)]
