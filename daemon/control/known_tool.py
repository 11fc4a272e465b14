"""The known angle and torque of a tool after each step of an experiment, before it runs.

An angle or a torque is known exactly, within an interval, or not at all. These facts about the tool are assumed:

- A turn in one direction does not load the tool in the other one. The size of the change of torque is not known: the
  tool has an unknown stiffness, and may slip or break loose.
- To raise a torque (counterclockwise is positive), the wrist turns counterclockwise; to lower it, clockwise.
- While the wrist stands, the torque may fall towards 0. Under a held torque, the tool may creep in its direction.
- `identify` turns counterclockwise, ends where it began, and refuses a tool that slips.
- A straight line may turn wrist 3. The angle from the grip is measured by this joint.
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
# Smaller differences come from rounding.
_ROUNDING: Final = 1e-9

# The possible directions of a turn. None among them: possibly there is no turn.
Ways: TypeAlias = frozenset[Direction | None]
STILL: Final[Ways] = frozenset({None})
_OPPOSITE: Final[dict[Direction, Direction]] = {"clockwise": "counterclockwise", "counterclockwise": "clockwise"}


def way_from(start: float, end: float) -> Direction | None:
    """Return the direction from an angle or a torque to another; None if they differ by rounding only."""
    return None if abs(end - start) <= _ROUNDING else direction_of(end - start)


def opposite(ways: Ways) -> Ways:
    """Return the opposite directions; None has no opposite."""
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
        """Return the possible directions from this value to another."""
        ends = {way_from(self.low, value), way_from(self.high, value)}
        return frozenset(ends | STILL) if len(ends) > 1 else frozenset(ends)

    def plus(self, other: "Interval") -> "Interval":
        """Return the possible sums of a value of this interval and one of the other."""
        return Interval(self.low + other.low, self.high + other.high)

    def up_to(self, value: float) -> "Interval":
        """Return the smallest interval that contains this one and a value."""
        return Interval(min(self.low, value), max(self.high, value))

    def beyond(self, ways: Ways) -> "Interval":
        """Return the possible values after changes of unknown size in these directions."""
        low = -math.inf if "clockwise" in ways else self.low
        high = math.inf if "counterclockwise" in ways else self.high
        return Interval(low, high)

    def within(self, bound: float) -> "Interval":
        """Return the part of this interval from -`bound` to `bound`; all of that range if they do not overlap."""
        low, high = max(self.low, -bound), min(self.high, bound)
        return Interval(low, high) if low <= high else Interval(-bound, bound)


def exactly(value: float) -> Interval:
    """Return a value that is known exactly."""
    return Interval(value, value)


ZERO: Final = exactly(0.0)
UNKNOWN: Final = Interval(-math.inf, math.inf)


class Held(Enum):
    """Whether a tool is held, by the fingers or by a clamp."""

    NO = "no"
    MAYBE = "maybe"
    YES = "yes"


@dataclass(frozen=True, slots=True)
class KnownTool:
    """The known state between two steps."""

    # The tool's angle from the grip.
    angle_rad: Interval = ZERO
    torque_nm: Interval = ZERO
    # The latest torque that a step has asked for in this grip: the likely torque where `torque_nm` is not exact.
    last_nm: float = 0.0
    # The wrist joint's angle.
    wrist_rad: Interval = UNKNOWN
    # The wrist joint's angle at which the tool's angle is 0; None if it is not known.
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
        """Return the possible directions of a turn to an angle of the wrist joint."""
        if self.origin_rad is not None:
            return self.angle_rad.ways_to(wrist_rad - self.origin_rad)
        return self.wrist_rad.ways_to(wrist_rad)

    def returned(self, ways: Ways) -> "KnownTool":
        """Return the known state after a turn there and back: slip may leave a torque in the opposite direction."""
        return replace(self, torque_nm=self.torque_nm.up_to(0.0).beyond(opposite(ways)))

    def torque_brought_to(self, torque_nm: float) -> "KnownTool":
        """Return the known state after the torque was brought to a value and held."""
        turns = self.torque_nm.ways_to(torque_nm)
        creeps: Ways = frozenset({direction_of(torque_nm)})
        return replace(self._turned_beyond(turns | creeps, exactly(torque_nm)), last_nm=torque_nm)

    def tightened(self, step: TightenStep, *, reaches: bool) -> "KnownTool":
        """Return the known state after a `tighten`; `reaches`: it ended at its torque or beyond, not at its angle."""
        sign, ways = SIGNS[step.direction], frozenset({step.direction})
        until_nm = sign * (1.0 - TORQUE_TOLERANCE) * step.until_torque_nm
        torque_nm = exactly(until_nm).beyond(ways) if reaches else self._loaded(ways)
        by_rad = ZERO.up_to(sign * step.until_angle_rad)
        turned = self._turned(self.angle_rad.plus(by_rad), self.wrist_rad.plus(by_rad), torque_nm)
        return replace(turned, last_nm=sign * step.until_torque_nm)

    def gripped(self, step: GripStep) -> "KnownTool":
        """Return the known state after the fingers have closed: a tool that was held before keeps its angle."""
        held = Held.YES if step.expect_object else Held.MAYBE
        another = KnownTool(wrist_rad=self.wrist_rad, origin_rad=self.wrist_rad.exact, held=held)
        if self.held is Held.NO:
            return another
        # A sensor may read another torque in a tighter grip.
        tighter = self.rescaled()
        if self.held is Held.YES:
            return replace(tighter, held=Held.YES)
        angle_rad = self.angle_rad.up_to(0.0)
        was_unturned = self.angle_rad == ZERO
        origin_rad = self.origin_rad if was_unturned else None
        return replace(tighter, held=held, angle_rad=angle_rad, origin_rad=origin_rad)

    def released(self) -> "KnownTool":
        """Return the known state after the fingers have opened: the angle counts from 0 again."""
        return KnownTool(wrist_rad=self.wrist_rad, origin_rad=self.wrist_rad.exact, held=Held.NO)

    def tared(self) -> "KnownTool":
        """Return the known state after a tare: it is refused with a gripped tool, and with a turned clamped one."""
        angle_rad = self.angle_rad if self.held is Held.NO else self.angle_rad.within(UNTURNED_RAD)
        return replace(self, angle_rad=angle_rad, torque_nm=ZERO, last_nm=0.0)

    def moved(self) -> "KnownTool":
        """Return the known state after a straight line: it may turn wrist 3 and load a held tool."""
        torque_nm = self.torque_nm if self.held is Held.NO else UNKNOWN
        return replace(self, angle_rad=UNKNOWN, wrist_rad=UNKNOWN, torque_nm=torque_nm)

    def relaxed(self) -> "KnownTool":
        """Return the known state after a rest, in which the torque may fall towards 0."""
        return replace(self, torque_nm=self.torque_nm.up_to(0.0))

    def rescaled(self) -> "KnownTool":
        """Return the known state after a change of the measured torque's scale: only its direction is still known."""
        load_ways = opposite(self.torque_nm.ways_to(0.0))
        return replace(self, torque_nm=self.torque_nm.up_to(0.0).beyond(load_ways))

    def _loaded(self, ways: Ways) -> Interval:
        """Return the possible torques after a turn in one of these directions: the tool may break loose."""
        return self.torque_nm.up_to(0.0).beyond(ways)

    def _turned_beyond(self, ways: Ways, torque_nm: Interval) -> "KnownTool":
        return self._turned(self.angle_rad.beyond(ways), self.wrist_rad.beyond(ways), torque_nm)

    def _turned(self, angle_rad: Interval, wrist_rad: Interval, torque_nm: Interval) -> "KnownTool":
        """Return the known state at another angle. The wrist joint's angle is the tool's angle plus the origin."""
        origin_rad = self.origin_rad
        if origin_rad is not None:
            wrist_rad = angle_rad.plus(exactly(origin_rad))
        elif angle_rad.exact is not None and wrist_rad.exact is not None:
            origin_rad = wrist_rad.exact - angle_rad.exact
        return replace(self, angle_rad=angle_rad, wrist_rad=wrist_rad, torque_nm=torque_nm, origin_rad=origin_rad)


