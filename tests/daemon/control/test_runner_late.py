"""A loop that is late or was away: over the real worker, with an arm and a gripper of this process."""

import asyncio
from collections.abc import Awaitable, Callable
from contextlib import nullcontext
from typing import Any

import pytest

from shearloop.daemon.control import fault_detection
from shearloop.daemon.control.command_sender import CommandSender
from shearloop.daemon.control.control_loop import ControlLoop
from shearloop.daemon.control.experiment import ExperimentPhase
from shearloop.daemon.control.experiment_schema import GripStep
from shearloop.daemon.control.fault_detection import ARM_STALE_S, LONGEST_HANG_S
from shearloop.daemon.control.faults import Fault, FaultCode
from shearloop.daemon.control.wrench import wrench_source
from shearloop.daemon.loop_config import LoopConfig
from shearloop.daemon.messaging.deadlines import NO_DEADLINE, Deadline
from shearloop.daemon.messaging.messages import LoopStop
from shearloop.daemon.torques import WRENCH
from shearloop.drivers.errors import DriverError
from shearloop.drivers.robotiq.gripper import Permit, permitted
from shearloop.drivers.ur.messages import MoveLinear, Unlock
from shearloop.errors import NotBegunError
from tests.daemon.control.cell import GRIP, MOVE, TWIST, Cell, Gripper, driven
from tests.drivers.ur.handler_bench import CYCLE_NS, SETTINGS


async def test_a_decision_that_takes_long_makes_the_loop_late(monkeypatch):
    async with driven(TWIST, cycles=50) as cell:
        decide = cell.control_loop.tick

        def at_length(*given: Any) -> Any:
            monkeypatch.undo()
            orders = decide(*given)
            cell.robot.bench.now_ns += 200_000_000
            return orders

        monkeypatch.setattr(cell.control_loop, "tick", at_length)
        await cell.cycles(2)
        assert FaultCode.LOOP_LATE in [trouble.code for trouble in cell.control_loop.status.decision.faults]


async def test_a_speed_that_comes_while_the_arm_still_brakes_after_a_late_one_says_why_and_the_turn_continues(
    monkeypatch,
):
    # This arm turns for longer without a decision than the delivered one.
    monkeypatch.setattr(fault_detection, "LONGEST_HANG_S", 1.0)
    # So do its torques.
    sources = {WRENCH: wrench_source(SETTINGS.rate_hz)}
    patient = Cell(ControlLoop(LoopConfig(stale_after_s=1.0), sources, ("robot",)))
    async with driven(TWIST, cycles=50, cell=patient) as cell:
        while cell.state.motion != "stopping":
            cell.robot.cycle(read=False)
        await cell.cycles(3)
        late = "The arm is still stopping (the wrist speed was not renewed within 0.3 s)"
        assert Fault(FaultCode.COMMAND_REFUSED, late).sentence in cell.published.reasons
        await cell.cycles(50)
        assert (cell.phase, cell.state.motion) == (ExperimentPhase.RUNNING, "wrist")


@pytest.mark.parametrize(("missed", "read"), [(24, 1), (18, 2), (12, 1)])
async def test_a_loop_that_is_late_again_and_again_is_stopped(missed, read):
    """Though it then reads many states at once, or decides in time before it is late again."""
    async with driven({"do": "wait", "wait_s": 60}) as cell:
        for _ in range(60):
            for _ in range(missed):
                cell.robot.cycle(read=False)
            await cell.cycles(read)
            if cell.phase is not ExperimentPhase.RUNNING:
                break
        assert "loop ran" in cell.why


