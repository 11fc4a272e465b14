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
    of the zero; they are fitted but not corrected. `time_range_s` is the 95 % interval of the creep's time constant.
    """

    creep: Creep
    scale: float
    offset_nm: float
    before_nm: float
    after_nm: float
    time_range_s: tuple[float, float]


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """The least-squares fit for one time constant of the lag: its coefficients and residuals (n,), of the readings."""

    lag_s: float
    lag: float
    offset_nm: float
    gain: float
    residual_nm: FloatArray

    @property
    def creep(self) -> Creep:
        share = self.lag / (self.gain + self.lag)
        return Creep(share, self.lag_s * (1.0 - share))


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
    that do not tell the time constant, as those that were held too briefly.
    """
    if sum(grip.t_s.size for grip in grips) < _MIN_READINGS:
        count = sum(grip.t_s.size for grip in grips)
        raise UserError(f"creep: too few readings for a fit: {count}; hold a twist for a minute")
    shear, torque = (np.concatenate([getattr(grip, name) for grip in grips]) for name in ("shear_nm", "torque_nm"))
    wanted = shear - torque if scale_is_right else shear
    plain = np.column_stack([np.ones_like(torque), *([] if scale_is_right else [torque])])
    before_nm = _least_squares(plain, wanted)[1].std()
    fits = []
    for lag_s in _TIMES_S.tolist():
        followed = np.concatenate([_low_passed(grip, lag_s) for grip in grips])
        (lag, offset_nm, *gains), residual_nm = _least_squares(np.column_stack([followed, plain]), wanted)
        gain = float(gains[0]) if gains else 1.0
        # Negative gain or lag is unphysical: noise that happens to fit.
        if gain > 0.0 <= lag:
            fits.append(_Fit(lag_s, float(lag), float(offset_nm), gain, residual_nm))
    if not fits:
        raise UserError("creep: the torque does not fall behind the readings; is the load cell's zero right?")
    best = min(fits, key=lambda fit: fit.residual_nm.std())
    after_nm = float(best.residual_nm.std()) / best.gain
    if after_nm >= torque.std():
        raise UserError(
            f"creep: the corrected readings are off by {after_nm * 1e3:.1f} mN·m, and the torque varies "
            f"by {torque.std() * 1e3:.1f} mN·m alone: the calibration does not fit these recordings"
        )
    if best.lag_s == _TIMES_S[0]:
        raise UserError(
            f"creep: the torque falls behind the readings by {best.lag_s:g} s or less, and a gel creeps for longer: "
            "short holds, or a poor calibration, look like this; hold some twists for a minute"
        )
    if best.lag_s == _TIMES_S[-1]:
        raise UserError(
            "creep: the torque still fell behind the readings at the end of the recording, as it does when the "
            "estimates themselves drift; hold some twists for a minute"
        )
    alike = _as_good(fits, best)
    range_s = alike[0].creep.time_s, alike[-1].creep.time_s
    if alike[0].lag_s == _TIMES_S[0] or alike[-1].lag_s == _TIMES_S[-1]:
        raise UserError(
            f"creep: the recordings do not tell how fast the gel creeps: time constants from {range_s[0]:.0f} s to "
            f"{range_s[1]:.0f} s, and perhaps beyond, fit them alike; hold some twists for a minute, and record more"
        )
    offset_nm = -best.offset_nm / best.gain
    return FittedCreep(best.creep, 1.0 / best.gain, offset_nm, float(before_nm) / best.gain, after_nm, range_s)


def _as_good(fits: Sequence[_Fit], best: _Fit) -> list[_Fit]:
    """Return the fits that a likelihood-ratio test at 5 % cannot tell from the best one.

    Neighbouring residuals are alike, as of an estimator's slow error, so that they count as fewer independent ones:
    as those of a first-order autoregression with their correlation.
    """
    residual_nm = best.residual_nm
    correlation = max(float(residual_nm[1:] @ residual_nm[:-1] / (residual_nm @ residual_nm)), 0.0)
    independent = residual_nm.size * (1.0 - correlation) / (1.0 + correlation)
    # 3.84 is the 95 % point of chi-squared with one degree of freedom.
    largest = float(residual_nm.var()) * np.exp(3.84 / independent)
    return [fit for fit in fits if fit.residual_nm.var() <= largest]


def _least_squares(columns: FloatArray, wanted: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the least-squares coefficients of columns (n, m), and the residuals (n,)."""
    coefficients: FloatArray = np.linalg.lstsq(columns, wanted, rcond=None)[0].astype(np.float64)
    return coefficients, wanted - columns @ coefficients


def _low_passed(grip: Stretch, time_s: float) -> FloatArray:
    """Return the torque, low-pass filtered with a time constant from rest (n,)."""
    follower, followed = Creep(0.0, time_s), np.empty_like(grip.t_s)
    for index, (at_s, torque_nm) in enumerate(zip(grip.t_s, grip.torque_nm, strict=True)):
        follower.torque_nm(float(torque_nm), round(at_s * 1e9))
        followed[index] = follower.crept_nm
    return followed
