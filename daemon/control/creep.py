"""The creep of a gel under a constant twist: shear into torque."""

import math
from dataclasses import dataclass


@dataclass(slots=True)
class Creep:
    """Converts shear into torque, reading by reading; `share` is the final loss of torque.

    Under a constant twist the gel's shear stays and its torque falls; a fingertip measures the shear. With γ the shear,
    as the torque on a fresh gel, the torque is γ − share·c. Here c follows γ with a time constant: one Maxwell element
    in parallel with a spring (the standard linear solid; Ferry, Viscoelastic Properties of Polymers, 1980, chapter 1).
    """

    share: float
    time_s: float
    crept_nm: float = 0.0
    _t_ns: int | None = None
    _shear_nm: float = 0.0

    def torque_nm(self, shear_nm: float, t_ns: int) -> float:
        """Return the torque of a reading at t_ns (monotonic clock)."""
        if self._t_ns is not None and t_ns > self._t_ns:
            decay = -math.expm1(-(t_ns - self._t_ns) / 1e9 / self.time_s)
            self.crept_nm += (0.5 * (self._shear_nm + shear_nm) - self.crept_nm) * decay
        self._t_ns, self._shear_nm = t_ns, shear_nm
        return shear_nm - self.share * self.crept_nm

    def reset(self) -> None:
        """Restart with a gel at rest, after a release or a tare."""
        self.crept_nm, self._t_ns, self._shear_nm = 0.0, None, 0.0
