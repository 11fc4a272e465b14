"""From a response to a shear force: friction, and one rising curve from tension at the gauges to response.

The curve is a straight line through the origin up to 1.2 N; beyond it, to 5 N and more, as many straight pieces as
the recorded data bear (`calibration_fit`). Straight pieces that rise can be read backwards without iteration.
"""

import math
from dataclasses import dataclass

import numpy as np

from shearloop.bank.arrays import FloatArray
from shearloop.bank.errors import CalibrationError
from shearloop.bank.skin.membrane import Direction, Membrane, ShearInterval


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationTable:
    """Recorded rows in the order in which they were recorded: resistances in Ω, forces in N, each (rows,)."""

    r1_ohm: FloatArray
    r2_ohm: FloatArray
    shear_n: FloatArray
    normal_n: FloatArray


@dataclass(frozen=True, slots=True)
class SkinCalibration:
    """Friction, and the curve from net tension at the gauges (N) to response, both rising.

    `response_half_width` is the 95 % prediction interval of one response. `rows` were fitted; `rows_beyond` lie
    outside the curve, where they were too few for a piece of their own. `rest_ohm` is what R₁ and R₂ were without load,
    by which a later zero is judged.
    """

    friction: float
    gauge_angle_deg: float
    linear_to_n: float
    tension_n: tuple[float, ...]
    response: tuple[float, ...]
    response_half_width: float
    rows: int
    rows_beyond: int
    rest_ohm: tuple[float, float]

    def __post_init__(self) -> None:
        """Refuse a curve that cannot be read backwards."""
        if len(self.tension_n) != len(self.response) or len(self.tension_n) < 2:
            raise CalibrationError("The calibration's tension_n and response must be two lists of the same length.")
        for name, values in (("tension_n", self.tension_n), ("response", self.response)):
            if not (np.isfinite(values).all() and (np.diff(values) > 0).all()):
                raise CalibrationError(f"The calibration's {name} must rise from each value to the next.")
        if not (0 <= self.friction <= 1 and self.response_half_width >= 0):
            raise CalibrationError("The calibration's friction must lie in [0, 1], its response_half_width be ≥ 0.")
        if not (np.isfinite(self.rest_ohm).all() and min(self.rest_ohm) > 0):
            raise CalibrationError("The calibration's rest_ohm must be two resistances above 0.")

    @property
    def slope_per_n(self) -> float:
        """Response per N of tension at the gauges, in the middle piece of the curve: F/(EA)."""
        ends = np.clip([-self.linear_to_n, self.linear_to_n], self.tension_n[0], self.tension_n[-1])
        low, high = np.interp(ends, self.tension_n, self.response)
        return float((high - low) / (ends[1] - ends[0]))

    @property
    def prediction_half_width_n(self) -> float:
        """The 95 % prediction interval in N of shear, ±, at small forces."""
        capstan = math.exp(self.friction * math.radians(self.gauge_angle_deg))
        return self.response_half_width / self.slope_per_n * capstan

    def band(self, response: float, normal_n: float, direction: Direction = Direction.UNKNOWN) -> ShearInterval:
        """Return the shear forces (N) that friction leaves open for a response that is taken to be exact.

        Beyond the calibrated curve it is the band of the curve's end.
        """
        tension = float(np.interp(response, self.response, self.tension_n))
        return self._membrane.shear_from_tensions(tension, tension, tension, normal_n, direction)

    def shear_from_response(
        self, response: float, normal_n: float, direction: Direction = Direction.UNKNOWN, wider: float = 0.0
    ) -> ShearInterval:
        """Return the shear force (N) and the interval that holds it with 95 % and whatever friction leaves open.

        The deadband is taken out where the direction of loading is known and added to the interval where it is not.
        An end beyond the calibrated curve is infinite: such a force is not to be relied upon. `wider` is by how much
        more the response itself is uncertain, either way.
        """
        half = self.response_half_width + wider
        low, high = response - half, response + half
        tension_low, tension, tension_high = np.interp([low, response, high], self.response, self.tension_n).tolist()
        if low < self.response[0]:
            tension_low = -math.inf
        if high > self.response[-1]:
            tension_high = math.inf
        return self._membrane.shear_from_tensions(tension_low, tension, tension_high, normal_n, direction)

    @property
    def _membrane(self) -> Membrane:
        return Membrane(1.0, self.friction, math.radians(self.gauge_angle_deg), 1.0)
