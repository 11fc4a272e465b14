"""Which way each step of an experiment turns the tool, and which steps turn it back."""

from collections.abc import Iterable, Iterator
from itertools import pairwise
from typing import NamedTuple

from shearloop.daemon.control.experiment_schema import (
    ApproachStep,
    ExperimentFile,
    HoldTorqueStep,
    IdentifyStep,
    ReleaseStep,
    Step,
    TightenStep,
    TurnToStep,
    TwistingStep,
    TwistStep,
)
from shearloop.daemon.control.known_tool import (
    AT_REST,
    STILL,
    Held,
    Interval,
    KnownTool,
    Ways,
    known_after,
    opposite,
    way_from,
)
from shearloop.daemon.torques import BOTH_DIRECTIONS, Direction, direction_of


def only_way(ways: Ways) -> Direction | None:
    """Return the one direction of a turn, if there is a turn; None if both are possible, or none is."""
    directions = ways - STILL
    return next(iter(directions)) if len(directions) == 1 else None


def either_way(ways: Ways) -> bool:
    """Return whether both directions are possible."""
    return len(ways - STILL) > 1


def ways_between(values: Iterable[float]) -> list[Direction]:
    """Return the directions of the turns from each angle to the next, in order; equal angles have no turn between."""
    ways = (way_from(earlier, later) for earlier, later in pairwise(values))
    return [way for way in ways if way is not None]


class Turn(NamedTuple):
    """What a step turns: in which directions its first turn may be, and the last one of those that it leaves.

    A step that returns to where it began leaves no turn. `loads` is the direction of the torque or the angle that it
    leaves, None where that is as before. `asks_for` are those of all torques, or of all angles since the grip, that it
    asks for. `may_load` are the directions of all torques that it may put on a held tool. `reach_rad` bounds the angle
    since the grip; infinite where it is unknown. `turns_tool`: it turns a tool that is held, or may be. `by_angle`: it
    does so by an angle, with a torque that is not known before.
    """

    begins: Ways
    leaves: Ways
    loads: Direction | None
    asks_for: frozenset[Direction]
    may_load: frozenset[Direction]
    reach_rad: Interval
    turns_tool: bool
    by_angle: bool

    @property
    def direction(self) -> Direction | None:
        """The direction of its first turn; None for none, or unknown."""
        return only_way(self.begins)

    @property
    def way_unknown(self) -> bool:
        """Whether it may turn the tool in either direction."""
        return either_way(self.begins)


def turns(file: ExperimentFile, start: KnownTool = AT_REST, *, reaches: bool = True) -> Iterator[Turn]:
    """Yield what each step turns; `reaches`: each `tighten` ends at its torque or beyond, not at its angle."""
    known = start
    for step in file.steps:
        after = known_after(step, known, reaches=reaches)
        yield _turn_of(step, known, after)
        known = after


def _turn_of(step: Step, before: KnownTool, after: KnownTool) -> Turn:
    turns_tool = isinstance(step, TwistingStep) or (isinstance(step, TurnToStep) and before.held is not Held.NO)
    by_angle = turns_tool and isinstance(step, TwistStep | IdentifyStep | TurnToStep)
    begins = _begins(step, before) if turns_tool else STILL
    leaves, loads = begins, None
    reach_rad = after.angle_rad
    match step:
        case HoldTorqueStep(signed_torque_nm=torque_nm):
            loads = direction_of(torque_nm)
        case TightenStep(direction=direction):
            loads = direction
        case TwistStep(angles_rad=angles_rad, absolute=absolute):
            reach_rad = _reach(step, before, after)
            if step.return_to_start:
                leaves = STILL
            else:
                last = _last_way(angles_rad)
                leaves = begins if last is None else frozenset({last})
                loads = None if absolute else direction_of(angles_rad[-1])
        case IdentifyStep(amplitude_rad=amplitude_rad):
            leaves = STILL
            reach_rad = Interval(reach_rad.low, reach_rad.high + amplitude_rad)
    asks_for = _asks_for(step, before)
    may_load = _may_load(step, before, begins, asks_for)
    return Turn(begins, leaves, loads, asks_for, may_load, reach_rad, turns_tool, by_angle)


