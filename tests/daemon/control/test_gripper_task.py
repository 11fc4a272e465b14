"""The gripper's task over the real driver and the emulated gripper, on both connections."""

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import replace
from itertools import product
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from shearloop.daemon.clock import Clock
from shearloop.daemon.control import gripper_task
from shearloop.daemon.control.experiment_schema import GripStep, opening
from shearloop.daemon.control.fault_detection import GRIPPER_STALE_S
from shearloop.daemon.control.fingertip_diameters import FingertipDiameters
from shearloop.daemon.control.gripper_task import GripperTask
from shearloop.daemon.control.held_tool import HeldTool
from shearloop.daemon.control.inputs import GripperStatus
from shearloop.drivers.errors import DriverError
from shearloop.drivers.robotiq.gripper import Permit
from shearloop.drivers.robotiq.messages import (
    ActivationStatus,
    GripperAction,
    GripperCommand,
    GripperFault,
    GripperFaultError,
    GripperMove,
    GripperState,
    ObjectStatus,
    Request,
)
from shearloop.drivers.robotiq.models import MODELS
from shearloop.drivers.robotiq.widths import WidthCalibration
from shearloop.emulators.gripper import Fingers, GripperRegisters
from shearloop.errors import ActionError, NotBegunError
from shearloop.estimation.values import TWO_SIDED_95
from tests.drivers.robotiq.gripper_rig import STEP_S, WAYS, Rig, a_rig
from tests.fixtures.daemons import DEADLINE_S

GRIP = GripStep(do="grip", width_mm=0.0, force_n=40.0)


class Felt(list[GripperStatus]):
    """A control loop that keeps the states of the gripper; `tool.was_gripped`: a grip is known."""

    on_gripper = list.append

    def __init__(self) -> None:
        super().__init__()
        self.tool = SimpleNamespace(was_gripped=False)


def task_of(
    rig: Rig, felt: Felt | None = None, *, measures_diameters: bool = True, patience: float = 1.0
) -> GripperTask:
    silent = SimpleNamespace(publish=lambda _: None)
    diameters = FingertipDiameters("combined", {})
    felt = Felt() if felt is None else felt
    return GripperTask(rig.driver, silent, felt, diameters, Clock(), measures_diameters, patience)


async def holding(rig: Rig) -> tuple[GripperTask, float]:
    """Grip an object of 40 mm; return the task, and the true width."""
    rig.model.object_mm = 40.0
    task = task_of(rig)
    await task.grip(GRIP)
    return task, rig.model.width_mm


@asynccontextmanager
async def reading(way: str, folder: Path, **settings: float) -> AsyncIterator[tuple[Rig, GripperTask, Felt]]:
    """Yield a rig and a task that reads its gripper."""
    async with a_rig(way, folder, **settings) as rig, asyncio.timeout(DEADLINE_S), asyncio.TaskGroup() as tasks:
        felt = Felt()
        task = task_of(rig, felt)
        read = tasks.create_task(task.run())
        while rig.driver.latest is None:  # noqa: ASYNC110 - the driver is asked, as the loop is
            await asyncio.sleep(0)
        yield rig, task, felt
        read.cancel()


@WAYS
async def test_cancelled_grip_can_be_released(way, tmp_path):
    async with reading(way, tmp_path) as (rig, task, _):
        rig.model.object_mm = 40.0
        for turns in range(1, 30, 3):
            grip = asyncio.create_task(task.grip(GRIP))
            # A question is under way now and then: broken off, it takes the connection with it.
            for _ in range(turns):
                await asyncio.sleep(0)
            grip.cancel()
            await task.release()
            assert rig.model.width_mm > 130.0


