"""What the plan says of durations and turns, against runs with tools in unknown states, and on the simulated rig."""

import random
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shearloop.daemon.control import experiment_schema as steps
from shearloop.daemon.control.experiment import ExperimentPhase
from shearloop.daemon.control.experiment_schema import ExperimentFile, Step
from shearloop.daemon.control.known_tool import known_at_start
from shearloop.daemon.control.plan import StepPlan, plan_of
from shearloop.daemon.control.step_demands import SETTLES_S, demands
from tests.daemon.control.loop_rig import GRIP, TICK_S, Rig, new_loop, phase, started
from tests.daemon.control.test_turns import CLAMPED, GRIPPED, EndedError, Run, file_of

RELEASE, IDENTIFY = {"do": "release"}, {"do": "identify", "hold_s": 0.8}
TIGHTEN = {"do": "tighten", "direction": "clockwise", "until_torque_nm": 0.15, "until_angle_rad": 2.0}
FAST_TWIST = {"do": "twist", "speed_rad_per_s": 0.5, "repeats": 3}
LIMITS = {"torque_nm": 0.5, "angle_rad": 3.0}


def _hold(torque_nm: float, **keys: Any) -> dict[str, Any]:
    return {"do": "hold_torque", "torque_nm": torque_nm, "ramp_nm_per_s": 0.02, "hold_s": 1.0, **keys}


def _is_guessed(said: StepPlan) -> bool:
    return any("is a guess here" in note for note in said.notes)


def _took_s(step: Step, run: Run, torque_before: float) -> tuple[float, int] | None:
    """Return how long a step took without coming near to anything, and how often it came near; None for other steps."""
    match step:
        case steps.TwistStep():
            count = len(step.angles_rad) * step.repeats
            moves = count * (2 if step.return_to_start else 1)
            return count * step.hold_s + sum(map(abs, run.moves)) / step.speed_rad_per_s, moves
        case steps.TurnToStep() | steps.TightenStep():
            return sum(map(abs, run.moves)) / step.speed_rad_per_s, 1
        case steps.HoldTorqueStep():
            return step.hold_s + abs(step.signed_torque_nm - torque_before) / step.ramp_nm_per_s, 1
        case steps.WaitStep():
            return step.wait_s, 0
    return None


def _durations_hold(file: ExperimentFile, run: Run, *, wrist_is_known: bool) -> None:
    start = known_at_start(loaded=False, twisted_rad=0.0, wrist_rad=run.origin) if wrist_is_known else None
    for said, step in zip(plan_of(file, start=start).steps, file.steps, strict=True):
        torque_before, limits = run.torque, file.limits_of(step)
        try:
            run.do(step)
        except EndedError:
            return
        largest_nm = max(map(abs, [torque_before, run.torque, *run.torques]))
        if largest_nm >= limits.torque_nm or abs(run.angle) >= limits.angle_rad or abs(run.angle + run.origin) > 6.2832:
            return
        took = _took_s(step, run, torque_before)
        if took is None:
            continue
        took_s, arrivals = took
        assert took_s <= said.longest_s + 1e-6, said
        if not _is_guessed(said) and not isinstance(step, steps.TightenStep):
            assert said.duration_s == said.longest_s
            assert took_s - 1e-6 <= said.duration_s <= took_s + arrivals * SETTLES_S + 1e-6, said
        if not isinstance(step, steps.HoldTorqueStep):
            assert max(map(abs, run.moves), default=0.0) <= said.angle_rad + 1e-9, said


@pytest.mark.long
@given(content=st.one_of(CLAMPED, GRIPPED), seed=st.integers(0, 2**32), wrist_is_known=st.booleans())
@settings(max_examples=400, deadline=None)
def test_no_step_takes_longer_than_the_plan_says_and_a_time_without_a_note_is_right(content, seed, wrist_is_known):
    """Also where a `tighten` ends at its angle."""
    file = file_of(content)
    for number in range(8):
        run = Run(random.Random(seed + number), clamped=True, reaches=False)
        _durations_hold(file, run, wrist_is_known=wrist_is_known)


