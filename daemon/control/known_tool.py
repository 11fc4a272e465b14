"""The known angle and torque of a tool after each step of an experiment, before it runs.

An angle or a torque is known exactly, within an interval, or not at all. Of the tool these facts are used, and no more:

- A turn in one direction does not turn the torque to the other one. How much the torque rises is not known: the tool
  springs with an unknown stiffness, slips, or breaks loose.
- To raise a torque (counterclockwise is positive), the wrist turns counterclockwise; to lower it, clockwise.
- While the wrist stands, the torque may fall towards 0. Under a held torque, the tool may creep on in its direction.
- `identify` turns counterclockwise, ends where it began, and refuses a tool that slips.
- A straight line may turn wrist 3, by which the angle from the grip counts.
"""

import math
from dataclasses import dataclass, replace
from enum import Enum
from typing import Final, NamedTuple, TypeAlias

from shearloop.daemon.control.experiment_schema import (
    AdaptStep,
    ApproachStep,
    GripStep,
    HoldTorqueStep,
    IdentifyStep,
    ReleaseStep,
    Step,
    TareStep,
    TightenStep,
    TurnToStep,
    TwistingStep,
    TwistStep,
    WaitStep,
)
from shearloop.daemon.torques import SIGNS, Direction, direction_of

# A clamped tool that was turned by less is back at the angle of its zero.
UNTURNED_RAD: Final = 0.02
# A torque counts as reached within this fraction of the set point: the closed loop's accuracy.
TORQUE_TOLERANCE: Final = 0.10
# Smaller differences are of rounding.
_ROUNDING: Final = 1e-9

# The directions in which something may turn; None: it may not turn at all.
Ways: TypeAlias = frozenset[Direction | None]
STILL: Final[Ways] = frozenset({None})
_OPPOSITE: Final[dict[Direction, Direction]] = {"clockwise": "counterclockwise", "counterclockwise": "clockwise"}


def way_from(start: float, end: float) -> Direction | None:
    """Return the direction from an angle or a torque to another; None if they differ by rounding only."""
    return None if abs(end - start) <= _ROUNDING else direction_of(end - start)


def opposite(ways: Ways) -> Ways:
    """Return the opposite directions; the opposite of no turn is left out."""
    return frozenset(_OPPOSITE[way] for way in ways if way is not None)


class Interval(NamedTuple):
    """The smallest and the largest value that an angle or a torque may have; counterclockwise is positive."""

    low: float
    high: float

    @property
    def exact(self) -> float | None:
        """The value, or None where it is not known exactly."""
        return self.low if self.low == self.high else None

    def ways_to(self, value: float) -> Ways:
        """Return in which directions another value may lie."""
        ends = {way_from(self.low, value), way_from(self.high, value)}
        return frozenset(ends | STILL) if len(ends) > 1 else frozenset(ends)

    def plus(self, other: "Interval") -> "Interval":
        """Return the sum of a value of each."""
        return Interval(self.low + other.low, self.high + other.high)

    def up_to(self, value: float) -> "Interval":
        """Return the smallest interval that has these values and another one."""
        return Interval(min(self.low, value), max(self.high, value))

    def beyond(self, ways: Ways) -> "Interval":
        """Return the values after changes of unknown extent in these directions."""
        low = -math.inf if "clockwise" in ways else self.low
        high = math.inf if "counterclockwise" in ways else self.high
        return Interval(low, high)

    def within(self, most: float) -> "Interval":
        """Return the values that are at most `most` in magnitude; all such values if none of these is."""
        low, high = max(self.low, -most), min(self.high, most)
        return Interval(low, high) if low <= high else Interval(-most, most)


def exactly(value: float) -> Interval:
    """Return a value that is known exactly."""
    return Interval(value, value)


NONE: Final = exactly(0.0)
UNKNOWN: Final = Interval(-math.inf, math.inf)


class Held(Enum):
    """Whether a tool is held, by the fingers or by a clamp."""

    NO = "no"
    MAYBE = "maybe"
    YES = "yes"


