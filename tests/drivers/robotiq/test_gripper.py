"""The driver against the played gripper, by both ways in: real socket and real pseudo-terminal, real pymodbus.

Model time runs as fast as the loop turns, but stands still while a busy machine keeps the driver waiting for an answer;
the driver is given the same clock.
"""

import asyncio
import contextlib
from collections.abc import AsyncIterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import pytest

from drivers.emulators.robotiq.gripper import Gripper, GripperMechanics
from drivers.emulators.robotiq.modbus_face import ModbusServer
from drivers.emulators.robotiq.urcap_face import UrcapServer
from drivers.errors import DeviceLostError, DeviceNotFoundError, DriverError
from drivers.robotiq.faults import GripperFaultError, GripperRefusedError
from drivers.robotiq.gripper import RobotiqGripper
from drivers.robotiq.messages import (
    ActivationStatus,
    GoTo,
    GripperClient,
    GripperCommand,
    ObjectStatus,
    Readout,
    Request,
)
from drivers.robotiq.modbus_client import ModbusClient
from drivers.robotiq.socket_client import SocketClient
from drivers.robotiq.width import WidthCalibration
from drivers.serial_port import LinkEvent, ReconnectPolicy

STEP_S = 0.01
# Between two looks of the driver at its clock.
MOST_STEPS = 20
MECHANICS = GripperMechanics(open_counts=4.0, closed_counts=224.0)
CALIBRATION = WidthCalibration(open_counts=4.0, open_mm=140.0, closed_counts=224.0, std_mm=0.4)
WAYS = pytest.mark.parametrize("way", ["socket", "modbus"])


@dataclass
class Rig:
    model: Gripper
    server: UrcapServer | ModbusServer
    t_s: float = 0.0
    steps_left: int = MOST_STEPS
    object_mm: float | None = None
    stopped: bool = False
    driver: RobotiqGripper = field(init=False)
    events: list[LinkEvent] = field(default_factory=list)
    lost: asyncio.Event = field(default_factory=asyncio.Event)

    def clock_ns(self) -> int:
        self.steps_left = MOST_STEPS
        return round(self.t_s * 1e9)

    def on_event(self, event: LinkEvent) -> None:
        self.events.append(event)
        if not event.up:
            self.lost.set()

    def silence(self, silent: bool) -> None:
        self.server.silent = silent


@contextlib.asynccontextmanager
async def a_rig(way: str, tmp_path: Path) -> AsyncIterator[Rig]:
    model = Gripper(MECHANICS)
    server: UrcapServer | ModbusServer
    client: GripperClient
    if way == "socket":
        server = UrcapServer(model, port=0)
        await server.bring_back()
        client = SocketClient("127.0.0.1", server.port, reply_deadline_s=0.2)
    else:
        link = tmp_path / "gripper"
        server = ModbusServer(model, link)
        await server.bring_back()
        client = ModbusClient(path=str(link), reply_deadline_s=0.2)
    rig = Rig(model, server)
    driver = rig.driver = RobotiqGripper(
        client,
        CALIBRATION,
        poll_s=0.0,
        policy=ReconnectPolicy(0.001, 0.002),
        on_event=rig.on_event,
        clock_ns=rig.clock_ns,
    )
    model.between = lambda _: rig.object_mm

    async def pass_time() -> None:
        while True:
            if not rig.stopped and rig.steps_left > 0:
                rig.steps_left -= 1
                model.step(STEP_S)
                rig.t_s += STEP_S
            await asyncio.sleep(0)

    tasks = [asyncio.create_task(pass_time()), asyncio.create_task(server.run())]
    try:
        yield rig
    finally:
        await driver.close()
        for task in tasks:
            task.cancel()
        await asyncio.wait(tasks)


