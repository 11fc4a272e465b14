"""A straight move is repeated after an interruption by the loop, and after nothing else."""

import asyncio
from typing import Any

import pytest

from shearloop.daemon.control.experiment import ExperimentPhase
from shearloop.drivers.ur.messages import Command, CommandReply, MoveLinear, Stop
from tests.daemon.control.cell import MOVE, Cell, driven


def moves(cell: Cell) -> int:
    return sum(isinstance(command, MoveLinear) for command in cell.robot.commands)


@pytest.mark.parametrize("interrupted", [False, True])
async def test_a_refused_move_is_sent_again_only_if_the_loop_has_interrupted_it(monkeypatch, interrupted):
    async with driven() as cell:
        send = cell.robot.send

        def refuse_first_move(command: Command) -> Any:
            if not isinstance(command, MoveLinear) or moves(cell):
                return send(command)
            cell.robot.commands.append(command)
            if interrupted:
                assert cell.runner.straight_moves.interrupt()
            refused = asyncio.get_running_loop().create_future()
            refused.set_result(CommandReply("the arm is stopping"))
            return refused

        monkeypatch.setattr(cell.robot, "send", refuse_first_move)
        await cell.start(MOVE)
        await cell.until_ended()
        if interrupted:
            assert (cell.phase, moves(cell)) == (ExperimentPhase.DONE, 2)
        else:
            assert (cell.phase, moves(cell)) == (ExperimentPhase.STOPPED, 1)
            assert "the arm is stopping" in cell.why


async def test_a_move_that_somebody_else_stops_is_not_sent_again():
    async with driven(MOVE, cycles=40) as cell:
        assert cell.state.motion == "linear"
        cell.robot.send(Stop(4.0))
        await cell.until_ended()
        assert cell.phase is ExperimentPhase.STOPPED
        assert "the move ended early: stopped on command" in cell.why
        assert moves(cell) == 1
