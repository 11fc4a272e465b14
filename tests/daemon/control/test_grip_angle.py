"""The angle since the grip belongs to the grip, whatever stops, starts and restarts come between."""

import asyncio
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from shearloop.daemon.commands import Commands
from shearloop.daemon.control.control_loop import ControlLoop
from shearloop.daemon.control.experiment import ExperimentPhase
from shearloop.daemon.control.experiment_schema import ExperimentFile
from shearloop.daemon.control.grip import Grip
from shearloop.daemon.control.operator_view import release_question
from shearloop.daemon.control.plan import plan_of
from shearloop.daemon.control.wrench import wrench_source
from shearloop.daemon.messaging.deadlines import Deadline
from shearloop.daemon.operator_questions import held_note
from shearloop.daemon.rig_memory import read_memories
from shearloop.daemon.torques import TorqueSample
from shearloop.drivers.load_cell import LoadCalibration, LoadCell
from shearloop.drivers.ur.client import UrRobot
from tests.daemon.control.cell import TWIST, driven
from tests.daemon.control.loop_rig import CONFIG, EIT, FILES, GRIP, LOAD, Rig, memory_of, new_loop, phase, started, stop
from tests.drivers.ur.handler_bench import SETTINGS
from tests.fixtures.daemons import bound_handlers

TWIST_AGAIN = {"do": "twist", "angles_rad": [0.25], "return_to_start": False, "speed_rad_per_s": 0.2, "hold_s": 0.1}
TWISTED = {"limits": {"angle_rad": 0.3, "torque_nm": 0.5}, "torque_source": "load_cell"}


def twisted() -> Rig:
    """Return a rig that holds a tool of 30 mm, twisted by 0.25 of 0.3 rad."""
    rig = started(Rig(new_loop()), GRIP, TWIST_AGAIN, **TWISTED)
    rig.run(20)
    assert phase(rig) is ExperimentPhase.DONE, rig.control_loop.experiment.stop_reason
    return rig


def stopped_fingers(rig: Rig, step: dict[str, Any], width_mm: float, sense: dict[str, Any]) -> Rig:
    """Stop an experiment while its fingers are on their way, and acknowledge the stop."""
    started(rig, step)
    while not rig.pending:
        rig.step()
    rig.pending.clear()
    rig.force_n, rig.width_mm, rig.hand = 0.0, width_mm, replace(rig.hand, moving=True)
    rig.step()
    stop(rig)
    rig.hand = replace(rig.hand, **{"moving": False, **sense})
    rig.run(0.1)
    rig.control_loop.acknowledge()
    return rig


def twisted_again_rad(rig: Rig) -> float:
    """Grip and twist once more, to the end; return the angle since then."""
    again_rad = rig.wrist_rad
    started(rig, GRIP, TWIST_AGAIN, **TWISTED)
    rig.hand = replace(rig.hand, uncertain=False)
    rig.run(20)
    assert phase(rig) is ExperimentPhase.DONE, rig.control_loop.experiment.stop_reason
    return rig.wrist_rad - again_rad


@pytest.mark.parametrize("sense", [{"uncertain": True}, {"unfelt": True}, {"moving": True}])
@pytest.mark.parametrize("width_mm", [30.0, 27.0])
def test_a_tighter_grip_that_was_stopped_keeps_the_angle_of_the_grip(width_mm, sense):
    """The halt leaves the gripper in doubt. Fingers that close tighter press a soft tool together."""
    rig = twisted()
    gripped_rad = rig.control_loop.tool.grip.origin_rad
    stopped_fingers(rig, {**GRIP, "force_n": 100.0}, width_mm, sense)
    assert rig.control_loop.tool.grip.origin_rad == gripped_rad
    started(rig, {**GRIP, "force_n": 100.0}, TWIST_AGAIN, **TWISTED)
    while not rig.pending:
        rig.step()
    rig.hand = replace(rig.hand, moving=True, uncertain=False, unfelt=False)
    while rig.pending:
        rig.step()
    rig.hand = replace(rig.hand, moving=False)
    rig.run(20)
    assert phase(rig) is ExperimentPhase.DONE, rig.control_loop.experiment.stop_reason
    assert rig.wrist_rad - gripped_rad == pytest.approx(0.25, abs=0.01)
    assert rig.control_loop.tool.grip == Grip(gripped_rad, 100.0, 30.0)


