"""The loop's task over the real worker, with an arm and a gripper of this process when things go wrong."""

import asyncio
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from shearloop.daemon.control.control_loop import ControlLoop
from shearloop.daemon.control.experiment import ExperimentPhase
from shearloop.daemon.control.experiment_schema import ExperimentFile
from shearloop.daemon.control.faults import FaultCode
from shearloop.daemon.control.loop_runner import ControlLoopRunner
from shearloop.daemon.control.wrench import wrench_source
from shearloop.daemon.loop_config import LoopConfig
from shearloop.daemon.messaging.deadlines import Deadline
from shearloop.daemon.messaging.messages import LoopStop
from shearloop.daemon.torques import WRENCH, TorqueSample
from shearloop.drivers.errors import DriverError
from shearloop.drivers.ur.messages import Enable, MoveLinear, Stop, WristSpeed
from shearloop.drivers.ur.poses import along_tool
from shearloop.errors import ActionError
from tests.daemon.control.cell import GRIP, MOVE, TWIST, Cell, driven, experiment, no_tick
from tests.drivers.ur.handler_bench import SETTINGS


async def test_an_action_that_crashes_fails_its_step_with_the_error():
    async with driven() as cell:
        cell.gripper.error = RuntimeError("no such register")
        await cell.start(GRIP)
        await cell.until_ended(50)
        assert "step 1 (grip) failed: it crashed with RuntimeError: no such register" in cell.why


@pytest.mark.parametrize("kind", [ActionError, DriverError, OSError])
async def test_a_gripper_that_does_not_open_after_a_stop_is_reported_until_unlock(kind):
    async with driven({"do": "wait", "wait_s": 60}) as cell:
        cell.gripper.error = kind("the gripper does not answer")
        cell.exceed_torque()
        await cell.until_ended(10)
        await cell.cycles(50)
        assert FaultCode.NOT_RELEASED.text in cell.published.faults
        assert "the gripper does not answer" in cell.published.reasons
        assert FaultCode.TORQUE_LIMIT.text in cell.published.faults, "and why it was to open"
        unlocking = asyncio.create_task(cell.runner.unlock())
        await cell.cycles(30)
        assert await unlocking is None
        assert cell.published.reasons == ""


async def test_a_command_that_dies_ends_the_experiment():
    async with driven(TWIST, cycles=50) as cell:
        assert cell.state.motion == "wrist"
        cell.robot.dies_of = ValueError("not a float")
        await cell.until_ended(10)
        assert "loop: ValueError: not a float" in cell.why
        cell.robot.dies_of = None
        await cell.cycles(60)
        assert cell.state.rests


async def test_a_straight_move_that_is_paused_brakes_and_goes_on_to_its_end():
    async with driven(MOVE, cycles=40) as cell:
        end_m = cell.robot.end_m
        assert cell.control_loop.pause() is None
        await cell.cycles(5)
        paused_m = cell.robot.z_m
        assert abs(paused_m - end_m) > 0.05, "it is under way"
        await cell.cycles(100)
        assert cell.robot.z_m == paused_m, "it stands"
        assert cell.phase is ExperimentPhase.PAUSED
        assert sum(isinstance(command, Stop) for command in cell.robot.commands[-20:]) == 1
        assert cell.control_loop.resume() is None
        await cell.until_done()
        assert cell.robot.z_m == pytest.approx(end_m), "where it was to go from the start"


async def test_a_straight_move_stops_without_decisions():
    async with driven(MOVE, cycles=40) as cell:
        assert cell.state.motion == "linear", "each decision lets it go on"
        for _ in range(50):
            cell.robot.cycle(read=False)
        assert cell.state.motion == "idle"
        assert "silent" in cell.state.end_reason