async def test_a_daemon_that_was_paused_says_so_first_and_not_what_follows_from_it():
    async with driven(TWIST, cycles=50) as cell:
        for _ in range(6_000_000_000 // CYCLE_NS):
            cell.robot.cycle(read=False)
        await cell.cycles(1)
        assert cell.phase is ExperimentPhase.STOPPED
        assert cell.why == Fault(FaultCode.DAEMON_PAUSED, "it stood still for 6.0 s, and 0.3 s are allowed").sentence


@pytest.mark.parametrize("asked", [False, True])
async def test_the_times_of_a_stop_after_a_pause_count_from_the_last_decision(asked):
    """The wrist stood long before the decision, by the robot's own deadlines. A person may have asked for it meanwhile.

    It was "decided after 0.000 s", and stood after the daemon's return.
    """
    async with driven(TWIST, cycles=50) as cell:
        decided_ns = cell.robot.bench.now_ns
        for _ in range(3_000_000_000 // CYCLE_NS):
            cell.robot.cycle(read=False)
        if asked:
            assert cell.runner.stop() == "test"
        await cell.cycles(20)
        (stop,) = (one for one in cell.published.messages if isinstance(one, LoopStop))
        assert stop.faults.split(", ")[0] == (FaultCode.OPERATOR_STOP if asked else FaultCode.DAEMON_PAUSED).text
        assert stop.t_mono_ns == pytest.approx(decided_ns, abs=2 * CYCLE_NS)
        assert 3.0 <= stop.decided_after_s <= stop.sent_after_s <= 3.1
        assert 0.1 <= stop.stands_after_s <= 0.3 + SETTINGS.command_timeout_s


async def test_a_cause_that_nothing_measures_has_no_time():
    """It was "decided after 0.000 s", as if it had been seen at once."""
    async with driven(TWIST, cycles=50) as cell:
        cell.died["right"] = "it crashed some time ago"
        await cell.cycles(60)
        (stop,) = (one for one in cell.published.messages if isinstance(one, LoopStop))
        assert stop.faults == FaultCode.TASK_DIED.text
        assert stop.decided_after_s is None
        assert 0.0 <= stop.sent_after_s < stop.stands_after_s < 0.3


async def test_the_whole_gap_of_a_late_loop_counts_as_held():
    async with driven(TWIST, cycles=50) as cell:
        for run in (1, 2):
            assert cell.published.held_s == 0.0
            for _ in range(20):
                cell.robot.cycle(read=False)
            await cell.cycles(10)
            assert cell.phase is ExperimentPhase.RUNNING
            # From the last decision to the one that is late, and on to the next.
            assert cell.published.held_s == pytest.approx(22 * CYCLE_NS / 1e9, abs=1e-6), run
            cell.runner.stop()
            await cell.cycles(60)
            assert await cell.runner.unlock() is None
            await cell.start(TWIST)
            await cell.cycles(50)


@pytest.mark.parametrize(("hang_s", "goes_on"), [(0.15, True), (0.28, True), (0.32, False), (0.5, False), (2.0, False)])
async def test_a_daemon_that_hung_for_longer_than_a_hand_needs_does_not_turn_the_wrist_again_by_itself(hang_s, goes_on):
    async with driven(TWIST, cycles=50) as cell:
        for _ in range(round(hang_s * 1e9 / CYCLE_NS)):
            cell.robot.cycle(read=False)
        await cell.cycles(100)
        assert (cell.phase is ExperimentPhase.RUNNING) == goes_on
        assert (cell.state.motion == "wrist") == goes_on
        assert (cell.control_loop.safety.waiting is None) == goes_on, "a stop waits for the operator's word"


async def test_a_loop_that_decides_before_the_last_state_is_stale_is_in_time():
    async with driven({"do": "wait", "wait_s": 60}) as cell:
        for _ in range(100):
            for _ in range(11):
                cell.robot.cycle(read=False)
            await cell.cycles(1)
            assert cell.control_loop.status.decision.faults == ()


async def test_of_states_that_are_read_at_once_the_newest_is_decided_upon(monkeypatch):
    async with driven({"do": "wait", "wait_s": 60}) as cell:
        decided: list[int] = []
        decide = cell.control_loop.tick

        def tick(*given: Any) -> Any:
            decided.append(cell.control_loop.inputs.arm.t_ns)
            return decide(*given)

        monkeypatch.setattr(cell.control_loop, "tick", tick)
        for _ in range(5):
            cell.robot.cycle(read=False)
        await cell.cycles(1)
        assert decided == [cell.state.read_ns]


class Slow(Gripper):
    """A gripper whose answer takes as long as a test lets time pass; then it moves once or twice."""

    def __init__(self, pass_time: Callable[[int], Awaitable[None]], motions: int = 1) -> None:
        super().__init__()
        self._pass_time, self._motions = pass_time, motions

    async def open_by_operator(self, permit: Permit = permitted) -> None:
        for number in range(self._motions):
            await self._pass_time(number)
            await super().open_by_operator(permit)

    async def unlock(self, permit: Permit = permitted, *, confirmed: bool = False) -> None:
        await self._pass_time(0)
        await super().unlock(permit, confirmed=confirmed)


@pytest.mark.parametrize("decided_since", [False, True])
@pytest.mark.parametrize("command", ["release", "unlock"])
async def test_no_fingers_begin_to_move_after_the_daemon_stood_still(command, decided_since):
    """Also where the loop has decided again before the gripper answers."""

    async def stand_still(_number: int) -> None:
        cell.robot.bench.now_ns += 5_000_000_000
        if decided_since:
            await cell.cycles(2)

    async with driven(cell=Cell(gripper=Slow(stand_still))) as cell:
        act = cell.runner.release() if command == "release" else cell.runner.unlock(confirmed=True)
        answered = asyncio.create_task(act)
        while not answered.done():
            await cell.cycles(1)
        assert "the daemon stood still for 5.0 s: look at the rig, and send the command again" in answered.result()
        assert cell.gripper.asked == []
        assert not cell.runner.fingers.may_be_moving, "a halt would make the gripper forget what it holds"
        # The next command is a new one.
        cell.gripper = cell.runner.fingers.gripper = Gripper()
        again = asyncio.create_task(cell.runner.release())
        while not again.done():
            await cell.cycles(1)
        assert (again.result(), cell.gripper.asked) == (None, ["open"])


@pytest.mark.parametrize(
    ("arrives_s", "said", "asked"),
    [
        ((0.5, 1.5), None, ["open", "open"]),
        ((1.5, 2.5), "reaching the robot or the gripper took 1.5 s, and the request had expired 0.5 s before", []),
    ],
    ids=["in time", "late"],
)
async def test_a_release_is_in_time_by_the_beginning_of_its_motion(arrives_s, said, asked):
    """An activation takes longer than a click counts."""
    now_s = 0.0

    async def arrive(number: int) -> None:
        nonlocal now_s
        now_s = arrives_s[number]

    async with driven(cell=Cell(gripper=Slow(arrive, motions=2))) as cell:
        refusal = await cell.runner.release(Deadline(10**9, 0, lambda: round(1e9 * now_s)))
        assert (refusal and refusal.partition(";")[0], cell.gripper.asked) == (said, asked)


async def test_a_release_that_has_nothing_to_do_leaves_no_deadline_behind():
    """As where the fingers are open: nothing asks for the permit then."""
    now_ns = 0

    class Open(Gripper):
        async def open_by_operator(self, _permit: Permit = permitted) -> None:
            self.asked.append("nothing to do")

    async with driven(cell=Cell(gripper=Open())) as cell:
        assert await cell.runner.release(Deadline(10**9, 0, lambda: now_ns)) is None
        now_ns = 10**12
        await cell.start(GRIP)
        await cell.until_done()
        assert cell.gripper.asked == ["nothing to do", "grip"]


async def test_fingers_that_moved_before_a_refusal_are_halted_by_a_stop():
    """The connection failed after the first motion, and its repetition is refused."""

    async def stand_still(number: int) -> None:
        cell.robot.bench.now_ns += number * 5_000_000_000

    async with driven(cell=Cell(gripper=Slow(stand_still, motions=2))) as cell:
        answered = asyncio.create_task(cell.runner.release())
        while not answered.done():
            await cell.cycles(1)
        assert "the daemon stood still" in answered.result()
        assert cell.runner.fingers.may_be_moving
        cell.runner.stop(also_idle=True)
        await cell.cycles(3)
        assert cell.gripper.asked == ["open", "halt"]


async def test_no_fingers_begin_to_move_after_the_computer_was_suspended():
    """CLOCK_MONOTONIC stands meanwhile, and the connection to the gripper may outlive it."""
    async with driven() as cell:
        permit = cell.runner.permit(NO_DEADLINE)
        permit.begin()
        cell.clock.slept_ns += 3_600_000_000_000
        await cell.cycles(2)
        with pytest.raises(NotBegunError, match=r"the daemon stood still for 3600\.0 s"):
            permit.begin()
        cell.runner.permit(NO_DEADLINE).begin()


@pytest.mark.parametrize("decided_since", [False, True])
@pytest.mark.parametrize("beyond_s", [-0.02, 0.02])
async def test_a_standstill_is_longer_than_the_longest_time_between_two_decisions_and_a_hang(beyond_s, decided_since):
    """What is shorter forbids nothing: a way out is not refused on a busy computer."""
    async with driven() as cell:
        permit = cell.runner.permit(NO_DEADLINE)
        cell.robot.bench.now_ns += round((ARM_STALE_S + LONGEST_HANG_S + beyond_s) * 1e9)
        if decided_since:
            cell.runner.decide_now()
        with pytest.raises(NotBegunError, match="the daemon stood still") if beyond_s > 0 else nullcontext():
            permit.begin()


async def test_fingers_may_be_opened_while_no_loop_runs():
    """A loop that has crashed takes some seconds to come back, and decides nothing meanwhile."""
    async with driven() as cell:
        cell.task.cancel()
        await asyncio.wait([cell.task])
        cell.robot.bench.now_ns += 5_000_000_000
        assert await cell.runner.release() is None
        assert cell.gripper.asked == ["open"]


async def test_an_unlock_that_has_expired_reaches_no_robot():
    async with driven() as cell:
        unlocking = asyncio.create_task(cell.runner.unlock(Deadline(0, 0, lambda: 10**9)))
        await cell.cycles(2)
        assert "the request had expired" in unlocking.result()
        assert Unlock() not in cell.robot.commands


async def test_fingers_of_a_failed_motion_are_halted_by_a_stop_although_the_next_one_was_refused():
    """Its connection was lost in the middle, and the next command came too late to begin anything."""
    async with driven() as cell:
        cell.gripper.error = DriverError("the connection to the gripper broke")
        releasing = asyncio.create_task(cell.runner.release())
        await cell.cycles(2)
        assert "broke" in releasing.result()
        releasing = asyncio.create_task(cell.runner.release(Deadline(0, 0, lambda: 10**9)))
        await cell.cycles(2)
        assert "the request had expired" in releasing.result()
        cell.runner.stop()
        await cell.cycles(2)
        assert cell.gripper.asked == ["open", "halt"]


async def test_a_loop_that_crashed_and_came_back_late_lets_no_fingers_begin():
    async with driven() as cell:
        permit = cell.runner.permit(NO_DEADLINE)
        cell.task.cancel()
        await asyncio.wait([cell.task])
        cell.robot.bench.now_ns += 5_000_000_000
        cell.drive()
        await cell.cycles(2)
        with pytest.raises(NotBegunError, match=r"the daemon stood still for 5\.\d s"):
            permit.begin()


async def test_no_step_begins_to_close_the_fingers_after_the_daemon_stood_still():
    """The gripper's answer is taken before the loop decides again."""

    class Asked(Gripper):
        async def grip(self, wish: GripStep, permit: Permit = permitted) -> None:
            cell.robot.bench.now_ns += 5_000_000_000
            await super().grip(wish, permit)

    async with driven(cell=Cell(gripper=Asked())) as cell:
        await cell.start(GRIP)
        await cell.until_ended()
        assert cell.phase is ExperimentPhase.STOPPED
        assert "stood still for 5.0 s" in cell.why
        assert cell.gripper.asked == []


async def test_no_straight_move_begins_after_the_daemon_stood_still(monkeypatch):
    """The state that shows the arm at rest is taken before the loop decides again."""

    async def stand_still(_: CommandSender) -> None:
        cell.robot.bench.now_ns += 5_000_000_000

    async with driven() as cell:
        monkeypatch.setattr(CommandSender, "wait_for_rest", stand_still)
        await cell.start(MOVE)
        await cell.until_ended()
        assert cell.phase is ExperimentPhase.STOPPED
        assert "stood still for 5.0 s" in cell.why
        assert not any(isinstance(command, MoveLinear) for command in cell.robot.commands)