@pytest.mark.parametrize(
    ("step", "width_mm", "sense"),
    [
        ({"do": "release"}, 80.0, {"uncertain": True}),
        ({"do": "release"}, 140.0, {}),
        ({**GRIP, "force_n": 100.0}, 10.0, {}),
    ],
)
def test_fingers_that_let_the_tool_go_begin_a_grip_with_an_angle_of_its_own(step, width_mm, sense):
    rig = stopped_fingers(twisted(), step, width_mm, sense)
    assert not rig.control_loop.tool.grip.known
    assert twisted_again_rad(rig) == pytest.approx(0.25, abs=0.01)


def test_a_grip_that_was_stopped_before_it_held_anything_is_begun_anew():
    rig = stopped_fingers(Rig(new_loop()), GRIP, 80.0, {"uncertain": True})
    rig.wrist_rad += 0.2
    rig.run(0.1)
    assert twisted_again_rad(rig) == pytest.approx(0.25, abs=0.01)


def test_a_tool_that_is_gripped_again_within_a_run_after_a_release_has_a_new_angle():
    rig = started(Rig(new_loop()), GRIP, TWIST_AGAIN, {"do": "release"}, GRIP, TWIST_AGAIN, **TWISTED)
    begun_rad = rig.wrist_rad
    rig.run(30)
    assert phase(rig) is ExperimentPhase.DONE, rig.control_loop.experiment.stop_reason
    assert rig.wrist_rad - begun_rad == pytest.approx(0.5, abs=0.02)


def test_the_question_before_a_tighter_grip_says_that_the_angle_is_not_known():
    tighter, after_release = (
        ExperimentFile.model_validate({"name": "test", "steps": steps})
        for steps in ([GRIP, TWIST_AGAIN], [{"do": "release"}, GRIP, TWIST_AGAIN])
    )
    rig = Rig(new_loop())
    rig.force_n = 60.0
    rig.run(0.6)
    assert "its angle counts from the start" in held_note(rig.control_loop.operator, tighter)
    assert "its angle counts" not in held_note(rig.control_loop.operator, after_release)
    assert held_note(twisted().control_loop.operator, tighter) == "", "its angle goes on"


def clamped_rig() -> Rig:
    """Return a rig without a gripper, with a tool clamped to the wrist."""
    rig = Rig(ControlLoop(CONFIG, {"right": EIT, "load_cell": LOAD}, ("right",)))
    rig.force_n, rig.silent = 60.0, {"hand"}
    return rig


def test_a_clamped_tool_is_turned_back_without_a_zero():
    """It is the way out where a lost zero has stopped a twist."""
    rig = clamped_rig()
    sources = {"right": EIT, "load_cell": replace(LOAD, needs_zero=True)}
    rig.control_loop = ControlLoop(CONFIG, sources, ("right",))
    started(rig, {"do": "turn_to", "angle_rad": rig.wrist_rad + 0.1}, torque_source="load_cell")
    rig.run(20)
    assert phase(rig) is ExperimentPhase.DONE, rig.control_loop.experiment.stop_reason


def turn_to_limit(rig: Rig) -> float:
    """Run the twist by 0.25 of 0.3 rad once more, and return how far the wrist has turned in it."""
    begun_rad = rig.wrist_rad
    started(rig, TWIST_AGAIN, **TWISTED)
    rig.run(20)
    assert phase(rig) is ExperimentPhase.DONE, rig.control_loop.experiment.stop_reason
    return rig.wrist_rad - begun_rad


