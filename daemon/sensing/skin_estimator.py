"""From resistances to a shear force: zero, equation (1), friction and calibration. A plain object without I/O.

Yin et al. 2017, section 3. What is not known is not left out but added to the interval: the zero's own uncertainty,
the drift since it was taken, and a gauge that reads what it cannot.
"""

from dataclasses import dataclass

from shearloop.bank.eit.gaussian import TWO_SIDED_95
from shearloop.bank.skin.calibration import SkinCalibration
from shearloop.bank.skin.membrane import Direction, ShearInterval
from shearloop.bank.skin.tracking import DirectionFinder, ForceFollower
from shearloop.daemon.sensing.skin_zero import RefusedZero, Zero, ZeroTaker
from shearloop.drivers.shear_skin.skin import SkinSample

# The gauge on the slack side is never stretched, and compressed by at most so much of the other's stretch (the 2-D
# reference gives 0.125, see docs/skin-models.md).
MOST_COMPRESSION = 0.15
# Outside of that by more than this, and the zero is no longer one.
MOST_ASTRAY = 0.02
# The paper's drift, 1.48e-4 over an hour, as a 95 % bound.
DRIFT_PER_HOUR = TWO_SIDED_95 * 1.48e-4


@dataclass(frozen=True, slots=True)
class SkinReading:
    """What one sample said: both gauges' changes, the response, the force with its interval, and what speaks against.

    `band` is the force and what friction alone leaves open around it, without width where the direction is known;
    `interval` holds the force with 95 % beside that. Both are None unless nothing speaks against them.
    """

    response_1: float | None = None
    response_2: float | None = None
    band: ShearInterval | None = None
    interval: ShearInterval | None = None
    direction: Direction = Direction.UNKNOWN
    why: tuple[str, ...] = ()

    @property
    def valid(self) -> bool:
        """Whether nothing speaks against it."""
        return not self.why

    @property
    def shear_n(self) -> float | None:
        """The shear force, where friction most plausibly has it."""
        return None if self.band is None else self.band.shear_n

    @property
    def response(self) -> float | None:
        """The normalised response, equation (1)."""
        if self.response_1 is None or self.response_2 is None:
            return None
        return self.response_1 - self.response_2