@dataclass(frozen=True, slots=True)
class KnownTool:
    """The known state between two steps; `origin_rad` is the wrist joint's angle at which the tool's angle is 0.

    `last_nm` is the torque that a step has asked for last in this grip, the likely one where it is not known.
    """

    angle_rad: Interval = NONE
    torque_nm: Interval = NONE
    last_nm: float = 0.0
    wrist_rad: Interval = UNKNOWN
    origin_rad: float | None = None
    held: Held = Held.MAYBE

    def turned_to(self, angle_rad: float) -> "KnownTool":
        """Return the known state after a turn to an angle from the grip."""
        ways = self.angle_rad.ways_to(angle_rad)
        by_rad = Interval(angle_rad - self.angle_rad.high, angle_rad - self.angle_rad.low)
        wrist_rad = self.wrist_rad.plus(by_rad)
        return self._turned(exactly(angle_rad), wrist_rad, self._loaded(ways))

    def wrist_turned_to(self, wrist_rad: float) -> "KnownTool":
        """Return the known state after a turn to an angle of the wrist joint."""
        ways = self.ways_of_wrist(wrist_rad)
        by_rad = Interval(wrist_rad - self.wrist_rad.high, wrist_rad - self.wrist_rad.low)
        origin_rad = self.origin_rad
        angle_rad = self.angle_rad.plus(by_rad) if origin_rad is None else exactly(wrist_rad - origin_rad)
        return self._turned(angle_rad, exactly(wrist_rad), self._loaded(ways))

    def ways_of_wrist(self, wrist_rad: float) -> Ways:
        """Return in which directions an angle of the wrist joint may lie."""
        if self.origin_rad is not None:
            return self.angle_rad.ways_to(wrist_rad - self.origin_rad)
        return self.wrist_rad.ways_to(wrist_rad)

    def returned(self, ways: Ways) -> "KnownTool":
        """Return the known state after a turn in one of these directions, and back: slip may turn the torque back."""
        return replace(self, torque_nm=self.torque_nm.up_to(0.0).beyond(opposite(ways)))

    def torque_brought_to(self, torque_nm: float) -> "KnownTool":
        """Return the known state after a turn until the torque has a value, and while it was held."""
        turns = self.torque_nm.ways_to(torque_nm)
        creeps: Ways = frozenset({direction_of(torque_nm)})
        return replace(self._turned_beyond(turns | creeps, exactly(torque_nm)), last_nm=torque_nm)

    def tightened(self, step: TightenStep, *, reaches: bool) -> "KnownTool":
        """Return the known state after a `tighten`; `reaches`: it ends near its torque or beyond, not at its angle."""
        sign, ways = SIGNS[step.direction], frozenset({step.direction})
        until_nm = sign * (1.0 - TORQUE_TOLERANCE) * step.until_torque_nm
        torque_nm = exactly(until_nm).beyond(ways) if reaches else self._loaded(ways)
        by_rad = NONE.up_to(sign * step.until_angle_rad)
        turned = self._turned(self.angle_rad.plus(by_rad), self.wrist_rad.plus(by_rad), torque_nm)
        return replace(turned, last_nm=sign * step.until_torque_nm)

    def gripped(self, step: GripStep) -> "KnownTool":
        """Return the known state after the fingers have closed; a held tool is gripped tighter and keeps its angle."""
        held = Held.YES if step.expect_object else Held.MAYBE
        another = KnownTool(wrist_rad=self.wrist_rad, origin_rad=self.wrist_rad.exact, held=held)
        if self.held is Held.NO:
            return another
        # A sensor may read another torque in a tighter grip.
        tighter = self.rescaled()
        if self.held is Held.YES:
            return replace(tighter, held=Held.YES)
        angle_rad = self.angle_rad.up_to(0.0)
        was_unturned = self.angle_rad == NONE
        origin_rad = self.origin_rad if was_unturned else None
        return replace(tighter, held=held, angle_rad=angle_rad, origin_rad=origin_rad)

    def released(self) -> "KnownTool":
        """Return the known state after the fingers have opened: the angle counts from 0 again."""
        return KnownTool(wrist_rad=self.wrist_rad, origin_rad=self.wrist_rad.exact, held=Held.NO)

    def tared(self) -> "KnownTool":
        """Return the known state after a tare; it is refused with a held tool that is not clamped, or is turned."""
        angle_rad = self.angle_rad if self.held is Held.NO else self.angle_rad.within(UNTURNED_RAD)
        return replace(self, angle_rad=angle_rad, torque_nm=NONE, last_nm=0.0)

    def moved(self) -> "KnownTool":
        """Return the known state after a straight line, which may turn wrist 3 and load a held tool."""
        torque_nm = self.torque_nm if self.held is Held.NO else UNKNOWN
        return replace(self, angle_rad=UNKNOWN, wrist_rad=UNKNOWN, torque_nm=torque_nm)

    def relaxed(self) -> "KnownTool":
        """Return the known state after a rest, in which the torque may fall towards 0."""
        return replace(self, torque_nm=self.torque_nm.up_to(0.0))

    def rescaled(self) -> "KnownTool":
        """Return the known state after a change of the measured torque's scale: only its direction stays."""
        load_ways = opposite(self.torque_nm.ways_to(0.0))
        return replace(self, torque_nm=self.torque_nm.up_to(0.0).beyond(load_ways))

    def _loaded(self, ways: Ways) -> Interval:
        """Return the torque after a turn in one of these directions; a tool that breaks loose may lose all of it."""
        return self.torque_nm.up_to(0.0).beyond(ways)

    def _turned_beyond(self, ways: Ways, torque_nm: Interval) -> "KnownTool":
        return self._turned(self.angle_rad.beyond(ways), self.wrist_rad.beyond(ways), torque_nm)

    def _turned(self, angle_rad: Interval, wrist_rad: Interval, torque_nm: Interval) -> "KnownTool":
        """Return the known state with another angle: the wrist joint's angle and the tool's differ by the origin."""
        origin_rad = self.origin_rad
        if origin_rad is not None:
            wrist_rad = angle_rad.plus(exactly(origin_rad))
        elif angle_rad.exact is not None and wrist_rad.exact is not None:
            origin_rad = wrist_rad.exact - angle_rad.exact
        return replace(self, angle_rad=angle_rad, wrist_rad=wrist_rad, torque_nm=torque_nm, origin_rad=origin_rad)