def test_the_angle_of_a_clamped_tool_goes_on_from_start_to_start_until_another_one_is_clamped():
    rig = clamped_rig()
    assert turn_to_limit(rig) == pytest.approx(0.25, abs=0.01)
    assert turn_to_limit(rig) == pytest.approx(0.0, abs=0.01)
    file = ExperimentFile.model_validate({"name": "test", "steps": [TWIST_AGAIN]})
    assert "it is turned by +0.249 rad; if another tool is clamped, `shearloop command" in held_note(
        rig.control_loop.operator, file
    )
    rig.wrist_rad += 0.1
    started(rig, TWIST_AGAIN, **TWISTED)
    rig.run(1)
    assert "`shearloop command release --yes` lets it count from 0" in rig.control_loop.experiment.stop_reason
    rig.control_loop.acknowledge()
    assert rig.control_loop.operator.release_refusal() is None
    assert "nothing opens, because no gripper is configured; the angle of" in release_question(
        rig.control_loop.operator
    )
    rig.control_loop.tool.on_release_ended()
    assert held_note(rig.control_loop.operator, file) == ""
    assert turn_to_limit(rig) == pytest.approx(0.25, abs=0.01)


async def test_the_angle_of_a_clamped_tool_outlives_the_process():
    before = clamped_rig()
    memory = memory_of(before.control_loop)
    turn_to_limit(before)
    await memory.save_present()
    after = clamped_rig()
    after.wrist_rad = before.wrist_rad
    memory_of(after.control_loop)
    assert turn_to_limit(after) == pytest.approx(0.0, abs=0.01)
    after.control_loop.tool.on_release_ended()
    memory = memory_of(after.control_loop)
    assert after.control_loop.tool.grip == before.control_loop.tool.grip, "what is on the disk counts"
    after.control_loop.tool.on_release_ended()
    await memory.save_present()
    again = clamped_rig()
    memory_of(again.control_loop)
    assert not again.control_loop.tool.grip.known


async def test_a_daemon_that_has_lost_its_gripper_keeps_the_angle_and_none_of_the_zeros():
    """The tool may still be in the gripper that the configuration does not name."""
    before = twisted()
    cell = LoadCell(None, LoadCalibration(tare_counts=8321.5, scale_n_per_count=0.001))
    memory = memory_of(before.control_loop, cell)
    before.control_loop.on_zero("load_cell")
    await memory.save_present()
    after, cell = clamped_rig(), LoadCell(None, LoadCalibration(tare_counts=8000.0, scale_n_per_count=0.001))
    after.wrist_rad = before.wrist_rad
    memory_of(after.control_loop, cell)
    assert cell.calibration.tare_counts == 8000.0
    assert after.control_loop.tool.grip == Grip(before.control_loop.tool.grip.origin_rad)


ZERO = (0.0, 0.0, 0.0, 0.0, 0.0, -0.11)


def clamped_with_wrench() -> Rig:
    """Return a rig without a gripper, whose sources include the wrench."""
    sources = {"right": EIT, "load_cell": LOAD, "wrench": wrench_source(125.0, 0.05)}
    rig = Rig(ControlLoop(CONFIG, sources, ("right",)))
    rig.force_n, rig.silent = 60.0, {"hand"}
    return rig


def test_a_clamped_tool_that_was_turned_may_load_the_wrench_until_another_one_is_clamped():
    """A program that starts then keeps the zero of the wrench, and does not take the tool's load for it."""
    rig = clamped_rig()
    assert not rig.control_loop.tool.may_be_loaded()
    turn_to_limit(rig)
    assert rig.control_loop.tool.may_be_loaded()
    rig.control_loop.tool.on_release_ended()
    assert not rig.control_loop.tool.may_be_loaded()