async def test_a_straight_move_is_not_begun_while_the_experiment_is_paused():
    async with driven() as cell:
        starting = asyncio.create_task(cell.runner.start(experiment(MOVE)))
        while not starting.done():
            await cell.cycles(1)
            cell.control_loop.pause()
        await cell.cycles(50)
        assert not any(isinstance(command, MoveLinear) for command in cell.robot.commands)
        cell.control_loop.resume()
        await cell.until_done()


async def test_experiment_ended_returns_the_experiment_it_waited_for():
    async with driven({"do": "wait", "wait_s": 60}) as cell:
        first = cell.control_loop.experiment
        waiting = asyncio.create_task(cell.runner.experiment_ended())
        await cell.cycles(5)
        cell.runner.stop()
        # The next one begins before whoever waits has had his turn.
        cell.control_loop.tick(cell.robot.bench.now_ns)
        cell.control_loop.acknowledge()
        again = {"name": "again", "torque_source": WRENCH, "steps": [{"do": "wait", "wait_s": 60}]}
        assert cell.control_loop.start(ExperimentFile.model_validate(again), cell.robot.bench.now_ns) is None
        async with asyncio.timeout(20):
            while not waiting.done():
                await cell.cycles(1)
        assert await waiting is first


async def test_an_end_between_two_decisions_is_published_before_it_is_reported():
    async with driven(MOVE, cycles=5) as cell:
        waiting = asyncio.create_task(cell.runner.experiment_ended())
        await asyncio.sleep(0)
        cell.control_loop.on_action_ended("it met something")
        cell.runner.states.notify()
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        assert not waiting.done()
        await cell.cycles(20)
        assert (await waiting).phase is ExperimentPhase.STOPPED
        assert "stopped" in {one.phase for one in cell.published.messages if one.topic == "loop.state"}


async def test_a_loop_that_dies_stops_the_arm_and_when_begun_again_the_experiment(monkeypatch):
    async with driven(MOVE, cycles=40) as cell:
        assert cell.state.motion == "linear"

        monkeypatch.setattr(cell.control_loop, "tick", no_tick)
        await cell.cycles(1)
        await cell.loop_died()
        await cell.cycles(5)
        assert cell.state.motion == "idle"
        stopped_m = cell.robot.z_m
        monkeypatch.undo()
        cell.drive()
        await cell.cycles(20)
        assert cell.phase is ExperimentPhase.STOPPED
        assert "loop: ZeroDivisionError: a tick went wrong" in cell.why
        assert cell.robot.z_m == stopped_m
        assert FaultCode.TASK_DIED in {trouble.code for trouble in cell.control_loop.status.decision.faults}


async def test_the_next_run_after_a_crash_stops_the_arm_once_though_no_experiment_ran(monkeypatch):
    """Nobody knows whether the stop of the run that crashed has arrived."""
    async with driven() as cell:
        monkeypatch.setattr(cell.control_loop, "tick", no_tick)
        await cell.cycles(1)
        await cell.loop_died()
        monkeypatch.undo()
        cell.robot.commands.clear()
        cell.drive()
        await cell.cycles(5)
        assert [type(command) for command in cell.robot.commands] == [Stop]


async def test_a_loop_that_dies_while_the_gripper_opens_lets_it_open(monkeypatch):
    """Before the gripper has heard of it there is nothing that would open by itself."""
    async with driven({"do": "wait", "wait_s": 60}) as cell:
        heard, answered = asyncio.Event(), asyncio.Event()

        async def at_length() -> None:
            heard.set()
            await answered.wait()
            raise ActionError("it did not open")

        monkeypatch.setattr(cell.gripper, "release", at_length)
        cell.exceed_torque()
        await cell.until_ended(10)
        await heard.wait()
        tick = cell.control_loop.tick

        def dies_once(*_: object) -> Any:
            monkeypatch.setattr(cell.control_loop, "tick", tick)
            raise ZeroDivisionError("a tick went wrong")

        monkeypatch.setattr(cell.control_loop, "tick", dies_once)
        await cell.cycles(20)
        assert not cell.task.done(), "it waits for the gripper"
        answered.set()
        await cell.loop_died()
        cell.drive()
        await cell.cycles(20)
        assert FaultCode.NOT_RELEASED.text in cell.published.faults


