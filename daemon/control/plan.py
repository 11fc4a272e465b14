"""The plan of an experiment: each step in words, with direction, angle, torque, force, duration and limits."""

import itertools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

from shearloop.daemon.control import experiment_schema as steps
from shearloop.daemon.control.decimal_commas import DECIMAL_POINT, are_probably_decimals
from shearloop.daemon.control.experiment_schema import ExperimentFile, Step
from shearloop.daemon.control.known_tool import AT_REST, NOTHING_KNOWN, KnownTool, known_after
from shearloop.daemon.control.step_demands import demands
from shearloop.daemon.control.step_motions import AS_ASKED, Speeds, first_turn_before_tare
from shearloop.daemon.control.turns import Turn, either_way, reversals, turns, ways_between
from shearloop.daemon.loop_config import LoopConfig
from shearloop.daemon.torques import LOAD_CELL, WRENCH, Direction, direction_of
from shearloop.drivers.robotiq.models import LARGEST_STROKE_MM, GripperModel
from shearloop.drivers.ur.settings import UrLimits

# A gripper feels a tool that is wider than its target by this much: by the manual it takes some millimetres.
FELT_MM = 5.0


@dataclass(frozen=True, slots=True)
class StepPlan:
    """One step: its action in words, its times, its largest values, and its limits, reversals and refusals.

    It takes about `duration_s`, and at most `longest_s`. `angle_rad` is its longest turn by a known angle, at most.
    `torque_nm` is None if the step turns the tool by an angle, because its torque is not known before. `reverses` says
    whether the step turns a held tool against the previous turn, `may_reverse` whether it may do so, `turns_back`
    whether it turns both ways, `way_unknown` whether it turns a tool in a direction that is not known before. `moves`
    says whether arm or fingers move.
    """

    number: int
    do: str
    text: str
    duration_s: float
    longest_s: float
    direction: str = ""
    torque_nm: float | None = 0.0
    angle_rad: float = 0.0
    force_n: float = 0.0
    timeout_s: float | None = None
    reverses: bool = False
    may_reverse: bool = False
    turns_back: bool = False
    way_unknown: bool = False
    moves: bool = True
    notes: tuple[str, ...] = ()
    refused: tuple[str, ...] = ()

    def sentences(self) -> Iterator[str]:
        """Yield the step's lines."""
        timeout = f", stopped after {self.timeout_s:g} s" if self.timeout_s is not None else ""
        yield f"  {self.number:>2}  {self.do:<12} {self.text}; {_about(self.duration_s, self.longest_s)}{timeout}"
        for note in (*self.notes, *(f"REFUSED: {why}" for why in self.refused)):
            yield f"      {'':<12} {note}"


