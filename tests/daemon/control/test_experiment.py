from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from shearloop.daemon.config_file import load_yaml_model
from shearloop.daemon.control.experiment import (
    ConstantVelocity,
    Experiment,
    ExperimentPhase,
    Hold,
    MoveToAngle,
    StepCommand,
    TrackTorque,
)
from shearloop.daemon.control.experiment_check import check_steps
from shearloop.daemon.control.experiment_schema import STEP_KINDS, ExperimentFile, ExperimentLimits, outline
from shearloop.daemon.control.turns import reversals

TICK_NS = 8_000_000
STIFFNESS_NM_PER_RAD = 0.2


def experiment(*steps: dict[str, Any], **keys: Any) -> Experiment:
    return Experiment(ExperimentFile.model_validate({"name": "test", "steps": list(steps), **keys}), 0)


class Bench:
    """The simplest thing that can carry wishes out: a wrist that turns at once, a spring, and prompt actions."""

    def __init__(self, machine: Experiment, tick_ns: int = TICK_NS) -> None:
        self.machine, self.t_ns, self.wrist_rad, self.tick_ns = machine, 0, 0.0, tick_ns
        self.begun: list[str] = []
        self.wish = StepCommand()
        self.seen: list[StepCommand] = []

    def tick(self, *, clock_stands: bool = False) -> StepCommand:
        self.t_ns += self.tick_ns
        if self.wish.action:
            self.machine.end_action()
        torque_nm = STIFFNESS_NM_PER_RAD * self.wrist_rad
        # A ramp of no time.
        ramp_nm = self.wish.wrist.torque_nm if isinstance(self.wish.wrist, TrackTorque) else None
        self.machine.update(self.t_ns, self.wrist_rad, torque_nm, ramp_nm=ramp_nm, clock_stands=clock_stands)
        wish = self.machine.command
        if wish.action is not None and self.machine.begin_action():
            self.begun.append(type(wish.action).__name__)
        step_s = self.tick_ns / 1e9
        match Hold() if clock_stands or self.machine.phase is ExperimentPhase.PAUSED else wish.wrist:
            case MoveToAngle(angle, speed):
                reach = speed * step_s
                self.wrist_rad += max(-reach, min(reach, angle - self.wrist_rad))
            case ConstantVelocity(speed):
                self.wrist_rad += speed * step_s
            case TrackTorque(torque, _):
                self.wrist_rad += 0.05 * (torque / STIFFNESS_NM_PER_RAD - self.wrist_rad)
            case Hold():
                pass
        self.wish = wish
        self.seen.append(wish)
        return wish

    def run(self, most: int = 200_000) -> None:
        """Tick until the experiment is done."""
        while self.machine.running and most:
            self.tick()
            most -= 1
        assert self.machine.phase is ExperimentPhase.DONE


def test_the_steps_are_carried_out_in_order_to_the_end():
    bench = Bench(
        experiment(
            {"do": "approach", "pose_m_rad": [0.4, 0, 0.3, 0, 3.1, 0]},
            {"do": "grip", "width_mm": 20},
            {"do": "tare"},
            {"do": "twist", "angles_rad": "0.1:0.3:3", "hold_s": 1.0, "repeats": 2},
            {"do": "hold_torque", "torque_nm": 0.1, "hold_s": 2},
            {"do": "release"},
            {"do": "retreat", "pose_m_rad": [0.4, 0, 0.5, 0, 3.1, 0]},
        )
    )
    bench.run()
    assert bench.begun == ["ApproachStep", "GripStep", "TareStep", "Opening", "RetreatStep"]
    assert bench.machine.progress == 1.0
    holds = [wish for wish in bench.seen if wish.activity.startswith("holding 0.200 rad")]
    assert len(holds) * TICK_NS / 1e9 == pytest.approx(2 * 1.0, abs=0.05)
    assert {wish.activity.split(": ")[1].split(",")[1] for wish in holds} == {" repeat 1 of 2", " repeat 2 of 2"}


