"""No tool drops unasked: every short sequence of steps on the real driver and the emulated gripper, from every state.

What may begin without a question opens nothing that is held, or may be; what asks is a release, and it does open.
Of a gripper that has just got its power, only a known grip speaks for a tool (`HeldTool.any_object`).
"""

import asyncio
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from shearloop.daemon.clock import Clock
from shearloop.daemon.control.control_loop import ControlLoop
from shearloop.daemon.control.experiment_check import check_steps
from shearloop.daemon.control.experiment_schema import ExperimentFile, GripStep, ReleaseStep, Step, opening
from shearloop.daemon.control.fingertip_diameters import FingertipDiameters
from shearloop.daemon.control.gripper_task import GripperTask
from shearloop.emulators.gripper import Gripper, GripperRegisters
from shearloop.errors import ActionError, NotBegunError
from tests.daemon.control.loop_rig import new_loop
from tests.drivers.robotiq.gripper_rig import STEP_S, Rig, a_rig

TOOL_MM = 30.0
TURN = {"do": "turn_to", "angle_rad": 0.5}


def grip(width_mm: float) -> dict[str, Any]:
    return {"do": "grip", "width_mm": width_mm, "force_n": 40.0, "speed_mm_per_s": 150.0, "expect_object": False}


KINDS = (grip(40.0), grip(20.0), grip(15.0), {"do": "release"}, TURN)
# How the fingers stand before the start. The tool is 30 mm wide.
STATES = ("held", "held, of an unknown grip", "as wide as the target", "halted", "without power", "new daemon", "empty")


def sequences() -> Iterator[ExperimentFile]:
    """Yield each experiment that its plan allows."""
    for count in (1, 2, 3):
        for steps in product(KINDS, repeat=count):
            file = ExperimentFile.model_validate({"name": "one", "steps": steps})
            if not check_steps(file):
                yield file


class Bench:
    """A gripper with its task and a control loop that knows nothing else; `widest_mm` since it was reset."""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self.widest_mm = 0.0
        self.forget()

    def forget(self) -> None:
        """Begin as a new daemon does."""
        self.loop: ControlLoop = new_loop()
        silent: Any = SimpleNamespace(publish=lambda _: None)
        self.task = GripperTask(self.rig.driver, silent, self.loop, FingertipDiameters("combined", {}), Clock())

    async def do(self, step: Step) -> None:
        """Carry out a step as the loop and its runner do; a turn does not move the fingers."""
        if isinstance(step, ReleaseStep):
            step = opening(step.width_mm, 150.0)
        if not isinstance(step, GripStep):
            return
        self.loop.tool.begin_grip(step)
        try:
            await self.task.grip(step)
        except NotBegunError:
            self.loop.tool.on_grip_refused()
            raise
        self.loop.tool.on_grip_ended(step)

    async def look(self) -> None:
        """Take the gripper's present state."""
        self.loop.on_gripper(self.task.status_of(await self.rig.driver.read()))

    async def prepare(self, state: str) -> None:
        """Bring the fingers to a state that a start may find."""
        model = self.rig.model
        self.forget()
        model.object_mm = None
        await self.task.release()
        if state != "empty":
            model.object_mm = TOOL_MM
            at_mm = TOOL_MM if state == "as wide as the target" else 10.0
            await self.do(GripStep.model_validate(grip(at_mm)))
        if state == "halted":
            await self.task.halt()
        if state in ("without power", "new daemon"):
            model.write(GripperRegisters())
            model.step(STEP_S)
        known = self.loop.tool.grip
        if state in ("new daemon", "held, of an unknown grip"):
            self.forget()
        if state == "new daemon":
            self.loop.tool.restore_grip(known, lambda _: None)
        await self.look()


@pytest.mark.long
@pytest.mark.parametrize("state", STATES)
async def test_no_tool_drops_unasked(state: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    step_model = Gripper.step

    def step_and_look(model: Gripper, dt_s: float) -> None:
        step_model(model, dt_s)
        bench.widest_mm = max(bench.widest_mm, model.width_mm)

    asked = begun = 0
    async with a_rig("socket", tmp_path, active=True) as rig, asyncio.timeout(120):
        bench = Bench(rig)
        monkeypatch.setattr(Gripper, "step", step_and_look)
        await bench.prepare(state)
        for file in sequences():
            operator = bench.loop.operator
            if operator.why_not_begun(file) is not None:
                continue
            asks, before_mm = bool(operator.drop_sentence(file)), bench.rig.model.width_mm
            bench.widest_mm = before_mm
            # An experiment runs: the loop does not judge the grip meanwhile.
            experiment: Any = SimpleNamespace(running=True)
            bench.loop.experiment = experiment
            for step in file.steps:
                try:
                    await bench.do(step)
                except NotBegunError as error:
                    pytest.fail(f"{file.steps}: {error}; the start should refuse it")
                except ActionError:
                    break
            opened = bench.widest_mm > before_mm + 1.0
            assert opened == asks or state == "empty", file.steps
            begun, asked = begun + 1, asked + asks
            await bench.prepare(state)
    assert begun > 0
    assert (asked == 0) == (state == "empty")
