"""Estimates shear force from a skin's resistances: zero, equation (1), friction and calibration. No I/O.

Yin et al. 2017, section 3. The interval includes the zero's uncertainty, the drift since it was taken, and readings
that no load explains. All changes are relative: 1 % of one resistance is a response of 0.01, a tenth of a newton.
"""

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

# scipy.stats would cost the daemon 40 MB and half of its start-up time.
from scipy.special import chdtri

from shearloop.daemon.sensing.skin_drift import DriftLearner, zeros_differ_by
from shearloop.drivers.defaults import DRIFT_PER_HOUR
from shearloop.drivers.shear_skin.skin import SkinSample
from shearloop.estimation.skin.calibration import DirectionFinder, ForceFollower, SkinCalibration
from shearloop.estimation.skin.membrane import Direction, ShearInterval

# A larger deviation of the slack gauge from the calibration makes the zero invalid.
MAX_DEVIATION = 0.02
# A larger trend while the zero is taken means that the skin was touched or drifts (the paper's noise: 1e-4).
MAX_TREND = 1e-3
MAX_NOISE = 5e-3
# The noise of the best converters and gauges.
MIN_NOISE = 2e-5
# The change of both gauges over 20 K; a load that looks like swapped gauges stretches more.
MAX_COMMON_CHANGE = 0.015
# A skin that changed more since its calibration is refused: a quarter of a newton.
MAX_CHANGE = 0.02
# Gauges that are swapped after the zero, without a load, differ from its resistances by noise and drift, and deviate by
# more than this from any load.
EXCHANGED_TOLERANCE, EXCHANGED_DEVIATION = 5e-3, 1e-2
_NOT_IN_TIME = "it took too long; tare again with nothing on the skin"


@dataclass(frozen=True, slots=True)
class SkinZero:
    """Resistances at rest in Ω, the noise of one response, and the zero's own uncertainty (95 %)."""

    r1_ohm: float
    r2_ohm: float
    noise: float
    uncertainty: float

    def changes(self, r1_ohm: float, r2_ohm: float) -> tuple[float, float]:
        """Return ΔR/R₀ of both gauges."""
        return r1_ohm / self.r1_ohm - 1.0, r2_ohm / self.r2_ohm - 1.0


@dataclass(frozen=True, slots=True)
class SkinZeroTaker:
    """Averages resistances until they make a zero, or a reason against it."""

    n_samples: int
    rest_ohm: tuple[float, float]
    slope_per_n: float
    samples: list[tuple[float, float]] = field(default_factory=list)

    @property
    def progress(self) -> str:
        """The number of samples taken, of those needed."""
        return f"{len(self.samples)} of {self.n_samples}"

    def add(self, r1_ohm: float, r2_ohm: float) -> SkinZero | str | None:
        """Add a sample; return the zero once there are enough, or the reason to refuse it, and start again."""
        self.samples.append((r1_ohm, r2_ohm))
        if len(self.samples) < self.n_samples:
            return None
        ohm = np.array(self.samples)
        self.samples.clear()
        return self._check_rest(ohm) or self._check_calibration(*ohm.mean(axis=0).tolist()) or self._zero(ohm)

    def _check_rest(self, ohm: NDArray[np.float64]) -> str | None:
        relative = ohm / ohm.mean(axis=0) - 1.0
        place = np.linspace(-0.5, 0.5, len(ohm))
        trends = place @ relative / (place @ place)
        noises = np.std(relative - np.outer(place, trends), axis=0, ddof=2)
        for number, (trend, noise) in enumerate(zip(trends, noises, strict=True), start=1):
            # Noise alone gives a slope of noise/√Σx², and Σx² is n/12.
            if abs(trend) > MAX_TREND + 4.0 * noise * math.sqrt(12.0 / len(ohm)):
                return (
                    f"gauge {number} changed by {100 * trend:+.2f} % while the zero was taken; "
                    "leave the skin alone, or see whether the gauge drifts"
                )
            if noise > MAX_NOISE:
                return f"gauge {number} scatters by {100 * noise:.1f} %; see its contacts and the shield of its wires"
        return None

    def _check_calibration(self, r1_ohm: float, r2_ohm: float) -> str | None:
        deviation = self.why_not_at_rest(r1_ohm, r2_ohm)
        if not deviation or are_exchanged(self.rest_ohm, r1_ohm, r2_ohm):
            return deviation or None
        return f"{deviation}; take the load off, or calibrate again"

    def why_not_at_rest(self, r1_ohm: float, r2_ohm: float) -> str:
        """Return why these are not the resistances of the calibrated skin at rest, empty where they may be.

        It compares the ratio of both with the calibration's: current and temperature cancel.
        """
        change = _log_ratio(r1_ohm, r2_ohm) - _log_ratio(*self.rest_ohm)
        if abs(change) <= MAX_CHANGE:
            return ""
        seen = f"R₁ {r1_ohm:.2f} Ω and R₂ {r2_ohm:.2f} Ω"
        if are_exchanged(self.rest_ohm, r1_ohm, r2_ohm):
            return f"{seen} are the calibration's, but exchanged: the wires of the gauges are swapped"
        return (
            f"{seen} are not the skin's values at rest: a shear force of about {change / self.slope_per_n:+.2f} N "
            "would look like that"
        )

    def _zero(self, ohm: NDArray[np.float64]) -> SkinZero:
        r1_ohm, r2_ohm = ohm.mean(axis=0).tolist()
        # The upper bound of the noise that a few samples allow.
        bound = math.sqrt((len(ohm) - 1) / float(chdtri(len(ohm) - 1, 0.95)))
        noise = max(bound * float(np.std(ohm[:, 0] / r1_ohm - ohm[:, 1] / r2_ohm, ddof=1)), MIN_NOISE)
        change = abs(_log_ratio(r1_ohm, r2_ohm) - _log_ratio(*self.rest_ohm))
        return SkinZero(r1_ohm, r2_ohm, noise, change + 2.0 * noise / math.sqrt(len(ohm)))


