"""Commands to the gripper on both connections."""

import asyncio
import contextlib
from dataclasses import replace

import pytest

from shearloop.drivers.robotiq import messages
from shearloop.drivers.robotiq.gripper import RobotiqGripper
from shearloop.drivers.robotiq.socket_client import SocketClient
from shearloop.emulators.gripper import GripperRegisters
from shearloop.errors import NotBegunError
from tests.drivers.robotiq.gripper_rig import CALIBRATION, STEP_S, WAYS, Rig, a_rig


@WAYS
async def test_gripper_activates_moves_and_measures_an_object(way, tmp_path):
    async with a_rig(way, tmp_path) as rig:
        driver = rig.driver
        first = await driver.connect()
        assert first.activation is messages.ActivationStatus.RESET
        with pytest.raises(messages.GripperFaultError, match="has to be activated"):
            await driver.move(messages.GripperCommand(50.0))
        active = await driver.activate(may_drop=True)
        assert active.activation is messages.ActivationStatus.ACTIVE
        assert active.fault.code == 0
        # The fingers opened and closed for it.
        assert active.width_mm == pytest.approx(140, abs=1)

        sent = await driver.move(messages.GripperCommand(60.0, speed_mm_per_s=250.0, force_n=20.0))
        state = await driver.finish(sent)
        assert state.object is messages.ObjectStatus.AT_TARGET
        assert state.diameter_mm is None
        assert abs(state.width_mm - 60.0) <= abs(CALIBRATION.mm_per_count) / 2 + 1e-9

        rig.model.object_mm = 31.7
        state = await driver.finish(await driver.move(messages.GripperCommand(0.0, force_n=40.0)))
        assert state.object is messages.ObjectStatus.CONTACT_CLOSING
        assert state.diameter_mm == pytest.approx(31.7, abs=abs(CALIBRATION.mm_per_count) / 2 + 1e-9)
        assert state.diameter_std_mm == CALIBRATION.width_std_mm
        assert state.current_ma > 0
        assert rig.model.grip_force_n == pytest.approx(40.0, abs=0.5)
        # Without the object the fingers go on to their target: what they held is no longer claimed.
        rig.model.object_mm = None
        closed = asyncio.Event()
        while not closed.is_set():
            state = await driver.read()
            assert state.diameter_mm is None
            if state.object is messages.ObjectStatus.AT_TARGET:
                closed.set()
        assert state.width_mm == pytest.approx(0.0, abs=0.7)


@WAYS
async def test_a_grip_that_another_program_closes_is_a_grip(way, tmp_path):
    """The pendant opens the gripper, closes it on a tool, and then tighter."""
    async with a_rig(way, tmp_path, active=True) as rig:
        driver, model = rig.driver, rig.model
        await driver.finish(await driver.move(messages.GripperCommand(60.0)))
        model.object_mm = 31.7
        for others, position in enumerate((0, 240, 250), 1):
            model.write(replace(model.command, pos=position))
            state = await driver.read()
            while state.others_requests < others or state.moves:
                state = await driver.read()
            assert state.others_requests == others
            assert state.object.value == model.obj
        assert state.object is messages.ObjectStatus.CONTACT_CLOSING
        assert state.diameter_mm == pytest.approx(31.7, abs=0.5)


@WAYS
async def test_a_motion_that_another_program_takes_over_does_not_end_well(way, tmp_path):
    async with a_rig(way, tmp_path, active=True) as rig:
        sent = await rig.driver.move(messages.GripperCommand(0.0, speed_mm_per_s=30.0))
        while (await rig.driver.read()).width_mm >= 140:
            pass
        rig.model.write(replace(rig.model.command, pos=3, spe=255))
        with pytest.raises(messages.GripperRefusedError, match="Another program commanded the gripper"):
            await rig.driver.finish(sent)