# The state after a new grip, and a state of which nothing is known.
AT_REST: Final = KnownTool()
NOTHING_KNOWN: Final = KnownTool(angle_rad=UNKNOWN, torque_nm=UNKNOWN)


def known_at_start(*, loaded: bool, twisted_rad: float, wrist_rad: float | None = None) -> KnownTool:
    """Return the known state at a start.

    `loaded`: a tool may be held, and is turned by about `twisted_rad` since its grip. `wrist_rad` is the wrist joint's
    angle, None if it is not known.
    """
    wrist_bounds_rad = UNKNOWN if wrist_rad is None else exactly(wrist_rad)
    if not loaded:
        return replace(AT_REST, wrist_rad=wrist_bounds_rad, origin_rad=wrist_rad)
    angle_rad = UNKNOWN if abs(twisted_rad) > UNTURNED_RAD else UNKNOWN.within(UNTURNED_RAD)
    return replace(NOTHING_KNOWN, angle_rad=angle_rad, wrist_rad=wrist_bounds_rad)


def known_after(step: Step, known: KnownTool, *, reaches: bool = True) -> KnownTool:
    """Return the known state after a step, from the one before it."""
    if isinstance(step, TwistingStep) and known.held is Held.NO:
        # Not only the fingers can hold a tool: it may be clamped.
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