@pytest.mark.parametrize(("absolute", "goal_rad"), [(True, 1.5), (False, 2.9)])
def test_absolute_angles_are_the_wrists_own_and_others_count_from_the_grip(absolute, goal_rad):
    machine = experiment({"do": "twist", "angles_rad": [1.5], "absolute": absolute})
    for cycle in (1, 2):
        machine.update(cycle * TICK_NS, 1.6, 0.0, gripped_at_rad=1.4)
    assert isinstance(machine.command.wrist, MoveToAngle)
    assert machine.command.wrist.angle_rad == pytest.approx(goal_rad)


def test_tighten_ends_at_the_torque_or_at_the_angle_whichever_comes_first():
    for angle_rad, reached_rad in ((3.0, 0.5), (0.25, 0.25)):
        bench = Bench(
            experiment(
                {"do": "tighten", "direction": "clockwise", "until_torque_nm": 0.1, "until_angle_rad": angle_rad}
            )
        )
        bench.run()
        assert bench.wrist_rad == pytest.approx(-reached_rad, abs=0.002), "clockwise is negative"


def test_a_torque_the_other_way_does_not_end_a_tightening():
    tighten = {"do": "tighten", "until_torque_nm": 0.05, "until_angle_rad": 3.0}
    bench = Bench(experiment({**tighten, "direction": "counterclockwise"}, {**tighten, "direction": "clockwise"}))
    bench.run()
    assert bench.wrist_rad == pytest.approx(-0.25, abs=0.002)


def test_a_failed_action_stops_the_experiment_with_its_reason():
    machine = experiment({"do": "grip"}, {"do": "release"})
    assert not machine.end_action("of the step before")
    assert machine.begin_action()
    machine.update(TICK_NS, 0.0, None)
    assert not machine.begin_action(), "it is under way"
    machine.end_action("nothing was between the fingers")
    machine.update(TICK_NS, 0.0, None)
    assert (machine.phase, machine.command) == (ExperimentPhase.STOPPED, StepCommand())
    assert machine.stop_reason == "step 1 (grip) failed: nothing was between the fingers"


def test_while_paused_or_held_no_time_passes():
    bench = Bench(experiment({"do": "twist", "angles_rad": [0.5], "hold_s": 5.0}))
    for _ in range(100):
        bench.tick()
    left_s, command = bench.machine.remaining_s, bench.machine.command
    bench.machine.pause()
    for _ in range(1000):
        bench.tick()
    bench.machine.resume()
    for _ in range(1000):
        bench.tick(clock_stands=True)
    assert bench.machine.remaining_s == left_s
    assert bench.machine.command == command
    bench.run()


def test_a_step_that_takes_too_long_is_said_to_be_overdue():
    machine = experiment({"do": "grip", "timeout_s": 2.0})
    machine.update(2_000_000_000, 0.0, None)
    assert not machine.overdue
    machine.update(2_100_000_000, 0.0, None)
    assert machine.overdue == "step 1 (grip) has taken 2.1 s of at most 2 s"


def test_a_steps_limits_only_tighten_the_experiments():
    step = {"do": "wait", "wait_s": 1, "limits": {"torque_nm": 0.4, "angle_rad": 0.1}}
    machine = experiment(step, limits={"torque_nm": 0.2, "angle_rad": 1.0})
    assert (machine.limits.torque_nm, machine.limits.angle_rad) == (0.2, 0.1)