@WAYS
async def test_cancelled_grip_is_halted_and_stays_connected(way, tmp_path):
    async with reading(way, tmp_path) as (rig, task, felt):
        assert felt[-1].uncertain, "a gripper without power may hold a tool"
        await rig.driver.activate(may_drop=True)
        for turns in range(1, 40, 3):
            await task.release()
            assert not felt[-1].uncertain
            grip = asyncio.create_task(task.grip(GRIP))
            for _ in range(turns):
                await asyncio.sleep(0)
            grip.cancel()
            await task.halt()
            halted_mm = rig.model.width_mm
            for _ in range(200):
                await asyncio.sleep(0)
            # What is written is taken up at the model's next step.
            assert rig.model.width_mm == pytest.approx(halted_mm, abs=60.0 * STEP_S + 1e-6)
            assert not rig.model.taken.gto
            assert felt[-1].uncertain
            assert not felt[-1].holding
        assert rig.driver.diagnostics()["connections"] == 1


@WAYS
async def test_halt_stops_the_fingers_after_a_reconnection(way, tmp_path):
    async with reading(way, tmp_path, reply_deadline_s=0.2) as (rig, task, _):
        await task.release()
        grip = asyncio.create_task(task.grip(GRIP))
        while rig.model.width_mm > 120.0:  # noqa: ASYNC110 - the model is looked at, as it moves
            await asyncio.sleep(0)
        rig.silence(True)
        rig.stopped = True
        with pytest.raises(DriverError):
            await grip
        halt = asyncio.create_task(task.halt())
        await rig.link.down(len(rig.link.losses) + 1)
        rig.silence(False)
        await halt
        rig.model.step(STEP_S)
        assert not rig.model.taken.gto
        assert rig.model.width_mm > 110.0


@WAYS
async def test_cancelled_activation_stops_the_fingers(way, tmp_path):
    async with a_rig(way, tmp_path, connected=True) as rig, asyncio.timeout(DEADLINE_S):
        task = task_of(rig)
        release = asyncio.create_task(task.release())
        while rig.model.width_mm < 100.0:  # noqa: ASYNC110 - the model is looked at, as it moves
            await asyncio.sleep(0)
        release.cancel()
        await task.halt()
        rig.model.step(STEP_S)
        halted_mm = rig.model.width_mm
        for _ in range(200):
            await asyncio.sleep(0)
        assert rig.model.width_mm == halted_mm
        await task.release()
        with pytest.raises(ActionError, match=r"closed to 0\.0 mm and met nothing wider; put the tool between them"):
            await task.grip(GRIP)


@WAYS
@pytest.mark.parametrize("target_mm", [20.0, 60.0])
async def test_a_tool_as_wide_as_the_target_may_be_held_although_it_is_not_felt(way, tmp_path, target_mm):
    """The gripper reports "at target", as with nothing between its fingers."""
    to_target = GRIP.model_copy(update={"width_mm": target_mm, "expect_object": False})
    async with reading(way, tmp_path) as (rig, task, felt):
        await task.release()
        assert not felt[-1].may_hold
        # Within one count.
        rig.model.object_mm = target_mm - 0.6
        await task.grip(to_target)
        assert (felt[-1].unfelt, felt[-1].holding, felt[-1].may_hold) == (True, False, True)
        with pytest.raises(ActionError, match="met nothing wider"):
            await task.grip(to_target.model_copy(update={"expect_object": True}))
        with pytest.raises(NotBegunError, match="would open them and drop it"):
            await task.grip(to_target.model_copy(update={"width_mm": target_mm + 10.0}))
        # Above its width, and not well above it: such a release opens fully.
        await task.grip(opening(target_mm + 1.0, 100.0))
        assert rig.model.width_mm > 130.0
        assert not felt[-1].may_hold
        # Fingers that have opened to a width between hold nothing.
        rig.model.object_mm = None
        await task.grip(to_target)
        await task.grip(opening(target_mm + 20.0, 100.0))
        assert not felt[-1].may_hold