@WAYS
async def test_it_is_activated_moves_and_measures_what_it_grips(way: str, tmp_path: Path) -> None:
    async with a_rig(way, tmp_path) as rig:
        driver = rig.driver
        first = await driver.connect()
        assert first.activation is ActivationStatus.RESET
        with pytest.raises(GripperFaultError, match="has to be activated"):
            await driver.move(GripperCommand(50.0))
        active = await driver.activate()
        assert active.activation is ActivationStatus.ACTIVE
        assert active.fault.code == 0
        # The fingers opened and closed for it.
        assert active.width_mm == pytest.approx(140, abs=1)

        sent = await driver.move(GripperCommand(60.0, speed_mm_s=250.0, force_n=20.0))
        assert sent.clipped == ()
        state = await driver.finish(sent)
        assert state.object is ObjectStatus.AT_TARGET
        assert state.diameter_mm is None
        assert abs(state.width_mm - 60.0) <= abs(CALIBRATION.mm_per_count) / 2 + 1e-9

        rig.object_mm = 31.7
        state = await driver.finish(await driver.move(GripperCommand(0.0, force_n=40.0)))
        assert state.object is ObjectStatus.CONTACT_CLOSING
        assert state.diameter_mm == pytest.approx(31.7, abs=abs(CALIBRATION.mm_per_count) / 2 + 1e-9)
        assert state.diameter_std_mm == CALIBRATION.width_std_mm
        assert state.current_ma is not None
        assert state.current_ma > 0
        assert rig.model.grip_force_n == pytest.approx(40.0, abs=0.5)
        # Without the object the fingers go on to their target: what they held is no longer claimed.
        rig.object_mm = None
        closed = asyncio.Event()
        while not closed.is_set():
            state = await driver.read()
            assert state.diameter_mm is None
            if state.object is ObjectStatus.AT_TARGET:
                closed.set()
        assert state.width_mm == pytest.approx(0.0, abs=0.7)


@WAYS
async def test_until_a_command_is_taken_up_the_old_contact_is_not_believed(way: str, tmp_path: Path) -> None:
    async with a_rig(way, tmp_path) as rig:
        await rig.driver.connect()
        await rig.driver.activate()
        rig.object_mm = 20.0
        await rig.driver.finish(await rig.driver.move(GripperCommand(0.0)))
        rig.stopped = True
        sent = await rig.driver.move(GripperCommand(100.0))
        # The registers still say "contact closing" of the motion before.
        assert rig.model.obj == 2
        assert (await rig.driver.read()).object is ObjectStatus.MOVING
        assert (await rig.driver.read()).diameter_mm is None
        rig.stopped = False
        assert (await rig.driver.finish(sent)).object is ObjectStatus.AT_TARGET


@WAYS
async def test_a_halted_gripper_claims_no_object(way: str, tmp_path: Path) -> None:
    async with a_rig(way, tmp_path) as rig:
        await rig.driver.connect()
        await rig.driver.activate()
        sent = await rig.driver.move(GripperCommand(0.0, speed_mm_s=30.0))
        while (await rig.driver.read()).width_mm >= 140:
            pass
        rig.stopped = True
        await rig.driver.halt()
        rig.stopped = False
        with pytest.raises(GripperRefusedError, match="took over"):
            await rig.driver.finish(sent)
        state = await rig.driver.read()
        assert state.object is ObjectStatus.UNKNOWN
        assert 0 < state.width_mm < 140


@WAYS
async def test_a_major_fault_ends_only_by_the_operators_word(way: str, tmp_path: Path) -> None:
    async with a_rig(way, tmp_path) as rig:
        driver = rig.driver
        await driver.connect()
        await driver.activate()
        sent = await driver.move(GripperCommand(0.0, speed_mm_s=30.0))
        rig.model.fail(14)
        with pytest.raises(GripperFaultError, match="too much current"):
            await driver.finish(sent)
        assert (await driver.read()).fault.name == "overcurrent"
        for refused in (driver.activate(), driver.move(GripperCommand(50.0))):
            with pytest.raises(GripperFaultError, match="too much current"):
                await refused
        assert not rig.model.command.gto or rig.model.command.pos == sent.request.position
        state = await driver.activate(operator_confirmed=True)
        assert state.fault.code == 0
        assert state.activation is ActivationStatus.ACTIVE


@WAYS
async def test_overheating_passes_without_activation(way: str, tmp_path: Path) -> None:
    async with a_rig(way, tmp_path) as rig:
        await rig.driver.connect()
        await rig.driver.activate()
        rig.model.fail(8)
        with pytest.raises(GripperFaultError, match="too hot"):
            await rig.driver.move(GripperCommand(50.0))
        rig.model.clear_minor()
        await rig.driver.finish(await rig.driver.move(GripperCommand(50.0)))