def _durations(
    rig: Rig, *content: dict[str, Any], torque_source: str = "load_cell"
) -> tuple[list[float], list[StepPlan]]:
    """Run an experiment; return how long each step took, and what the plan before it said."""
    file = ExperimentFile.model_validate(
        {"name": "one", "torque_source": torque_source, "limits": LIMITS, "steps": content}
    )
    said = list(plan_of(file, loop=rig.control_loop.config, start=rig.control_loop.operator.known_tool()).steps)
    started(rig, *content, torque_source=torque_source, limits=LIMITS)
    ticks = [0] * len(content)
    while rig.control_loop.experiment.running:
        ticks[rig.control_loop.experiment.step_number - 1] += 1
        rig.step()
    assert phase(rig) is ExperimentPhase.DONE, rig.control_loop.experiment.stop_reason
    return [count * TICK_S for count in ticks], said


@pytest.mark.parametrize(
    "before",
    [
        [TIGHTEN],
        [_hold(-0.15), IDENTIFY],
        [_hold(-0.15), {"do": "twist", "angles_rad": [-0.6], "hold_s": 0}],
        [_hold(-0.15), {"do": "wait", "wait_s": 2.0}],
    ],
    ids=["tighten", "identify", "twist", "wait"],
)
@pytest.mark.parametrize("torque_nm", [0.0, 0.1])
def test_a_ramp_from_a_torque_that_a_step_has_left_takes_about_as_long_as_planned(before, torque_nm):
    hold = _hold(torque_nm, direction="counterclockwise")
    took_s, said = _durations(Rig(new_loop()), GRIP, IDENTIFY, *before, hold)
    assert _is_guessed(said[-1])
    assert took_s[-1] == pytest.approx(said[-1].duration_s, rel=0.15)
    assert took_s[-1] <= said[-1].longest_s


def test_the_remaining_time_counts_the_torque_before_and_where_the_wrist_stands():
    rig = Rig(new_loop())
    turn = {"do": "turn_to", "angle_rad": 2.3, "speed_rad_per_s": 0.2}
    hold = _hold(0.1, direction="counterclockwise")
    started(rig, RELEASE, turn, GRIP, IDENTIFY, TIGHTEN, hold, torque_source="load_cell", limits=LIMITS)
    left_s: dict[int, float] = {}
    began: dict[int, int] = {}
    while rig.control_loop.experiment.running:
        number = rig.control_loop.experiment.step_number
        left_s.setdefault(number, rig.control_loop.experiment.remaining_s)
        began.setdefault(number, rig.tick)
        rig.step()
    assert phase(rig) is ExperimentPhase.DONE
    # From 0.3 rad.
    assert left_s[2] - left_s[3] == pytest.approx(2.0 / 0.2 + SETTLES_S, abs=0.1)
    assert (began[3] - began[2]) * TICK_S == pytest.approx(2.0 / 0.2 + SETTLES_S, rel=0.1)
    assert (rig.tick - began[6]) * TICK_S == pytest.approx(left_s[6], rel=0.25)


def test_an_identification_with_much_noise_takes_no_longer_than_the_plan_says():
    identify = {"do": "identify", "amplitude_rad": 0.15}
    rig = started(Rig(new_loop()), GRIP, identify, torque_source="right", limits=LIMITS)
    while rig.control_loop.experiment.step_number == 1:
        rig.step()
    begun = rig.tick
    rig.run(120)
    took_s, said = (rig.tick - begun) * TICK_S, _last(GRIP, identify, loop=rig.control_loop.config)
    assert said.duration_s < took_s <= said.longest_s


def _last(*content: dict[str, Any], **keys: Any) -> StepPlan:
    file = ExperimentFile.model_validate({"name": "one", "limits": LIMITS, "steps": content})
    return plan_of(file, **keys).steps[-1]


