"""Fingers that are on their way when the loop stops are stopped too: they would go on by themselves."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest

from shearloop.daemon.control.experiment import ExperimentPhase
from shearloop.daemon.loop_config import LoopConfig
from shearloop.drivers.errors import DriverError
from shearloop.drivers.ur.messages import Stop, ZeroForceTorque
from shearloop.errors import NotBegunError
from tests.daemon.control.cell import GRIP, Cell, Gripper, driven, experiment, no_tick


@asynccontextmanager
async def gripping() -> AsyncIterator[Cell]:
    """Yield a cell in the middle of a grip."""
    async with driven() as cell:
        cell.gripper.there.clear()
        await cell.start(GRIP)
        await cell.cycles(10)
        yield cell


async def test_a_stop_in_the_middle_of_a_grip_stops_the_fingers_once():
    async with gripping() as cell:
        assert cell.gripper.asked == ["grip"]
        cell.runner.stop()
        await cell.cycles(20)
        assert cell.gripper.asked == ["grip", "halt"]


@pytest.mark.parametrize("error", [DriverError("the connection to the gripper broke"), RuntimeError("no register")])
async def test_a_grip_that_has_failed_stops_the_fingers_once(error):
    """Where its connection is lost in the middle, the experiment ends, and they go on to where they were sent."""
    async with driven() as cell:
        cell.gripper.error = error
        await cell.start(GRIP)
        await cell.cycles(20)
        assert cell.gripper.asked == ["grip", "halt"]
        cell.gripper.error = None
        cell.control_loop.acknowledge()
        await cell.start(GRIP, {"do": "wait", "wait_s": 60})
        await cell.cycles(20)
        cell.runner.stop()
        await cell.cycles(20)
        await cell.runner.halt_and_wait()
        assert cell.gripper.asked == ["grip", "halt", "grip"]


async def test_a_grip_that_was_refused_halts_nothing():
    """A halted gripper does not know any more whether it holds something."""
    async with driven() as cell:
        cell.gripper.error = NotBegunError("a grip to 20 mm would open them and drop it")
        await cell.start(GRIP)
        await cell.cycles(20)
        assert "would open them" in cell.control_loop.experiment.stop_reason
        assert cell.gripper.asked == ["grip"]


@pytest.mark.parametrize("stops", [False, True])
async def test_fingers_stay_where_their_new_grip_cannot_be_written_or_a_stop_comes_first(stops):
    """The tool keeps what is known of its grip."""
    written = asyncio.Event()

    async def fails() -> str:
        await written.wait()
        return "the disk is full"

    async with driven(GRIP) as cell:
        await cell.until_done()
        grip = cell.control_loop.tool.grip
        assert grip.force_n
        cell.runner.actions.write_state = fails
        await cell.start(GRIP)
        await cell.cycles(10)
        if stops:
            cell.runner.stop()
        else:
            written.set()
        await cell.cycles(20)
        assert cell.phase is ExperimentPhase.STOPPED
        assert ("the fingers were not closed: the disk is full" in cell.why) is not stops
        assert cell.gripper.asked == ["grip"]
        assert cell.control_loop.tool.grip == grip


async def test_no_zero_is_taken_that_cannot_be_written():
    async def fails() -> str:
        return "the disk is full"

    async with driven() as cell:
        cell.holding = False
        cell.runner.actions.write_state = fails
        await cell.start({"do": "tare"})
        await cell.cycles(10)
        assert "no zero was taken: the disk is full" in cell.why
        assert ZeroForceTorque() not in cell.robot.commands


async def test_a_stop_after_a_grip_leaves_the_fingers_alone():
    async with driven(GRIP, {"do": "wait", "wait_s": 60}, cycles=50) as cell:
        cell.runner.stop()
        await cell.cycles(20)
        assert cell.gripper.asked == ["grip"]


async def test_a_stop_that_lets_the_tool_go_in_the_middle_of_a_grip_opens_the_fingers():
    async with gripping() as cell:
        cell.exceed_torque()
        await cell.cycles(20)
        assert cell.gripper.asked == ["grip", "grip"], "the second one wide open"


async def test_a_loop_that_dies_in_the_middle_of_a_grip_stops_the_fingers(monkeypatch):
    async with gripping() as cell:
        monkeypatch.setattr(cell.control_loop, "tick", no_tick)
        await cell.cycles(2)
        await cell.loop_died()
        assert cell.gripper.asked == ["grip", "halt"]


async def test_a_daemon_that_ends_in_the_middle_of_a_grip_stops_the_fingers_first():
    async with gripping() as cell:
        await cell.runner.halt_and_wait()
        assert cell.gripper.asked == ["grip", "halt"]


async def test_a_daemon_that_ends_in_the_middle_of_a_release_ends_it_and_stops_the_fingers():
    """A release that goes on would be repeated after the halt."""
    async with driven() as cell:
        cell.gripper.there.clear()
        releasing = asyncio.create_task(cell.runner.release())
        await cell.cycles(5)
        await cell.runner.halt_and_wait()
        assert "the release was stopped" in await releasing
        assert cell.gripper.asked == ["open", "halt"]


async def test_a_loop_that_comes_back_lets_the_halt_of_a_stop_end(monkeypatch):
    """Its first decision stops what may move since its crash."""

    class Slow(Gripper):
        async def halt(self) -> None:
            await answers.wait()
            await super().halt()

    answers = asyncio.Event()
    async with driven(cell=Cell(gripper=Slow())) as cell:
        with monkeypatch.context() as crashing:
            crashing.setattr(cell.control_loop, "tick", no_tick)
            await cell.cycles(2)
            await cell.loop_died()
        cell.gripper.there.clear()
        releasing = asyncio.create_task(cell.runner.release())
        await cell.cycles(2)
        assert cell.runner.stop() == "release"
        cell.drive()
        await cell.cycles(5)
        answers.set()
        await cell.cycles(2)
        assert "the release was stopped" in await releasing
        assert cell.gripper.asked == ["open", "halt"]


async def test_a_stop_ends_unlocking_and_stops_the_fingers():
    async with driven() as cell:
        cell.gripper.there.clear()
        unlocking = asyncio.create_task(cell.runner.unlock(confirmed=True))
        await cell.cycles(5)
        starting = asyncio.create_task(cell.runner.start(experiment(GRIP)))
        await cell.cycles(5)
        assert "being unlocked" in await starting
        assert cell.runner.stop() == "unlock"
        await cell.cycles(5)
        assert "unlocking was stopped" in await unlocking
        assert cell.gripper.asked == ["activate", "halt"]
        assert cell.robot.commands[-1] == Stop(LoopConfig().wrist_acceleration_rad_per_s2), "it ends the robot's part"
        assert cell.runner.stop() is None


async def test_a_stop_before_the_fingers_were_asked_to_move_halts_nothing():
    """As where the gripper is still being read. A halted gripper does not know any more whether it holds something."""
    async with driven() as cell:
        cell.gripper.there.clear()
        unlocking = asyncio.create_task(cell.runner.unlock())
        await cell.cycles(5)
        assert cell.runner.stop() == "unlock"
        await cell.cycles(5)
        assert "unlocking was stopped" in await unlocking
        assert cell.gripper.asked == []


async def test_the_state_warns_of_fingers_that_could_not_be_stopped(monkeypatch):
    async with gripping() as cell:

        async def does_not() -> None:
            raise DriverError("the gripper does not answer")

        with monkeypatch.context() as failing:
            failing.setattr(cell.gripper, "halt", does_not)
            cell.runner.stop()
            await cell.cycles(20)
        reasons = [one.reasons for one in cell.published.messages if one.topic == "loop.state"]
        assert any("keep clear of them: the gripper does not answer" in one for one in reasons)
        # They may move still.
        cell.runner.stop()
        await cell.cycles(20)
        assert cell.gripper.asked == ["grip", "halt"]