@WAYS
async def test_activating_an_active_gripper_moves_nothing(way: str, tmp_path: Path) -> None:
    async with a_rig(way, tmp_path) as rig:
        await rig.driver.connect()
        await rig.driver.activate()
        rig.object_mm = 25.0
        held = await rig.driver.finish(await rig.driver.move(GripperCommand(0.0)))
        again = await rig.driver.activate()
        assert again.position_counts == held.position_counts
        assert again.diameter_mm == held.diameter_mm


@WAYS
async def test_silence_is_a_loss_and_nothing_old_is_given_as_new(way: str, tmp_path: Path) -> None:
    async with a_rig(way, tmp_path) as rig:
        await rig.driver.connect()
        assert rig.driver.latest is not None
        rig.silence(True)
        with pytest.raises(DeviceLostError, match=r"within 0\.2 s"):
            await rig.driver.read()
        assert rig.driver.latest is None
        assert not rig.driver.connected
        # A reply that comes too late must not be taken for the next one's: the connection is closed.
        rig.silence(False)
        with pytest.raises(DeviceLostError, match="no connection"):
            await rig.driver.read()
        with pytest.raises(DeviceLostError, match="no connection"):
            await rig.driver.move(GripperCommand(10.0))
        assert (await rig.driver.connect()).seq > 0


@WAYS
async def test_it_comes_back_by_itself_and_says_so(way: str, tmp_path: Path) -> None:
    async with a_rig(way, tmp_path) as rig, contextlib.aclosing(rig.driver.states()) as states, asyncio.timeout(20):
        first = await anext(states)
        assert rig.driver.latest == first
        await rig.server.lose()
        # The next states are awaited, not made up.
        coming = asyncio.create_task(anext(states))
        await rig.lost.wait()
        assert rig.driver.latest is None
        assert not coming.done()
        lost_ns = round(rig.t_s * 1e9)
        await rig.server.bring_back()
        second = await coming
        assert second.t_ns >= lost_ns
        assert second.seq > first.seq
        openings = rig.driver.facts()["openings"]
        assert openings == 2
        ups = [event.up for event in rig.events]
        assert ups[0]
        assert ups[-1]
        assert not all(ups)
        # The first loss is news, its repetitions are not.
        assert [event.repeated for event in rig.events if not event.up][1:] == [True] * (ups.count(False) - 1)


@WAYS
async def test_a_loss_that_a_command_meets_is_told_as_well(way: str, tmp_path: Path) -> None:
    async with a_rig(way, tmp_path) as rig, contextlib.aclosing(rig.driver.states()) as states, asyncio.timeout(20):
        await anext(states)
        await rig.driver.activate()
        rig.silence(True)
        with pytest.raises(DeviceLostError) as met:
            await rig.driver.move(GripperCommand(50.0))
        rig.silence(False)
        await anext(states)
        assert [(event.up, event.sentence == str(met.value)) for event in rig.events] == [
            (True, False),
            (False, True),
            (True, False),
        ]
        assert rig.driver.facts()["last_loss"] == str(met.value)


@WAYS
async def test_states_are_polled_while_a_command_runs(way: str, tmp_path: Path) -> None:
    async with a_rig(way, tmp_path) as rig, contextlib.aclosing(rig.driver.states()) as states, asyncio.timeout(20):
        await anext(states)
        activating = asyncio.create_task(rig.driver.activate())
        seen = [await anext(states)]
        while not activating.done():
            seen.append(await anext(states))
        assert ActivationStatus.ACTIVATING in {state.activation for state in seen}
        assert (await activating).activation is ActivationStatus.ACTIVE
        assert [state.seq for state in seen] == sorted({state.seq for state in seen})


@WAYS
async def test_a_call_that_is_cancelled_does_not_leave_its_answer_to_the_next(way: str, tmp_path: Path) -> None:
    async with a_rig(way, tmp_path) as rig:
        await rig.driver.connect()
        rig.silence(True)
        reading = asyncio.create_task(rig.driver.read())
        await asyncio.sleep(0)
        reading.cancel()
        await asyncio.wait([reading])
        rig.silence(False)
        with contextlib.suppress(DriverError):
            await rig.driver.read()
        await rig.driver.connect()
        assert (await rig.driver.read()).position_counts == rig.model.pos