def are_exchanged(rest_ohm: tuple[float, float], r1_ohm: float, r2_ohm: float, tolerance: float = MAX_CHANGE) -> bool:
    """Return whether these are the resistances at rest of the other gauge each, where the two differ enough to tell.

    `tolerance` is of the ratio of both.
    """
    known, found = _log_ratio(*rest_ohm), _log_ratio(r1_ohm, r2_ohm)
    common = 0.5 * math.log(r1_ohm * r2_ohm / math.prod(rest_ohm))
    apart = abs(found - known)
    return apart > MAX_CHANGE and abs(found + known) < min(tolerance, apart) and abs(common) < MAX_COMMON_CHANGE


def _log_ratio(r1_ohm: float, r2_ohm: float) -> float:
    return math.log(r1_ohm / r2_ohm)


@dataclass(frozen=True, slots=True)
class SkinReading:
    """The estimate of one sample: both gauges' changes, the response, and the force with its interval.

    `band` is the force and the range that friction leaves open, without width if the direction is known. `interval`
    holds the force with 95 %. With `reasons` both are None.
    """

    response_1: float | None = None
    response_2: float | None = None
    band: ShearInterval | None = None
    interval: ShearInterval | None = None
    direction: Direction = Direction.UNKNOWN
    reasons: tuple[str, ...] = ()

    @property
    def valid(self) -> bool:
        """Whether there are no reasons against it."""
        return not self.reasons

    @property
    def shear_n(self) -> float | None:
        """The most plausible shear force, N."""
        return None if self.band is None else self.band.shear_n

    @property
    def response(self) -> float | None:
        """The normalised response, equation (1)."""
        if self.response_1 is None or self.response_2 is None:
            return None
        return self.response_1 - self.response_2


