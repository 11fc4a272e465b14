"""A stop of any kind stays a stop: nothing starts before the operator has acknowledged it."""

import asyncio
from collections.abc import Awaitable, Callable

import pytest

from shearloop.daemon.control.experiment import ExperimentPhase
from shearloop.daemon.control.faults import TABLE, Response
from shearloop.drivers.errors import DriverError
from shearloop.drivers.ur.messages import Enable
from tests.daemon.control.cell import GRIP, MOVE, Cell, driven, experiment

WAIT = {"do": "wait", "wait_s": 60}


async def operator(cell: Cell) -> None:
    await cell.start(WAIT)
    assert cell.runner.stop() == "test"


async def operator_of_the_page_while_nothing_moves(cell: Cell) -> None:
    assert cell.runner.stop(also_idle=True) is None


async def operator_during_a_start(cell: Cell) -> None:
    starting = asyncio.create_task(cell.runner.start(experiment(WAIT)))
    await asyncio.sleep(0)
    cell.runner.stop()
    await cell.cycles(5)
    assert await starting == "it was stopped during its start"


async def operator_during_an_unlocking(cell: Cell) -> None:
    cell.gripper.there.clear()
    unlocking = asyncio.create_task(cell.runner.unlock())
    await cell.cycles(5)
    assert cell.runner.stop() == "unlock"
    await cell.cycles(5)
    assert "unlocking was stopped" in (await unlocking or "")
    cell.gripper.there.set()


async def failed_step(cell: Cell) -> None:
    cell.gripper.error = DriverError("the fingers met nothing")
    await cell.start(GRIP)
    await cell.cycles(5)
    assert cell.why == "step 1 (grip) failed: the fingers met nothing"
    cell.gripper.error = None


async def step_that_cannot_be_done(cell: Cell) -> None:
    # Nothing was identified.
    await cell.start({"do": "hold_torque", "torque_nm": 0.1})
    await cell.until_ended()
    assert "cannot be done" in cell.why


async def fault(cell: Cell) -> None:
    await cell.start(MOVE)
    await cell.cycles(5)
    cell.exceed_torque()
    await cell.until_ended()


KINDS: list[Callable[[Cell], Awaitable[None]]] = [
    operator,
    operator_of_the_page_while_nothing_moves,
    operator_during_a_start,
    operator_during_an_unlocking,
    failed_step,
    step_that_cannot_be_done,
    fault,
]


@pytest.mark.parametrize("stop", KINDS, ids=lambda kind: kind.__name__)
async def test_nothing_starts_after_a_stop_before_it_is_acknowledged(stop):
    async with driven() as cell:
        await stop(cell)
        await cell.cycles(20)
        cell.robot.commands.clear()
        cell.gripper.asked.clear()
        refusal = await cell.runner.start(experiment(GRIP, MOVE))
        first, *others = cell.control_loop.safety.waiting.faults
        assert refusal.startswith(first.sentence)
        assert all(fault.cause in refusal for fault in others)
        assert refusal.count("`shearloop command unlock`") == 1
        await cell.cycles(20)
        assert not any(isinstance(command, Enable) for command in cell.robot.commands)
        assert cell.gripper.asked == []
        assert cell.control_loop.status.decision.response >= Response.STOP_AND_KEEP_GRIP
        unlocking = asyncio.create_task(cell.runner.unlock())
        while not unlocking.done():
            await cell.cycles(1)
        assert unlocking.result() is None
        await cell.start(WAIT)


async def test_an_unlock_that_the_gripper_fails_says_what_was_unlocked_and_acknowledges_nothing():
    async with driven() as cell:
        await operator(cell)
        await cell.cycles(20)
        cell.gripper.unlock_error = DriverError("there is no connection to the gripper")
        unlocking = asyncio.create_task(cell.runner.unlock())
        while not unlocking.done():
            await cell.cycles(1)
        unlocked = "the robot is unlocked and may move again"
        said = f"{unlocked}, and the gripper is not ready: there is no connection to the gripper"
        assert unlocking.result() == said
        said = "the operator stopped it: 'test' was under way. Send `shearloop command unlock` before the next start."
        assert cell.runner.start_refusal() == said


async def test_the_daemons_end_in_mid_experiment_is_a_stop():
    async with driven(WAIT) as cell:
        cell.runner.close()
        assert cell.phase is ExperimentPhase.STOPPED
        assert cell.control_loop.safety.waiting is not None


async def test_an_experiment_that_is_done_is_no_stop():
    async with driven({"do": "wait", "wait_s": 0.1}) as cell:
        await cell.until_done()
        await cell.start(WAIT)


def test_every_stop_says_how_it_is_acknowledged():
    """The refusal of the next start names the command; these rows name it themselves, for the page."""
    for code in ("OPERATOR_STOP", "DAEMON_ENDED", "STEP_FAILED"):
        rule = next(rule for named, rule in TABLE.items() if named.name == code)
        assert "shearloop command unlock" in rule.cure
