"""Which speeds of the wrist the robot's process is told, and when again."""

import contextlib
from collections.abc import AsyncIterator, Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from shearloop.daemon.control.step_runner import ExperimentPhase
from shearloop.daemon.control.velocity_sender import RENEWED_AFTER, VelocityCommandSender
from shearloop.drivers.ur.messages import CommandReply, RobotState, WristSpeed
from tests.daemon.cell import driven
from tests.drivers.ur.flight import SETTINGS

TWIST = {"do": "twist", "angles_rad": [1.0], "speed_rad_per_s": 0.3}
TURN = WristSpeed(0.3, 4.0)


async def test_a_wrist_speed_that_stays_the_same_is_told_again_now_and_then() -> None:
    async with driven() as cell:
        await cell.start(TWIST)
        await cell.cycles(20)
        cell.robot.commands.clear()
        await cell.cycles(200)
        assert set(cell.robot.commands) == {TURN}
        renewed_s = RENEWED_AFTER * SETTINGS.command_timeout_s
        assert len(cell.robot.commands) == pytest.approx(200 * 0.008 / renewed_s, rel=0.2)
        assert cell.robot.flight.wrist_speed == pytest.approx(0.3)


async def test_a_wrist_speed_that_is_clipped_is_told_in_each_cycle() -> None:
    """What the robot's process clips, it would take up by itself as soon as its limits allow."""
    async with driven() as cell:
        await cell.start(TWIST)
        cell.robot.flight.arm.be(wrench=(0.0, 0.0, 0.9 * SETTINGS.limits.force_n.hard, 0.0, 0.0, 0.0))
        await cell.cycles(20)
        assert 0.0 < cell.robot.flight.wrist_speed < 0.3
        cell.robot.commands.clear()
        await cell.cycles(50)
        assert cell.robot.commands == [TURN] * 50


async def test_a_process_that_dies_with_a_command_of_the_loop_has_refused_none() -> None:
    """Nobody has sent one that could be mended; what helps is told instead."""
    async with driven() as cell:
        await cell.start(TWIST)
        # What is clipped is told in each cycle, so that one is unanswered whenever the process dies.
        cell.robot.flight.arm.be(wrench=(0.0, 0.0, 0.9 * SETTINGS.limits.force_n.hard, 0.0, 0.0, 0.0))
        await cell.cycles(20)
        cell.brain.inputs.lost["robot"] = "The robot's process died of SIGKILL."
        cell.robot.die(50)
        cell.loop.decide_now()
        assert cell.phase is ExperimentPhase.STOPPED
        assert "a command was refused" not in cell.why
        assert "ended before it answered" in cell.why
        assert cell.why.endswith("once the robot is connected again, `shearloop command unlock`.")
        # Neither was the stop that comes next, of which there is nobody to hear.
        cell.loop.decide_now()
        told = " ".join(cell.brain.status.decision.reasons)
        assert "not connected" in told
        assert "a command was refused" not in told


class Process:
    """A robot's process that takes every command as `takes` says, and does what `state` says."""

    settings = SETTINGS

    def __init__(self, state: RobotState) -> None:
        self.state = state
        self.takes = TURN
        self.told: list[Any] = []

    def tell(self, command: WristSpeed, answered: Callable[[CommandReply], None]) -> None:
        self.told.append(command)
        answered(CommandReply(sent=self.takes))


@contextlib.asynccontextmanager
async def turning() -> AsyncIterator[tuple[Process, VelocityCommandSender]]:
    """Give what tells a process that turns the wrist as it was told at time 0."""
    async with driven() as cell:
        process = Process(replace(cell.state, motion="wrist", sent=TURN, clipped=()))
        commands = VelocityCommandSender(process, SimpleNamespace(on_speed_sent=lambda _: None), 4.0, pytest.fail)  # type: ignore[arg-type]
        yield process, commands


@pytest.mark.parametrize(
    "otherwise",
    [
        {"motion": "stopping"},
        {"sent": WristSpeed(0.2, 4.0)},
        {"sent": WristSpeed(0.3, 2.0)},
        {"clipped": ("wrist speed is limited to 0.3 rad/s",)},
    ],
)
async def test_what_the_robot_does_not_do_for_certain_is_told_at_once(otherwise: dict[str, Any]) -> None:
    async with turning() as (process, commands):
        commands.turn(0.3, 0)
        commands.turn(0.3, 50_000_000)
        assert process.told == [TURN], "it does so already"
        process.state = replace(process.state, **otherwise)
        commands.turn(0.3, 50_000_000)
        assert process.told == [TURN, TURN]


async def test_a_speed_that_was_taken_otherwise_is_told_though_no_state_tells_of_it_yet() -> None:
    async with turning() as (process, commands):
        process.takes = WristSpeed(0.2, 4.0)
        commands.turn(0.3, 0)
        commands.turn(0.3, 0)
        assert process.told == [TURN, TURN]


async def test_a_speed_is_told_again_after_a_fifth_of_the_time_that_it_is_held_for() -> None:
    async with turning() as (process, commands):
        renewed_ns = round(RENEWED_AFTER * SETTINGS.command_timeout_s * 1e9)
        commands.turn(0.3, 0)
        commands.turn(0.3, renewed_ns - 1)
        assert process.told == [TURN]
        commands.turn(0.3, renewed_ns)
        assert process.told == [TURN, TURN]