@dataclass(frozen=True, slots=True)
class Plan:
    """An experiment's steps in order, its largest values, and what it assumes or does not know."""

    name: str
    torque_source: str
    limit_nm: float
    limit_rad: float
    steps: tuple[StepPlan, ...]
    unknown: str = ""
    assumed: str = ""

    @property
    def duration_s(self) -> float:
        """How long all steps take, about."""
        return sum(step.duration_s for step in self.steps)

    @property
    def longest_s(self) -> float:
        """How long all steps may take."""
        return sum(step.longest_s for step in self.steps)

    @property
    def angle_rad(self) -> float:
        """The longest turn of a step that asks for an angle."""
        return max(step.angle_rad for step in self.steps)

    @property
    def torque_nm(self) -> float | None:
        """The largest torque that a step asks for; None if none does and a step turns the tool by an angle."""
        known = [step.torque_nm for step in self.steps if step.torque_nm is not None]
        largest_nm = max(known, default=0.0)
        if largest_nm == 0.0 and not self.torque_is_known:
            return None
        return largest_nm

    @property
    def torque_is_known(self) -> bool:
        """Whether no step turns the tool by an angle, with a torque that is not known before."""
        return all(step.torque_nm is not None for step in self.steps)

    @property
    def force_n(self) -> float:
        """The largest force of the fingers."""
        return max(step.force_n for step in self.steps)

    @property
    def first_motion(self) -> str:
        """The first motion, as a sentence for the operator who starts the experiment."""
        first = next((step for step in self.steps if step.moves), None)
        if first is None:
            return "no step moves anything"
        return f"the first motion is step {first.number} of {len(self.steps)} ({first.do}), which {first.text}"

    def as_json(self) -> dict[str, Any]:
        """Return the plan for a script."""
        names = ("duration_s", "longest_s", "angle_rad", "torque_nm", "torque_is_known", "force_n")
        totals = {name: getattr(self, name) for name in names}
        return asdict(self) | totals

    def sentences(self) -> Iterator[str]:
        """Yield the plan's lines."""
        yield f"plan of {self.name!r}, driven by {self.torque_source}, {_about(self.duration_s, self.longest_s)}:"
        for step in self.steps:
            yield from step.sentences()
        torque = f"{self.torque_nm:g} N·m" if self.torque_nm is not None else ""
        if not self.torque_is_known:
            torque += " where a torque is asked for, and " if torque else ""
            torque += "a torque not known before where the tool turns by an angle"
        asked = " that asks for an angle" if any(step.do == "hold_torque" for step in self.steps) else ""
        yield (
            f"  at most {_angle(self.angle_rad)} in a turn{asked}, {torque}, fingers "
            f"{self.force_n:g} N; its limits stop it at {self.limit_nm:g} N·m and {_angle(self.limit_rad)} from "
            "the grip"
        )
        yield f"  {self._reversals()}"
        if unknown_ways := _listed(step for step in self.steps if step.way_unknown):
            yield f"  turning a held tool in a direction that is not known before: step {unknown_ways}"
        if both_ways := _listed(step for step in self.steps if step.turns_back):
            yield f"  turning back within themselves: step {both_ways}"
        yield "  clockwise and counterclockwise are for an eye that faces the gripper"
        for sentence in (self.assumed, self.unknown):
            if sentence:
                yield f"  {sentence}"

    def _reversals(self) -> str:
        """Return how many steps turn a held tool back, and which ones may."""
        count = sum(step.reverses for step in self.steps)
        possible = _listed(step for step in self.steps if step.may_reverse)
        none = "no certain" if possible else "no"
        certain = f"{count or none} reversal{'s' if count != 1 else ''} of a held tool between steps"
        return f"{certain}; it is not known whether these turn it back: step {possible}" if possible else certain


def _listed(some: Iterable[StepPlan]) -> str:
    """Return steps with their numbers."""
    return ", ".join(f"{step.number} ({step.do})" for step in some)


def speeds_of(robot: UrLimits | None, loop: LoopConfig | None) -> Speeds:
    """Return the largest speeds of the loop within the robot's limits; as asked where these are not known."""
    if robot is None:
        return AS_ASKED
    turns = robot.wrist_speed_rad_per_s.inner if loop is None else loop.within(robot).wrist_speed_rad_per_s
    return Speeds(turns, robot.linear_speed_m_per_s.inner)


def plan_of(
    file: ExperimentFile,
    robot: UrLimits | None = None,
    gripper: GripperModel | None = None,
    refused: Mapping[int, tuple[str, ...]] | None = None,
    warm_up_s: float = 0.0,
    start: KnownTool | None = None,
    loop: LoopConfig | None = None,
) -> Plan:
    """Return the plan of an experiment within the limits of the robot, the gripper and the loop, where they are known.

    `refused` has the reasons against each step by its index. `warm_up_s` passes after a grip or a tare until the first
    torque. `start` is the known state of the tool at the start; None: it is assumed to be neither turned nor loaded.
    """
    speeds = speeds_of(robot, loop)
    known = AT_REST if start is None else start
    ways = _ways_of(file, known)
    found_turns = tuple(turns(file, known))
    waits = _waits_for_torques(file, found_turns) if warm_up_s > 0 else {}
    refused_tares = _tares_before_release(file) if gripper is not None else frozenset()
    untared = first_turn_before_tare(file) if file.torque_source in (LOAD_CELL, WRENCH) else None
    planned: list[StepPlan] = []
    needed, ends = demands(file, speeds, known, robot), _ends_of_range(file, found_turns, known, robot)
    for number, (step, turn, needs, end) in enumerate(zip(file.steps, found_turns, needed, ends, strict=True), 1):
        waits_s = 0.0
        notes = [*ways.notes(number, step, turn), *_notes(file, step, turn, robot, speeds), *end]
        if number in waits:
            notes.append(f"before it, up to {warm_up_s:.0f} s for the first torques after {waits[number]}")
            waits_s = warm_up_s
        if needs.depends_on:
            notes.append(f"how long it takes depends on {needs.depends_on}, and is a guess here")
        if step.timeout_s is not None and needs.safe_timeout_s > step.timeout_s:
            notes.append(f"its timeout_s of {step.timeout_s:g} s may stop it before its end")
        if number == untared:
            notes.append("no `tare` comes before it: the start is refused unless a zero is known")
        if number in refused_tares:
            notes.append("it is refused unless the gripper knows that it holds nothing: put a `release` before it")
        planned.append(
            StepPlan(
                number=number,
                do=step.do,
                text=_words(step, turn, gripper, speeds),
                duration_s=needs.takes_s + waits_s,
                longest_s=needs.longest_s + waits_s,
                direction=turn.direction or "",
                torque_nm=None if turn.by_angle else needs.torque_nm,
                angle_rad=needs.turn_rad,
                force_n=step.force_n if isinstance(step, steps.GripStep) else 0.0,
                timeout_s=step.timeout_s,
                reverses=number in ways.back,
                may_reverse=number in ways.possible,
                turns_back=_turns_back(step, turn.direction),
                way_unknown=turn.way_unknown,
                moves=not isinstance(step, steps.TareStep | steps.AdaptStep | steps.WaitStep),
                notes=tuple(notes),
                refused=(refused or {}).get(number - 1, ()),
            )
        )
    unknown = ""
    if robot is None:
        unknown = "the robot's limits are not known: they come from the robot's settings of `--config RIG`, if in order"
    assumed = _assumed(file) if start is None else ""
    limits = file.limits
    return Plan(file.name, file.torque_source, limits.torque_nm, limits.angle_rad, tuple(planned), unknown, assumed)