@WAYS
@pytest.mark.parametrize("object_mm", [None, 40.0, 134.0], ids=["nothing", "a tool", "nearly the stroke"])
@pytest.mark.parametrize("gripped", [True, False], ids=["grip known", "grip unknown"])
async def test_a_grip_does_not_activate_a_gripper_that_lost_its_power(way, tmp_path, gripped, object_mm):
    """Its activation opens the fingers, and it cannot say whether they hold something. A confirmed release may."""
    async with a_rig(way, tmp_path, active=True) as rig, asyncio.timeout(DEADLINE_S):
        rig.model.object_mm = object_mm
        felt = Felt()
        task = task_of(rig, felt)
        await task.grip(GRIP.model_copy(update={"expect_object": object_mm is not None}))
        felt.tool.was_gripped = gripped
        held_mm = rig.model.width_mm
        rig.model.write(GripperRegisters())
        rig.model.step(STEP_S)
        with pytest.raises(NotBegunError, match=r"opens the fingers, and a tool .* `shearloop command release --yes`"):
            await task.grip(GRIP)
        assert (rig.model.width_mm, rig.model.sta) == (held_mm, 0)
        await task.open_by_operator()
        assert rig.model.width_mm > 130.0
        assert rig.model.sta == 3


@WAYS
async def test_a_grip_does_not_activate_a_gripper_that_loses_its_power_after_it_was_read(way, tmp_path, monkeypatch):
    async with a_rig(way, tmp_path, active=True) as rig, asyncio.timeout(DEADLINE_S):
        task, held_mm = await holding(rig)
        task.control_loop.tool.was_gripped = True
        read = rig.driver.read

        async def read_then_lost() -> GripperState:
            state = await read()
            rig.model.write(GripperRegisters())
            rig.model.step(STEP_S)
            return state

        monkeypatch.setattr(rig.driver, "read", read_then_lost)
        with pytest.raises(DriverError, match="has to be activated"):
            await task.grip(replace_step(GRIP, force_n=100.0))
        assert (rig.model.width_mm, rig.model.sta) == (held_mm, 0)


@WAYS
async def test_a_grip_does_not_open_a_held_tool_that_is_nearly_as_wide_as_the_stroke(way, tmp_path):
    async with a_rig(way, tmp_path, active=True) as rig, asyncio.timeout(DEADLINE_S):
        task = task_of(rig)
        await task.release()
        rig.model.object_mm = 134.0
        await task.grip(GRIP)
        held_mm = rig.model.width_mm
        with pytest.raises(NotBegunError, match="would open them and drop it"):
            await task.grip(GRIP.model_copy(update={"width_mm": 138.0}))
        assert rig.model.width_mm == held_mm


@WAYS
@pytest.mark.parametrize("beyond_mm", [-5.0, 1.0])
async def test_a_release_of_a_known_grip_opens_fully_after_a_new_connection(way, tmp_path, beyond_mm):
    """The tool is as wide as the grip's target, so that the gripper does not feel it."""
    async with a_rig(way, tmp_path, active=True) as rig, asyncio.timeout(DEADLINE_S):
        felt = Felt()
        felt.tool.was_gripped = True
        task = task_of(rig, felt)
        await task.release()
        await task.grip(GRIP.model_copy(update={"width_mm": 60.0, "expect_object": False}))
        await rig.driver.close()
        await rig.driver.connect()
        await task.grip(opening(rig.model.width_mm + beyond_mm, 100.0))
        assert rig.model.width_mm > 130.0


@WAYS
async def test_a_release_to_where_the_fingers_stand_moves_nothing_after_a_new_connection(way, tmp_path):
    """An earlier program has opened them so far, perhaps because there is no room for more."""
    async with a_rig(way, tmp_path, active=True) as rig, asyncio.timeout(DEADLINE_S):
        felt = Felt()
        task = task_of(rig, felt)
        await task.release()
        await task.grip(opening(60.0, 100.0))
        await task.grip(GRIP.model_copy(update={"width_mm": 60.0, "expect_object": False}))
        await rig.driver.close()
        task.control_loop.on_gripper(task.status_of(await rig.driver.connect()))
        assert felt[-1].unfelt, "nothing shows that they did not close on a tool of this width"
        stood_mm = rig.model.width_mm
        await task.grip(opening(stood_mm - 0.1, 100.0))
        assert rig.model.width_mm == stood_mm
        assert not felt[-1].may_hold


