"""What the plan says of directions and reversals, against runs with tools that spring, slip, relax and creep."""

import math
import random
from dataclasses import dataclass, field
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shearloop.daemon.control import experiment_schema as steps
from shearloop.daemon.control.experiment_schema import ExperimentFile, Step
from shearloop.daemon.control.known_tool import NOTHING_KNOWN, TORQUE_TOLERANCE, UNTURNED_RAD, known_at_start
from shearloop.daemon.control.plan import plan_of
from shearloop.daemon.control.turns import reversals, turns
from shearloop.daemon.torques import BOTH_DIRECTIONS, SIGNS, direction_of

_SMALL = 1e-9


class EndedError(Exception):
    """The daemon stops the experiment here, or refuses it."""


@dataclass
class Run:
    """One run of an experiment with one tool; angles in rad from the grip, torques in N·m."""

    rng: random.Random
    clamped: bool
    # Whether a `tighten` that ends at its angle ends the run, as the plan assumes that it does not.
    reaches: bool
    angle: float = 0.0
    torque: float = 0.0
    held: bool = True
    moves: list[float] = field(default_factory=list)
    # The torques after each turn of the present step.
    torques: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.origin = self.rng.choice([0.0, 0.1, self.rng.uniform(-1.0, 1.0)])
        self.stiffness = self.rng.uniform(0.2, 3.0)
        # It slips at this torque, and then bears a fraction of it.
        self.slips_at = self.rng.choice([math.inf, self.rng.uniform(0.05, 0.5)])
        self.sliding = self.rng.choice([1.0, self.rng.uniform(0.0, 1.0)])
        self.relaxes, self.creeps = self.rng.choice([0.0, 0.5]), self.rng.choice([0.0, 0.1])

    def turn(self, angle: float) -> None:
        """Turn the wrist to an angle."""
        by = angle - self.angle
        if abs(by) <= _SMALL:
            return
        self.moves.append(by)
        self.angle = angle
        if not self.held:
            return
        self.torque += self.stiffness * by
        if abs(self.torque) > self.slips_at:
            self.torque = math.copysign(self.slips_at * self.sliding, self.torque)
        self.torques.append(self.torque)

    def rest(self) -> None:
        """Stand still: the torque falls."""
        self.torque *= 1.0 - self.rng.uniform(0.0, self.relaxes)

    def do(self, step: Step) -> None:
        """Carry out a step."""
        self.moves, self.torques = [], []
        match step:
            case steps.TwistStep():
                self._twist(step)
            case steps.TurnToStep():
                self.turn(step.angle_rad - self.origin)
            case steps.HoldTorqueStep():
                self._hold(step.signed_torque_nm)
            case steps.TightenStep():
                self._tighten(step)
            case steps.IdentifyStep():
                if abs(self.torque) + self.stiffness * step.amplitude_rad > self.slips_at:
                    raise EndedError
                start = self.angle
                self.turn(start + step.amplitude_rad)
                self.turn(start)
                self.rest()
            case steps.WaitStep() | steps.AdaptStep():
                self.rest()
            case steps.TareStep():
                if (self.held and not self.clamped) or abs(self.angle) > UNTURNED_RAD:
                    raise EndedError
                self.torque = 0.0
            case steps.ApproachStep():
                self.angle += self.rng.uniform(-1.0, 1.0)
                self.torque = self.rng.uniform(-0.1, 0.1) if self.held else 0.0
                self.torques.append(self.torque)
            case steps.GripStep() | steps.ReleaseStep():
                self._fingers(holds=isinstance(step, steps.GripStep))

    def _fingers(self, *, holds: bool) -> None:
        if holds and self.held:
            # Another pressure, and another reading.
            factor = self.rng.uniform(0.7, 1.4)
            self.stiffness *= factor
            self.torque *= factor
            self.torque = max(-self.slips_at, min(self.slips_at, self.torque))
            return
        self.held = holds
        self.origin += self.angle
        self.angle = self.torque = 0.0

    def _twist(self, step: steps.TwistStep) -> None:
        start = self.angle
        for angle in step.angles_rad * step.repeats:
            self.turn(angle - self.origin if step.absolute else angle)
            self.rest()
            if step.return_to_start:
                self.turn(start)

    def _hold(self, torque: float) -> None:
        if not self.held or abs(torque) >= self.slips_at:
            raise EndedError
        by = (torque - self.torque) / self.stiffness
        if abs(by) > _SMALL:
            self.moves.append(by)
            self.angle += by
        self.torque = torque
        self.torques.append(torque)
        # Corrections of the loop do not count as turns.
        if torque:
            self.angle += math.copysign(self.rng.uniform(0.0, self.creeps), torque)

    def _tighten(self, step: steps.TightenStep) -> None:
        sign, start = SIGNS[step.direction], self.angle
        until = step.until_torque_nm * (1.0 - self.rng.uniform(0.0, TORQUE_TOLERANCE))
        while sign * self.torque < until:
            if abs(self.angle - start) >= step.until_angle_rad - _SMALL:
                if self.reaches:
                    raise EndedError
                return
            self.turn(self.angle + sign * min(0.01, step.until_angle_rad - abs(self.angle - start)))
        if self.moves and self.slips_at == math.inf:
            left_rad = step.until_angle_rad - abs(self.angle - start)
            self.turn(self.angle + sign * self.rng.uniform(0.0, max(0.0, min(0.05, left_rad))))