@pytest.mark.parametrize("tared", [True, False])
async def test_the_zeros_of_a_clamped_tool_outlive_the_process(tared):
    before, robot = clamped_with_wrench(), UrRobot(SETTINGS)
    cell = LoadCell(None, LoadCalibration(tare_counts=8321.5, scale_n_per_count=0.001))
    memory = memory_of(before.control_loop, cell, robot)
    turn_to_limit(before)
    robot.restore_wrench_zero(ZERO)
    before.control_loop.on_zero("load_cell")
    before.control_loop.on_zero("wrench", known=tared)
    await memory.save_present()
    after, robot = clamped_with_wrench(), UrRobot(SETTINGS)
    cell = LoadCell(None, LoadCalibration(tare_counts=8000.0, scale_n_per_count=0.001))
    memory_of(after.control_loop, cell, robot)
    assert (cell.calibration.tare_counts, robot.wrench_zero) == (8321.5, ZERO)
    assert after.control_loop.has_zero("load_cell")
    assert after.control_loop.has_zero("wrench") is tared


@pytest.mark.parametrize("make", [clamped_rig, clamped_with_wrench])
def test_a_turned_clamped_tool_becomes_no_zero_of_any_sensor_unless_the_operator_confirms(make):
    """Its load may be below what counts as drift."""
    rig = make()
    rig.run(0.1)
    operator, tool = rig.control_loop.operator, rig.control_loop.tool
    tool.count_angle(rig.control_loop.inputs.arm.wrist_rad - 0.08)
    turned = "the clamped tool is turned by +0.080 rad, and its load would become the zero; "
    assert operator.why_no_tare_step().startswith(turned)
    assert operator.tare_refusal().startswith(turned)
    assert operator.tare_refusal(confirmed=True) is None
    tool.on_release_ended()
    assert operator.why_no_tare_step() is operator.tare_refusal() is None


def test_the_last_torque_of_a_lost_sensor_is_no_load():
    rig = clamped_rig()
    rig.run(0.1)
    loop = rig.control_loop
    t_ns = loop.inputs.arm.t_ns
    loop.on_torque(TorqueSample("load_cell", 0.2, "", t_ns, t_ns))
    assert loop.operator.tare_refusal().startswith("load_cell measures +0.200 N·m")
    loop.on_link("load_cell", "its cable is out", up=False)
    assert loop.operator.tare_refusal() is None


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("torque_nm", [0.0, 0.08, 0.15])
def test_a_step_takes_no_zero_of_the_wrench_under_a_clamped_tool_that_is_turned(known, torque_nm):
    """Whatever the wrench measures: loads below its noise would add up from zero to zero."""
    rig = clamped_with_wrench()
    rig.run(0.1)
    loop = rig.control_loop
    loop.on_zero("wrench", known=known)
    loop.on_torque(TorqueSample("wrench", torque_nm, "", loop.inputs.arm.t_ns, loop.inputs.arm.t_ns))
    assert loop.operator.why_no_tare_step() is None
    loop.tool.count_angle(loop.inputs.arm.wrist_rad - 0.01)
    assert loop.operator.why_no_tare_step() is None
    loop.tool.on_release_ended()
    loop.tool.count_angle(loop.inputs.arm.wrist_rad - 0.08)
    assert "the clamped tool is turned by +0.080 rad" in loop.operator.why_no_tare_step()
    # The operator says that nothing loads it.
    loop.tool.on_release_ended()
    assert loop.operator.why_no_tare_step() is None


async def test_a_release_is_on_the_disk_before_it_is_answered():
    """A daemon that is killed then must not restore the angle and the zeros of the tool before."""
    rig = clamped_with_wrench()
    memory = memory_of(rig.control_loop)
    turn_to_limit(rig)
    await memory.save_present()

    async def release(_deadline: Deadline) -> None:
        rig.control_loop.tool.on_release_ended()

    subject = SimpleNamespace(
        control_loop=rig.control_loop,
        runner=SimpleNamespace(release=release, release_refusal=lambda: None),
        memory=memory,
        occasion=lambda: (),
    )
    commands = Commands(subject, None, None, None, asyncio.Event(), None)
    assert await bound_handlers(commands)["release"]({"confirmed": True}) == {}
    assert not read_memories(FILES).grip.known


async def second_stop(rig: Rig) -> dict[str, Any]:
    """Return the reply to a stop while nothing runs."""
    runner = SimpleNamespace(stop=lambda **_: None, just_ended=dict)
    subject, ending = SimpleNamespace(control_loop=rig.control_loop, runner=runner), asyncio.Event()
    return await Commands(subject, None, None, None, ending, None, now_ns=lambda: 0).handlers()["stop"]({"until_ns": 1})