class SkinEstimator:
    """Turns the samples of one skin into readings, one by one, in order."""

    def __init__(
        self,
        calibration: SkinCalibration,
        *,
        normal_n: float,
        zero_samples: int,
        drift_per_hour: float = DRIFT_PER_HOUR,
    ) -> None:
        """Use the calibration, the normal force behind the friction (N), and the zero's samples and drift."""
        self._calibration = calibration
        self._normal_n = normal_n
        self._zero_samples = zero_samples
        explained = zeros_differ_by(calibration.friction_response(normal_n), calibration.response_half_width)
        self._drift = DriftLearner(drift_per_hour, explained)
        self._zero_s = 0.0
        self.tare()

    def tare(self, from_ns: int = 0, until_ns: int | None = None) -> None:
        """Take a new zero from samples measured after `from_ns` that arrive until `until_ns` (monotonic clock)."""
        self._zero_from_ns, self._zero_until_ns = from_ns, until_ns
        self._taker = SkinZeroTaker(self._zero_samples, self._calibration.rest_ohm, self._calibration.slope_per_n)
        self.zero: SkinZero | None = None
        self.refused: str | None = None
        self.given_up = False

    def give_up_zero(self) -> None:
        """Take no zero until the next tare: later samples could be of any load."""
        if self.zero is None:
            self.given_up = True

    @property
    def is_collecting(self) -> bool:
        """Whether samples of the next zero have come."""
        return bool(self._taker.samples)

    @property
    def loaded_n(self) -> float:
        """The shear force (N) that no drift explains: a zero that differs so from the calibration is refused."""
        return MAX_CHANGE / self._calibration.slope_per_n

    def why_not_at_rest(self, sample: SkinSample) -> str:
        """Return why a zero of such samples would be refused by the calibration; empty for one without resistances."""
        if sample.r1_ohm is None or sample.r2_ohm is None:
            return ""
        return self._taker.why_not_at_rest(sample.r1_ohm, sample.r2_ohm)

    @property
    def fixed(self) -> dict[str, object]:
        """What follows from the configuration, and is no state."""
        return {"calibration": self._calibration}

    @property
    def drift_per_hour(self) -> float:
        """The assumed drift of a response: as configured, or more while the zeros of the last two hours show it."""
        return self._drift.per_s * 3600.0

    @property
    def drift_warning(self) -> str:
        """What a drift beyond the configured one does to the interval, and the cure; empty without one."""
        if not self._drift.has_learned:
            return ""
        per_hour_n = self.drift_per_hour / self._calibration.slope_per_n
        return (
            "the skin drifts, or a zero was taken under load: zeros of the last two hours differ by more than friction "
            f"and noise explain, and the interval widens by {per_hour_n:.2g} N an hour; tare with nothing on the skin. "
            "If that does not end it, see the gauges' contacts and temperature, and `skin.normal_n`"
        )

    def update(self, sample: SkinSample) -> SkinReading:
        """Return the reading of a sample; an invalid one comes with reasons."""
        if self._zero_until_ns is not None and sample.t_arrival_ns > self._zero_until_ns:
            self.give_up_zero()
        if sample.r1_ohm is None or sample.r2_ohm is None:
            self._forget_direction()
            return SkinReading(reasons=tuple(map(str, sample.faults)))
        if self.given_up:
            return SkinReading(reasons=("no zero: " + (self.refused or _NOT_IN_TIME),))
        if self.zero is None:
            # The measurement lasts as long before its middle as after it.
            if 2 * sample.t_mid_ns - sample.t_arrival_ns < self._zero_from_ns:
                return SkinReading(reasons=("measured before the zero was asked for",))
            self._take_zero(sample.r1_ohm, sample.r2_ohm, sample.t_mid_ns)
        if self.zero is None:
            refused = f"the zero was refused and is taken again: {self.refused}"
            return SkinReading(reasons=(refused if self.refused else f"taking the zero, {self._taker.progress}",))
        if sample.missed or sample.paused:
            self._forget_direction()
        response_1, response_2 = self.zero.changes(sample.r1_ohm, sample.r2_ohm)
        response = response_1 - response_2
        time_s = sample.t_mid_ns / 1e9
        direction = self._finder.update(time_s, response)
        rest_ohm = self.zero.r1_ohm, self.zero.r2_ohm
        exchanged = are_exchanged(rest_ohm, sample.r1_ohm, sample.r2_ohm, EXCHANGED_TOLERANCE)
        deviation, reasons = _deviation(self._calibration, response_1, response_2, exchanged=exchanged)
        wider = self.zero.uncertainty + self._drift.per_s * (time_s - self._zero_s) + deviation
        interval = self._calibration.shear_from_response(response, self._normal_n, direction, wider)
        if math.isinf(interval.low_n) or math.isinf(interval.high_n):
            reasons = (*reasons, _beyond_curve(self._calibration, response))
        if reasons:
            return SkinReading(response_1, response_2, direction=direction, reasons=reasons)
        band = self._follower.update(response, self._normal_n, direction)
        interval = ShearInterval(band.shear_n, min(interval.low_n, band.shear_n), max(interval.high_n, band.shear_n))
        return SkinReading(response_1, response_2, band, interval, direction)

    def _take_zero(self, r1_ohm: float, r2_ohm: float, t_mid_ns: int) -> None:
        """Use a sample for the zero, which may be complete then, or refused."""
        found = self._taker.add(r1_ohm, r2_ohm)
        if isinstance(found, SkinZero):
            self.zero, self._zero_s, self.refused = found, t_mid_ns / 1e9, None
            noise = 2.0 * found.noise / math.sqrt(self._zero_samples)
            self._drift.add(self._zero_s, _log_ratio(found.r1_ohm, found.r2_ohm), noise)
            self._finder = DirectionFinder(found.noise)
            self._follower = ForceFollower(self._calibration, self._finder.threshold)
        elif found is not None:
            self.refused = found

    def _forget_direction(self) -> None:
        if self.zero is not None:
            self._finder.restart()


def _beyond_curve(calibration: SkinCalibration, response: float) -> str:
    side = "negative" if response < 0 else "positive"
    if calibration.missing_side == side:
        return (
            f"the shear force is {side}, and the calibration has none of that sign; take load off, or record both "
            "signs and calibrate again"
        )
    return "the response is beyond the calibrated curve; take load off, or calibrate further"


def _deviation(
    calibration: SkinCalibration, response_1: float, response_2: float, *, exchanged: bool
) -> tuple[float, tuple[str, ...]]:
    """Return how far the gauges deviate from any load, and the reasons if that is too far.

    The rest is an error of the zero or a drift. `exchanged`: each gauge has the other one's resistance at rest.
    """
    deviation = calibration.slack_deviation(response_1, response_2)
    if exchanged and abs(deviation) > EXCHANGED_DEVIATION:
        return 0.0, ("R₁ and R₂ are the zero's, but exchanged: the wires of the gauges are swapped; exchange them",)
    if abs(deviation) <= MAX_DEVIATION:
        return abs(deviation), ()
    gauge = 1 if response_1 < response_2 else 2
    if deviation > 0:
        reason = f"gauge {gauge} reads {100 * deviation:.1f} % too long for any load: it drifts, or it is warmer"
    else:
        reason = (
            f"gauge {gauge} reads {-100 * deviation:.1f} % shorter than any load makes it: "
            "the zero was taken under load, or the gauge drifts"
        )
    return 0.0, (f"{reason}; take the load off and tare",)