def ways(run: Run) -> list[str | None]:
    return [direction_of(by) for by in run.moves]


_ANGLES = st.sampled_from([-0.3, -0.1, -0.05, 0.0, 0.05, 0.1, 0.3])
_TORQUES = st.sampled_from([-0.2, -0.1, -0.05, 0.0, 0.05, 0.1, 0.2])
_DIRECTIONS = st.sampled_from(["clockwise", "counterclockwise"])


def _step(do: str, **keys: st.SearchStrategy[Any]) -> st.SearchStrategy[dict[str, Any]]:
    return st.fixed_dictionaries({"do": st.just(do), **keys})


_TWIST = _step(
    "twist",
    angles_rad=st.lists(_ANGLES, min_size=1, max_size=3),
    absolute=st.sampled_from([False, False, True]),
    return_to_start=st.booleans(),
    repeats=st.integers(1, 2),
)
_TIGHTEN = _step(
    "tighten",
    direction=_DIRECTIONS,
    until_torque_nm=st.sampled_from([0.05, 0.1]),
    until_angle_rad=st.sampled_from([0.2, 1.0]),
)
_TURNING = (
    _TWIST,
    _step("hold_torque", torque_nm=_TORQUES),
    _TIGHTEN,
    _step("turn_to", angle_rad=_ANGLES),
    _step("identify", amplitude_rad=st.just(0.05)),
    _step("wait", wait_s=st.just(5.0)),
    _step("approach", along_tool_m=st.just(0.01)),
)
_TARE, _GRIP, _RELEASE = {"do": "tare"}, {"do": "grip"}, {"do": "release"}
CLAMPED = st.lists(st.one_of(*_TURNING, st.just(_TARE)), min_size=1, max_size=6)
GRIPPED = st.lists(st.one_of(*_TURNING, *_TURNING, st.just(_GRIP), st.just(_RELEASE)), min_size=1, max_size=6)


def file_of(content: list[dict[str, Any]]) -> ExperimentFile:
    return ExperimentFile.model_validate(
        {"name": "one", "limits": {"torque_nm": 0.5, "angle_rad": 5}, "steps": content}
    )


def _returns(step: Step) -> bool:
    return isinstance(step, steps.IdentifyStep) or (isinstance(step, steps.TwistStep) and step.return_to_start)


def _holds_in(file: ExperimentFile, run: Run) -> None:
    """Compare each statement of the plan with a run, to the run's end."""
    planned = plan_of(file).steps
    back = {one.number: one for one in reversals(file).known}
    last: str | None = None
    left: dict[int, str | None] = {}
    for said, step in zip(planned, file.steps, strict=True):
        was_held = run.held
        try:
            run.do(step)
        except EndedError:
            return
        turned = ways(run)
        first = turned[0] if turned else None
        if not was_held and not isinstance(step, steps.TwistingStep):
            turned, first = [], None
        if not said.way_unknown:
            assert first in (None, said.direction), said
            assert said.turns_back or len(set(turned)) < 2, said
        if not (said.reverses or said.may_reverse):
            assert None in (first, last) or first == last, said
        if said.reverses:
            one = back[said.number]
            assert first in (None, one.direction), said
            assert left[one.before] in (None, one.direction_before), said
        left[said.number] = turned[-1] if turned else None
        if turned and not _returns(step):
            last = turned[-1]
        if isinstance(step, steps.ReleaseStep):
            last = None


