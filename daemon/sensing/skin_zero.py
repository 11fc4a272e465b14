"""The resistances of the two gauges without load, taken before each loading; and what speaks against taking them now.

No I/O. Everything is relative: a change of 1 % of one resistance is a response of 0.01, a tenth of a newton.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# Not scipy.stats, which costs the daemon 40 MB and half of its start.
from scipy.special import chdtri

# Beyond such a change while the zero is taken, the skin was touched or a gauge drifts (the paper's noise: 1e-4).
MOST_TREND = 1e-3
MOST_NOISE = 5e-3
# No converter and no gauge is better than this.
LEAST_NOISE = 2e-5
# By so much the temperature changes both gauges, over 20 K; a load that looked like swapped gauges would stretch more.
MOST_COMMON_CHANGE = 0.015
# By so much a skin may have changed since it was calibrated, before its zero is refused: a quarter of a newton.
MOST_CHANGE = 0.02


@dataclass(frozen=True, slots=True)
class Zero:
    """Resistances at rest in Ω, the noise of one response, and by how much the zero itself may be wrong (95 %)."""

    r1_ohm: float
    r2_ohm: float
    noise: float
    uncertainty: float

    def changes(self, r1_ohm: float, r2_ohm: float) -> tuple[float, float]:
        """Return ΔR/R₀ of both gauges."""
        return r1_ohm / self.r1_ohm - 1.0, r2_ohm / self.r2_ohm - 1.0


@dataclass(frozen=True, slots=True)
class RefusedZero:
    """Why resistances are not those of a skin at rest."""

    why: str


class ZeroTaker:
    """Gathers resistances until they make a zero, or a reason why they do not."""

    def __init__(self, wanted: int, rest_ohm: tuple[float, float], slope_per_n: float) -> None:
        """Take how many samples are averaged, the calibration's resistances at rest, and its response per newton."""
        self.wanted = wanted
        self._rest_ohm = rest_ohm
        self._slope_per_n = slope_per_n
        self._taken: list[tuple[float, float]] = []

    @property
    def taken(self) -> int:
        """How many samples have been taken."""
        return len(self._taken)

    def add(self, r1_ohm: float, r2_ohm: float) -> Zero | RefusedZero | None:
        """Take in one sample; return the zero when there are enough, or why it is none. Then it begins anew."""
        self._taken.append((r1_ohm, r2_ohm))
        if len(self._taken) < self.wanted:
            return None
        ohm = np.array(self._taken)
        self._taken.clear()
        why = self._restless(ohm) or self._unlike_rest(*ohm.mean(axis=0).tolist())
        return RefusedZero(why) if why else self._zero(ohm)

    def _restless(self, ohm: NDArray[np.float64]) -> str:
        relative = ohm / ohm.mean(axis=0) - 1.0
        place = np.linspace(-0.5, 0.5, len(ohm))
        trends = place @ relative / (place @ place)
        noises = np.std(relative - np.outer(place, trends), axis=0, ddof=2)
        for number, (trend, noise) in enumerate(zip(trends, noises, strict=True), start=1):
            # What noise alone makes of a slope is noise/√Σx², and Σx² is n/12.
            if abs(trend) > MOST_TREND + 4.0 * noise * math.sqrt(12.0 / len(ohm)):
                return (
                    f"gauge {number} changed by {100 * trend:+.2f} % while the zero was taken; "
                    "leave the skin alone, or see whether the gauge drifts"
                )
            if noise > MOST_NOISE:
                return f"gauge {number} scatters by {100 * noise:.1f} %; see its contacts and the shield of its wires"
        return ""

    def _unlike_rest(self, r1_ohm: float, r2_ohm: float) -> str:
        """Compare the ratio of both, in which current and temperature cancel, with the calibration's."""
        known, found = _log_ratio(*self._rest_ohm), _log_ratio(r1_ohm, r2_ohm)
        if abs(found - known) <= MOST_CHANGE:
            return ""
        seen = f"R₁ {r1_ohm:.2f} Ω and R₂ {r2_ohm:.2f} Ω"
        common = 0.5 * math.log(r1_ohm * r2_ohm / math.prod(self._rest_ohm))
        if abs(found + known) < min(MOST_CHANGE, abs(found - known)) and abs(common) < MOST_COMMON_CHANGE:
            return f"{seen} are those of the calibration the other way round: the wires of the gauges are swapped"
        return (
            f"{seen} are not those of the skin at rest: a shear force of about "
            f"{(found - known) / self._slope_per_n:+.2f} N would look like that; take the load off, or calibrate anew"
        )

    def _zero(self, ohm: NDArray[np.float64]) -> Zero:
        r1_ohm, r2_ohm = ohm.mean(axis=0).tolist()
        # A few samples may find the noise small by chance: the upper end of what it may be is taken.
        bound = math.sqrt((len(ohm) - 1) / float(chdtri(len(ohm) - 1, 0.95)))
        noise = max(bound * float(np.std(ohm[:, 0] / r1_ohm - ohm[:, 1] / r2_ohm, ddof=1)), LEAST_NOISE)
        # What the zero was short of rest, if the skin has not changed since it was calibrated, every response lacks.
        change = abs(_log_ratio(r1_ohm, r2_ohm) - _log_ratio(*self._rest_ohm))
        return Zero(r1_ohm, r2_ohm, noise, change + 2.0 * noise / math.sqrt(len(ohm)))


def _log_ratio(r1_ohm: float, r2_ohm: float) -> float:
    return math.log(r1_ohm / r2_ohm)
