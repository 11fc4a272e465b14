"""What sensors and control loop exchange: torques with their sources and directions, zeros, and known torques."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from statistics import fmean
from typing import TYPE_CHECKING, Literal, NamedTuple, Protocol, runtime_checkable

from shearloop.daemon.messaging.messages import STALE_AFTER_PERIODS

if TYPE_CHECKING:
    from shearloop.daemon.reach import Reach

    # A rig without a fingertip does not load it.
    from shearloop.estimation import Calibration

# The paper's ten frames take 5.4 s.
LONGEST_TARE_S = 30.0
# A torque up to this counts as drift of the zero, and not as a load, if its source names no other one.
LARGEST_DRIFT_NM = 0.05
# A stretch within the noise may be a load if its mean exceeds this fraction of the noise. Noise has a smaller mean.
_LOAD_IN_NOISE = 0.5
UNLOAD = "take the load off (turn the tool back, or free it), then tare again"
# Only a person can know that a measured load is the drift of a zero.
CONFIRM_TARE = f"{UNLOAD}; only if nothing touches the sensor, confirm it with `shearloop command tare --yes`"
# The sources of the robot's own torque, and of the load cell's.
WRENCH, LOAD_CELL = "wrench", "load_cell"
# Of a turn or a torque, for an eye that faces the gripper.
Direction = Literal["clockwise", "counterclockwise"]
# One convention for every number of a file, and for recorded angles and torques.
SIGNS: Mapping[Direction, int] = {"clockwise": -1, "counterclockwise": 1}
BOTH_DIRECTIONS: frozenset[Direction] = frozenset(SIGNS)


def direction_of(number: float) -> Direction | None:
    """Return the direction of an angle or a torque; None for 0."""
    if number == 0:
        return None
    return "clockwise" if number < 0 else "counterclockwise"


@dataclass(frozen=True, slots=True)
class TorqueSample:
    """One torque of one source, with the time of its measurement (`t_mid_ns`) and of its arrival (`t_ns`).

    `torque_nm` is None if it is not valid, for `reason`. `low_nm` and `high_nm` bound the friction band that
    hides the torque. A torque beyond `loaded_nm` is a load; a smaller one may be drift of the zero. `loading` is a load
    in the source's own unit, of a source that gives no torque. `load` says why no zero can be taken under the present
    load, for instance where it is too large for a torque; empty if one can. `note` is what the torque rests on
    that nothing checks.
    """

    source: str
    torque_nm: float | None
    reason: str
    t_mid_ns: int
    t_ns: int
    low_nm: float | None = None
    high_nm: float | None = None
    loaded_nm: float = LARGEST_DRIFT_NM
    loading: str = ""
    load: str = ""
    note: str = ""

    def __post_init__(self) -> None:
        """Treat NaN and infinity as no torque, also at the ends of its band."""
        numbers = [number for number in (self.torque_nm, self.low_nm, self.high_nm) if number is not None]
        if odd := [number for number in numbers if not math.isfinite(number)]:
            object.__setattr__(self, "reason", f"it measured {odd[0]}, which is no number")
            for key in ("torque_nm", "low_nm", "high_nm"):
                object.__setattr__(self, key, None)


@dataclass(frozen=True, slots=True, kw_only=True)
class TorqueSource:
    """A source of torques: its period and the averaging window of one torque.

    `has_friction_band`: friction hides the torque within a band; the wrist turns through it without a change.
    `from_robot`: the torque comes with the robot's state, from no device of its own. `measures_torque` is False for a
    fingertip without a calibration; a silent one is a fault all the same. `warm_up_s`: the longest time from a grip to
    the first torque; 0 for a source that measures without a grip. `has_gain`: an `adapt` step can correct its gain.
    `noise_nm`: the torque is known to this; such a source supervises beyond it only, and drives nothing gentler.
    `needs_zero`: its torques count from a zero that has to be taken. `only_sign`: of the only torques that it
    measures, 0 for both; a torque of the other sign may read as 0. `calibration` is a fingertip's, where it could be
    opened: it says on which tools there is a torque. `min_fresh_s`: a torque is fresh for this long at least.
    """

    name: str
    period_s: float
    window_s: float = 0.0
    has_friction_band: bool = False
    from_robot: bool = False
    measures_torque: bool = True
    warm_up_s: float = 0.0
    has_gain: bool = False
    noise_nm: float = 0.0
    needs_zero: bool = False
    only_sign: int = 0
    calibration: "Calibration | None" = None
    min_fresh_s: float = 0.0
    # Of a source without a `calibration`, where it is known.
    reach: "Reach | None" = None

    @property
    def fresh_s(self) -> float:
        """How long after its arrival a torque is fresh."""
        return max(STALE_AFTER_PERIODS * self.period_s, self.min_fresh_s)

    @property
    def oldest_s(self) -> float:
        """How long after its measurement a torque is fresh.

        A torque is half its acquisition old at its end. The rest of its age is transport: a board or an estimator that
        falls behind sends on time, but old torques.
        """
        return self.fresh_s + self.acquired_s

    @property
    def acquired_s(self) -> float:
        """The age of a torque at the end of its acquisition."""
        return 0.5 * max(self.window_s, self.period_s)

    def as_read_nm(self, torque_nm: float) -> float:
        """Return what the source reads of another one's torque: 0 where it has the sign that it does not measure."""
        return 0.0 if torque_nm * self.only_sign < 0 else torque_nm