@WAYS
@pytest.mark.parametrize("measured", [True, False])
async def test_fingertips_that_touch_hold_nothing_where_that_is_measured(way, tmp_path, measured):
    """Soft fingertips meet before the fingers' end, which the gripper takes for an object."""
    async with a_rig(way, tmp_path, active=True) as rig, asyncio.timeout(DEADLINE_S):
        task = task_of(rig, measures_diameters=measured)
        rig.model.object_mm = 0.9
        if measured:
            with pytest.raises(ActionError, match="met nothing wider"):
                await task.grip(GRIP)
        else:
            await task.grip(GRIP)
        status = task.status_of(await rig.driver.read())
        assert (status.holding, status.may_hold) == (not measured, True)


@WAYS
async def test_fingers_that_meet_something_as_they_open_are_not_released(way, tmp_path, monkeypatch):
    monkeypatch.setattr(gripper_task, "TRIED_FOR_S", 0.0)
    async with a_rig(way, tmp_path, active=True) as rig, asyncio.timeout(DEADLINE_S):
        rig.model.object_mm = 40.0
        task = task_of(rig)
        await task.grip(GRIP)
        rig.model.widest_mm = 40.0
        with pytest.raises(ActionError, match=r"met something as they opened, and stopped at 40\.1 mm"):
            await task.release()
        rig.model.widest_mm = 139.0
        await task.release()


def replace_step(step: GripStep, **changes: float) -> GripStep:
    return step.model_copy(update=changes)


@WAYS
async def test_a_release_never_closes_the_fingers(way, tmp_path):
    async with a_rig(way, tmp_path, active=True) as rig, asyncio.timeout(DEADLINE_S):
        rig.model.object_mm = 40.0
        task = task_of(rig)
        # The gripper measures the held tool a little below its width.
        for width_mm in (10.0, 40.0, 41.0):
            await task.grip(GRIP)
            await task.grip(opening(width_mm, 60.0))
            assert rig.model.width_mm > 139, "what may be held is let go of"
        rig.model.object_mm = None
        await task.grip(replace_step(GRIP, expect_object=False))
        await task.grip(opening(80.0, 60.0))
        open_mm = rig.model.width_mm
        await task.grip(opening(10.0, 60.0))
        assert rig.model.width_mm == open_mm > 79


@WAYS
async def test_a_grip_never_drops_what_is_held(way, tmp_path):
    async with a_rig(way, tmp_path, active=True) as rig, asyncio.timeout(DEADLINE_S):
        task, held_mm = await holding(rig)
        for target in (replace_step(GRIP, width_mm=60.0), replace_step(GRIP, width_mm=60.0, expect_object=False)):
            with pytest.raises(ActionError, match=r"40\.\d mm apart and hold .*, and a grip to 60 mm would"):
                await task.grip(target)
            assert rig.model.width_mm == held_mm
        await task.grip(replace_step(GRIP, force_n=100.0))
        await task.halt()
        with pytest.raises(ActionError, match="or may hold it"):
            await task.grip(replace_step(GRIP, width_mm=60.0))
        assert rig.model.width_mm == held_mm, "after a halt the gripper does not say what it holds"


@WAYS
async def test_fingers_that_another_program_moves_count_as_moving_where_a_grip_is_refused(way, tmp_path):
    """So the end of the experiment halts them."""
    async with a_rig(way, tmp_path, active=True) as rig, asyncio.timeout(DEADLINE_S):
        task, _ = await holding(rig)
        rig.model.object_mm = None
        rig.model.write(replace(rig.model.command, pos=255, spe=0))
        while (await rig.driver.read()).object is not ObjectStatus.MOVING:
            pass
        rig.stopped = True
        asked: list[bool] = []
        with pytest.raises(ActionError, match="would open them and drop it") as refused:
            await task.grip(replace_step(GRIP, width_mm=60.0), lambda: asked.append(True))
        assert not isinstance(refused.value, NotBegunError), "what was gripped may be no more"
        assert asked == [True]


