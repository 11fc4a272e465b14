"""What the torque would be without any sensor: the mean torque at the same place of a repeated series of slices."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from shearloop.bank.arrays import FloatArray, IntArray
from shearloop.estimation.ridge import sign_of_loads
from shearloop.studies.slices.series import SliceSeries

# A fall of the load by more than this fraction of the range begins another repeat of a series of slices.
_RESTART = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class SliceProfile:
    """Mean torque_nm (p,) at rising offsets (p,): slices from a repeat's end."""

    offsets: FloatArray
    torque_nm: FloatArray

    @classmethod
    def fit(cls, recordings: Sequence[SliceSeries]) -> Self | None:
        """Return the profile of slices, None without a known torque."""
        places = np.concatenate([_places(recording.torque_at_frames()) for recording in recordings])
        torque_nm = np.concatenate([recording.torque_at_frames() for recording in recordings])
        each = np.unique(places[np.isfinite(torque_nm)])
        if not len(each):
            return None
        return cls(each.astype(np.float64), np.array([np.nanmean(torque_nm[places == place]) for place in each]))

    def predict(self, series: SliceSeries) -> FloatArray:
        """Return the (n,) torques by the places of the slices."""
        return np.interp(_places(series.torque_at_frames()), self.offsets, self.torque_nm)


def _places(torque_nm: FloatArray) -> IntArray:
    """Return the place (n,) of each slice in its repeat: −1 for the last place of a whole repeat, less before.

    The first repeat may lack its first slices, the last one its last slices. A whole repeat is the longest one.
    """
    known = np.nan_to_num(torque_nm)
    known = sign_of_loads(known) * known
    falls = np.flatnonzero(np.diff(known) < -_RESTART * float(np.ptp(known))) + 1
    starts = np.array([0, *falls.tolist()])
    lengths = np.diff([*starts.tolist(), len(known)])
    whole = int(lengths.max())
    # The first repeat ends in its place, so it counts as begun earlier.
    starts[0] += lengths[0] - whole
    rows = np.arange(len(known))
    own_start = starts[np.searchsorted(falls, rows, side="right")]
    return np.asarray(rows - own_start - whole)
