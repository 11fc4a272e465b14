"""A skin's calibration, one rising curve from tension at the gauges to response, and the tracking of a shear force.

The curve is a straight line through the origin up to 1.2 N. Beyond, to 5 N and more, it has as many straight pieces as
the recorded data support (`calibration_fit.py`). Rising straight pieces invert without iteration. The load turns with
the skin. The stretched gauge gives its angle.

Friction gives one response a band of forces. A rising or falling response proves slip, and the force is at an end of
the band. A constant one leaves it anywhere within: it is then taken to be at its last known place, moved no further
than the band demands (the inverse of a play).
"""

import math
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationInfo, field_validator

from shearloop.bank.arrays import FloatArray
from shearloop.bank.errors import CalibrationError
from shearloop.estimation.skin.membrane import Belt, Direction, ShearInterval, direction_of
from shearloop.models import validated
from shearloop.yaml_files import read_yaml, save_yaml

FORMAT = "shearloop skin calibration 3"
# A response has moved when it differs by this many standard deviations of the compared means: by chance about once a
# week at ten responses a second.
STANDARD_DEVIATIONS = 5.0
# A curve that ends closer to zero has no data of that side.
MIN_SIDE_N = 0.1
# Of the search for the response that friction leaves: to 1e-6 of the straight piece.
BISECTIONS = 20
# Responses averaged before they are compared.
AVERAGED = 3
# A slip proves the direction for this long. A longer time misses a hand that turns back, a shorter one forgets a slow
# loading between two responses.
MEMORY_S = 0.2
# While the skin sticks, the reference response is averaged over about this many: noise chose the first one.
SETTLES_OVER = 20.0


# No gauge with its contacts has less, so that a smaller number is in kΩ.
MIN_OHM = 1.0


def _in_ohm(resistance: float) -> float:
    """Return a gauge's resistance; raises ValueError for one that has another unit."""
    if 0.0 < resistance < MIN_OHM:
        raise ValueError(f"{resistance:g} Ω is too small for a gauge: write it in Ω, not in kΩ")
    return resistance


Resistance = Annotated[float, Field(gt=0), AfterValidator(_in_ohm)]