@WAYS
async def test_a_hot_gripper_refuses_a_grip_and_opens_for_a_release(way, tmp_path):
    async with a_rig(way, tmp_path, active=True) as rig, asyncio.timeout(DEADLINE_S):
        task, held_mm = await holding(rig)
        rig.model.fail(8)
        with pytest.raises(NotBegunError, match="too hot"):
            await task.grip(replace_step(GRIP, force_n=100.0))
        assert rig.model.width_mm == held_mm
        await task.open_by_operator()
        assert rig.model.width_mm > 100


@WAYS
async def test_unlocking_a_gripper_without_a_fault_does_not_open_it(way, tmp_path):
    async with a_rig(way, tmp_path, active=True) as rig, asyncio.timeout(DEADLINE_S):
        task, held_mm = await holding(rig)
        rig.driver.latest = None
        await task.unlock()
        for _ in range(200):
            await asyncio.sleep(0)
        assert rig.model.width_mm == held_mm
        rig.model.fail(12)
        assert "internal fault" in task.status_of(await rig.driver.read()).fault
        dropped = r"a tool in it drops; its fingers are 40\.\d mm apart.*`shearloop command unlock --yes`"
        with pytest.raises(ActionError, match=dropped):
            await task.unlock()
        assert rig.model.width_mm == held_mm
        await task.unlock(confirmed=True)
        state = await rig.driver.read()
        assert not state.fault.needs_activation
        assert not task.status_of(state).may_hold, "open fingers are empty after an activation"


@WAYS
async def test_unlock_handles_a_fault_newer_than_the_state(way, tmp_path):
    async with a_rig(way, tmp_path, active=True) as rig, asyncio.timeout(DEADLINE_S):
        assert not (await rig.driver.read()).fault.needs_activation
        rig.model.fail(12)
        await task_of(rig).unlock(confirmed=True)
        assert not (await rig.driver.read()).fault.needs_activation


@WAYS
@pytest.mark.parametrize("command", ["unlock", "release"])
async def test_fingers_open_after_a_fault_although_a_request_fails_once(way, tmp_path, command, monkeypatch):
    """The way out does not end at the first request that the gripper does not answer."""
    async with a_rig(way, tmp_path, active=True) as rig, asyncio.timeout(DEADLINE_S):
        task, _ = await holding(rig)
        rig.model.fail(12)
        move, losses = rig.driver.move, [DriverError("the gripper did not answer")]

        async def fail_once(request: GripperCommand, permit: Permit) -> GripperMove:
            if losses:
                raise losses.pop()
            return await move(request, permit)

        monkeypatch.setattr(rig.driver, "move", fail_once)
        await (task.unlock(confirmed=True) if command == "unlock" else task.open_by_operator())
        assert losses == []
        assert not task.status_of(await rig.driver.read()).may_hold


@WAYS
@pytest.mark.parametrize("command", ["unlock", "release"])
@pytest.mark.parametrize("is_faulty", [True, False])
async def test_each_request_that_may_move_the_fingers_asks_for_the_permit(way, tmp_path, command, is_faulty):
    async with a_rig(way, tmp_path, active=is_faulty, connected=True) as rig, asyncio.timeout(DEADLINE_S):
        task = task_of(rig)
        if is_faulty:
            await holding(rig)
            rig.model.fail(12)
        write, asked, written = rig.driver.client.write, [], []

        async def note(request: Request, before: Callable[[], None]) -> None:
            await write(request, before)
            written.append((request, len(asked)))

        rig.driver.client.write = note

        def permit() -> None:
            asked.append(True)

        act = task.unlock(permit, confirmed=True) if command == "unlock" else task.open_by_operator(permit)
        await act
        moves = is_faulty or command == "release"
        requests = [type(request) for request, _ in written]
        assert requests == [GripperAction, GripperAction, GripperMove] * moves
        assert [asks for _, asks in written] == [1, 2, 3] * moves