@pytest.mark.parametrize(
    ("source", "step"),
    [
        ("load_cell", {**FAST_TWIST, "angles_rad": [0.05, 0.3], "hold_s": 1}),
        ("load_cell", {**FAST_TWIST, "angles_rad": [0.1, -0.1], "hold_s": 0, "return_to_start": False}),
        ("right", _hold(0.2)),
        ("right", _hold(-0.1)),
    ],
)
def test_a_step_from_a_known_state_ends_before_a_timeout_without_a_warning(source, step):
    content = (GRIP, {"do": "identify"}, step)
    took_s, said = _durations(Rig(new_loop()), *content, torque_source=source)
    assert not _is_guessed(said[-1])
    assert took_s[-1] <= list(demands(file_of(list(content))))[-1].safe_timeout_s


@pytest.mark.parametrize(
    ("before", "step", "warned"),
    [
        # From -0.5 N·m, its limit, to 0.2 N·m at 0.02 N·m/s: 36.5 s.
        ([GRIP, TIGHTEN], _hold(0.2, timeout_s=36), True),
        ([GRIP, TIGHTEN], _hold(0.2, timeout_s=44), False),
        ([GRIP, IDENTIFY], _hold(0.2, timeout_s=14), False),
        ([GRIP, {"do": "twist", "angles_rad": [-0.1]}], _hold(0.2, timeout_s=13), True),
        ([], {"do": "turn_to", "angle_rad": 6.0, "speed_rad_per_s": 0.1, "timeout_s": 120}, True),
        ([], {"do": "turn_to", "angle_rad": 6.0, "speed_rad_per_s": 0.1, "timeout_s": 148}, False),
        ([], {"do": "approach", "pose_m_rad": [0.4, 0, 0.3, 0, 3.1, 0], "timeout_s": 20}, True),
        ([GRIP], {"do": "identify", "timeout_s": 30}, True),
        # 130 mm at 20 mm/s.
        ([], {**GRIP, "speed_mm_per_s": 20, "timeout_s": 6}, True),
        ([], {**GRIP, "speed_mm_per_s": 20, "timeout_s": 9}, False),
    ],
)
def test_a_timeout_that_an_unknown_state_may_exceed_is_named(before, step, warned):
    notes = _last(RELEASE, *before, step).notes
    assert any("may stop it before its end" in note for note in notes) is warned


def test_only_the_first_release_may_take_as_long_as_an_activation():
    """A real gripper takes two to four seconds for it, after a reset and a pause."""
    first, _, again = plan_of(file_of([RELEASE, GRIP, RELEASE])).steps
    assert first.longest_s == pytest.approx(first.duration_s + 5.0)
    assert again.longest_s == again.duration_s == first.duration_s


def test_a_first_turn_is_known_where_the_wrist_is():
    turn = {"do": "turn_to", "angle_rad": 6.0, "speed_rad_per_s": 0.1, "timeout_s": 60}
    guessed, known = _last(turn), _last(turn, start=known_at_start(loaded=False, twisted_rad=0.0, wrist_rad=1.0))
    assert (_is_guessed(guessed), _is_guessed(known)) == (True, False)
    assert known.duration_s == known.longest_s == pytest.approx(5.0 / 0.1 + SETTLES_S)
    assert known.angle_rad == pytest.approx(5.0)
    assert guessed.angle_rad > 12.0
    assert _last(turn, {**turn, "angle_rad": -6.0}).angle_rad == pytest.approx(12.0)


def test_a_time_of_many_rounds_is_found_at_once():
    twist = {"do": "twist", "angles_rad": [0.1, -0.1], "repeats": 1000, "return_to_start": False, "hold_s": 0}
    said = _last(GRIP, twist)
    assert said.duration_s == pytest.approx((0.1 + 1999 * 0.2) / 0.2 + 2000 * SETTLES_S)
    assert said.angle_rad == pytest.approx(0.2)