async def test_a_loop_that_dies_as_a_straight_move_is_to_begin_leaves_the_arm_at_rest(monkeypatch):
    """The loop dies of the state that also wakes the move which waits for it."""
    for _ in range(2):
        async with driven() as cell:
            tick, running = cell.control_loop.tick, iter(range(2))

            def dies_at_the_second(*given: Any, tick: Any = tick, running: Any = running) -> Any:
                if cell.control_loop.experiment is not None and next(running):
                    raise ZeroDivisionError("a tick went wrong")
                return tick(*given)

            monkeypatch.setattr(cell.control_loop, "tick", dies_at_the_second)
            await cell.start(MOVE)
            await cell.cycles(5)
            await cell.loop_died()
            assert cell.state.motion == "idle", cell.robot.commands


@pytest.mark.parametrize("how", [ControlLoopRunner.stop, ControlLoopRunner.close])
async def test_a_stop_during_the_start_of_an_experiment_counts(how):
    async with driven() as cell:
        starting = asyncio.create_task(cell.runner.start(experiment(TWIST)))
        await asyncio.sleep(0)
        how(cell.runner)
        await cell.cycles(10)
        assert await starting == "it was stopped during its start"
        assert cell.control_loop.experiment is None


async def test_a_request_that_expires_while_the_arm_is_enabled_begins_nothing():
    async with driven() as cell:
        now_ns = cell.robot.bench.now_ns

        def enabled_for_long() -> int:
            assert any(isinstance(command, Enable) for command in cell.robot.commands), "only then it is known"
            return now_ns + 3_500_000_000

        deadline = Deadline(now_ns + 2_000_000_000, now_ns, enabled_for_long)
        starting = asyncio.create_task(cell.runner.start(experiment(TWIST), deadline=deadline))
        while not starting.done():
            await cell.cycles(1)
        assert "enabling the arm took 3.5 s, and the request had expired 1.5 s before" in starting.result()
        assert cell.control_loop.experiment is None
        await cell.cycles(10)
        assert cell.state.motion == "idle"


async def test_a_daemon_that_ends_starts_and_unlocks_nothing():
    async with driven(TWIST, cycles=10) as cell:
        cell.runner.close()
        assert cell.phase is ExperimentPhase.STOPPED
        assert "the daemon ends" in await cell.runner.start(experiment(TWIST))
        assert "the daemon ends" in await cell.runner.unlock()


async def test_what_stopped_the_arm_is_not_enabled_again_by_a_start_that_is_refused():
    async with driven(TWIST, cycles=10) as cell:
        before = len(cell.robot.commands)
        file = experiment(MOVE)
        assert "is running; stop it first" in (await cell.runner.start(file) or "")
        assert all(isinstance(command, WristSpeed) for command in cell.robot.commands[before:])


REFUSED_ONLY_BY_THE_EXPERIMENT = {
    "a tool would drop": ([{"do": "release"}], {}, "secure it, then send the same command with `--yes`"),
    "a move with a held tool": ([MOVE], {}, "put a `grip` or a `release` before step 1"),
    "a torque beyond its limit": ([TWIST], {"limits": {"torque_nm": 0.05}}, "measured"),
}


@pytest.mark.parametrize("why", REFUSED_ONLY_BY_THE_EXPERIMENT)
async def test_an_arm_is_not_enabled_for_an_experiment_that_cannot_begin(why):
    steps, keys, said = REFUSED_ONLY_BY_THE_EXPERIMENT[why]
    loop = ControlLoop(LoopConfig(), {WRENCH: wrench_source(SETTINGS.rate_hz)}, ("robot", "gripper"))
    async with driven(cell=Cell(loop)) as cell:
        now_ns = cell.robot.bench.now_ns
        cell.control_loop.on_torque(TorqueSample(WRENCH, 0.1, "", now_ns, now_ns))
        assert cell.state.awaits_enable
        starting = asyncio.create_task(cell.runner.start(experiment(*steps, **keys)))
        while not starting.done():
            await cell.cycles(1)
        assert said in starting.result()
        assert cell.robot.commands == []
        assert cell.state.awaits_enable