def _ends_of_range(
    file: ExperimentFile, found_turns: Sequence[Turn], start: KnownTool, robot: UrLimits | None
) -> Iterator[list[str]]:
    """Yield for each step notes on the ends of the wrist's range that it may come to."""
    tool = start
    for step, turn in zip(file.steps, found_turns, strict=True):
        wrist_rad, turned_rad = tool.wrist_rad.exact, tool.angle_rad.exact
        ends: list[str] = []
        if robot is not None and turn.turns_tool and wrist_rad is not None and turned_rad is not None:
            joints, gripped_at_rad = robot.joints, wrist_rad - turned_rad
            reach_rad = turn.reach_rad.within(file.limits_of(step).angle_rad)
            if gripped_at_rad + reach_rad.low < joints.lower_rad[-1] + joints.margin_rad:
                ends.append("clockwise")
            if gripped_at_rad + reach_rad.high > joints.upper_rad[-1] - joints.margin_rad:
                ends.append("counterclockwise")
        yield [
            f"the wrist may stop before the step is done, because wrist 3 stands near the {end} end of its range: turn "
            "it back first, with `turn_to` while nothing is held or with freedrive"
            for end in ends
        ]
        tool = known_after(step, tool, reaches=False)


def _waits_for_torques(file: ExperimentFile, found_turns: Sequence[Turn]) -> dict[int, str]:
    """Return which steps turn a tool first after a grip or a tare, by their numbers, each with that grip or tare."""
    waits: dict[int, str] = {}
    latest = ""
    for number, (step, turn) in enumerate(zip(file.steps, found_turns, strict=True), 1):
        if isinstance(step, steps.GripStep | steps.TareStep):
            latest = f"step {number} ({step.do})"
        elif latest and turn.turns_tool:
            waits[number] = latest
            latest = ""
    return waits


def _tares_before_release(file: ExperimentFile) -> frozenset[int]:
    """Return the numbers of the tares before any release: the gripper may hold a tool since before the start."""
    numbered = enumerate(file.steps, 1)
    before = itertools.takewhile(lambda one: not isinstance(one[1], steps.ReleaseStep), numbered)
    return frozenset(number for number, step in before if isinstance(step, steps.TareStep))


_LAST_UNKNOWN = "it may be a reversal: which way the tool turned last before it is not known"


class _Ways(NamedTuple):
    """The steps, by their numbers, that turn the tool back, that may, and whose direction is that after a `tighten`.

    Such a direction is another one if the `tighten` ends at its angle.
    """

    back: Mapping[int, str]
    possible: Mapping[int, str]
    if_tightened: frozenset[int]

    def notes(self, number: int, step: Step, turn: Turn) -> Iterator[str]:
        """Yield the sentences about a step's direction."""
        if number in self.back:
            yield self.back[number]
        if turn.way_unknown:
            yield _why_way_unknown(step)
        elif number in self.possible:
            yield self.possible[number]
        if number in self.if_tightened:
            yield "its direction may be the other one if the `tighten` before it ends at its angle, below its torque"


