"""The gel creeps: under a held twist its shear stays and its torque falls. A fingertip sees the shear.

With γ the shear, expressed as the torque that it means on a fresh gel, the torque is γ − share·c, where c follows γ
with a time constant: one Maxwell element beside a spring (the standard linear solid, e.g. Ferry, Viscoelastic
Properties of Polymers, 1980, chapter 1). What was learnt on one held twist beside a load cell holds for the gel.
"""

import math
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


def fit_creep(t_s: FloatArray, shear_nm: FloatArray, torque_nm: FloatArray) -> Creep:
    """Return the creep of a gel from readings (n,) and the load cell's torque beside them (n,), gripped at the first.

    For each time constant of a grid the share is a least-squares fit; the one that leaves least wins. Raises UserError
    for fewer than twenty readings, and where the torque does not fall behind the readings.
    """
    if t_s.size < _FEWEST:
        raise UserError(f"creep: {t_s.size} readings are too few to learn it from; hold a twist for a minute")
    best: tuple[float, float, float] | None = None
    for time_s in _TIMES_S:
        creep = Creep(0.0, float(time_s))
        crept = np.empty_like(t_s)
        for index, (at_s, shear) in enumerate(zip(t_s, shear_nm, strict=True)):
            creep.torque_nm(float(shear), round(at_s * 1e9))
            crept[index] = creep._crept_nm
        share = float(crept @ (shear_nm - torque_nm) / (crept @ crept))
        left = float(np.sum((shear_nm - torque_nm - share * crept) ** 2))
        if best is None or left < best[0]:
            best = (left, share, float(time_s))
    if best is None or not 0.0 <= best[1] < 1.0:
        raise UserError("creep: the torque does not fall behind the readings; is the load cell's zero right?")
    return Creep(best[1], best[2])