@pytest.mark.parametrize(
    ("step", "part"),
    [
        ({"do": "twist", "angles_rad": "1.45:1.65"}, "START:STOP:STEPS"),
        ({"do": "twist", "angles_rad": "0:1:1"}, "steps from 2 to 1000"),
        ({"do": "twist", "angles_rad": ["nan"]}, "finite"),
        ({"do": "twist", "angles_rad": "0:1e400:5"}, "must start and stop at an angle"),
        ({"do": "twist", "angles_rad": "nan:1:5"}, "must start and stop at an angle"),
        ({"do": "twist", "angles_rad": "-1e308:1e308:5"}, "must start and stop at an angle"),
        ({"do": "twist", "angles_rad": "0:1:" + "x" * 9999}, r"'0:1:x{54}… is not START:STOP:STEPS"),
        ({"do": "fly"}, "'approach', 'retreat'"),
        ({"do": "approach"}, "either pose_m_rad or along_tool_m"),
        ({"do": "grip", "width_mm": 200}, "140"),
        ({"do": "grip", "widht_mm": 20}, "not permitted"),
    ],
)
def test_a_mistake_in_a_step_is_refused_with_the_cure(step, part):
    with pytest.raises(ValidationError, match=part):
        experiment(step)


SMALLEST: dict[str, dict[str, Any]] = {
    "approach": {"along_tool_m": 0.1},
    "retreat": {"along_tool_m": 0.1},
    "adapt": {"fingertip": "right"},
    "turn_to": {"angle_rad": 1.0},
    "twist": {"angles_rad": [0.3]},
    "hold_torque": {"torque_nm": 0.1},
    "tighten": {"direction": "clockwise", "until_torque_nm": 0.1, "until_angle_rad": 0.3},
    "wait": {"wait_s": 1},
}


@pytest.mark.parametrize("kind", STEP_KINDS)
def test_every_kind_of_step_has_a_duration_a_program_and_limits(kind):
    machine = experiment({"do": kind, **SMALLEST.get(kind, {})})
    assert machine.remaining_s > 0
    assert machine.command.activity
    tight = ExperimentLimits(torque_nm=0.05, angle_rad=0.1)
    over = check_steps(machine.file.model_copy(update={"limits": tight}))
    limited = {"twist": 1, "identify": 1, "hold_torque": 2, "tighten": 2}
    assert len(over) == limited.get(kind, 0), "of hold_torque also the missing identify"
    assert [mistake for mistake in check_steps(outline({"steps": [{"do": kind}]})) if "its limit" in mistake[1]] == []


STEPS = st.one_of(
    st.just({"do": "grip"}),
    st.just({"do": "tare"}),
    st.just({"do": "release"}),
    st.builds(lambda s: {"do": "wait", "wait_s": s}, st.floats(0, 2)),
    st.builds(
        lambda a, r: {"do": "twist", "angles_rad": a, "repeats": r, "hold_s": 0.1, "speed_rad_per_s": 3.0},
        st.lists(st.floats(-0.5, 0.5), min_size=1, max_size=3),
        st.integers(1, 2),
    ),
    st.builds(lambda t: {"do": "hold_torque", "torque_nm": t, "hold_s": 0.2}, st.floats(-0.2, 0.2)),
)


@given(
    st.lists(STEPS, min_size=1, max_size=4), st.lists(st.sampled_from(["pause", "resume", "hold", "tick"]), max_size=40)
)
def test_any_experiment_ends_whatever_interrupts_it_and_never_moves_after_its_end(steps, interruptions):
    bench = Bench(experiment(*steps))
    for what in interruptions:
        if what == "pause":
            bench.machine.pause()
        elif what == "resume":
            bench.machine.resume()
        bench.tick(clock_stands=what == "hold")
        assert 0.0 <= bench.machine.progress <= 1.0
    bench.machine.resume()
    bench.run()
    assert bench.tick() == StepCommand()


@pytest.mark.parametrize("path", sorted(Path("config/experiments").glob("*.yaml")), ids=lambda path: path.stem)
def test_the_experiments_that_are_shipped_are_in_order_and_end(path):
    file = load_yaml_model(path, ExperimentFile)
    bench = Bench(Experiment(file, 0), tick_ns=100_000_000)
    bench.run()