class SkinCalibration(BaseModel):
    """Friction, and the curve from net tension at the gauges (N) to response, both rising.

    `response_half_width` is the 95 % prediction interval of one response. `rows` were fitted; `rows_beyond` lie outside
    the curve, too few for a piece of their own. `rest_ohm` are R₁ and R₂ without load, to judge a later zero by.
    `slack` is the slack gauge's change ΔR/R₀ at each response of the curve, within `slack_half_width` (95 %). The slack
    side bends, so it depends on `gauge_depth_mm`, outwards from mid-thickness of the paper's section; None where no
    depth within the skin gives this ratio.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)

    friction: float = Field(ge=0, le=1)
    gauge_angle_deg: float = Field(gt=0, lt=90)
    linear_to_n: float = Field(gt=0)
    tension_n: tuple[float, ...] = Field(min_length=2, strict=False)
    response: tuple[float, ...] = Field(min_length=2, strict=False)
    response_half_width: float = Field(ge=0)
    slack: tuple[float, ...] = Field(min_length=2, strict=False)
    slack_half_width: float = Field(ge=0)
    gauge_depth_mm: float | None
    rows: int = Field(ge=1)
    rows_beyond: int = Field(ge=0)
    rest_ohm: tuple[Resistance, Resistance] = Field(strict=False)

    @field_validator("tension_n", "response")
    @classmethod
    def _rises(cls, values: tuple[float, ...], info: ValidationInfo) -> tuple[float, ...]:
        if (np.diff(values) <= 0).any():
            raise ValueError("must rise from each value to the next")
        if len(info.data.get("tension_n", values)) != len(values):
            raise ValueError("must have as many values as tension_n")
        return values

    @property
    def slope_per_n(self) -> float:
        """Response per N of tension at the gauges, in the middle piece of the curve: F/(EA)."""
        ends = np.clip([-self.linear_to_n, self.linear_to_n], self.tension_n[0], self.tension_n[-1])
        low, high = np.interp(ends, self.tension_n, self.response)
        return float((high - low) / (ends[1] - ends[0]))

    @property
    def slack_ratio(self) -> float:
        """The slack gauge's change over the stretched one's, in the middle piece of the curve; both sides' mean."""
        ends = np.clip([-self.linear_to_n, self.linear_to_n], self.tension_n[0], self.tension_n[-1])
        size = abs(np.interp(ends, self.tension_n, self.response))
        slack = np.interp(ends, self.tension_n, self.slack)
        return float(slack.sum() / (size + slack).sum())

    def slack_deviation(self, response_1: float, response_2: float) -> float:
        """Return how far the slack gauge's change lies beyond its 95 % interval, signed; 0 within it."""
        # As a function of the stretched gauge, which a drift of the slack one leaves alone.
        knots = [at + math.copysign(1.0, at) * slack for at, slack in zip(self.response, self.slack, strict=True)]
        slack, stretched = sorted((response_1, response_2))
        expected = slack_at(math.copysign(1.0, response_1 - response_2) * stretched, knots, self.slack)
        left = slack - expected
        return left - min(max(left, -self.slack_half_width), self.slack_half_width)

    @property
    def prediction_half_width_n(self) -> float:
        """The 95 % prediction interval in N of shear, ±, at small forces."""
        capstan = math.exp(self.friction * math.radians(self.gauge_angle_deg))
        return self.response_half_width / self.slope_per_n * capstan

    @property
    def missing_side(self) -> Literal["", "positive", "negative"]:
        """The sign of the shear forces that were not recorded; empty where both were."""
        if self.tension_n[0] > -MIN_SIDE_N:
            return "negative"
        return "positive" if self.tension_n[-1] < MIN_SIDE_N else ""

    def friction_response(self, normal_n: float) -> float:
        """Return the largest response, of either sign, that friction can leave without a shear force."""
        low, high = 0.0, self.slope_per_n * self.linear_to_n
        for _ in range(BISECTIONS):
            middle = (low + high) / 2
            unloaded_n, _ = self._shear_range(middle, middle / self.slope_per_n, normal_n, Direction.UNLOADING)
            low, high = (middle, high) if unloaded_n < 0 else (low, middle)
        return high

    def band(self, response: float, normal_n: float, direction: Direction) -> ShearInterval:
        """Return the shear forces (N) that friction leaves open for an exact response.

        Beyond the calibrated curve it is the band of the curve's end.
        """
        low, high = self._shear_range(response, self._tension(response), normal_n, direction)
        return ShearInterval((low + high) / 2, low, high)

    def shear_from_response(
        self, response: float, normal_n: float, direction: Direction = Direction.UNKNOWN, wider: float = 0.0
    ) -> ShearInterval:
        """Return the shear force (N) and its 95 % interval, which includes what friction leaves open.

        A known direction of loading takes the deadband out; an unknown one adds it to the interval. An end beyond the
        calibrated curve is infinite. The responses of a skin at rest are within it, also where one side was not
        recorded. `wider` is a further uncertainty of the response, either way.
        """
        half, shear_n = self.response_half_width + wider, self.band(response, normal_n, direction).shear_n
        ends = response - half, response + half
        tensions = self._tension(ends[0], left=-math.inf), self._tension(ends[1], right=math.inf)
        if self.missing_side and abs(response) <= self.friction_response(normal_n) + half:
            # The straight line through the origin, which the other side gave.
            low, high = (end / self.slope_per_n for end in ends)
            if self.missing_side == "negative":
                tensions = max(tensions[0], low), tensions[1]
            else:
                tensions = tensions[0], min(tensions[1], high)
        low, high = (
            self._shear_range(end, tension, normal_n, direction)[side]
            for side, (end, tension) in enumerate(zip(ends, tensions, strict=True))
        )
        if ends[0] <= 0 <= ends[1]:
            slack = self._belt.shear_range(0.0, normal_n, 0.0, direction)
            low, high = min(low, slack[0]), max(high, slack[1])
        return ShearInterval(shear_n, low, high)

    def _tension(self, response: float, left: float | None = None, right: float | None = None) -> float:
        return float(np.interp(response, self.response, self.tension_n, left=left, right=right))

    def _shear_range(
        self, response: float, tension_n: float, normal_n: float, direction: Direction
    ) -> tuple[float, float]:
        slack = slack_at(response, self.response, self.slack)
        turned = math.copysign(float(turned_rad(abs(response) + slack)), response)
        return self._belt.shear_range(tension_n, normal_n, turned, direction)

    @property
    def _belt(self) -> Belt:
        return Belt(self.friction, math.radians(self.gauge_angle_deg))


