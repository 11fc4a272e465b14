"""The emulated rig as a process, and the real clients on its ports, for the tests beside."""

import asyncio
import dataclasses
import time
from collections.abc import AsyncGenerator, AsyncIterator, Callable
from contextlib import aclosing, asynccontextmanager
from pathlib import Path
from typing import Generic, Self, TypeVar

import numpy as np
import pytest
from numpy.typing import NDArray

from shearloop.bank.bank_file import BankDefinition, write_bank
from shearloop.bank.channels import PAPER_TABLE
from shearloop.drivers.connection import LinkMonitor, SerialLink
from shearloop.drivers.eit_kit import EitKit, Frame
from shearloop.drivers.load_cell import LoadCalibration, LoadSample
from shearloop.drivers.robotiq.gripper import RobotiqGripper
from shearloop.drivers.robotiq.messages import GripperCommand, GripperState
from shearloop.drivers.robotiq.socket_client import SocketClient
from shearloop.drivers.robotiq.widths import WidthCalibration
from shearloop.drivers.ur.client import UrRobot
from shearloop.drivers.ur.messages import Enable, RobotState, Stop, WristSpeed
from shearloop.drivers.ur.settings import read_settings
from shearloop.emulators.emulated_rig import NOISE_NM
from tests.emulator_process import EmulatorProcess, Event
from tests.running import running

# Of gel, fingers and boards.
SPEED = 10
PACE = ("--speed", str(SPEED), "--rate-hz", "250", "--unlock-wait-s", "0.2", "--power-on-s", "0.1")
DEADLINE_S = 30
N_FRAMES, N_SAMPLES = 6, 20
# Of a mean of so many samples: six times its standard deviation.
LOAD_NOISE_NM = 6 * NOISE_NM / N_SAMPLES**0.5
PERIOD_NS = round(0.5408e9 / SPEED)
CM_PER_NM = (1.25 - 1.85) / 0.14
PATTERN = np.cos(PAPER_TABLE.electrodes @ [0.3, 0.1, 0.2, 0.5])
HOMOGENEOUS = 0.5 * np.sin(PAPER_TABLE.electrodes @ [0.1, 0.2, 0.3, 0.4]) + 0.9
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


def write_rig_bank(path: Path, strength: float = 1.0) -> Path:
    """Write a bank whose signals grow with σ along the pattern."""
    sigma = np.array([0.9, 2.3])
    definition = BankDefinition("0" * 64, "gaussian_derivative", np.array([3.0, 4.0]), sigma)
    signals = np.broadcast_to(strength * sigma[None, :, None] * PATTERN, (2, 2, 896)).astype(np.float32)
    write_bank(path, definition, HOMOGENEOUS, np.full((2, 2), 0.5), np.ones((2, 2), bool), signals)
    return path


@asynccontextmanager
async def open_gripper_at(rig: RigProcess) -> AsyncIterator[RobotiqGripper]:
    gripper = RobotiqGripper(SocketClient(rig.host), WidthCalibration.nominal(), poll_s=0.02)
    try:
        await gripper.connect()
        await gripper.activate(may_drop=True)
        await release(gripper)
        yield gripper
    finally:
        await gripper.close()


def kit_at(rig: RigProcess, side: str) -> EitKit:
    path = rig.run_dir / f"eit-{side}"
    return EitKit(SerialLink(path=path), PAPER_TABLE.zero_slots, 0.5408 / SPEED)


@asynccontextmanager
async def arm_at(rig: RigProcess) -> AsyncIterator[UrRobot]:
    pytest.importorskip("rtde_control", reason="ur-rtde has wheels for CPython up to 3.12 on x86-64 only")
    settings = read_settings(Path(__file__).parents[3] / "config" / "demo_ur.yaml")
    arm = UrRobot(dataclasses.replace(settings, host=rig.host), LinkMonitor())
    async with running(arm.run()):
        await until(arm, lambda state: state.program_running and not state.recovering)
        assert (await arm.send(Enable())).accepted
        yield arm


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
            assert reply.accepted, reply.refusal
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