class SkinEstimator:
    """Turns the samples of one skin into readings, one for each sample, in order."""

    def __init__(
        self,
        calibration: SkinCalibration,
        *,
        normal_n: float,
        zero_samples: int = 20,
        drift_per_hour: float = DRIFT_PER_HOUR,
    ) -> None:
        """Take the calibration, the normal force that friction goes by (N), and how the zero is taken and ages."""
        self._calibration = calibration
        self._normal_n = normal_n
        self._zero_samples = zero_samples
        self._drift_per_s = drift_per_hour / 3600.0
        self._zero_s = 0.0
        self._last: tuple[Zero, float] | None = None
        self.tare()

    def tare(self, from_ns: int = 0) -> None:
        """Take a new zero from the samples to come that are measured from then on (monotonic clock)."""
        self._zero_from_ns = from_ns
        self._taker = ZeroTaker(self._zero_samples, self._calibration.rest_ohm, self._calibration.slope_per_n)
        self._zero: Zero | None = None
        self.refused = ""

    @property
    def zero(self) -> Zero | None:
        """The resistances at rest, once they have been taken."""
        return self._zero

    @property
    def drift_per_hour(self) -> float:
        """By how much a response is held to drift: as told, or faster where two zeros have shown it."""
        return self._drift_per_s * 3600.0

    def update(self, sample: SkinSample) -> SkinReading:
        """Return what the sample says; one that says nothing comes back with the reasons."""
        if sample.r1_ohm is None or sample.r2_ohm is None:
            self._forget_direction()
            return SkinReading(why=tuple(map(str, sample.faults)))
        if self._zero is None:
            # It is measured as long before its middle as after it, and was there then or later.
            if 2 * sample.t_mid_ns - sample.t_arrival_ns < self._zero_from_ns:
                return SkinReading(why=("measured before the zero was asked for",))
            waits = self._take_zero(sample.r1_ohm, sample.r2_ohm, sample.t_mid_ns)
            if waits or self._zero is None:
                return SkinReading(why=(waits,))
        if sample.missed:
            self._forget_direction()
        response_1, response_2 = self._zero.changes(sample.r1_ohm, sample.r2_ohm)
        response = response_1 - response_2
        time_s = sample.t_mid_ns / 1e9
        direction = self._finder.update(time_s, response)
        astray, why = _astray(response_1, response_2)
        wider = self._zero.uncertainty + self._drift_per_s * (time_s - self._zero_s) + astray
        interval = self._calibration.shear_from_response(response, self._normal_n, direction, wider)
        if abs(interval.low_n) == float("inf") or abs(interval.high_n) == float("inf"):
            why = (*why, "the response is beyond the calibrated curve; take load off, or calibrate further")
        if why:
            return SkinReading(response_1, response_2, direction=direction, why=why)
        band = self._follower.update(response, self._normal_n, direction)
        interval = ShearInterval(band.shear_n, min(interval.low_n, band.shear_n), max(interval.high_n, band.shear_n))
        return SkinReading(response_1, response_2, band, interval, direction)

    def _take_zero(self, r1_ohm: float, r2_ohm: float, t_mid_ns: int) -> str:
        """Take one more sample for the zero; return what is waited for, or nothing once it is there."""
        found = self._taker.add(r1_ohm, r2_ohm)
        if isinstance(found, Zero):
            self._zero, self._zero_s, self.refused = found, t_mid_ns / 1e9, ""
            self._learn_drift()
            self._finder = DirectionFinder(found.noise)
            self._follower = ForceFollower(self._calibration, self._finder.threshold)
            return ""
        if isinstance(found, RefusedZero):
            self.refused = found.why
        if self.refused:
            return f"the zero was refused and is taken again: {self.refused}"
        return f"taking the zero, {self._taker.taken} of {self._taker.wanted}"

    def _learn_drift(self) -> None:
        """See what the last zero has become: a load comes and goes in between, a drift stays."""
        if self._zero is None:
            return
        if self._last is not None:
            before, before_s = self._last
            change_1, change_2 = before.changes(self._zero.r1_ohm, self._zero.r2_ohm)
            by_noise = 4.0 * (before.noise + self._zero.noise) / self._zero_samples**0.5
            drifted = abs(change_1 - change_2)
            if drifted > by_noise:
                self._drift_per_s = max(self._drift_per_s, drifted / max(self._zero_s - before_s, 1.0))
        self._last = (self._zero, self._zero_s)

    def _forget_direction(self) -> None:
        if self._zero is not None:
            self._finder.restart()


def _astray(response_1: float, response_2: float) -> tuple[float, tuple[str, ...]]:
    """Return how far a gauge is from anything that a skin can do to it, and what that means where it is too far.

    One gauge is stretched and the other slack: it reads its zero, or a little less. What it reads beyond that is the
    zero's error or a drift, which the response cannot be told from.
    """
    slack, stretched = sorted((response_1, response_2))
    lowest = -MOST_COMPRESSION * max(stretched, 0.0)
    if slack > MOST_ASTRAY:
        why = f"both gauges read at least {100 * slack:.1f} % longer than at their zero: one drifts, or it is warmer"
    elif slack < lowest - MOST_ASTRAY:
        why = (
            f"gauge {1 if response_1 < response_2 else 2} reads {-100 * slack:.1f} % shorter than at its zero, "
            "which no load does: the zero was taken under load, or the gauge drifts"
        )
    else:
        return max(slack, lowest - slack, 0.0), ()
    return 0.0, (f"{why}; take the load off and tare",)
