"""The directions in which each step of an experiment turns the tool, and the steps that turn it back."""

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
    """Return the only possible direction of a turn; None if both directions are possible, or no turn is."""
    directions = ways - STILL
    return next(iter(directions)) if len(directions) == 1 else None


def either_way(ways: Ways) -> bool:
    """Return whether both directions are possible."""
    return len(ways - STILL) > 1


def ways_between(values: Iterable[float]) -> list[Direction]:
    """Return the direction of each turn from angle to angle, in order; equal angles need no turn."""
    ways = (way_from(earlier, later) for earlier, later in pairwise(values))
    return [way for way in ways if way is not None]


class Turn(NamedTuple):
    """The turns of one step."""

    # The possible directions of its first turn.
    begins: Ways
    # The possible directions of the last turn. A step that returns to where it began counts as no turn.
    leaves: Ways
    # The direction of the torque or the angle at its end; None where the step sets neither.
    loads: Direction | None
    # The directions of all torques, or of all angles since the grip, that it asks for.
    asks_for: frozenset[Direction]
    # The directions in which it may load a held tool.
    may_load: frozenset[Direction]
    # The bounds of the angle since the grip during the step; infinite where it is not known.
    reach_rad: Interval
    # Whether it turns a tool that is held, or may be held.
    turns_tool: bool
    # Whether it turns that tool by an angle, so that the torque is not known before.
    by_angle: bool

    @property
    def direction(self) -> Direction | None:
        """The direction of its first turn; None if it does not turn, or if the direction is not known."""
        return only_way(self.begins)

    @property
    def way_unknown(self) -> bool:
        """Whether its first turn may be in either direction."""
        return either_way(self.begins)


def turns(file: ExperimentFile, start: KnownTool = AT_REST, *, reaches: bool = True) -> Iterator[Turn]:
    """Yield the turns of each step; `reaches`: each `tighten` ends at its torque or beyond, not at its angle."""
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
    """Return the directions in which a step may load a held tool.

    A step that asks for a torque turns the other way only to lower the torque. Any other turn may load the tool in its
    own direction. That includes a turn back: a tool that has slipped is unloaded before the wrist is back, and the rest
    of the turn loads it the other way.
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
    """Return the possible directions of a step's first turn."""
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
    """Return the possible directions of a twist's first turn, from those to its first angle.

    If the tool is at the first angle already, its first turn is to a later angle.
    """
    if None not in to_first:
        return to_first
    later_ways = ways_between(angles_rad)
    first_later = later_ways[0] if later_ways else None
    return (to_first - STILL) | {first_later}


def _tightens(direction: Direction, until_nm: float, torque_nm: Interval) -> Ways:
    """Return the possible directions of a `tighten`: it does not turn where its torque is reached already."""
    weakest_nm, strongest_nm = torque_nm.low, torque_nm.high
    if direction == "clockwise":
        weakest_nm, strongest_nm = -torque_nm.high, -torque_nm.low
    if weakest_nm >= until_nm:
        return STILL
    return frozenset({direction, None}) if strongest_nm >= until_nm else frozenset({direction})


def _reach(step: TwistStep, before: KnownTool, after: KnownTool) -> Interval:
    """Return the bounds of the angle since the grip during a twist."""
    angles_rad = _since_grip(step, before)
    if angles_rad is None:
        return after.angle_rad
    return after.angle_rad.up_to(min(angles_rad)).up_to(max(angles_rad))


def _since_grip(step: TwistStep, before: KnownTool) -> tuple[float, ...] | None:
    """Return a twist's angles since the grip.

    None for angles of the wrist joint, if the joint's angle at the grip is not known.
    """
    if not step.absolute:
        return step.angles_rad
    origin_rad = before.origin_rad
    return None if origin_rad is None else tuple(angle_rad - origin_rad for angle_rad in step.angles_rad)


def _last_way(angles_rad: tuple[float, ...]) -> Direction | None:
    """Return the direction of the last turn from angle to angle; None where all angles are equal."""
    ways = ways_between(angles_rad)
    return ways[-1] if ways else None


class Reversal(NamedTuple):
    """A step that turns a held tool back, and the earlier step: their numbers, from 1, and their directions."""

    number: int
    direction: Direction
    before: int
    direction_before: Direction

    def sentence(self, file: ExperimentFile) -> str:
        """Return the reversal in words."""
        return (
            f"reversal: {file.steps[self.number - 1].do} turns {self.direction}, against {self._before(file)}, which "
            f"turned {self.direction_before}"
        )

    def possible_sentence(self, file: ExperimentFile) -> str:
        """Return the reversal in words, where one of the two steps possibly does not turn at all."""
        step, against = file.steps[self.number - 1], f"the {self.direction_before} turn of {self._before(file)}"
        return f"may turn back: {step.do} may turn {self.direction}, against {against}"

    def _before(self, file: ExperimentFile) -> str:
        return f"step {self.before} ({file.steps[self.before - 1].do})"


class _EarlierTurn(NamedTuple):
    """The number of an earlier step, and a direction in which it turned or may have turned."""

    number: int
    direction: Direction


class Reversals(NamedTuple):
    """The steps that turn the tool back in its grip. Numbers of steps count from 1."""

    known: tuple[Reversal, ...]
    # The numbers of further steps that may turn it back.
    possible: tuple[int, ...]
    # The numbers of those in `known` where the step, or the earlier one, possibly does not turn at all.
    uncertain: frozenset[int]


def reversals(file: ExperimentFile, start: KnownTool = AT_REST) -> Reversals:
    """Return the steps that turn the tool back in its grip: against the last turn, or to the other side.

    With torques of 0.1, 0 and -0.1 N·m the second and the third step do. A step that returns to where it began does not
    count as the last turn.
    """
    known: list[Reversal] = []
    possible: list[int] = []
    uncertain: set[int] = set()
    # The possible directions of the last turn, each with the number of its step. A step that turns for certain stays
    # here when a later step may turn the same way.
    last: dict[Direction, int] = {}
    certain: set[int] = set()
    # The latest turn in the direction of the tool's load.
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