@WAYS
async def test_a_release_that_is_refused_is_not_tried_again(way, tmp_path):
    """It would begin later by itself."""
    async with a_rig(way, tmp_path, active=True) as rig, asyncio.timeout(DEADLINE_S):
        task, held_mm = await holding(rig)
        asked: list[bool] = []

        def permit() -> None:
            asked.append(True)
            if len(asked) == 1:
                raise NotBegunError("the daemon stood still")

        with pytest.raises(NotBegunError):
            await task.release(permit)
        assert asked == [True]
        assert rig.model.width_mm == held_mm


@WAYS
async def test_a_fault_lasts_until_the_activation_that_ends_it_is_complete(way, tmp_path):
    """Its reset alone would hide it: the next unlock would acknowledge a gripper that does not move."""
    async with a_rig(way, tmp_path, active=True) as rig, asyncio.timeout(DEADLINE_S):
        task, _ = await holding(rig)
        rig.model.fail(12)
        asked: list[bool] = []

        def permit() -> None:
            asked.append(True)
            if len(asked) == 2:
                raise NotBegunError("the daemon stood still")

        with pytest.raises(NotBegunError):
            await task.unlock(permit, confirmed=True)
        state = await rig.driver.read()
        assert (state.fault.code, state.activation) == (12, ActivationStatus.RESET)
        with pytest.raises(NotBegunError, match="confirm it with `shearloop command unlock --yes`"):
            await task.unlock()
        with pytest.raises(GripperFaultError, match="An operator has to confirm that the fingers are clear"):
            await rig.driver.activate(may_drop=True)
        await task.unlock(confirmed=True)
        state = await rig.driver.read()
        assert (state.fault.code, state.activation) == (0, ActivationStatus.ACTIVE)
        assert not task.status_of(state).may_hold


@WAYS
async def test_a_fault_of_the_activation_replaces_the_one_that_it_was_to_end(way, tmp_path):
    """Its sentence has the cure."""
    async with a_rig(way, tmp_path, active=True) as rig, asyncio.timeout(DEADLINE_S):
        task, _ = await holding(rig)
        rig.model.fail(12)
        asked: list[bool] = []

        def permit() -> None:
            asked.append(True)
            if len(asked) == 2:
                rig.model.fail(13)
                raise NotBegunError("the activation failed")

        with pytest.raises(NotBegunError, match="the activation failed"):
            await task.unlock(permit, confirmed=True)
        assert (await rig.driver.read()).fault.code == 13


@WAYS
async def test_fingers_that_are_known_to_be_empty_are_activated_unasked(way, tmp_path):
    async with a_rig(way, tmp_path, active=True) as rig, asyncio.timeout(DEADLINE_S):
        await task_of(rig).release()
        rig.model.fail(12)
        await task_of(rig).unlock()
        assert not (await rig.driver.read()).fault.needs_activation


async def test_held_tool_has_a_diameter_while_states_are_new(tmp_path):
    async with a_rig("socket", tmp_path) as rig, asyncio.timeout(DEADLINE_S):
        rig.model.object_mm = 40.0
        task = task_of(rig)
        assert task.held_tool(0) is None, "nothing was read yet"
        await rig.driver.connect()
        await task.release()
        await task.grip(GRIP)
        state = await rig.driver.read()
        tool = task.held_tool(state.t_ns)
        assert tool.half_width == pytest.approx(TWO_SIDED_95 * state.width_std_mm)
        assert abs(tool.value - 40.0) < tool.half_width
        stale_ns = state.t_ns + round(GRIPPER_STALE_S * 1e9) + 1
        assert task.held_tool(stale_ns) is None
        assert task_of(rig, patience=10.0).held_tool(stale_ns) is not None, "as long as the loop takes the state"
        assert task_of(rig, measures_diameters=False).held_tool(state.t_ns) is None, "the maker's widths are no gauge"
        await task.release()
        assert task.held_tool((await rig.driver.read()).t_ns) is None


