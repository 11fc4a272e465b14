"""Whatever happens in whatever order to loop, robot and operator: nothing moves that an experiment does not move."""

import asyncio
import itertools
from collections.abc import Awaitable, Callable, Sequence
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shearloop.daemon.control.experiment import ExperimentPhase
from shearloop.daemon.control.faults import Response
from tests.daemon.control.cell import GRIP, MOVE, TWIST, Cell, driven, experiment

TURN = {"do": "turn_to", "angle_rad": 0.5}
# A stop, and what a program that is resumed at the pendant does until its watchdog ends it, takes less, in cycles.
STANDS_AFTER, EXCUSED_FOR = 60, 60
# Its supervisor's first pause is half a second.
BEGUN_AGAIN_AFTER = 65


class Scenario:
    """A cell to which things happen; after each cycle it is looked at."""

    def __init__(self, cell: Cell) -> None:
        self.cell = cell
        self.arm = cell.robot.bench.arm
        self.idle = self.excused = self.dead = 0
        self.moved = False

    async def go(self, cycles: int) -> None:
        for _ in range(cycles):
            self.dead = self.dead + 1 if self.cell.task.done() else 0
            if self.dead > BEGUN_AGAIN_AFTER:
                assert isinstance(self.cell.task.exception(), ZeroDivisionError)
                self.cell.drive()
                await asyncio.sleep(0)
            await self.cell.cycles(1)
            self.look()

    def look(self) -> None:
        experiment, verdict = self.cell.control_loop.experiment, self.cell.control_loop.status.decision
        runs = (
            experiment is not None and experiment.phase is ExperimentPhase.RUNNING and verdict.response is Response.NOTE
        )
        self.idle = 0 if runs and not self.dead and self.arm.reading.age_ns < 1e8 else self.idle + 1
        self.excused = max(0, self.excused - 1)
        moves = self.arm.reading.fastest_rad_per_s > 0 or self.arm.reading.moving_linearly
        self.moved |= moves
        assert not moves or self.idle < STANDS_AFTER or self.excused, f"it moves: {self.cell.state}"

    async def within(self, doing: Awaitable[Any], cycles: int) -> None:
        task = asyncio.ensure_future(doing)
        for _ in range(cycles):
            if task.done():
                return
            await self.go(1)

    async def start(self, *steps: dict[str, Any]) -> None:
        file = experiment(*steps)
        await self.within(self.cell.runner.start(file), 100)

    async def mend(self) -> None:
        self.arm.be(age_ns=0, wrench=(0.0,) * 6, safety_mode=1)
        self.arm.stoppable = True
        self.cell.died.clear()
        await self.go(5)
        await self.within(self.cell.runner.unlock(), 300)

    def tick_dies(self) -> None:
        tick = self.cell.control_loop.tick

        def once(*_: object) -> Any:
            self.cell.control_loop.tick = tick
            raise ZeroDivisionError("a tick went wrong")

        self.cell.control_loop.tick = once

    def protective_stop(self) -> None:
        if self.arm.reading.safety_mode == 1:
            self.arm.protective_stop()
            self.arm.be(moving_linearly=False)

    def resumed(self) -> None:
        if self.arm.reading.runtime_state == 4:
            self.arm.be_resumed_at_the_pendant()
            self.excused = EXCUSED_FOR

    def process_dies(self) -> None:
        self.cell.robot.die(50)
        self.arm.be(moving_linearly=False)
        self.cell.runner.decide_now()

    def unread(self) -> None:
        for _ in range(40):
            self.cell.robot.cycle(read=False)


HAPPENINGS: dict[str, Callable[[Scenario], Any]] = {
    "turn": lambda scenario: scenario.start(TURN, GRIP, TWIST),
    "move": lambda scenario: scenario.start(MOVE, TURN),
    "twist": lambda scenario: scenario.start(TWIST),
    "mend": lambda scenario: scenario.mend(),
    "wait": lambda scenario: scenario.go(40),
    "wait long": lambda scenario: scenario.go(90),
    "pause": lambda scenario: scenario.cell.control_loop.pause(),
    "resume": lambda scenario: scenario.cell.control_loop.resume(),
    "stop": lambda scenario: scenario.cell.runner.stop(),
    "protective stop": lambda scenario: scenario.protective_stop(),
    "resumed at the pendant": lambda scenario: scenario.resumed(),
    "program ends": lambda scenario: scenario.arm.end_program(),
    "dashboard hangs": lambda scenario: setattr(scenario.arm, "stoppable", False),
    "states are late": lambda scenario: scenario.arm.be(age_ns=150_000_000),
    "states are old": lambda scenario: scenario.arm.be(age_ns=300_000_000),
    "states are new": lambda scenario: scenario.arm.be(age_ns=0),
    "states are not read": lambda scenario: scenario.unread(),
    "the worker dies": lambda scenario: scenario.process_dies(),
    "a task dies": lambda scenario: scenario.cell.died.update(right="it died"),
    "the loop dies": lambda scenario: scenario.tick_dies(),
    "torque beyond its limit": lambda scenario: scenario.cell.exceed_torque(),
    "pushed": lambda scenario: scenario.arm.be(wrench=(100.0, 0.0, 0.0, 0.0, 0.0, 0.0)),
}


async def stays_safe(happenings: Sequence[str]) -> bool:
    """Let things happen, one after the other; return whether anything has moved at all."""
    async with driven() as cell:
        scenario = Scenario(cell)
        for name in happenings:
            happened = HAPPENINGS[name](scenario)
            if asyncio.iscoroutine(happened):
                await happened
            await scenario.go(5)
        await scenario.go(STANDS_AFTER)
        return scenario.moved


@settings(max_examples=40, deadline=None)
@given(st.lists(st.sampled_from([*HAPPENINGS]), max_size=25))
def test_nothing_moves_that_no_experiment_moves(happenings):
    asyncio.run(stays_safe(happenings))


@pytest.mark.parametrize("begun", ["turn", "move", "twist"])
def test_whatever_befalls_a_motion_and_then_again_it_stands(begun):
    others = [name for name in HAPPENINGS if name not in ("turn", "move", "twist", "mend", "wait long")]
    for first, second in itertools.permutations(others, 2):
        assert asyncio.run(stays_safe(["mend", begun, first, second])), "it moved at first"