def _ways_of(file: ExperimentFile, start: KnownTool) -> _Ways:
    found = reversals(file, start)
    assumed, certain = turns(file, start), turns(file, start, reaches=False)
    differing = enumerate(map(_is_less_certain, assumed, certain), 1)
    uncertain = {one.number: one.possible_sentence(file) for one in found.known if one.number in found.uncertain}
    return _Ways(
        {one.number: one.sentence(file) for one in found.known if one.number not in uncertain},
        dict.fromkeys(found.possible, _LAST_UNKNOWN) | uncertain,
        frozenset(number for number, differs in differing if differs),
    )


def _is_less_certain(assumed: Turn, certain: Turn) -> bool:
    """Return whether a direction that an assumption gives is not known without it."""
    return assumed.direction is not None and certain.direction != assumed.direction


def _why_way_unknown(step: Step) -> str:
    match step:
        case steps.TurnToStep() | steps.TwistStep(absolute=True):
            return "a tool may be held, and turns too: which way, and how far, depends on where wrist 3 stands"
        case steps.TwistStep():
            return "which way it turns first is not known: the steps before it leave the tool at an unknown angle"
    return "which way it turns is not known: the steps before it leave an unknown torque"


def _assumed(file: ExperimentFile) -> str:
    """Return what the plan assumes of a tool that may be held at the start; empty if no direction depends on it."""
    if any(map(_is_less_certain, turns(file), turns(file, NOTHING_KNOWN))):
        return (
            "directions and durations assume that a tool that is held at the start is neither turned nor loaded then; "
            "the plan before a start does not, because the daemon knows whether it is turned"
        )
    return ""


def _words(step: Step, turn: Turn, gripper: GripperModel | None, speeds: Speeds) -> str:
    match step:
        case steps.ApproachStep(pose_m_rad=pose) if pose is not None:
            x, y, z = pose[:3]
            return (
                f"moves the arm in a straight line to x {x:g}, y {y:g}, z {z:g} m {_moving(step.speed_m_per_s, speeds)}"
            )
        case steps.ApproachStep(along_tool_m=distance_m):
            way = "away from the robot" if (distance_m or 0.0) >= 0 else "towards the robot"
            along_mm = 1e3 * abs(distance_m or 0.0)
            return f"moves the arm {along_mm:g} mm along the tool, {way}, {_moving(step.speed_m_per_s, speeds)}"
        case steps.GripStep():
            empty = "stops the experiment if it meets nothing" if step.expect_object else "may meet nothing"
            to = f"closes the fingers to {step.width_mm:g} mm, or onto a tool, at {step.speed_mm_per_s:g} mm/s"
            return f"{to} with up to {step.force_n:g} N; {empty}"
        case steps.ReleaseStep():
            return f"opens the fingers {_opens_to(step, gripper)}: a held tool drops"
        case steps.TareStep():
            return "takes the zero of every torque sensor; nothing turns"
        case steps.IdentifyStep():
            return f"turns the wrist to and fro by up to {_angle(step.amplitude_rad)}, to measure the tool"
        case steps.AdaptStep():
            return f"corrects the gain of {step.fingertip} by the {step.reference.replace('_', ' ')}; nothing turns"
        case steps.TurnToStep():
            return f"turns wrist 3 to {_angle(step.angle_rad)} {_turning(step.speed_rad_per_s, speeds)}"
        case steps.TwistStep():
            return _twist(step, turn, speeds)
        case steps.HoldTorqueStep():
            direction = direction_of(step.signed_torque_nm)
            way = f" {direction}" if direction is not None else ""
            until = f"until the torque is {abs(step.torque_nm):g} N·m{way}"
            return f"turns the wrist {until}, and holds it for {step.hold_s:g} s"
        case steps.TightenStep():
            until = f"until {step.until_torque_nm:g} N·m or {_angle(step.until_angle_rad)}"
            return f"turns the wrist {step.direction} {_turning(step.speed_rad_per_s, speeds)} {until}"
        case steps.WaitStep():
            return f"stands still for {step.wait_s:g} s"


def _turning(asked_rad_per_s: float, speeds: Speeds) -> str:
    """Return in words how fast a step turns the wrist."""
    return f"at {min(asked_rad_per_s, speeds.wrist_rad_per_s):g} rad/s"


def _moving(asked_m_per_s: float, speeds: Speeds) -> str:
    """Return in words how fast a step moves the tool centre."""
    return f"at {min(asked_m_per_s, speeds.linear_m_per_s):g} m/s"


def _opens_to(step: steps.ReleaseStep, gripper: GripperModel | None) -> str:
    """Return how far a step opens the fingers of a gripper, in words; as it is written where none is known.

    A width that would not let a held tool go opens them fully.
    """
    stroke_mm = LARGEST_STROKE_MM if gripper is None else gripper.stroke_mm
    if step.width_mm >= stroke_mm:
        return f"to {stroke_mm:g} mm"
    return f"to {step.width_mm:g} mm, or fully where they hold something about as wide or wider"