async def test_what_refuses_a_start_while_the_arm_is_enabled_begins_nothing():
    loop = ControlLoop(LoopConfig(), {WRENCH: wrench_source(SETTINGS.rate_hz)}, ("robot", "gripper"))
    async with driven(cell=Cell(loop)) as cell:
        cell.holding = False
        await cell.cycles(5)
        starting = asyncio.create_task(cell.runner.start(experiment({"do": "release"})))
        while not cell.robot.commands:
            await cell.cycles(1)
        assert not starting.done()
        # Somebody puts a tool between the fingers.
        cell.holding = True
        while not starting.done():
            await cell.cycles(1)
        assert "secure it, then send the same command with `--yes`" in starting.result()
        assert cell.control_loop.experiment is None


@pytest.mark.parametrize("running", [False, True])
async def test_each_state_is_decided_upon_and_every_fifth_published(monkeypatch, running):
    async with driven() as cell:
        if running:
            await cell.start({"do": "wait", "wait_s": 60})
        decided: list[int] = []
        tick = cell.control_loop.tick
        monkeypatch.setattr(cell.control_loop, "tick", lambda *given: decided.append(cell.state.cycle) or tick(*given))
        cell.published.messages.clear()
        await cell.cycles(50)
        assert len(decided) == 50
        assert sum(one.topic == "robot.state" for one in cell.published.messages) == 10


async def test_a_zero_is_taken_after_a_turn():
    """A wrist that turned is the robot's to move until its last speed, zero, has run out.

    It turns back before, because a clamped tool that is turned may load the wrench.
    """
    there, back = ({"do": "turn_to", "angle_rad": angle_rad} for angle_rad in (0.2, 0.0))
    async with driven(there, back, {"do": "tare"}) as cell:
        await cell.until_done()


@pytest.mark.parametrize("cycles", [1, 2, 3])
async def test_a_straight_move_goes_on_though_the_pause_was_shorter_than_its_braking(cycles):
    async with driven(MOVE, cycles=40) as cell:
        end_m = cell.robot.end_m
        cell.robot.brakes_for = 20
        assert cell.control_loop.pause() is None
        await cell.cycles(cycles)
        assert cell.control_loop.resume() is None
        await cell.until_done()
        assert cell.robot.z_m == pytest.approx(end_m)


async def test_a_straight_move_that_met_something_is_not_begun_again_after_a_pause_in_the_same_moment():
    async with driven(MOVE, cycles=40) as cell:
        arm, bench = cell.robot.bench.arm, cell.robot.bench
        # The pause is said while the state that tells of the force is on its way.
        arm.be(wrench=(0.0, 0.0, SETTINGS.limits.force_n.inner + 5.0, 0.0, 0.0, 0.0))
        bench.run(1)
        assert "force" in bench.state.end_reason
        cell.runner.straight_moves.interrupt()
        arm.be(wrench=(0.0,) * 6)
        await cell.cycles(1)
        cell.runner.straight_moves.go_on()
        await cell.until_ended()
        assert "the move ended early: force" in cell.why
        assert sum(isinstance(command, MoveLinear) for command in cell.robot.commands) == 1


TURN = WristSpeed(0.3, 4.0)


async def test_a_wrist_speed_is_sent_at_each_state():
    async with driven(TWIST, cycles=20) as cell:
        cell.robot.commands.clear()
        await cell.cycles(50)
        assert cell.robot.commands == [TURN] * 50
        assert cell.robot.bench.wrist_speed == pytest.approx(0.3)


