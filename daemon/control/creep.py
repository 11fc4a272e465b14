"""The gel creeps: under a held twist its shear stays and its torque falls. A fingertip sees the shear.

With γ the shear, expressed as the torque that it means on a fresh gel, the torque is γ − share·c, where c follows γ
with a time constant: one Maxwell element beside a spring (the standard linear solid, e.g. Ferry, Viscoelastic
Properties of Polymers, 1980, chapter 1). What was learnt on one held twist beside a load cell holds for the gel.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from daemon.errors import UserError

FloatArray = NDArray[np.float64]

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
    """The creep of a gel, and how far readings are from the torque without it and with it (std, N·m).

    Both are of readings times `scale` plus `offset_nm`, which were fitted beside it: they are the estimator's and the
    zero's, and stay as wrong as they are.
    """

    creep: Creep
    scale: float
    offset_nm: float
    before_nm: float
    after_nm: float


def fit_creep(grips: Sequence[Stretch], *, scale_is_right: bool = False) -> FittedCreep:
    """Return the creep of a gel from grips, each of them begun with the gel at rest.

    For each time constant of a grid share, scale and offset are a least-squares fit; the one that leaves least wins.
    With `scale_is_right` the readings differ from the torque by creep and offset alone, and tell more of both.
    Raises UserError for fewer than twenty readings, where the torque does not fall behind the readings, and where no
    twist was held for long enough to tell.
    """
    if sum(grip.t_s.size for grip in grips) < _FEWEST:
        count = sum(grip.t_s.size for grip in grips)
        raise UserError(f"creep: {count} readings are too few to learn it from; hold a twist for a minute")
    shear, torque = (np.concatenate([getattr(grip, name) for grip in grips]) for name in ("shear_nm", "torque_nm"))
    best: FittedCreep | None = None
    without = np.ones((shear.size, 1)) if scale_is_right else np.column_stack([shear, np.ones_like(shear)])
    before_nm = _left(without, torque - shear)[1]
    for time_s in _TIMES_S:
        crept = np.concatenate([_crept(grip, float(time_s)) for grip in grips])
        # A factor and a constant between the two are the estimator's scale and the zero's, and no creep.
        if scale_is_right:
            (fallen, offset_nm), after_nm = _left(np.column_stack([-crept, np.ones_like(shear)]), torque - shear)
            scale = 1.0
        else:
            (scale, fallen, offset_nm), after_nm = _left(np.column_stack([shear, -crept, np.ones_like(shear)]), torque)
        # What no gel does is noise that happens to fit.
        if 0.0 <= fallen < scale and (best is None or after_nm < best.after_nm):
            creep = Creep(float(fallen / scale), float(time_s))
            best = FittedCreep(creep, float(scale), float(offset_nm), before_nm, after_nm)
    if best is None:
        raise UserError("creep: the torque does not fall behind the readings; is the load cell's zero right?")
    if best.creep.time_s == _TIMES_S[-1]:
        raise UserError(
            "creep: the torque falls behind the readings for as long as it was recorded, as it does where the "
            "estimates themselves drift; hold some twists for a minute"
        )
    return best


def _left(columns: FloatArray, wanted: FloatArray) -> tuple[FloatArray, float]:
    """Return the least-squares coefficients of columns (n, m), and the standard deviation of what they leave."""
    coefficients: FloatArray = np.linalg.lstsq(columns, wanted, rcond=None)[0].astype(np.float64)
    return coefficients, float((wanted - columns @ coefficients).std())


def _crept(grip: Stretch, time_s: float) -> FloatArray:
    creep, crept = Creep(0.0, time_s), np.empty_like(grip.t_s)
    for index, (at_s, shear) in enumerate(zip(grip.t_s, grip.shear_nm, strict=True)):
        creep.torque_nm(float(shear), round(at_s * 1e9))
        crept[index] = creep._crept_nm
    return crept