def _twist(step: steps.TwistStep, turn: Turn, speeds: Speeds) -> str:
    angles_rad = step.angles_rad
    count = len(angles_rad)
    if count == 1:
        places = _angle(angles_rad[0])
    else:
        places = f"{count} angles from {_angle(min(angles_rad))} to {_angle(max(angles_rad))}"
    since = "of wrist 3" if step.absolute else "from the grip"
    way = "in a direction that is not known" if turn.way_unknown else turn.direction
    turns_once = count == step.repeats == 1 and not step.return_to_start
    first = ""
    if way is not None:
        first = f", {way}" if turns_once else f", first {way}"
    then = f"holds each for {step.hold_s:g} s" + (" and returns" if step.return_to_start else "")
    times = f", {step.repeats} times" if step.repeats > 1 else ""
    return f"twists the wrist to {places} {since}{first}, {then}{times}, {_turning(step.speed_rad_per_s, speeds)}"


def _turns_back(step: Step, begins: Direction | None) -> bool:
    """Return whether a step turns the tool both ways; `hold_torque` does so only to correct.

    `begins` is the direction of its first turn, where that is known.
    """
    match step:
        case steps.IdentifyStep():
            return True
        case steps.TwistStep(return_to_start=True):
            return True
        case steps.TwistStep(angles_rad=angles_rad):
            rounds = angles_rad * min(step.repeats, 2)
            return either_way(frozenset({begins, *ways_between(rounds)}))
    return False


def _notes(file: ExperimentFile, step: Step, turn: Turn, robot: UrLimits | None, speeds: Speeds) -> Iterator[str]:
    """Yield what a step's limits and the robot's change."""
    if isinstance(step, steps.GripStep) and file.tool_mm is not None and step.width_mm > file.tool_mm - FELT_MM:
        most_mm = max(0.0, file.tool_mm - FELT_MM)
        cure = f": make `width_mm` at most {most_mm:g}" if step.width_mm > most_mm else ""
        yield f"the gripper may not feel the tool of {file.tool_mm:g} mm{cure}"
    if isinstance(step, steps.TwistStep) and are_probably_decimals(step.angles_rad):
        yield f"it turns the tool far, by whole numbers of rad: {DECIMAL_POINT}"
    if turn.turns_tool:
        limits = file.limits_of(step)
        if step.limits is not None:
            yield f"its limits stop it at {limits.torque_nm:g} N·m and {_angle(limits.angle_rad)} from the grip"
        reach_rad = max(-turn.reach_rad.low, turn.reach_rad.high)
        if math.isfinite(reach_rad) and reach_rad >= limits.angle_rad:
            asks = f"with the steps before it may be {_angle(reach_rad)} from the grip"
            yield f"{asks}: the limit stops it at {_angle(limits.angle_rad)}"
    if robot is None:
        return
    match step:
        case steps.ApproachStep():
            largest_m_per_s = speeds.linear_m_per_s
            if step.speed_m_per_s > largest_m_per_s:
                yield f"it asks for {step.speed_m_per_s:g} m/s, and the robot's limit allows {largest_m_per_s:g} m/s"
            if step.pose_m_rad is None:
                yield "its end is checked against the workspace as it begins: it depends on where the tool is"
        case steps.TwistStep() | steps.TurnToStep() | steps.TightenStep():
            largest_rad_per_s = speeds.wrist_rad_per_s
            if step.speed_rad_per_s > largest_rad_per_s:
                by_robot = largest_rad_per_s == robot.wrist_speed_rad_per_s.inner
                limit = "the robot's limit" if by_robot else "`loop.wrist_speed_rad_per_s`"
                yield f"it asks for {step.speed_rad_per_s:g} rad/s, and {limit} allows {largest_rad_per_s:g} rad/s"


def _angle(angle_rad: float) -> str:
    return f"{round(angle_rad, 3):g} rad ({math.degrees(angle_rad):.0f}°)"


def _about(seconds: float, longest_s: float) -> str:
    """Return in words how long something takes, and how long it may take."""
    about, longest = _duration(seconds), _duration(longest_s)
    return f"about {about}" if longest == about else f"about {about}, at most {longest}"


def _duration(seconds: float) -> str:
    if 0.0 < seconds < 1.0:
        return f"{max(seconds, 0.1):.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02} s" if minutes else f"{rest} s"
