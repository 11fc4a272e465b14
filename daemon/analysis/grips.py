"""The grips of a recording: stretches of valid torques, each with the load cell's torque beside it."""

from collections.abc import Iterator

import numpy as np

from shearloop.daemon.analysis.evaluation import EstimateTrack
from shearloop.daemon.control.creep import Stretch

# A longer time without a torque ends a grip; single frames that were not valid do not.
LONGEST_GAP_S = 5.0


def grips_of(track: EstimateTrack) -> Iterator[Stretch]:
    """Yield the grips of a series in order; frames without an estimate or without a truth are left out."""
    shear = np.array([np.nan if one.torque_nm is None else one.torque_nm for one in track.estimates])
    torque = track.series.torque_at_frames()
    known = np.isfinite(shear) & np.isfinite(torque)
    t_s = track.series.t_s[known]
    for rows in np.split(np.arange(t_s.size), np.flatnonzero(np.diff(t_s) > LONGEST_GAP_S) + 1):
        if rows.size:
            yield Stretch(t_s[rows], shear[known][rows], torque[known][rows])