@WAYS
async def test_halted_gripper_reports_no_object(way, tmp_path):
    async with a_rig(way, tmp_path, active=True) as rig:
        sent = await rig.driver.move(messages.GripperCommand(0.0, speed_mm_per_s=30.0))
        while (await rig.driver.read()).width_mm >= 140:
            pass
        rig.stopped = True
        await rig.driver.halt()
        rig.stopped = False
        with pytest.raises(messages.GripperRefusedError, match="took over"):
            await rig.driver.finish(sent)
        state = await rig.driver.read()
        assert state.object is messages.ObjectStatus.UNKNOWN
        assert 0 < state.width_mm < 140


@pytest.mark.parametrize("requested", [[], [messages.GripperAction.ACTIVATE]], ids=["reset", "about to activate"])
@WAYS
async def test_halting_a_gripper_that_is_not_active_moves_nothing(way, requested, tmp_path):
    """A stop meets an activation before its beginning."""
    async with a_rig(way, tmp_path, connected=True) as rig:
        before_mm = rig.model.width_mm
        # The status shows a command only after the next step.
        rig.stopped = True
        for request in requested:
            await rig.driver.client.write(request)
        await rig.driver.halt()
        rig.stopped = False
        for _ in range(10):
            assert (await rig.driver.read()).activation is messages.ActivationStatus.RESET
            rig.monotonic_ns()
        assert rig.model.width_mm == before_mm


@WAYS
async def test_a_halt_of_a_gripper_that_has_restarted_activates_nothing(way, tmp_path):
    """Its controller was without power for a moment, and the link was not: its registers are 0, the fingers stay."""
    async with a_rig(way, tmp_path, active=True) as rig:
        await _grip(rig)
        await rig.driver.halt()
        await _stays(rig)


@WAYS
async def test_a_move_of_a_gripper_that_has_restarted_activates_nothing(way, tmp_path):
    """The readout before is of before the restart: it shows an active gripper."""
    async with a_rig(way, tmp_path, active=True) as rig:
        await _grip(rig)
        await rig.driver.client.write(messages.GripperMove(200, 255, 100))
        await _stays(rig)


@pytest.mark.parametrize("active", [True, False])
@WAYS
async def test_a_request_that_is_not_permitted_any_more_as_it_is_sent_changes_nothing(way, active, tmp_path):
    """A daemon may stand still at any moment between a command and its last byte."""
    async with a_rig(way, tmp_path, active=active, connected=True) as rig:
        if active:
            await rig.driver.finish(await rig.driver.move(messages.GripperCommand(0.0)))
            await rig.driver.finish(await rig.driver.move(messages.GripperCommand(60.0)))
        before, command, read = await rig.driver.read(), rig.model.command, rig.driver.client.read
        stood: list[bool] = []

        async def read_at_length(*, whole: bool = False) -> messages.Readout:
            stood.append(True)
            return await read(whole=whole)

        def permit() -> None:
            if stood:
                raise NotBegunError("the daemon stood still")

        rig.driver.client.read = read_at_length
        closing = messages.GripperCommand(20.0)
        with pytest.raises(NotBegunError, match="the daemon stood still"):
            await (rig.driver.move(closing, permit) if active else rig.driver.activate(may_drop=True, permit=permit))
        for _ in range(10):
            state = await rig.driver.read()
            rig.monotonic_ns()
        assert rig.model.command == command
        assert replace(state, t_ns=0) == replace(before, t_ns=0)
        assert rig.driver.connected
        await rig.driver.activate(may_drop=True)
        await rig.driver.finish(await rig.driver.move(messages.GripperCommand(30.0)))
        assert rig.model.width_mm == pytest.approx(30.0, abs=1.0)