@pytest.mark.parametrize(
    ("own", "torque_nm", "angle_rad"),
    [
        (None, 1.0, 5.0),
        ({"angle_rad": 2.0}, 1.0, 2.0),
        ({"torque_nm": 0.2}, 0.2, 5.0),
        ({}, 1.0, 5.0),
        ({"torque_nm": 2.0, "angle_rad": 6.0}, 1.0, 5.0),
    ],
)
def test_a_steps_limits_change_only_what_they_name(own, torque_nm, angle_rad):
    step = {"do": "wait", "wait_s": 1, **({} if own is None else {"limits": own})}
    file = ExperimentFile.model_validate(
        {"name": "one", "limits": {"torque_nm": 1.0, "angle_rad": 5.0}, "steps": [step]}
    )
    limits = file.limits_of(file.steps[0])
    assert (limits.torque_nm, limits.angle_rad) == (torque_nm, angle_rad)


GRIP, TIGHTEN = {"do": "grip"}, {"do": "tighten", "until_torque_nm": 0.1, "until_angle_rad": 2.0}
HOLD, TWIST, RELEASE = {"do": "hold_torque", "torque_nm": 0.08}, {"do": "twist"}, {"do": "release"}
CLOCKWISE, COUNTERCLOCKWISE = {"direction": "clockwise"}, {"direction": "counterclockwise"}


@pytest.mark.parametrize("direction", ["clockwise", "counterclockwise"])
def test_the_same_direction_turns_the_same_way_in_every_step(direction):
    """The sign of an angle, of a torque and of a speed is one: counterclockwise is positive."""
    sign = -1 if direction == "clockwise" else 1
    given = {"direction": direction}
    held = experiment({**HOLD, **given})
    assert held.command.wrist.torque_nm == sign * 0.08
    turned = experiment({**TIGHTEN, **given})
    turned.update(TICK_NS, 0.0, 0.0)
    assert turned.command.wrist.speed_rad_per_s * sign > 0
    assert experiment({**HOLD, "torque_nm": sign * 0.08}).command.wrist == held.command.wrist


@pytest.mark.parametrize("step", [TIGHTEN, {**HOLD, "torque_nm": -0.08, **CLOCKWISE}])
def test_a_turn_of_unknown_or_twofold_direction_is_refused(step):
    with pytest.raises(ValidationError, match="direction"):
        experiment(step)