class SensorListener(Protocol):
    """Takes what all sensors report: the control loop, or `LatestTorques` without a robot."""

    @property
    def stated_tool_mm(self) -> float | None:
        """The diameter of the tool that the latest experiment states; None once its tool may be gone."""

    def on_link(self, device: str, sentence: str, *, up: bool) -> None:
        """Take the return or the loss of a device, with a sentence."""

    def on_torque(self, torque: TorqueSample) -> None:
        """Accept a torque sample from any source."""

    def on_zero(self, source: str, *, known: bool = True) -> None:
        """Take that a source's zero is known from now on, or is not."""

    def torques_of(self, source: str) -> tuple[Sequence[int], Sequence[float]]:
        """Return the valid torques of a source that are kept: times of measurement in ns, ascending, and N·m.

        Torques within the source's noise are as in `beyond_noise`.
        """


class LatestTorques:
    """The listener of sensors without a robot: it knows which of them is loaded."""

    # No experiment states one.
    stated_tool_mm: float | None = None

    def __init__(self) -> None:
        self._torques: dict[str, TorqueSample] = {}

    def on_link(self, _device: str, _sentence: str, *, up: bool) -> None:
        """Forget all torques when a device is lost, also `combined`; the other devices send new ones at once."""
        if not up:
            self._torques.clear()

    def on_torque(self, torque: TorqueSample) -> None:
        """Accept a torque sample from any source."""
        self._torques[torque.source] = torque

    def on_zero(self, source: str, *, known: bool = True) -> None:
        """Ignore a zero: nothing turns that could need it."""

    def torques_of(self, _source: str) -> tuple[Sequence[int], Sequence[float]]:
        """Return no torques: nothing adapts a fingertip without a robot."""
        return [], []

    def tare_refusal(self, *, confirmed: bool = False) -> str | None:
        """Return why no zero may be taken now, or None; `confirmed`: the operator says that nothing is loaded."""
        loaded = load_of(self._torques.values())
        if confirmed or loaded is None:
            return None
        return f"{loaded.sentence}, which would become the zero; {loaded.cure}"


def beyond_noise(times_ns: Sequence[int], torques_nm: Sequence[float], noise_nm: float) -> list[float]:
    """Return torques beyond a source's noise, 0 between loads, and NaN where a load may begin or end.

    Noise about 0 would look like small loads. A stretch within the noise is 0 in its middle half, unless its mean is so
    far from 0 that it may be a small load.
    """
    found: list[float] = []
    for is_noise, stretch in groupby(zip(times_ns, torques_nm, strict=True), lambda one: abs(one[1]) <= noise_nm):
        samples = list(stretch)
        if not is_noise or noise_nm == 0.0:
            found += [torque_nm for _, torque_nm in samples]
            continue
        first_ns, last_ns = samples[0][0], samples[-1][0]
        quarter_ns = 0.25 * (last_ns - first_ns)
        may_be_load = abs(fmean(torque_nm for _, torque_nm in samples)) > _LOAD_IN_NOISE * noise_nm
        for t_ns, _ in samples:
            in_the_middle = first_ns + quarter_ns <= t_ns <= last_ns - quarter_ns
            found.append(0.0 if in_the_middle and not may_be_load else math.nan)
    return found


class SensorLoad(NamedTuple):
    """A sensor's load, as a sentence; `may_be_drift`: a confirmed tare could make it the zero."""

    sentence: str
    may_be_drift: bool

    @property
    def cure(self) -> str:
        """What the operator does before a tare. Under a load that is no drift, a confirmed one costs the good zero."""
        return CONFIRM_TARE if self.may_be_drift else UNLOAD


def load_of(torques: Iterable[TorqueSample]) -> SensorLoad | None:
    """Return the first load that is beyond the usual drift, or None."""
    for torque in torques:
        measured = torque.loading
        if torque.torque_nm is not None and abs(torque.torque_nm) > torque.loaded_nm:
            measured = f"{torque.torque_nm:+.3f} N·m"
        if measured:
            return SensorLoad(f"{torque.source} measures {measured}", may_be_drift=not torque.load)
        if torque.load:
            return SensorLoad(f"{torque.source} is loaded: {torque.load}", may_be_drift=False)
    return None


class Tareable(Protocol):
    """A sensor with a zero."""

    @property
    def taring(self) -> bool:
        """Whether a zero that was asked for is being taken."""

    def tare(self, *, confirmed: bool = False) -> None:
        """Take a new zero from later measurements; `confirmed`: the operator says that nothing is loaded."""

    async def tare_and_wait(self, within_s: float) -> str | None:
        """Take a new zero and wait until it is done; return None, or why it was not taken."""


@runtime_checkable
class Adaptable(Protocol):
    """A sensor that another sensor's torque can correct."""

    async def adapt(self, reference: str) -> None:
        """Correct the gain by this source's torque during this grip; raises ActionError."""
