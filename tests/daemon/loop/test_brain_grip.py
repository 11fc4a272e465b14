"""The brain and the tool: one that is taken away, one that nobody expected, one that the gripper is not sure of."""

from dataclasses import replace
from typing import Any

import pytest

from shearloop.daemon.control.experiment_schema import ExperimentFile
from shearloop.daemon.control.safety import FaultCode
from shearloop.daemon.control.step_runner import ExperimentPhase
from tests.daemon.loop.rig import GRIP, Rig, new_loop, phase, started

TWIST = {"do": "twist", "angles_rad": [0.2]}


def test_a_tool_that_is_taken_away_is_noticed() -> None:
    rig = started(Rig(new_loop()), GRIP, {"do": "twist", "angles_rad": [0.2], "hold_s": 60})
    rig.run(5)
    rig.force_n = 0.0
    rig.step()
    assert FaultCode.GRIP_LOST in {trouble.code for trouble in rig.control_loop.status.decision.faults}
    assert phase(rig) is ExperimentPhase.STOPPED


@pytest.mark.parametrize("step", [{**GRIP, "expect_object": False}, {"do": "release", "width_mm": 20}])
def test_a_tool_that_is_met_though_nobody_expected_it_is_watched_as_well(step: dict[str, Any]) -> None:
    rig = Rig(new_loop())
    rig.meets = True
    started(rig, step, {"do": "twist", "angles_rad": [0.2], "hold_s": 60})
    rig.run(5)
    assert phase(rig) is ExperimentPhase.RUNNING
    rig.force_n = 0.0
    rig.step()
    assert FaultCode.GRIP_LOST in {trouble.code for trouble in rig.control_loop.status.decision.faults}
    assert phase(rig) is ExperimentPhase.STOPPED


@pytest.mark.parametrize(
    ("sense", "what"),
    [
        ({"uncertain": True}, "stand where a stop, an activation or a lack of power has left them"),
        ({"moving": True}, "are moving"),
    ],
)
@pytest.mark.parametrize("turning", [TWIST, {"do": "turn_to", "angle_rad": 0.4}, {"do": "identify"}])
def test_nothing_turns_a_tool_that_the_gripper_may_hold_and_does_not_tell_of(
    sense: dict[str, Any], what: str, turning: dict[str, Any]
) -> None:
    """After a stop in the middle of a grip the wrist turned, and nothing watched torque, angle or grip."""
    rig = Rig(new_loop())
    for _ in range(70):
        rig.step()
    rig.hand, rig.width_mm = replace(rig.hand, **sense), 43.2
    rig.step()

    def refused(*steps: dict[str, Any]) -> str | None:
        return rig.control_loop.start(ExperimentFile.model_validate({"name": "test", "steps": list(steps)}), rig.t_ns)

    why = refused({"do": "wait", "wait_s": 1}, turning, GRIP)
    assert why == (
        f"the gripper does not say whether it holds a tool: its fingers, 43.2 mm apart, {what}; put a `grip` or a "
        f"`release` before step 2 ({turning['do']}), which turns the wrist"
    )
    assert rig.control_loop.experiment is None
    assert refused({"do": "tare"}, GRIP, turning) is None
    rig.control_loop.stop("")
    assert refused({"do": "release"}, turning) is None


@pytest.mark.parametrize("sense", [{"uncertain": True}, {"moving": True}])
@pytest.mark.parametrize("turning", [TWIST, {"do": "turn_to", "angle_rad": 0.4}, {"do": "identify"}])
def test_a_gripper_that_tells_only_after_the_start_that_it_does_not_know_stops_what_turns(
    sense: dict[str, Any], turning: dict[str, Any]
) -> None:
    """It is asked ten times a second: started right after a stop, an experiment was judged by what was before that."""
    rig = started(Rig(new_loop()), {"do": "wait", "wait_s": 0.1}, turning, GRIP)
    rig.hand = replace(rig.hand, **sense)
    rig.run(1)
    assert rig.control_loop.experiment is not None
    assert not rig.control_loop.experiment.running
    assert (
        f"step 2 ({turning['do']}) cannot be done: the gripper does not say" in rig.control_loop.experiment.stop_reason
    )
    assert rig.control_loop.experiment.stop_reason.endswith("; put a `grip` or a `release` before it")
    assert rig.speed == 0.0