@pytest.mark.long
@given(content=CLAMPED, seed=st.integers(0, 2**32))
@settings(max_examples=400, deadline=None)
def test_what_the_plan_says_of_a_clamped_tool_holds_in_every_run(content, seed):
    file = file_of(content)
    for number in range(8):
        _holds_in(file, Run(random.Random(seed + number), clamped=True, reaches=True))


@pytest.mark.long
@given(begins=st.sampled_from([[], [_RELEASE], [_RELEASE, {"do": "turn_to", "angle_rad": 0.1}]]), content=GRIPPED,
       seed=st.integers(0, 2**32))  # fmt: skip
@settings(max_examples=400, deadline=None)
def test_what_the_plan_says_of_a_gripped_tool_holds_in_every_run(begins, content, seed):
    file = file_of([*begins, _GRIP, *content])
    for number in range(8):
        _holds_in(file, Run(random.Random(seed + number), clamped=False, reaches=True))


@pytest.mark.long
@given(content=CLAMPED, seed=st.integers(0, 2**32), twisted_rad=st.sampled_from([0.0, 0.01, 0.4]),
       loaded=st.booleans(), wrist_is_known=st.booleans())  # fmt: skip
@settings(max_examples=400, deadline=None)
def test_a_direction_that_assumes_nothing_holds_for_every_tool_and_every_tighten(
    content, seed, twisted_rad, loaded, wrist_is_known
):
    """Also where the tool is turned and loaded at the start, and a `tighten` ends at its angle."""
    file = file_of(content)
    for number in range(8):
        run = Run(random.Random(seed + number), clamped=True, reaches=False)
        run.angle = twisted_rad
        if loaded:
            run.torque = run.rng.uniform(-0.05, 0.05)
        else:
            run.origin, run.angle = run.origin + run.angle, 0.0
        wrist_rad = run.origin + run.angle if wrist_is_known else None
        said = turns(file, known_at_start(loaded=loaded, twisted_rad=twisted_rad, wrist_rad=wrist_rad), reaches=False)
        for step, turn in zip(file.steps, said, strict=True):
            try:
                run.do(step)
            except EndedError:
                break
            first = next(iter(ways(run)), None)
            assert first in turn.begins or (first is None and len(turn.begins) == 1), (step, turn)


@given(content=st.one_of(CLAMPED, GRIPPED), seed=st.integers(0, 2**32))
@settings(max_examples=300, deadline=None)
def test_a_step_loads_a_held_tool_only_in_directions_that_it_says(content, seed):
    """Of each tool: it is turned and loaded at the start, slips and relaxes."""
    file = file_of(content)
    said = list(turns(file, NOTHING_KNOWN))
    for number in range(8):
        run = Run(random.Random(seed + number), clamped=False, reaches=False)
        run.angle, run.torque = run.rng.choice([0.0, -0.4, 0.4]), run.rng.uniform(-0.05, 0.05)
        for step, turn in zip(file.steps, said, strict=True):
            before = run.torque
            try:
                run.do(step)
            except EndedError:
                break
            for direction in BOTH_DIRECTIONS - turn.may_load:
                most = max(SIGNS[direction] * torque for torque in (0.0, before, *run.torques))
                assert most <= max(0.0, SIGNS[direction] * before) + _SMALL, (step, turn)


def _hold(torque_nm: float) -> dict[str, Any]:
    return {"do": "hold_torque", "torque_nm": torque_nm}


def _twist(*angles_rad: float, back: bool = False, **keys: Any) -> dict[str, Any]:
    return {"do": "twist", "angles_rad": angles_rad, "return_to_start": back, **keys}


def _tighten(direction: str) -> dict[str, Any]:
    return {"do": "tighten", "direction": direction, "until_torque_nm": 0.1, "until_angle_rad": 1.0}


CW, CCW = "clockwise", "counterclockwise"
IDENTIFY, WAIT = {"do": "identify"}, {"do": "wait", "wait_s": 5}
LINE = {"do": "approach", "along_tool_m": 0.01}