async def test_the_speed_after_clipping_is_published():
    async with driven(TWIST, cycles=20) as cell:
        # Close to the limit of the force, the worker lets less through.
        cell.robot.bench.arm.be(wrench=(0.0, 0.0, 0.9 * SETTINGS.limits.force_n.hard, 0.0, 0.0, 0.0))
        await cell.cycles(150)
        state = next(one for one in reversed(cell.published.messages) if one.topic == "loop.state")
        assert state.speed_command_rad_per_s == pytest.approx(0.3)
        assert state.speed_sent_rad_per_s == cell.robot.bench.wrist_speed
        assert 0.0 < state.speed_sent_rad_per_s < 0.3


async def test_a_process_that_dies_with_a_command_of_the_loop_has_refused_none():
    """Nobody has sent one that could be mended; what helps is told instead."""
    async with driven(TWIST) as cell:
        # What is clipped is told in each cycle, so that one is unanswered whenever the process dies.
        cell.robot.bench.arm.be(wrench=(0.0, 0.0, 0.9 * SETTINGS.limits.force_n.hard, 0.0, 0.0, 0.0))
        await cell.cycles(20)
        cell.control_loop.on_link("robot", "The worker died of SIGKILL.", up=False)
        cell.robot.die(50)
        await asyncio.sleep(0)
        cell.runner.decide_now()
        assert cell.phase is ExperimentPhase.STOPPED
        codes = {fault.code for fault in cell.control_loop.status.decision.faults}
        assert FaultCode.COMMAND_UNANSWERED in codes
        assert FaultCode.COMMAND_REFUSED not in codes
        assert cell.why.endswith(FaultCode.COMMAND_UNANSWERED.value.cure)
        # Neither was the stop that comes next, of which there is nobody to hear.
        await asyncio.sleep(0)
        cell.runner.decide_now()
        codes = {fault.code for fault in cell.control_loop.status.decision.faults}
        assert FaultCode.COMMAND_UNANSWERED in codes
        assert FaultCode.COMMAND_REFUSED not in codes


async def test_motion_names_what_moves_until_arm_and_gripper_are_at_rest():
    """Meanwhile no file is read for a request: the loop that watches the motion must not be late."""
    async with driven({**TWIST, "angles_rad": [3.0]}) as cell:
        await cell.cycles(60)
        assert cell.runner.motion() == "the experiment 'test' is running"
        cell.runner.stop()
        while cell.state.motion != "idle":
            assert cell.runner.motion() is not None
            await cell.cycles(1)
        await cell.cycles(10)
        assert cell.runner.motion() is None
        cell.gripper.there.clear()
        releasing = asyncio.create_task(cell.runner.release())
        await cell.cycles(1)
        assert cell.runner.motion() == "the gripper or the robot is being moved"
        cell.gripper.there.set()
        await releasing
        assert cell.runner.motion() is None


def stops(cell: Cell) -> list[LoopStop]:
    return [one for one in cell.published.messages if isinstance(one, LoopStop)]


async def test_times_of_a_stop_are_published_once():
    async with driven(TWIST, cycles=50) as cell:
        assert cell.state.motion == "wrist"
        cause_ns = cell.robot.bench.now_ns
        cell.exceed_torque()
        await cell.until_ended(10)
        assert not stops(cell), "the wrist still turns"
        await cell.cycles(60)
        (stop,) = stops(cell)
        assert (stop.t_mono_ns, stop.response, stop.experiment) == (cause_ns, "stop and release", "test")
        assert stop.faults == FaultCode.TORQUE_LIMIT.text
        assert 0 <= stop.decided_after_s <= stop.sent_after_s <= 0.05
        assert stop.sent_after_s < stop.stands_after_s <= 0.2
        assert cell.state.rests


async def test_cause_of_a_requested_stop_is_the_request():
    async with driven(TWIST, cycles=50) as cell:
        asked_ns = cell.robot.bench.now_ns
        assert cell.runner.stop() == "test"
        await cell.cycles(60)
        (stop,) = stops(cell)
        assert (stop.t_mono_ns, stop.cause) == (asked_ns, "the operator stopped it: 'test' was under way")
        assert stop.decided_after_s <= 0.02