@WAYS
async def test_nobody_there_is_said_in_a_sentence(way: str, tmp_path: Path) -> None:
    async with a_rig(way, tmp_path) as rig:
        await rig.server.lose()
        with pytest.raises(DeviceNotFoundError, match="There is no"):
            await rig.driver.connect()


async def test_a_gripper_without_power_is_not_read_as_zero(tmp_path: Path) -> None:
    async with a_rig("socket", tmp_path) as rig:
        await rig.driver.connect()
        assert isinstance(rig.server, UrcapServer)
        rig.server.no_data = True
        with pytest.raises(DeviceLostError, match="no data of the gripper"):
            await rig.driver.read()


async def test_a_damaged_modbus_reply_is_not_believed(tmp_path: Path) -> None:
    async with a_rig("modbus", tmp_path) as rig:
        await rig.driver.connect()
        assert isinstance(rig.server, ModbusServer)
        rig.server.damage_next = True
        with pytest.raises(DeviceLostError):
            await rig.driver.read()
        await rig.driver.connect()


async def test_the_gripper_notices_a_master_that_was_silent(tmp_path: Path) -> None:
    async with a_rig("modbus", tmp_path) as rig:
        await rig.driver.connect()
        rig.stopped = True
        rig.model.watchdog_s = 1.0
        rig.model.step(1.1)
        assert (await rig.driver.read()).fault.name == "no communication"
        assert (await rig.driver.read()).fault.code == 0


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
async def test_a_command_that_is_no_number_is_refused(bad: float) -> None:
    driver = RobotiqGripper(SocketClient("127.0.0.1"), CALIBRATION)
    for command in (GripperCommand(bad), GripperCommand(1.0, speed_mm_s=bad), GripperCommand(1.0, force_n=bad)):
        with pytest.raises(GripperRefusedError, match="no command"):
            driver.clip(command)


async def test_what_is_clipped_is_said_and_what_is_sent_is_returned() -> None:
    driver = RobotiqGripper(SocketClient("127.0.0.1"), CALIBRATION)
    sent = driver.clip(GripperCommand(500.0, speed_mm_s=1.0, force_n=1e9))
    assert (sent.request.position, sent.request.speed, sent.request.force) == (0, 0, 255)
    assert (sent.speed_mm_s, sent.force_n) == (30.0, 125.0)
    assert sent.width_mm == pytest.approx(CALIBRATION.width_mm(0))
    assert [sentence.split()[1] for sentence in sent.clipped] == ["width", "speed", "force"]


class Counted:
    """A gripper that stands at its target, and how it was asked."""

    name = "here"

    def __init__(self) -> None:
        self.asked: list[str] = []
        self.readout = Readout(True, True, ActivationStatus.ACTIVE, ObjectStatus.AT_TARGET, 0, 100, 100, 0)

    async def connect(self) -> None: ...

    async def close(self) -> None: ...

    async def read(self) -> Readout:
        self.asked.append("whole")
        return self.readout

    async def read_again(self, before: Readout) -> Readout:
        assert before == self.readout
        self.asked.append("again")
        return self.readout

    async def write(self, request: Request) -> None:
        self.asked.append("write")
        if isinstance(request, GoTo):
            self.readout = replace(self.readout, pre=request.position, obj=ObjectStatus.MOVING)


async def test_a_gripper_that_stands_is_asked_as_a_whole_every_fifth_time_and_after_each_request() -> None:
    client = Counted()
    gripper = RobotiqGripper(client, CALIBRATION, poll_s=0.0)
    async with contextlib.aclosing(gripper.states()) as states:
        for _ in range(12):
            await anext(states)
        assert "".join(one[0] for one in client.asked) == "wwaaawaaaawa"
        client.asked.clear()
        await gripper.move(GripperCommand(50.0))
        for _ in range(3):
            await anext(states)
        assert client.asked == ["whole", "write", "whole", "whole", "whole"], "it moves"
        client.readout = replace(client.readout, obj=ObjectStatus.AT_TARGET)
        client.asked.clear()
        await anext(states)
        await gripper.halt()
        await anext(states)
        assert client.asked == ["whole", "write", "whole"]