@pytest.mark.parametrize(
    ("content", "direction", "reverses", "may_reverse"),
    [
        # A fresh grip.
        ([_twist(0.1)], CCW, False, False),
        ([_twist(-0.1, back=True)], CW, False, False),
        ([_twist(0.0, 0.1)], CCW, False, False),
        ([IDENTIFY, _hold(-0.1)], CW, False, False),
        ([_tighten(CW)], CW, False, False),
        ([WAIT, _hold(0.1)], CCW, False, False),
        # Angle after angle, and torque after torque.
        ([_twist(0.1), _twist(0.2)], CCW, False, False),
        ([_twist(0.1), _twist(0.05)], CW, True, False),
        ([_twist(0.1, back=True), _twist(-0.1)], CW, False, False),
        ([_hold(0.1), _hold(0.05)], CW, True, False),
        ([_hold(0.1), _hold(0.1)], "", False, False),
        ([_hold(0.1), WAIT, _hold(0.12)], CCW, False, False),
        ([_hold(0.1), WAIT, _hold(0.05)], "", False, True),
        # A torque after an angle, and an angle after a torque: known on the other side only.
        ([_twist(0.1), _hold(-0.05)], CW, True, False),
        ([_twist(-0.3), _hold(-0.05)], "", False, True),
        ([_hold(-0.1), _twist(-0.05)], "", False, True),
        ([_hold(-0.1), _twist(0.05)], CCW, True, False),
        ([_hold(0.1), _twist(0.0)], CW, False, True),
        ([_tighten(CW), _twist(-0.05)], "", False, True),
        ([_tighten(CW), _twist(-0.05, -0.1)], "", False, True),
        ([_tighten(CW), _twist(-1.1)], CW, False, False),
        ([_tighten(CW), _twist(0.1)], CCW, True, False),
        ([_tighten(CW), _hold(-0.05)], CCW, True, False),
        ([_tighten(CW), _hold(-0.1)], "", False, True),
        ([_tighten(CW), _hold(-0.1), _twist(-0.05)], "", False, True),
        ([_twist(-0.05), _tighten(CW), _twist(-0.1)], "", False, True),
        # What the small twists undo, and what nothing undoes.
        ([_tighten(CW), IDENTIFY], CCW, True, False),
        ([_tighten(CCW), IDENTIFY], CCW, False, False),
        # The last turn may have been either way.
        ([_tighten(CW), _twist(-0.05), _tighten(CW)], CW, False, True),
        # A straight line turns wrist 3, by which angles count.
        ([LINE, _twist(0.1)], "", False, False),
        ([_twist(0.1), LINE, _tighten(CCW)], CCW, False, False),
    ],
)
def test_a_direction_is_said_where_it_is_known_and_only_there(content, direction, reverses, may_reverse):
    plan = plan_of(file_of([_RELEASE, _GRIP, *content]))
    last = plan.steps[-1]
    assert (last.direction, last.reverses, last.may_reverse) == (direction, reverses, may_reverse)
    said = "\n".join(plan.sentences())
    assert ("it is not known whether these turn it back" in said) is may_reverse
    assert ("no reversals" in said) is not (reverses or may_reverse)
    assert plan.assumed == ""


def test_an_angle_of_the_wrist_joint_counts_with_the_angle_of_the_grip():
    turn, twist = {"do": "turn_to", "angle_rad": 1.4}, _twist(1.3, absolute=True)
    plan = plan_of(file_of([_RELEASE, turn, _GRIP, _hold(0.1), _twist(0.2), twist]))
    assert plan.steps[-1].direction == CW
    far = {**_twist(6.0, absolute=True), "limits": {"angle_rad": 4.0}}
    notes = plan_of(file_of([_RELEASE, turn, _GRIP, far])).steps[-1].notes
    assert any("4.6 rad (264°) from the grip: the limit stops it at 4 rad" in note for note in notes)


@pytest.mark.parametrize(
    ("content", "assumes"), [([_twist(0.1)], True), ([_tighten(CW)], False), ([_TARE, _twist(0.1)], False)]
)
def test_the_plan_says_what_it_assumes_of_a_tool_that_is_held_at_the_start(content, assumes):
    """The question before a start knows whether the tool is turned, and assumes nothing."""
    file = file_of(content)
    assert ("neither turned nor loaded" in plan_of(file).assumed) is assumes
    turned = plan_of(file, start=NOTHING_KNOWN)
    assert turned.assumed == ""
    assert turned.steps[-1].way_unknown is assumes


def test_a_direction_that_rests_on_a_tighten_says_so():
    notes = plan_of(file_of([_RELEASE, _GRIP, _tighten(CW), _hold(-0.05)])).steps[-1].notes
    assert any("if the `tighten` before it ends at its angle" in note for note in notes)
    notes = plan_of(file_of([_RELEASE, _GRIP, _tighten(CW), _hold(0.05)])).steps[-1].notes
    assert not any("ends at its angle" in note for note in notes)