@pytest.mark.parametrize(
    ("steps", "found"),
    [
        ([GRIP, {**TIGHTEN, **CLOCKWISE}, HOLD], [(3, "counterclockwise", 2, "clockwise")]),
        ([GRIP, {**TIGHTEN, **CLOCKWISE}, {**HOLD, "torque_nm": 0.1, **CLOCKWISE}], []),
        ([GRIP, {**TIGHTEN, **CLOCKWISE}, {**HOLD, "torque_nm": 0.12, **CLOCKWISE}], []),
        # A smaller torque turns the tool back, and none does.
        ([GRIP, {**TIGHTEN, **CLOCKWISE}, {**HOLD, **CLOCKWISE}], [(3, "counterclockwise", 2, "clockwise")]),
        ([GRIP, {**TIGHTEN, **CLOCKWISE}, {**HOLD, "torque_nm": 0.0}], [(3, "counterclockwise", 2, "clockwise")]),
        ([GRIP, HOLD, {**HOLD, "torque_nm": 0.0}, {**HOLD, "torque_nm": -0.08}],
         [(3, "clockwise", 2, "counterclockwise"), (4, "clockwise", 2, "counterclockwise")]),
        ([GRIP, HOLD, {**HOLD, "torque_nm": 0.05}, {**HOLD, "torque_nm": 0.02}],
         [(3, "clockwise", 2, "counterclockwise")]),
        ([GRIP, HOLD, {**HOLD, "torque_nm": 0.02}, {**HOLD, "torque_nm": 0.05}],
         [(3, "clockwise", 2, "counterclockwise"), (4, "counterclockwise", 3, "clockwise")]),
        # Only a release ends a grip: another `grip` closes tighter on the tool.
        ([GRIP, {**TIGHTEN, **CLOCKWISE}, GRIP, {**TIGHTEN, **COUNTERCLOCKWISE}],
         [(4, "counterclockwise", 2, "clockwise")]),
        ([GRIP, {**TWIST, "angles_rad": [0.2], "return_to_start": False}, GRIP, {**TWIST, "angles_rad": [0.1]}],
         [(4, "clockwise", 2, "counterclockwise")]),
        ([{**TIGHTEN, **CLOCKWISE}, GRIP, HOLD], [(3, "counterclockwise", 1, "clockwise")]),
        ([{"do": "turn_to", "angle_rad": 1.0}, GRIP, {**TWIST, "angles_rad": [0.1]}, HOLD], []),
        # The tool may stand anywhere up to the angle of its grip.
        ([GRIP, {**TIGHTEN, **CLOCKWISE}, {**TWIST, "angles_rad": [0.0], "return_to_start": False}],
         [(3, "counterclockwise", 2, "clockwise")]),
        ([GRIP, HOLD, {**TWIST, "angles_rad": [0.0]}], [(3, "clockwise", 2, "counterclockwise")]),
        # What turned a screw has no place of its own in the grip.
        ([GRIP, {**TIGHTEN, **CLOCKWISE}, {**HOLD, **COUNTERCLOCKWISE}, {**TWIST, "angles_rad": [-0.5]}],
         [(3, "counterclockwise", 2, "clockwise")]),
        # The last turn counts, and a torque that is not known may be larger or smaller.
        ([GRIP, {**TWIST, "angles_rad": [0.2, 0.1], "return_to_start": False}, {**TWIST, "angles_rad": [0.15]}],
         [(3, "counterclockwise", 2, "clockwise")]),
        ([GRIP, {**TWIST, "angles_rad": [0.2], "return_to_start": False}, HOLD], []),
        ([GRIP, {**TWIST, "angles_rad": [0.2], "return_to_start": False}, {**HOLD, "torque_nm": -0.08}],
         [(3, "clockwise", 2, "counterclockwise")]),
        ([GRIP, {**TIGHTEN, **CLOCKWISE}, {"do": "release"}, GRIP, HOLD], []),
        ([GRIP, {**TIGHTEN, **CLOCKWISE}, {**TIGHTEN, **COUNTERCLOCKWISE}], [(3, "counterclockwise", 2, "clockwise")]),
        ([GRIP, HOLD, {**HOLD, "torque_nm": -0.08}, HOLD], [(3, "clockwise", 2, "counterclockwise"),
                                                            (4, "counterclockwise", 3, "clockwise")]),
        # Angles count from the grip: 0.1 rad lies behind a tool that was turned clockwise.
        ([GRIP, {**TIGHTEN, **CLOCKWISE}, {**TWIST, "angles_rad": [0.1]}], [(3, "counterclockwise", 2, "clockwise")]),
        ([GRIP, {**TIGHTEN, **CLOCKWISE}, {**TWIST, "angles_rad": [-2.1]}], []),
        ([GRIP, {**TIGHTEN, **CLOCKWISE}, {**TWIST, "angles_rad": [-1.0]}], []),
        ([GRIP, {**TWIST, "angles_rad": [0.2], "return_to_start": False}, {**TWIST, "angles_rad": [0.1]}],
         [(3, "clockwise", 2, "counterclockwise")]),
        ([GRIP, {**TWIST, "angles_rad": [0.2]}, {**TWIST, "angles_rad": [-0.1]}], []),
    ],
)  # fmt: skip
def test_every_step_that_turns_a_held_tool_back_is_found(steps, found):
    file = ExperimentFile.model_validate({"name": "one", "steps": steps})
    assert list(reversals(file).known) == found