async def test_fingers_move_from_a_command_to_its_end(tmp_path):
    async with reading("socket", tmp_path) as (rig, reader, felt):
        task = replace(reader, clock=SimpleNamespace(now_ns=rig.monotonic_ns))

        async def next_state_ns() -> int:
            seen = len(felt)
            while len(felt) == seen:  # noqa: ASYNC110 - the driver is asked, as the loop is
                await asyncio.sleep(0)
            return felt[-1].t_ns

        rig.model.object_mm = 40.0
        await rig.driver.activate(may_drop=True)
        for act in (lambda: task.grip(GRIP), task.release, task.open_by_operator):
            rested_ns = await next_state_ns()
            began_ns = await next_state_ns()
            await act()
            ended_ns = rig.monotonic_ns()
            assert task.moved_between(began_ns, ended_ns)
            assert not task.moved_between(rested_ns + 1, began_ns)
        rested_ns = await next_state_ns()
        assert not task.moved_between(rested_ns + 1, await next_state_ns())


async def test_absent_gripper_is_reported(tmp_path, monkeypatch):
    monkeypatch.setattr(gripper_task, "TRIED_FOR_S", 0.2)
    async with a_rig("socket", tmp_path) as rig:
        with pytest.raises(DriverError, match="There is no connection to the gripper"):
            await task_of(rig).release()


@pytest.mark.parametrize("model", MODELS)
def test_no_bare_fingers_make_the_right_tool_look_like_another_one(model):
    """Whatever their bow, and wherever they are open and closed."""
    nominal = WidthCalibration.nominal(model)
    task = GripperTask(SimpleNamespace(model=MODELS[model]), None, Felt(), None, Clock(), measures_diameters=False)
    shapes = product((3.0, 8.0, 13.0), (227.0, 230.0, 233.0), (0.0, MODELS[model].bow_mm))
    for open_counts, closed_counts, bow_mm in shapes:
        fingers = Fingers(MODELS[model], open_counts, closed_counts, bow_mm)
        for tool_mm in np.arange(2.0, MODELS[model].stroke_mm, 1.0):
            status = task.status_of(closed_on(round(fingers.counts(tool_mm)), nominal))
            held = HeldTool(SimpleNamespace(gripper=status), has_gripper=True)
            assert held.why_not_stated(tool_mm) == ""
            assert held.why_not_stated(None) == ""


def test_another_tool_is_noted_unless_the_gripper_measures_it():
    nominal = WidthCalibration.nominal("2F-85")
    notes = []
    for measures_diameters in (False, True):
        task = GripperTask(SimpleNamespace(model=MODELS["2F-85"]), None, Felt(), None, Clock(), measures_diameters)
        status = task.status_of(closed_on(nominal.counts(40.0), nominal))
        notes.append(HeldTool(SimpleNamespace(gripper=status), has_gripper=True).why_not_stated(20.0))
    assert "a tool of 20 mm, and by the maker's figures the gripper's fingers are 40." in notes[0]
    assert notes[1] == "", "the sessions refuse it"


def closed_on(counts: int, calibration: WidthCalibration) -> GripperState:
    """Return the state of fingers that closed on an object at this position."""
    return GripperState(
        t_ns=0,
        position_counts=counts,
        width_mm=calibration.width_mm(counts),
        width_std_mm=calibration.width_std_mm,
        object=ObjectStatus.CONTACT_CLOSING,
        activation=ActivationStatus.ACTIVE,
        current_ma=None,
        fault=GripperFault(0, ""),
    )