@pytest.mark.parametrize("step", [{"do": "release"}, {**GRIP, "force_n": 100.0}])
@pytest.mark.parametrize("sense", [{"uncertain": True}, {"unfelt": True}, {"moving": True}])
async def test_a_second_stop_keeps_the_daemon_while_the_gripper_does_not_know(step, sense):
    """The fingers have left the width of the known grip: it is forgotten, and the tool may be there."""
    rig = stopped_fingers(twisted(), step, 80.0, sense)
    assert "the gripper does not know whether it holds a tool" in (await second_stop(rig))["held"]
    rig.hand = replace(rig.hand, moving=False, uncertain=True, unfelt=False, inactive=True)
    rig.run(0.1)
    assert "held" in await second_stop(rig), "a loss of power leaves the fingers where they are"
    rig.hand, rig.width_mm = replace(rig.hand, uncertain=False, inactive=False), 140.0
    rig.run(0.1)
    assert (await second_stop(rig))["ended"]


@pytest.mark.parametrize(("sense", "key"), [({"inactive": True}, "ended"), ({}, "held")])
async def test_a_stop_ends_the_daemon_before_the_gripper_is_first_activated(sense, key):
    rig = Rig(new_loop())
    rig.hand = replace(rig.hand, uncertain=True, **sense)
    rig.run(0.1)
    assert key in await second_stop(rig)


async def test_the_operator_says_that_another_tool_is_clamped():
    async with driven(TWIST, cycles=60) as cell:
        cell.runner.fingers.gripper = None
        assert await cell.runner.release() is not None, "an experiment runs"
        cell.runner.stop()
        await cell.cycles(50)
        assert cell.control_loop.tool.grip.known
        assert await cell.runner.release() is None
        assert not cell.control_loop.tool.grip.known


def test_a_grip_after_one_that_met_nothing_begins_an_angle_of_its_own():
    """The turn between was of empty fingers, and is no twist of the tool."""
    rig = Rig(new_loop())
    rig.force_n, rig.width_mm, rig.hand = 0.0, 60.0, replace(rig.hand, unfelt=True)
    met_nothing = {**GRIP, "width_mm": 60.0, "expect_object": False}
    started(rig, met_nothing, TWIST_AGAIN, torque_source="load_cell")
    rig.run(20)
    assert phase(rig) is ExperimentPhase.DONE, rig.control_loop.experiment.stop_reason
    again_rad = rig.wrist_rad
    started(rig, GRIP, TWIST_AGAIN, **TWISTED)
    while not rig.pending:
        rig.step()
    rig.force_n, rig.width_mm, rig.hand = 60.0, 30.0, replace(rig.hand, unfelt=False)
    rig.run(20)
    assert phase(rig) is ExperimentPhase.DONE, rig.control_loop.experiment.stop_reason
    assert rig.wrist_rad - again_rad == pytest.approx(0.25, abs=0.01)


@pytest.mark.parametrize("rig", [clamped_rig, twisted], ids=["clamped", "gripped"])
def test_the_plan_before_a_start_assumes_nothing_of_a_tool_that_is_turned(rig):
    """From 0.25 rad a twist to 0.1 rad turns clockwise; its sign alone would say counterclockwise."""
    ready = rig()
    file = ExperimentFile.model_validate({"name": "one", "steps": [{"do": "twist", "angles_rad": [0.1]}]})
    if rig is clamped_rig:
        before = plan_of(file, start=ready.control_loop.operator.known_tool())
        assert (before.steps[0].direction, before.assumed) == ("counterclockwise", "")
        started(ready, TWIST_AGAIN, **TWISTED).run(20)
    plan = plan_of(file, start=ready.control_loop.operator.known_tool())
    assert (plan.steps[0].way_unknown, plan.steps[0].direction, plan.assumed) == (True, "", "")