# A tool as a fresh grip leaves it, and one of which nothing is known.
AT_REST: Final = KnownTool()
NOTHING_KNOWN: Final = KnownTool(angle_rad=UNKNOWN, torque_nm=UNKNOWN)


def known_at_start(*, loaded: bool, twisted_rad: float, wrist_rad: float | None = None) -> KnownTool:
    """Return the known state at a start; `loaded`: a tool may be held, turned by about `twisted_rad` since its grip.

    `wrist_rad` is where the wrist joint stands; None: it is not known.
    """
    stands_rad = UNKNOWN if wrist_rad is None else exactly(wrist_rad)
    if not loaded:
        return replace(AT_REST, wrist_rad=stands_rad, origin_rad=wrist_rad)
    angle_rad = UNKNOWN if abs(twisted_rad) > UNTURNED_RAD else UNKNOWN.within(UNTURNED_RAD)
    return replace(NOTHING_KNOWN, angle_rad=angle_rad, wrist_rad=stands_rad)


def known_after(step: Step, known: KnownTool, *, reaches: bool = True) -> KnownTool:
    """Return the known state after a step, from the one before it."""
    if isinstance(step, TwistingStep) and known.held is Held.NO:
        # Something else than the fingers may hold it.
        known = replace(known, held=Held.MAYBE)
    match step:
        case TurnToStep(angle_rad=angle_rad):
            return known.wrist_turned_to(angle_rad)
        case TwistStep():
            return _twisted(step, known)
        case HoldTorqueStep(signed_torque_nm=torque_nm):
            return known.torque_brought_to(torque_nm)
        case TightenStep():
            return known.tightened(step, reaches=reaches)
        case GripStep():
            return known.gripped(step)
        case ReleaseStep():
            return known.released()
        case TareStep():
            return known.tared()
        case ApproachStep():
            return known.moved()
        case AdaptStep():
            return known.rescaled()
        case IdentifyStep() | WaitStep():
            return known.relaxed()


def _twisted(step: TwistStep, known: KnownTool) -> KnownTool:
    # A second round may turn back to the first angle, and a third one does the same.
    for target_rad in step.angles_rad * min(step.repeats, 2):
        if step.return_to_start:
            ways = known.ways_of_wrist(target_rad) if step.absolute else known.angle_rad.ways_to(target_rad)
            known = known.returned(ways)
        else:
            known = known.wrist_turned_to(target_rad) if step.absolute else known.turned_to(target_rad)
    return known