@pytest.mark.parametrize(
    ("tighten", "hold", "refused"),
    [
        (CLOCKWISE, {}, True),
        (COUNTERCLOCKWISE, {"torque_nm": -0.08}, True),
        (CLOCKWISE, {"torque_nm": -0.08}, False),
        (CLOCKWISE, COUNTERCLOCKWISE, False),
        (COUNTERCLOCKWISE, {}, False),
    ],
)
def test_a_torque_that_undoes_a_tightening_by_its_sign_alone_is_refused(tighten, hold, refused):
    steps = [GRIP, {"do": "identify"}, {**TIGHTEN, **tighten}, {**HOLD, **hold}]
    file = ExperimentFile.model_validate({"name": "one", "steps": steps})
    mistakes = [text for place, text in check_steps(file) if place == ("steps", 3)]
    assert len(mistakes) == refused
    assert not refused or f"write `direction: {tighten['direction']}`" in mistakes[0]


@pytest.mark.parametrize(("between", "refused"), [({**HOLD, "torque_nm": 0.0}, True), (GRIP, True), (RELEASE, False)])
def test_only_a_release_between_a_tightening_and_its_undoing_prevents_the_refusal(between, refused):
    steps = [GRIP, {**TIGHTEN, **CLOCKWISE}, between, {"do": "identify"}, HOLD]
    file = ExperimentFile.model_validate({"name": "one", "steps": steps})
    undoing = [text for _, text in check_steps(file) if "undoes step 2, tighten clockwise" in text]
    assert len(undoing) == refused


@pytest.mark.parametrize(
    ("first", "later", "refused"),
    [
        ({**HOLD, "torque_nm": 0.12}, {**HOLD, "torque_nm": 0.05, "limits": {"torque_nm": 0.08}}, True),
        ({**HOLD, "torque_nm": 0.12}, {"do": "wait", "wait_s": 1, "limits": {"torque_nm": 0.08}}, True),
        ({**HOLD, "torque_nm": -0.12}, {"do": "turn_to", "angle_rad": 1.0, "limits": {"torque_nm": 0.1}}, True),
        ({**HOLD, "torque_nm": 0.12}, {"do": "wait", "wait_s": 1, "limits": {"torque_nm": 0.13}}, False),
        ({**HOLD, "torque_nm": 0.12}, {**RELEASE, "limits": {"torque_nm": 0.08}}, False),
        ({"do": "twist", "angles_rad": [0.1]}, {"do": "wait", "wait_s": 1, "limits": {"torque_nm": 0.08}}, False),
    ],
)
def test_a_limit_below_the_torque_that_is_held_at_a_steps_begin_is_refused(first, later, refused):
    """The step would be stopped as it begins, and the tool dropped."""
    file = ExperimentFile.model_validate({"name": "one", "steps": [GRIP, {"do": "identify"}, first, later]})
    found = [text for place, text in check_steps(file) if place == ("steps", 3)]
    assert len(found) == refused
    assert all(text.startswith("the steps before it leave 0.12 N·m on the tool, and its limit is") for text in found)


@pytest.mark.parametrize(("limit_rad", "refused"), [(0.2, True), (0.3, True), (0.31, False)])
def test_a_limit_below_the_angle_at_which_a_step_begins_is_refused(limit_rad, refused):
    twist = {"do": "twist", "angles_rad": [0.3], "return_to_start": False}
    later = {"do": "wait", "wait_s": 1, "limits": {"angle_rad": limit_rad}}
    file = ExperimentFile.model_validate({"name": "one", "limits": {"angle_rad": 1}, "steps": [GRIP, twist, later]})
    found = [text for place, text in check_steps(file) if place == ("steps", 2)]
    assert len(found) == refused
    assert all(text.startswith("the steps before it leave the tool turned by 0.3 rad, and its limit") for text in found)
