"""The gel creeps: under a held twist its shear stays and its torque falls. A fingertip sees the shear.

With γ the shear, expressed as the torque that it means on a fresh gel, the torque is γ − share·c, where c follows γ
with a time constant: one Maxwell element beside a spring (the standard linear solid, e.g. Ferry, Viscoelastic
Properties of Polymers, 1980, chapter 1). What was learnt on one held twist beside a load cell holds for the gel.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from shearloop.bank.arrays import FloatArray
from shearloop.daemon.errors import UserError

_TIMES_S = np.geomspace(2.0, 200.0, 60)
# Fewer readings than this, and the noise decides.
_FEWEST = 20


@dataclass(slots=True)
class Creep:
    """Makes torque of shear, reading by reading; `share` is what a held torque loses in the end."""

    share: float
    time_s: float
    _crept_nm: float = 0.0
    _t_ns: int | None = None
    _shear_nm: float = 0.0

    def __post_init__(self) -> None:
        """Refuse what no gel does."""
        if not (0.0 <= self.share < 1.0 and 0.0 < self.time_s < math.inf):
            raise UserError(
                f"creep: share {self.share:g} and time_s {self.time_s:g} are no gel's; see docs/estimators.md"
            )

    def torque_nm(self, shear_nm: float, t_ns: int) -> float:
        """Return the torque of a reading that belongs to t_ns (monotonic clock)."""
        if self._t_ns is not None and t_ns > self._t_ns:
            decay = -math.expm1(-(t_ns - self._t_ns) / 1e9 / self.time_s)
            self._crept_nm += (0.5 * (self._shear_nm + shear_nm) - self._crept_nm) * decay
        self._t_ns, self._shear_nm = t_ns, shear_nm
        return shear_nm - self.share * self._crept_nm

    def forget(self) -> None:
        """Begin with a gel at rest: what was gripped has been let go, or its zero was taken anew."""
        self._crept_nm, self._t_ns, self._shear_nm = 0.0, None, 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Stretch:
    """One grip: when its readings were (n,) in s, what they said (n,) and the torque beside them (n,), in N·m."""

    t_s: FloatArray
    shear_nm: FloatArray
    torque_nm: FloatArray


@dataclass(frozen=True, slots=True)
class FittedCreep:
    """The creep of a gel, and how far readings are from what the torque makes of them without and with it (std, N·m).

    Torque is `scale` times a reading plus `offset_nm`, less the creep. Both were fitted beside it: they are the
    estimator's and the zero's, and stay as wrong as they are.
    """

    creep: Creep
    scale: float
    offset_nm: float
    before_nm: float
    after_nm: float


def fit_creep(grips: Sequence[Stretch], *, scale_is_right: bool = False) -> FittedCreep:
    """Return the creep of a gel from grips, each of them begun with the gel at rest.

    The readings, which are noisy, are fitted to the load cell's torques, which are hardly so. With c as above,
    d = (1 - share)·c follows the torque with a time constant of time_s / (1 - share), and γ is the torque plus
    share / (1 - share)·d. (The torque fitted to the readings takes noise for shear: at 12 mN·m the scale came out 5 %
    too small and a time constant of 20 s as 50, see benchmarks/creep_fit.py.) For each time constant of a grid
    share, scale
    and offset are a least-squares fit; the one that leaves least wins. With `scale_is_right` the readings differ from
    the torque by creep and offset alone, and tell more of both.
    Raises UserError for fewer than twenty readings, where the torque does not fall behind the readings, and where no
    twist was held for long enough to tell.
    """
    if sum(grip.t_s.size for grip in grips) < _FEWEST:
        count = sum(grip.t_s.size for grip in grips)
        raise UserError(f"creep: {count} readings are too few to learn it from; hold a twist for a minute")
    shear, torque = (np.concatenate([getattr(grip, name) for grip in grips]) for name in ("shear_nm", "torque_nm"))
    # A factor and a constant between the two are the estimator's scale and the zero's, and no creep.
    wanted = shear - torque if scale_is_right else shear
    plain = np.column_stack([np.ones_like(torque), *([] if scale_is_right else [torque])])
    before_nm = _left(plain, wanted)[1]
    best: FittedCreep | None = None
    slowest = False
    for time_s in _TIMES_S:
        followed = np.concatenate([_followed(grip, float(time_s)) for grip in grips])
        (lag, offset_nm, *gains), after_nm = _left(np.column_stack([followed, plain]), wanted)
        gain = float(gains[0]) if gains else 1.0
        # What no gel does is noise that happens to fit.
        if gain > 0.0 <= lag and (best is None or after_nm < best.after_nm):
            share = float(lag / (gain + lag))
            creep = Creep(share, float(time_s) * (1.0 - share))
            best = FittedCreep(creep, 1.0 / gain, -float(offset_nm) / gain, before_nm, after_nm)
            slowest = time_s == _TIMES_S[-1]
    if best is None:
        raise UserError("creep: the torque does not fall behind the readings; is the load cell's zero right?")
    if slowest:
        raise UserError(
            "creep: the torque falls behind the readings for as long as it was recorded, as it does where the "
            "estimates themselves drift; hold some twists for a minute"
        )
    return best


def _left(columns: FloatArray, wanted: FloatArray) -> tuple[FloatArray, float]:
    """Return the least-squares coefficients of columns (n, m), and the standard deviation of what they leave."""
    coefficients: FloatArray = np.linalg.lstsq(columns, wanted, rcond=None)[0].astype(np.float64)
    return coefficients, float((wanted - columns @ coefficients).std())


def _followed(grip: Stretch, time_s: float) -> FloatArray:
    """Return what follows the torque with a time constant, from rest."""
    follower, followed = Creep(0.0, time_s), np.empty_like(grip.t_s)
    for index, (at_s, torque_nm) in enumerate(zip(grip.t_s, grip.torque_nm, strict=True)):
        follower.torque_nm(float(torque_nm), round(at_s * 1e9))
        followed[index] = follower._crept_nm
    return followed
