"""Commands of the loop to the wrist."""

import pytest

from shearloop.daemon.control.step_runner import ExperimentPhase
from shearloop.drivers.ur.messages import WristSpeed
from tests.daemon.cell import driven
from tests.drivers.ur.flight import SETTINGS

TWIST = {"do": "twist", "angles_rad": [1.0], "speed_rad_per_s": 0.3}
TURN = WristSpeed(0.3, 4.0)


async def test_a_wrist_speed_is_sent_at_each_state() -> None:
    async with driven() as cell:
        await cell.start(TWIST)
        await cell.cycles(20)
        cell.robot.commands.clear()
        await cell.cycles(50)
        assert cell.robot.commands == [TURN] * 50
        assert cell.robot.flight.wrist_speed == pytest.approx(0.3)


async def test_a_process_that_dies_with_a_command_of_the_loop_has_refused_none() -> None:
    """Nobody has sent one that could be mended; what helps is told instead."""
    async with driven() as cell:
        await cell.start(TWIST)
        # What is clipped is told in each cycle, so that one is unanswered whenever the process dies.
        cell.robot.flight.arm.be(wrench=(0.0, 0.0, 0.9 * SETTINGS.limits.force_n.hard, 0.0, 0.0, 0.0))
        await cell.cycles(20)
        cell.control_loop.inputs.lost["robot"] = "The robot's process died of SIGKILL."
        cell.robot.die(50)
        cell.runner.decide_now()
        assert cell.phase is ExperimentPhase.STOPPED
        assert "a command was refused" not in cell.why
        assert "ended before it answered" in cell.why
        assert cell.why.endswith("once the robot is connected again, `shearloop command unlock`.")
        # Neither was the stop that comes next, of which there is nobody to hear.
        cell.runner.decide_now()
        told = " ".join(cell.control_loop.status.decision.reasons)
        assert "not connected" in told
        assert "a command was refused" not in told