@pytest.mark.parametrize("cycles", [0, 1, 60])
async def test_a_stop_that_is_unlocked_at_once_says_its_own_cause(cycles):
    """A script sends both within 2 ms, so that no state of the robot lies between them."""
    async with driven(TWIST, cycles=50) as cell:
        assert cell.runner.stop() == "test"
        await cell.cycles(cycles)
        assert await cell.runner.unlock() is None
        await cell.cycles(60)
        (stop,) = stops(cell)
        assert stop.cause == "the operator stopped it: 'test' was under way"
        assert stop.response == "stop and keep grip"
        assert stop.faults == FaultCode.OPERATOR_STOP.text
        assert stop.stands_after_s > 0


async def test_a_failure_that_is_unlocked_at_once_says_its_own_cause():
    async with driven(MOVE, cycles=5) as cell:
        cell.control_loop.on_action_ended("it met something")
        assert await cell.runner.unlock() is None
        await cell.cycles(60)
        (stop,) = stops(cell)
        assert "it met something" in stop.cause
        assert stop.faults == FaultCode.STEP_FAILED.text


async def test_each_of_two_stops_is_published_though_the_second_follows_at_once():
    """The second experiment is stopped before the loop has decided anything for it, and the arm still brakes."""
    async with driven(TWIST, cycles=50) as cell:
        cell.runner.stop()
        await cell.runner.unlock()
        now_ns = cell.robot.bench.now_ns
        assert cell.control_loop.start(experiment(TWIST, name="second"), now_ns) is None
        cell.runner.stop()
        await cell.cycles(100)
        first, second = stops(cell)
        assert (first.experiment, second.experiment) == ("test", "second")
        for stop in (first, second):
            assert stop.cause == f"the operator stopped it: {stop.experiment!r} was under way"
            assert stop.faults == FaultCode.OPERATOR_STOP.text
        assert second.stands_after_s is not None
        assert cell.state.rests


async def test_a_stop_that_a_blocked_robot_refuses_has_the_times_of_block_and_standstill():
    async with driven(TWIST, cycles=50) as cell:
        cell.robot.bench.arm.accepts = False
        await cell.until_ended(20)
        assert not stops(cell), "the wrist still turns"
        await cell.cycles(60)
        (stop,) = stops(cell)
        assert stop.sent_after_s is None
        assert stop.blocked_after_s == pytest.approx(0.0, abs=0.02)
        assert stop.blocked_after_s < stop.stands_after_s <= 0.3
        assert "The robot did not accept the wrist speed" in stop.refusal


async def test_standstill_that_nothing_measures_is_unknown():
    async with driven(TWIST, cycles=50) as cell:
        cell.robot.dies_of = ValueError("not a float")
        await cell.until_ended(10)
        cell.task.cancel()
        await asyncio.gather(cell.task, return_exceptions=True)
        (stop,) = stops(cell)
        assert (stop.sent_after_s, stop.stands_after_s) == (None, None)


async def test_an_experiment_that_is_done_has_no_stop():
    async with driven({"do": "wait", "wait_s": 0.1}) as cell:
        await cell.until_ended()
        await cell.cycles(10)
        assert cell.phase is ExperimentPhase.DONE
        assert not stops(cell)


@given(st.lists(st.floats(-7, 7), min_size=3, max_size=3), st.floats(-1, 1))
def test_along_tool_moves_along_the_third_axis(turned, distance_m):
    found = along_tool((0.1, -0.2, 0.3, *turned), distance_m)
    axis = Rotation.from_rotvec(turned).as_matrix()[:, 2]
    assert found[:3] == pytest.approx(np.array([0.1, -0.2, 0.3]) + distance_m * axis, abs=1e-12)
    assert found[3:] == tuple(turned)
