"""Fits the gel's creep on held twists with a load cell; `Creep` corrects it in the control loop."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from shearloop.bank.arrays import FloatArray
from shearloop.daemon.control.creep import Creep
from shearloop.errors import UserError
from shearloop.tools.estimate_tracks import EstimateTrack, values_of

# A longer time without a torque ends a grip; single invalid frames do not.
LONGEST_GAP_S = 5.0
# Time constants that are tried; with fewer readings the noise decides.
_TIMES_S = np.geomspace(2.0, 200.0, 60)
_MIN_READINGS = 20


@dataclass(frozen=True, slots=True, eq=False)
class Stretch:
    """One grip: times of the readings (n,) in s, readings (n,) and measured torque (n,), in N·m."""

    t_s: FloatArray
    shear_nm: FloatArray
    torque_nm: FloatArray


@dataclass(frozen=True, slots=True)
class FittedCreep:
    """A gel's creep, with the standard deviation of the scaled estimates' error without and with it (N·m of torque).

    Torque is `scale` times a reading plus `offset_nm`, less the creep. Scale and offset are errors of the estimator and
    of the zero; they are fitted but not corrected.
    """

    creep: Creep
    scale: float
    offset_nm: float
    before_nm: float
    after_nm: float


def grips_of(track: EstimateTrack) -> Iterator[Stretch]:
    """Yield the grips of a series in order: valid torques with the load cell's torque."""
    shear = values_of(track.estimates)[0]
    torque = track.series.torque_at_frames()
    known = np.isfinite(shear) & np.isfinite(torque)
    t_s = track.series.t_s[known]
    for rows in np.split(np.arange(t_s.size), np.flatnonzero(np.diff(t_s) > LONGEST_GAP_S) + 1):
        if rows.size:
            yield Stretch(t_s[rows], shear[known][rows], torque[known][rows])


def fit_creep(grips: Sequence[Stretch], *, scale_is_right: bool = False) -> FittedCreep:
    """Return the creep of a gel, fitted to grips that each begin with the gel at rest.

    The noisy readings are fitted to the load cell's torques, which have little noise. With c as above,
    d = (1 − share)·c follows the torque with the time constant time_s / (1 − share), and γ is the torque plus
    share / (1 − share)·d. For each time constant of a grid, share, scale and offset are a least-squares fit; the one
    with the smallest residual wins. `scale_is_right` fixes the scale at 1.
    Raises UserError for fewer than twenty readings, for torques that do not fall behind the readings, and for twists
    that were held too briefly.
    """
    if sum(grip.t_s.size for grip in grips) < _MIN_READINGS:
        count = sum(grip.t_s.size for grip in grips)
        raise UserError(f"creep: too few readings for a fit: {count}; hold a twist for a minute")
    shear, torque = (np.concatenate([getattr(grip, name) for grip in grips]) for name in ("shear_nm", "torque_nm"))
    wanted = shear - torque if scale_is_right else shear
    plain = np.column_stack([np.ones_like(torque), *([] if scale_is_right else [torque])])
    before_nm = _least_squares(plain, wanted)[1]
    best: FittedCreep | None = None
    # Of the readings, not of the torque.
    least_nm, best_s = np.inf, np.nan
    for time_s in _TIMES_S:
        followed = np.concatenate([_low_passed(grip, float(time_s)) for grip in grips])
        (lag, offset_nm, *gains), after_nm = _least_squares(np.column_stack([followed, plain]), wanted)
        gain = float(gains[0]) if gains else 1.0
        # Negative gain or lag is unphysical: noise that happens to fit.
        if gain > 0.0 <= lag and after_nm < least_nm:
            least_nm, best_s = after_nm, time_s
            share = float(lag / (gain + lag))
            creep = Creep(share, float(time_s) * (1.0 - share))
            best = FittedCreep(creep, 1.0 / gain, -float(offset_nm) / gain, before_nm / gain, after_nm / gain)
    if best is None:
        raise UserError("creep: the torque does not fall behind the readings; is the load cell's zero right?")
    if best.after_nm >= torque.std():
        raise UserError(
            f"creep: the corrected readings are off by {best.after_nm * 1e3:.1f} mN·m, and the torque varies "
            f"by {torque.std() * 1e3:.1f} mN·m alone: the calibration does not fit these recordings"
        )
    if best_s == _TIMES_S[0]:
        raise UserError(
            f"creep: the torque falls behind the readings by {best_s:g} s or less, and a gel creeps for longer: short "
            "holds, or a poor calibration, look like this; hold some twists for a minute"
        )
    if best_s == _TIMES_S[-1]:
        raise UserError(
            "creep: the torque still fell behind the readings at the end of the recording, as it does when the "
            "estimates themselves drift; hold some twists for a minute"
        )
    return best


def _least_squares(columns: FloatArray, wanted: FloatArray) -> tuple[FloatArray, float]:
    """Return the least-squares coefficients of columns (n, m), and the residual's standard deviation."""
    coefficients: FloatArray = np.linalg.lstsq(columns, wanted, rcond=None)[0].astype(np.float64)
    return coefficients, float((wanted - columns @ coefficients).std())


def _low_passed(grip: Stretch, time_s: float) -> FloatArray:
    """Return the torque, low-pass filtered with a time constant from rest (n,)."""
    follower, followed = Creep(0.0, time_s), np.empty_like(grip.t_s)
    for index, (at_s, torque_nm) in enumerate(zip(grip.t_s, grip.torque_nm, strict=True)):
        follower.torque_nm(float(torque_nm), round(at_s * 1e9))
        followed[index] = follower.crept_nm
    return followed