def save_calibration(calibration: SkinCalibration, path: Path) -> None:
    """Write a calibration as YAML, replacing the file at once."""
    save_yaml(path, {"format": FORMAT, **calibration.model_dump()}, CalibrationError, "calibration")


def load_calibration(path: Path) -> SkinCalibration:
    """Return the calibration in a YAML file; raises CalibrationError naming the file and every wrong key."""
    document = read_yaml(path, CalibrationError, "calibration", "; make it with `shearloop skin calibrate`.")
    if not (isinstance(document, dict) and document.pop("format", None) == FORMAT):
        raise CalibrationError(
            f"{path} is not a calibration as `shearloop skin calibrate` writes it: it has no `format: {FORMAT}`."
        )
    return validated(document, SkinCalibration, str(path), CalibrationError)


def slack_at(response: float, knots: Sequence[float], slack: Sequence[float]) -> float:
    """Return the slack gauge's change at a response: straight between the curve's knots and the origin."""
    grid = dict(sorted({**dict(zip(knots, slack, strict=True)), 0.0: 0.0}.items()))
    return float(np.interp(response, list(grid), list(grid.values())))


def turned_rad(stretched: FloatArray | float) -> FloatArray:
    """Return the load's angle about the core, from the stretched gauge's change λ² − 1.

    The load moves by the lengthening of a quarter of the ring, π/2 (λ − 1).
    """
    turned: FloatArray = np.pi / 2 * (np.sqrt(np.maximum(1 + stretched, 0.0)) - 1)
    return turned


class DirectionFinder:
    """Finds from successive responses whether the magnitude of the force rises, falls, or may do either."""

    def __init__(self, noise: float) -> None:
        """Take the standard deviation of one response."""
        self.threshold = STANDARD_DEVIATIONS * noise * math.sqrt(2.0 / AVERAGED)
        self.restart()

    def restart(self) -> None:
        """Forget the past after missing responses."""
        self._latest: deque[float] = deque(maxlen=AVERAGED)
        self._turning: float | None = None
        self._direction = Direction.UNKNOWN
        self._seen_s = -math.inf

    def update(self, time_s: float, response: float) -> Direction:
        """Return the direction at this time; call in order of time."""
        self._latest.append(response)
        if len(self._latest) < AVERAGED:
            return Direction.UNKNOWN
        mean = sum(self._latest) / AVERAGED
        if self._turning is None:
            self._turning = mean
        elif self._turning * mean < 0:
            # The force passed through zero and rises from there.
            self._turning = 0.0
        moved = direction_of(self._turning, mean, self.threshold)
        if moved is not Direction.UNKNOWN:
            self._turning, self._direction, self._seen_s = mean, moved, time_s
        elif time_s - self._seen_s > MEMORY_S:
            self._direction = Direction.UNKNOWN
            self._turning += (mean - self._turning) / SETTLES_OVER
        return self._direction


class ForceFollower:
    """Keeps the most plausible force of the band that each response leaves open; begins at zero force."""

    def __init__(self, calibration: SkinCalibration, slack: float) -> None:
        """Take a calibration, and the change of response that may be noise."""
        self._calibration = calibration
        self._slack_n = slack / calibration.slope_per_n
        self._shear_n = 0.0

    def update(self, response: float, normal_n: float, direction: Direction) -> ShearInterval:
        """Return the most plausible shear force (N) of a response, within the band that friction leaves.

        The band belongs to an exact response; a known direction gives it no width.
        """
        band = self._calibration.band(response, normal_n, direction)
        if direction is not Direction.UNKNOWN:
            self._shear_n = band.shear_n
            return band
        low_n, high_n = band.low_n - self._slack_n, band.high_n + self._slack_n
        self._shear_n = min(max(self._shear_n, low_n), high_n)
        return ShearInterval(self._shear_n, low_n, high_n)
