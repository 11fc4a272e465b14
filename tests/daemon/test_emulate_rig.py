"""The whole rig in a process of its own, met by the real clients on its real ports."""

import asyncio
import contextlib
import dataclasses
import json
import signal
import time
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Iterator
from contextlib import AsyncExitStack, aclosing, asynccontextmanager
from pathlib import Path
from typing import Generic, Self, TypeVar

import numpy as np
import pytest
from numpy.typing import NDArray

from bank.bank_file import BankDefinition, write_bank
from bank.calibration import Calibration
from bank.channels import CHANNELS, ZERO_SLOTS, channels_of_line
from daemon.cli import main
from drivers.eit_kit import EitKit, Frame
from drivers.errors import DeviceLostError, DriverError
from drivers.hx711 import LoadCalibration, LoadSample
from drivers.load_cell import LoadCell
from drivers.robotiq.gripper import RobotiqGripper
from drivers.robotiq.messages import GripperCommand, GripperState, ObjectStatus
from drivers.robotiq.modbus_client import ModbusClient
from drivers.robotiq.socket_client import SocketClient
from drivers.robotiq.width import WidthCalibration
from drivers.serial_port import LinkEvent
from drivers.ur.client import LinkEvent as RobotLink
from drivers.ur.client import UrRobot
from drivers.ur.messages import Enable, RobotState, Stop, Unlock, WristSpeed
from drivers.ur.settings import read_settings
from tests.emulator_process import EmulatorProcess, Event

pytestmark = pytest.mark.real_time

# Gel, fingers and boards; the arm moves as fast as its loop bears.
SPEED = 10
PACE = ("--speed", str(SPEED), "--arm-speed", "3", "--rate-hz", "250", "--unlock-wait-s", "0.2", "--power-on-s", "0.1")
DEADLINE_S = 30
N_FRAMES, N_SAMPLES = 6, 20
PERIOD_NS = round(0.5408e9 / SPEED)
CM_PER_NM = (1.25 - 1.85) / 0.14
PATTERN = np.cos(CHANNELS @ [0.3, 0.1, 0.2, 0.5])
HOMOGENEOUS = 0.5 * np.sin(CHANNELS @ [0.1, 0.2, 0.3, 0.4]) + 0.9
# What a centimetre of σ does to a channel in volts, by the synthesiser's scaling of a bank.
VOLTS_PER_CM = 0.17 * 0.13 / np.abs(HOMOGENEOUS).mean() * PATTERN
# Our sketch's scale: 420 counts a gram on a lever arm of 35 mm.
COUNTS = LoadCalibration(tare_counts=81_250.0, scale_n_per_count=9.80665 / 420e3)


ValueT = TypeVar("ValueT")


class RigProcess(EmulatorProcess):
    """The rig, and what is really so in it."""

    run_dir: Path

    async def truth(self, condition: Callable[[Event], bool] = lambda _: True) -> Event:
        """Return what is so now, or as soon as it fulfils a condition: what is ordered befalls the next cycle."""
        async with asyncio.timeout(DEADLINE_S):
            while not condition(truth := await self.ask("truth", "truth")):
                continue
            return truth