def _asks_for(step: Step, before: KnownTool) -> frozenset[Direction]:
    """Return the directions of the torques, or of the angles since the grip, that a step asks for."""
    directions: set[Direction | None] = set()
    match step:
        case HoldTorqueStep(signed_torque_nm=torque_nm):
            directions = {direction_of(torque_nm)}
        case TightenStep(direction=direction):
            directions = {direction}
        case IdentifyStep():
            directions = {"counterclockwise"}
        case TwistStep():
            directions = {direction_of(angle_rad) for angle_rad in _since_grip(step, before) or ()}
    return _without_none(directions)


def _may_load(step: Step, before: KnownTool, begins: Ways, asks_for: frozenset[Direction]) -> frozenset[Direction]:
    """Return in which directions a step may load a held tool.

    A step that asks for a torque turns the other way only to lower it. Any other turn counts in its own direction,
    because a tool that has slipped is loaded the other way before the wrist is back.
    """
    match step:
        case HoldTorqueStep() | TightenStep():
            return asks_for
        case IdentifyStep():
            return BOTH_DIRECTIONS
        case ApproachStep() if before.held is not Held.NO:
            return BOTH_DIRECTIONS
        case TwistStep(angles_rad=angles_rad):
            rounds = angles_rad * min(step.repeats, 2)
            ways = begins.union(ways_between(rounds))
            return _without_none(ways | opposite(ways) if step.return_to_start else ways)
    return _without_none(begins)


def _without_none(ways: Iterable[Direction | None]) -> frozenset[Direction]:
    return frozenset(way for way in ways if way is not None)


def _begins(step: Step, before: KnownTool) -> Ways:
    """Return in which directions the first turn of a step may be."""
    match step:
        case TurnToStep(angle_rad=angle_rad):
            return before.ways_of_wrist(angle_rad)
        case TwistStep(absolute=True, angles_rad=angles_rad):
            return _first_ways(before.ways_of_wrist(angles_rad[0]), angles_rad)
        case TwistStep(angles_rad=angles_rad):
            return _first_ways(before.angle_rad.ways_to(angles_rad[0]), angles_rad)
        case HoldTorqueStep(signed_torque_nm=torque_nm):
            return before.torque_nm.ways_to(torque_nm)
        case TightenStep(direction=direction, until_torque_nm=until_nm):
            return _tightens(direction, until_nm, before.torque_nm)
        case IdentifyStep():
            return frozenset({"counterclockwise"})
    return STILL


def _first_ways(to_first: Ways, angles_rad: tuple[float, ...]) -> Ways:
    """Return the directions of a twist's first turn; it is to a later angle if the tool stands at the first one."""
    if None not in to_first:
        return to_first
    later_ways = ways_between(angles_rad)
    first_later = later_ways[0] if later_ways else None
    return (to_first - STILL) | {first_later}


def _tightens(direction: Direction, until_nm: float, torque_nm: Interval) -> Ways:
    """Return whether a `tighten` turns: it does not where its torque is reached already."""
    weakest_nm, strongest_nm = torque_nm.low, torque_nm.high
    if direction == "clockwise":
        weakest_nm, strongest_nm = -torque_nm.high, -torque_nm.low
    if weakest_nm >= until_nm:
        return STILL
    return frozenset({direction, None}) if strongest_nm >= until_nm else frozenset({direction})


def _reach(step: TwistStep, before: KnownTool, after: KnownTool) -> Interval:
    """Return the bounds of the angle since the grip in a twist."""
    angles_rad = _since_grip(step, before)
    if angles_rad is None:
        return after.angle_rad
    return after.angle_rad.up_to(min(angles_rad)).up_to(max(angles_rad))