@pytest.mark.parametrize(
    ("way", "activates", "polls"),
    [
        ("socket", False, True),
        ("socket", True, True),
        ("modbus", False, True),
        ("modbus", True, True),
        # A move over Modbus is preceded by a reading of its own.
        ("modbus", False, False),
    ],
)
async def test_a_request_that_is_called_off_before_it_is_sent_changes_nothing(way, activates, polls, tmp_path):
    """A stop comes while the gripper still answers a question, for which the request waits."""
    async with a_rig(way, tmp_path, active=True) as rig:
        command, read = rig.model.command, rig.driver.client.read
        asked, answers, reads = asyncio.Event(), asyncio.Event(), 0

        async def read_at_length(*, whole: bool = False) -> messages.Readout:
            nonlocal reads
            reads += 1
            if reads == 2:
                asked.set()
                await answers.wait()
            return await read(whole=whole)

        rig.driver.client.read = read_at_length
        closing = messages.GripperCommand(20.0)
        act = rig.driver.activate(operator_confirmed=True) if activates else rig.driver.move(closing)
        moving = asyncio.create_task(act)
        polling = asyncio.create_task(rig.driver.poll() if polls else asked.wait())
        await asked.wait()
        for _ in range(100):
            await asyncio.sleep(0)
        moving.cancel()
        answers.set()
        await asyncio.wait([moving, polling])
        assert moving.cancelled()
        await rig.driver.read()
        assert rig.model.command == command
        assert rig.driver.connected


@WAYS
async def test_a_halt_that_is_called_off_is_sent(way, tmp_path):
    """The end of the daemon does not wait for it for ever, and the fingers may not go on."""
    async with a_rig(way, tmp_path, active=True) as rig:
        await rig.driver.move(messages.GripperCommand(0.0, speed_mm_per_s=30.0))
        polling = asyncio.create_task(rig.driver.poll())
        halting = asyncio.create_task(rig.driver.halt())
        await asyncio.sleep(0)
        halting.cancel()
        await asyncio.wait([polling, halting])
        await rig.driver.read()
        assert not rig.model.command.gto


@WAYS
async def test_a_halt_right_after_a_reset_activates_nothing(way, tmp_path):
    """The status shows the reset only after the next step."""
    async with a_rig(way, tmp_path, active=True) as rig:
        await _grip(rig, restarts=False)
        rig.stopped = True
        await rig.driver.client.write(messages.GripperAction.RESET)
        await rig.driver.client.read(whole=True)
        await rig.driver.client.write(messages.GripperAction.HALT)
        rig.stopped = False
        await _stays(rig)


async def _grip(rig: Rig, *, restarts: bool = True) -> None:
    """Hold an object; then the gripper's controller restarts, unseen by the driver."""
    rig.model.object_mm = 30.0
    await rig.driver.finish(await rig.driver.move(messages.GripperCommand(10.0)))
    if restarts:
        rig.model.write(GripperRegisters())
        rig.model.step(STEP_S)


async def _stays(rig: Rig) -> None:
    """Look on while an activation would have opened the fingers."""
    for _ in range(20):
        state = await rig.driver.read()
        assert state.activation is messages.ActivationStatus.RESET
        assert rig.model.width_mm == pytest.approx(30.0, abs=0.1)
        rig.monotonic_ns()


@WAYS
async def test_major_fault_needs_the_operators_confirmation(way, tmp_path):
    async with a_rig(way, tmp_path, active=True) as rig:
        driver = rig.driver
        sent = await driver.move(messages.GripperCommand(0.0, speed_mm_per_s=30.0))
        rig.model.fail(14)
        with pytest.raises(messages.GripperFaultError, match="too much current"):
            await driver.finish(sent)
        assert (await driver.read()).fault.code == 14
        for refused in (driver.activate(), driver.move(messages.GripperCommand(50.0))):
            with pytest.raises(messages.GripperFaultError, match="too much current"):
                await refused
        assert not rig.model.command.gto or rig.model.command.pos == sent.position
        state = await driver.activate(operator_confirmed=True)
        assert state.fault.code == 0
        assert state.activation is messages.ActivationStatus.ACTIVE
        # The fingers stay open: the move of before the fault is over, and something may be between them.
        for _ in range(50):
            rig.model.step(STEP_S)
        assert rig.model.width_mm == pytest.approx(state.width_mm, abs=1.0)
        assert rig.model.width_mm > 100