@pytest.fixture(scope="module")
def bank(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bank whose signals grow with σ along a known pattern."""
    path = tmp_path_factory.mktemp("bank") / "rig.bank"
    sigma = np.array([0.9, 2.3])
    definition = BankDefinition("0" * 64, "gaussian_derivative", np.array([3.0, 4.0]), sigma)
    signals = np.broadcast_to(sigma[None, :, None] * PATTERN, (2, 2, 896)).astype(np.float32)
    write_bank(path, definition, HOMOGENEOUS, np.full((2, 2), 0.5), np.ones((2, 2), bool), signals)
    return path


@pytest.fixture(scope="module")
def rig_process(bank: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[RigProcess]:
    run_dir = tmp_path_factory.mktemp("run")
    process = RigProcess("rig", "--bank", str(bank), "--run-dir", str(run_dir), *PACE, network=128, ready="rig ready")
    process.run_dir = run_dir
    yield process
    assert process.close() == 0, "it ends when its input does"
    assert not list(run_dir.iterdir()), "and leaves no port behind"


@pytest.fixture
def rig(rig_process: RigProcess) -> Iterator[RigProcess]:
    """The module's rig, without faults after the test."""
    yield rig_process
    asyncio.run(rig_process.fault("normal"))


@asynccontextmanager
async def open_gripper_at(rig: RigProcess) -> AsyncIterator[RobotiqGripper]:
    gripper = RobotiqGripper(SocketClient(rig.host), WidthCalibration.nominal(), poll_s=0.02)
    try:
        await gripper.connect()
        await gripper.activate()
        await release(gripper)
        yield gripper
    finally:
        await gripper.close()


def kit_at(rig: RigProcess, side: str, on_event: Callable[[LinkEvent], None] = lambda _: None) -> EitKit:
    return EitKit(
        zero_slots=ZERO_SLOTS, path=rig.run_dir / f"eit-{side}", frame_period_s=0.5408 / SPEED, on_event=on_event
    )


@asynccontextmanager
async def arm_at(rig: RigProcess, on_link: Callable[[RobotLink], None] | None = None) -> AsyncIterator[UrRobot]:
    pytest.importorskip("rtde_control", reason="ur-rtde has wheels for CPython up to 3.12 on x86-64 only")
    settings = read_settings(Path(__file__).parents[2] / "config" / "ur.yaml")
    arm = UrRobot(dataclasses.replace(settings, host=rig.host), on_link)
    task = asyncio.create_task(arm.run())
    try:
        await until(arm, lambda state: state.program_running and not state.recovering)
        assert (await arm.send(Enable())).accepted
        yield arm
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


async def until(arm: UrRobot, condition: Callable[[RobotState], bool]) -> RobotState:
    async with asyncio.timeout(DEADLINE_S):
        while not condition(state := await arm.next_state()):
            continue
        return state


async def twist(arm: UrRobot, by_rad: float) -> None:
    """Turn the wrist by an angle, and return when it rests."""
    target_rad = (await arm.next_state()).wrist_rad + by_rad
    async with asyncio.timeout(DEADLINE_S):
        while abs(missing_rad := target_rad - (await arm.next_state()).wrist_rad) > 0.002:
            speed = float(np.clip(4.0 * missing_rad, -0.2, 0.2))
            reply = await arm.send(WristSpeed(speed, 2.0))
            assert reply.accepted, reply.refused
    assert (await arm.send(Stop(4.0))).accepted
    await until(arm, lambda state: state.motion == "idle")


async def grip(gripper: RobotiqGripper) -> GripperState:
    return await gripper.finish(await gripper.move(GripperCommand(0.0, 60.0, 40.0)))


async def release(gripper: RobotiqGripper) -> None:
    await gripper.finish(await gripper.move(GripperCommand(140.0)))


class Reader(Generic[ValueT]):
    """Reads a board all the time, as the daemon does, and hands over what comes from a moment on."""

    def __init__(self, values: AsyncGenerator[ValueT]) -> None:
        self._values = values
        self._wanted: asyncio.Queue[ValueT] | None = None

    async def __aenter__(self) -> Self:
        self._task = asyncio.create_task(self._run())
        return self

    async def __aexit__(self, *_: object) -> None:
        self._task.cancel()
        await asyncio.gather(self._task, return_exceptions=True)

    async def take(self, n: int) -> list[ValueT]:
        self._wanted = asyncio.Queue()
        async with asyncio.timeout(DEADLINE_S):
            return [await self._wanted.get() for _ in range(n)]

    async def _run(self) -> None:
        async with aclosing(self._values) as arriving:
            async for value in arriving:
                if self._wanted is not None:
                    self._wanted.put_nowait(value)


async def mean_of(frames: Reader[Frame]) -> NDArray[np.float64]:
    """Return the mean of the next frames that began after it was asked for: on a busy machine several are under way."""
    asked_ns, found = time.monotonic_ns(), []
    while len(found) < N_FRAMES:
        found += [frame.channels for frame in await frames.take(1) if frame.t_mid_ns - PERIOD_NS > asked_ns]
    return np.mean(found, axis=0)


async def torque_of(samples: Reader[LoadSample]) -> float:
    return float(np.mean([sample.torque_nm for sample in (await samples.take(N_SAMPLES + 1))[1:]]))


def sigma_of(change: NDArray[np.float64]) -> float:
    """Return the change of σ in cm behind a change of the channels, by least squares."""
    return float(change @ VOLTS_PER_CM / (VOLTS_PER_CM @ VOLTS_PER_CM))


async def test_a_twist_is_felt_by_load_cell_wrench_and_both_fingertips_and_is_gone_with_the_grip(
    rig: RigProcess,
) -> None:
    async with AsyncExitStack() as stack:
        arm = await stack.enter_async_context(arm_at(rig))
        gripper = await stack.enter_async_context(open_gripper_at(rig))
        right = await stack.enter_async_context(Reader(kit_at(rig, "right").frames()))
        left = await stack.enter_async_context(Reader(kit_at(rig, "left").frames()))
        load = await stack.enter_async_context(Reader(LoadCell(COUNTS, path=rig.run_dir / "load-cell").samples()))
        free = [await mean_of(right), await mean_of(left)]
        held = await grip(gripper)
        assert held.object is ObjectStatus.CONTACT_CLOSING
        assert held.diameter_mm == pytest.approx(20.0, abs=1.0)
        rest = [await mean_of(right), await mean_of(left)]
        assert [sigma_of(frame - idle) for frame, idle in zip(rest, free, strict=True)] == [
            pytest.approx(1.85, rel=0.02),
            pytest.approx(1.85, rel=0.02),
        ]
        assert await torque_of(load) == pytest.approx(0.0, abs=0.0005)

        origin_rad = (await rig.truth())["wrist_rad"]
        await twist(arm, 0.1)
        before = await rig.truth()
        frames = [await mean_of(right), await mean_of(left)]
        torque_nm = await torque_of(load)
        state = await arm.next_state()
        after = await rig.truth()
        # Gel and joint in series; the gel relaxes meanwhile, by a twelfth in the end.
        quick_nm = (before["wrist_rad"] - origin_rad) / (1 / 0.8 + 1 / 20)
        assert quick_nm == pytest.approx(0.077, rel=0.1)
        assert 0.9 * quick_nm < after["torque_nm"] < before["torque_nm"] < quick_nm
        assert after["torque_nm"] - 0.001 < torque_nm < before["torque_nm"] + 0.001
        assert -before["torque_nm"] - 1e-6 < state.wrist_torque_nm < -after["torque_nm"] + 1e-6, "the tool resists"
        expected = CM_PER_NM * (before["shear_torque_nm"] + after["shear_torque_nm"]) / 2
        assert sigma_of(frames[0] - rest[0]) == pytest.approx(expected, rel=0.05)
        assert sigma_of(frames[1] - rest[1]) == pytest.approx(-expected, rel=0.05)

        await release(gripper)
        assert (await rig.truth(lambda truth: not truth["gripped"]))["torque_nm"] == 0.0
        assert await torque_of(load) == pytest.approx(0.0, abs=0.0005)
        assert (await arm.next_state()).wrist_torque_nm == pytest.approx(0.0, abs=1e-9)
        assert abs(sigma_of(await mean_of(right) - free[0])) < 0.02


async def test_disturbances_reach_the_tool_and_robot_faults_the_robot(rig: RigProcess) -> None:
    async with AsyncExitStack() as stack:
        gripper = await stack.enter_async_context(open_gripper_at(rig))
        load = await stack.enter_async_context(Reader(LoadCell(COUNTS, path=rig.run_dir / "load-cell").samples()))
        await grip(gripper)
        await rig.fault("kick 0.05")
        truth = await rig.truth(lambda truth: bool(truth["torque_nm"]))
        assert truth["torque_nm"] == pytest.approx(0.05, rel=0.05)
        assert await torque_of(load) == pytest.approx(0.05, rel=0.08)
        links: asyncio.Queue[RobotLink] = asyncio.Queue()
        async with arm_at(rig, links.put_nowait) as arm:
            await until(arm, lambda state: state.wrist_torque_nm < -0.04)
            await rig.fault("slip 0.01")
            await until(arm, lambda state: -0.02 < state.wrist_torque_nm < 0.0)
            assert (await rig.truth())["slipped_rad"] > 0.02
            await rig.fault("protective-stop")
            await until(arm, lambda state: state.protective_stop)
            await rig.event("protective-stop", 0)
            await rig.fault("robot emergency-stop")
            await until(arm, lambda state: state.emergency_stop)
            await rig.fault("release")
            async with asyncio.timeout(DEADLINE_S):
                while not (await arm.send(Unlock())).accepted:
                    await arm.next_state()
            await rig.fault("drop-rtde")
            async with asyncio.timeout(DEADLINE_S):
                while (await links.get()).status != "down":
                    continue
        await rig.fault("joint seized")
        assert (await rig.truth())["joint"] == "seized"
        await rig.fault("joint lever")


async def test_gripper_faults_reach_the_gripper(rig: RigProcess) -> None:
    async with asyncio.timeout(DEADLINE_S), open_gripper_at(rig) as gripper:
        await grip(gripper)
        await rig.fault("gripper drop")
        while (await gripper.read()).object is not ObjectStatus.AT_TARGET:
            continue
        assert not (await rig.truth())["gripped"]
        await rig.fault("object 30")
        await rig.fault("gripper fault 12")
        state = await gripper.read()
        assert (state.fault.code, state.fault.needs_activation) == (12, True)
        await gripper.activate(operator_confirmed=True)
        assert (await grip(gripper)).diameter_mm == pytest.approx(30.0, abs=1.0)
        await rig.fault("unplug gripper")
        with pytest.raises(DeviceLostError):
            await _read_on(gripper)
        await rig.fault("replug gripper")
        while not gripper.connected:
            with contextlib.suppress(DriverError):
                await gripper.connect()
        await rig.fault("silence gripper")
        with pytest.raises(DeviceLostError, match="gave no whole answer"):
            await gripper.read()
        await rig.fault("object 20")


async def _read_on(gripper: RobotiqGripper) -> None:
    while True:
        await gripper.read()


async def test_boards_fall_silent_vanish_and_come_back(rig: RigProcess) -> None:
    async with AsyncExitStack() as stack:
        told: asyncio.Queue[LinkEvent] = asyncio.Queue()
        losses: asyncio.Queue[LinkEvent] = asyncio.Queue()
        kit, other = kit_at(rig, "right", told.put_nowait), kit_at(rig, "left")
        cell = LoadCell(COUNTS, path=rig.run_dir / "load-cell", on_event=losses.put_nowait)
        right = await stack.enter_async_context(Reader(kit.frames()))
        left = await stack.enter_async_context(Reader(other.frames()))
        load = await stack.enter_async_context(Reader(cell.samples()))
        for each in (right, left, load):
            await each.take(1)
        assert told.get_nowait().up
        assert losses.get_nowait().up
        for line in ("unplug right", "silence left", "silence load"):
            await rig.fault(line)
        async with asyncio.timeout(DEADLINE_S):
            assert not (await told.get()).up
            assert "has sent nothing" in (await losses.get()).sentence
            # A silent board is started again by its driver, without being lost.
            while not other.facts()["silences"]:
                await left.take(1)
            await rig.fault("replug right")
            await rig.fault("normal")
            while not (await told.get()).up:
                continue
            while not (await losses.get()).up:
                continue
            for each in (right, left, load):
                await each.take(2)
            await rig.fault("right cut-line")
            while "wrong_count" not in kit.facts()["errors"]:
                await right.take(1)
            assert other.facts()["errors"] == {}


async def test_the_modbus_gripper_the_papers_sketch_a_calibration_and_the_truth_in_a_file(
    bank: Path, tmp_path: Path
) -> None:
    from bank.bank_file import Bank

    sigma = np.linspace(1.0, 2.0, 20)
    calibration = tmp_path / "calibration.yaml"
    Calibration.fit(Bank.open(bank).identity, "synthetic", torque=(sigma, 0.4 - 0.2 * sigma)).save(calibration)
    run_dir, truth = tmp_path / "run", tmp_path / "truth.jsonl"
    arguments = ("--bank", str(bank), "--run-dir", str(run_dir), *PACE, "--gripper", "modbus", "--paper-sketch")
    files = ("--truth", str(truth), "--calibration", str(calibration))
    rig = RigProcess(
        "rig", *arguments, *files, "--diameter-mm", "40", "--gel-stiffness", "0.4", network=192, ready="rig ready"
    )
    rig.run_dir = run_dir
    try:
        async with AsyncExitStack() as stack:
            gripper = RobotiqGripper(
                ModbusClient(path=str(run_dir / "gripper")), WidthCalibration.nominal(), poll_s=0.02
            )
            stack.push_async_callback(gripper.close)
            cell = LoadCell(LoadCalibration.of_torque_lines(), path=run_dir / "load-cell")
            load = await stack.enter_async_context(Reader(cell.samples()))
            right = await stack.enter_async_context(Reader(kit_at(rig, "right").frames()))
            await gripper.connect()
            await gripper.activate()
            free = await mean_of(right)
            assert (await grip(gripper)).diameter_mm == pytest.approx(40.0, abs=1.0)
            await rig.fault("kick -0.06")
            assert await torque_of(load) == pytest.approx(-0.06, rel=0.08)
            shear_nm = (await rig.truth())["shear_torque_nm"]
            seen_nm = 0.4 - 0.2 * sigma_of(await mean_of(right) - free)
            assert seen_nm == pytest.approx(shear_nm, abs=0.004), "σ is where the calibration has that torque"
            await rig.fault("slip")
            slipped_rad = (await rig.truth(lambda truth: bool(truth["slipped_rad"])))["slipped_rad"]
            assert slipped_rad == pytest.approx(-0.06 * (1 / 0.4 + 1 / 20), rel=0.1), "a softer gel was asked for"
        rig.process.send_signal(signal.SIGTERM)
        assert rig.process.wait(10) == 0
    finally:
        rig.close()
    assert not list(run_dir.iterdir())
    lines = [json.loads(line) for line in truth.read_text().splitlines()]
    assert {"t_mono_ns", "time_s", "torque_nm", "diameter_mm"} <= lines[-1].keys()
    assert np.median(np.diff([line["time_s"] for line in lines])) == pytest.approx(0.1, rel=0.3)
    assert min(line["torque_nm"] for line in lines) == pytest.approx(-0.06, rel=0.08)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--bank", "absent.bank"], "absent.bank"),
        (["--speed", "0"], "--speed 0 is not above 0"),
        (["--arm-speed", "nan"], "--arm-speed nan is not above 0"),
        (["--gel-stiffness", "-1"], "--gel-stiffness -1 is not above 0"),
        (["--rate-hz", "5"], "--rate-hz 5 is outside 50 to 1000"),
        (["--diameter-mm", "150"], "--diameter-mm 150 does not fit"),
        (["--run-dir", "/dev/null/run"], "--run-dir /dev/null/run cannot be made"),
        (["--truth", "/nowhere/truth"], "--truth /nowhere/truth cannot be written"),
        (["--sigma", "1.2", "1.8"], "give the larger one first"),
        (["--sigma", "3.0", "1.8"], "the bank has no signal at sigma = 3"),
        (["--calibration", "absent.yaml"], "absent.yaml"),
        # An address for documentation (RFC 5737), which no machine has.
        (["--host", "192.0.2.1"], "the rig cannot be played on 192.0.2.1"),
    ],
)
def test_mistakes_are_told(
    arguments: list[str], sentence: str, bank: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["emulate", "rig", "--bank", str(bank), "--run-dir", str(tmp_path), *arguments]) == 2
    complaint = capsys.readouterr().err
    assert sentence in complaint
    assert complaint.count("\n") == 1


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        ("explode", "'explode' is no command; there are kick NM"),
        ("kick hard", "'hard' is no torque in N·m"),
        ("kick 0.1", "kick needs a tool in the grip"),
        ("joint loose", "there is no joint 'loose'; there are lever"),
        ("unplug toaster", "there is no device 'toaster'; there are load, gripper, robot, right, left"),
        ("right explode", "there is no fault 'explode'"),
        ("gripper fault 99", "'99' is not a fault code"),
    ],
)
def test_what_is_no_command_is_said_to_be_none(line: str, sentence: str, tmp_path: Path) -> None:
    from drivers.emulators.rig import Rig, RigSettings

    rig = Rig(RigSettings(run_dir=tmp_path), lambda _grip, _shear, _diameter: channels_of_line(np.zeros(1024)))
    with pytest.raises(ValueError, match=sentence):
        rig.command(line)