def _since_grip(step: TwistStep, before: KnownTool) -> tuple[float, ...] | None:
    """Return the angles of a twist from the grip; None for those of a wrist joint whose angle there is not known."""
    if not step.absolute:
        return step.angles_rad
    origin_rad = before.origin_rad
    return None if origin_rad is None else tuple(angle_rad - origin_rad for angle_rad in step.angles_rad)


def _last_way(angles_rad: tuple[float, ...]) -> Direction | None:
    """Return the direction of the last turn from angle to angle; None where all are one."""
    ways = ways_between(angles_rad)
    return ways[-1] if ways else None


class Reversal(NamedTuple):
    """A step that turns a held tool back: the numbers, from 1, of it and of the step before, and both directions."""

    number: int
    direction: Direction
    before: int
    direction_before: Direction

    def sentence(self, file: ExperimentFile) -> str:
        """Return what turns back what."""
        return (
            f"reversal: {file.steps[self.number - 1].do} turns {self.direction}, against {self._before(file)}, which "
            f"turned {self.direction_before}"
        )

    def possible_sentence(self, file: ExperimentFile) -> str:
        """Return what may turn back what: one of the two steps may not turn at all."""
        step, against = file.steps[self.number - 1], f"the {self.direction_before} turn of {self._before(file)}"
        return f"may turn back: {step.do} may turn {self.direction}, against {against}"

    def _before(self, file: ExperimentFile) -> str:
        return f"step {self.before} ({file.steps[self.before - 1].do})"


class _EarlierTurn(NamedTuple):
    """The number of an earlier step, and a direction in which it turned or may have turned."""

    number: int
    direction: Direction


class Reversals(NamedTuple):
    """The steps that turn the tool back in its grip, and the numbers, from 1, of those that may.

    `uncertain` are the numbers of known ones where a step may not turn at all: it, or the one before.
    """

    known: tuple[Reversal, ...]
    possible: tuple[int, ...]
    uncertain: frozenset[int]


def reversals(file: ExperimentFile, start: KnownTool = AT_REST) -> Reversals:
    """Return the steps that turn the tool back in its grip: against the last turn, or to the other side.

    With torques of 0.1, 0 and -0.1 N·m the second and the third step do. A step that returns to where it began does not
    count as the last turn.
    """
    known: list[Reversal] = []
    possible: list[int] = []
    uncertain: set[int] = set()
    # The possible directions of the last turn, each with its latest step that turns for certain, else its latest step.
    last: dict[Direction, int] = {}
    certain: set[int] = set()
    # The last turn that loaded the tool further.
    loaded: _EarlierTurn | None = None
    for number, (step, turn) in enumerate(zip(file.steps, turns(file, start), strict=True), 1):
        if isinstance(step, ReleaseStep):
            last, loaded = {}, None
        way = turn.direction
        against: list[_EarlierTurn] = []
        for other, before in last.items():
            if turn.begins - STILL - {other}:
                against.append(_EarlierTurn(before, other))
        earlier: _EarlierTurn | None = None
        if way is not None and len(last) == 1 and against:
            earlier = against[0]
        elif way is not None and loaded is not None and way == turn.loads and way != loaded.direction:
            earlier = loaded
        if way is not None and earlier is not None:
            known.append(Reversal(number, way, earlier.number, earlier.direction))
            if None in turn.begins or earlier.number not in certain:
                uncertain.add(number)
        elif against:
            possible.append(number)
        if None not in turn.leaves:
            last = {}
            certain.add(number)
        for left in turn.leaves - STILL:
            if left is not None and last.get(left) not in certain:
                last[left] = number
        left_way = only_way(turn.leaves)
        if left_way is not None and left_way == turn.loads:
            loaded = _EarlierTurn(number, left_way)
    return Reversals(tuple(known), tuple(possible), frozenset(uncertain))