@WAYS
async def test_halt_after_a_failed_activation_keeps_the_fault(way, tmp_path):
    """The operator has to confirm that the fingers are clear."""
    async with a_rig(way, tmp_path, connected=True) as rig:
        activation = asyncio.create_task(rig.driver.activate(may_drop=True))
        while rig.model.sta != 1:  # noqa: ASYNC110 - the model is looked at, as it moves
            await asyncio.sleep(0)
        rig.model.fail(13)
        with pytest.raises(messages.GripperFaultError, match="activation failed"):
            await activation
        await rig.driver.halt()
        rig.model.step(STEP_S)
        assert (await rig.driver.read()).fault.code == 13
        with pytest.raises(messages.GripperFaultError, match="operator has to confirm"):
            await rig.driver.activate()


NEEDS_ACTIVATION = {
    "too hot": (lambda model: model.fail(8), messages.GripperTooHotError, "too hot"),
    "inactive": (lambda model: model.write(GripperRegisters()), messages.GripperInactiveError, "has to be activated"),
}


@WAYS
@pytest.mark.parametrize("state", NEEDS_ACTIVATION)
async def test_a_gripper_that_may_hold_an_object_is_activated_only_where_it_may_drop(way, state, tmp_path):
    """Its activation opens the fingers, and an inactive gripper cannot say whether it holds something."""
    bring_about, refusal, why = NEEDS_ACTIVATION[state]
    async with a_rig(way, tmp_path, active=True) as rig:
        model = rig.model
        model.object_mm = 40.0
        await rig.driver.finish(await rig.driver.move(messages.GripperCommand(5.0)))
        bring_about(model)
        model.step(STEP_S)
        await rig.driver.read()
        before = model.width_mm, model.sta, model.taken.act
        with pytest.raises(refusal, match=why):
            await rig.driver.activate()
        await rig.driver.read()
        assert (model.width_mm, model.sta, model.taken.act) == before
        await rig.driver.activate(may_drop=True)
        await rig.driver.finish(await rig.driver.move(messages.GripperCommand(140.0)))
        assert model.width_mm > 100


@WAYS
async def test_activating_an_active_gripper_moves_nothing(way, tmp_path):
    async with a_rig(way, tmp_path, active=True) as rig:
        rig.model.object_mm = 25.0
        held = await rig.driver.finish(await rig.driver.move(messages.GripperCommand(0.0)))
        again = await rig.driver.activate()
        assert again.position_counts == held.position_counts
        assert again.diameter_mm == held.diameter_mm


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
@pytest.mark.parametrize("name", ["width_mm", "speed_mm_per_s", "force_n"])
async def test_command_that_is_not_finite_is_refused(bad, name):
    driver = RobotiqGripper(SocketClient("127.0.0.1"), CALIBRATION)
    with pytest.raises(messages.GripperRefusedError, match="no command"):
        driver.request_of(messages.GripperCommand(**{"width_mm": 1.0, name: bad}))


async def test_commands_are_clipped():
    driver = RobotiqGripper(SocketClient("127.0.0.1"), CALIBRATION)
    sent = driver.request_of(messages.GripperCommand(500.0, speed_mm_per_s=1.0, force_n=1e9))
    assert sent == messages.GripperMove(0, 0, 255)


@WAYS
@pytest.mark.parametrize(
    ("command", "holds", "others"),
    [({"gto": False}, False, 0), ({"pos": 250}, True, 1)],
    ids=["halted", "sent further"],
)
async def test_command_of_another_master_is_seen_at_the_next_poll(way, tmp_path, command, holds, others):
    """Position and object stay the same, but the target is no longer ours. A halted gripper tells of no object."""
    async with a_rig(way, tmp_path) as rig, contextlib.aclosing(rig.driver.states()) as states, asyncio.timeout(20):
        await anext(states)
        await rig.driver.activate(may_drop=True)
        rig.model.object_mm = 20.0
        await rig.driver.finish(await rig.driver.move(messages.GripperCommand(0.0)))
        rig.stopped = True
        while (await anext(states)).object is not messages.ObjectStatus.CONTACT_CLOSING:
            pass
        rig.model.write(replace(rig.model.command, **command))
        rig.model.step(STEP_S)
        assert rig.model.obj == messages.ObjectStatus.CONTACT_CLOSING
        state = await anext(states)
        assert (state.diameter_mm is not None, state.others_requests) == (holds, others)
