"""The loop's task with an arm and a gripper of this process, whose time passes in the robot's cycles."""

import asyncio
import math
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from dataclasses import replace
from typing import Any

import pytest

from shearloop.daemon.clock import Clock
from shearloop.daemon.control.control_loop import ControlLoop, ControlOutput
from shearloop.daemon.control.experiment import ExperimentPhase
from shearloop.daemon.control.experiment_schema import ExperimentFile, GripStep
from shearloop.daemon.control.gripper_task import OPENING
from shearloop.daemon.control.inputs import GripperStatus
from shearloop.daemon.control.loop_runner import ControlLoopRunner
from shearloop.daemon.control.wrench import publish_every, wrench_source
from shearloop.daemon.loop_config import LoopConfig
from shearloop.daemon.rig_memory import NoMemory
from shearloop.daemon.torques import WRENCH, TorqueSample
from shearloop.drivers.robotiq.gripper import Permit, permitted
from shearloop.drivers.ur.client import UrRobot
from shearloop.drivers.ur.messages import Command, CommandReply, Heartbeat, MoveLinear, RobotState, WristSpeed
from shearloop.drivers.ur.settings import WRENCH_STATES
from shearloop.errors import NotBegunError
from tests.drivers.ur.handler_bench import CYCLE_NS, SETTINGS, FakeArm, HandlerBench

SPEED_M_PER_S = 0.1
# A state is read, decided on and answered, and an action goes on, within this number of turns of the event loop.
TURNS = 8
# Steps of experiments.
MOVE = {"do": "approach", "along_tool_m": 0.1, "speed_m_per_s": SPEED_M_PER_S}
GRIP = {"do": "grip", "width_mm": 10.0}
TWIST = {"do": "twist", "angles_rad": [1.0], "speed_rad_per_s": 0.3}


class Robot(UrRobot):
    """The client with the command handler in the same process, and an arm that moves in straight lines too."""

    def __init__(self, arm: FakeArm | None = None) -> None:
        super().__init__(SETTINGS)
        self.bench = HandlerBench(arm=arm)
        self.commands: list[Command] = []
        self.dies_of: Exception | None = None
        self._goal: MoveLinear | None = None
        # How many cycles a straight move goes on after it was told to stop, ever slower than a joint at rest.
        self.brakes_for = 0
        self.bench.run(5)
        self._held: list[tuple[asyncio.Future[CommandReply], CommandReply]] = []
        self._unread: list[RobotState] = []
        # For how many cycles there is no process yet.
        self.gone_for = 0

    def send(self, command: Command) -> asyncio.Future[CommandReply]:
        self.commands.append(replace(command, decided_ns=0) if isinstance(command, WristSpeed) else command)
        if self.dies_of is not None:
            raise self.dies_of
        replied: asyncio.Future[CommandReply] = asyncio.get_running_loop().create_future()
        if self.gone_for:
            replied.set_result(CommandReply("The robot is not connected."))
        else:
            asyncio.get_running_loop().call_soon(self._obey, command, replied)
        return replied

    def _obey(self, command: Command, replied: asyncio.Future[CommandReply]) -> None:
        if isinstance(command, MoveLinear):
            self._goal = command
        reply = self.bench.ask(command)
        if isinstance(command, WristSpeed):
            # Its reply comes with the next state.
            self._held.append((replied, reply))
        elif not replied.done():
            replied.set_result(reply)

    def keep_moving(self) -> None:
        if self.state is not None and self.state.motion == "linear":
            self.bench.handler.request(0, Heartbeat(), self.bench.now_ns)

    def die(self, gone_for: int) -> None:
        """End the process with all that it has not said; the next one is there after so many cycles."""
        self.gone_for = gone_for
        held, self._held, self._unread = self._held, [], []
        self._disconnect("The worker ended.")
        for replied, _ in held:
            replied.set_result(CommandReply("The worker ended before it answered."))

    def cycle(self, *, read: bool = True) -> None:
        """Let 8 ms pass, and tell who waits for the next state; what is not read now is read with the next one."""
        arm = self.bench.arm
        if self.gone_for:
            self.gone_for -= 1
            self.bench.run_without_handler()
            if not self.gone_for:
                self.bench.replace_handler()
            return
        # A real arm's move is under way until its end is told, though its joints rest.
        arm.stops_moves = not self.brakes_for
        if self.brakes_for and self.bench.state.motion == "stopping":
            self.brakes_for -= 1
            arm.be(moving_linearly=bool(self.brakes_for))
        elif arm.reading.moving_linearly and self._goal is not None:
            step_m = SPEED_M_PER_S * CYCLE_NS / 1e9
            z = arm.reading.tcp_pose[2]
            missing_m = self._goal.pose[2] - z
            z += math.copysign(min(step_m, abs(missing_m)), missing_m)
            arm.be(tcp_pose=(*arm.reading.tcp_pose[:2], z, *arm.reading.tcp_pose[3:]), moving_linearly=z != self.end_m)
        arm.be(read_ns=self.bench.now_ns)
        # A straight move goes on as long as the loop decides so.
        self.bench.run(1, daemon_alive=self.bench.state.motion != "linear")
        self._unread.append(self.bench.state)
        if not read:
            return
        held, self._held = self._held, []
        for replied, reply in held:
            replied.set_result(reply)
        for state in self._unread:
            self.handle_message(0, state)
        self._unread.clear()

    @property
    def end_m(self) -> float:
        return self._goal.pose[2]

    @property
    def z_m(self) -> float:
        return self.bench.arm.reading.tcp_pose[2]


class StepClock(Clock):
    """The robot's time, which stands between its cycles."""

    def __init__(self, bench: HandlerBench) -> None:
        self._bench, self.slept_ns = bench, 0
        super().__init__()

    def now_ns(self) -> int:
        return self._bench.now_ns

    def suspended_ns(self) -> int:
        return self.slept_ns


class Gripper:
    """A gripper's task as the loop knows it; `error` is what it raises, if anything, once it is `there`."""

    def __init__(self) -> None:
        self.error: Exception | None = None
        self.unlock_error: Exception | None = None
        self.there = asyncio.Event()
        self.there.set()
        self.asked: list[str] = []

    async def grip(self, _wish: GripStep, permit: Permit = permitted) -> None:
        if not isinstance(self.error, NotBegunError):
            permit()
        self.asked.append("grip")
        await self.there.wait()
        if self.error is not None:
            raise self.error

    async def halt(self) -> None:
        self.asked.append("halt")

    async def release(self) -> None:
        await self.grip(OPENING)

    async def unlock(self, permit: Permit = permitted, *, confirmed: bool = False) -> None:
        if confirmed:
            permit()
            self.asked.append("activate")
        await self.there.wait()
        if self.unlock_error is not None:
            raise self.unlock_error

    async def open_by_operator(self, permit: Permit = permitted) -> None:
        permit()
        self.asked.append("open")
        await self.there.wait()
        if self.error is not None:
            raise self.error


class Published:
    """What is published, as a list."""

    def __init__(self) -> None:
        self.messages: list[Any] = []

    def publish(self, message: Any) -> None:
        self.messages.append(message)

    @property
    def reasons(self) -> str:
        return str(self._loop_state.reasons)

    @property
    def faults(self) -> list[str]:
        return list(filter(None, self._loop_state.faults.split(", ")))

    @property
    def held_s(self) -> float:
        return float(self._loop_state.held_s)

    @property
    def _loop_state(self) -> Any:
        return next(one for one in reversed(self.messages) if one.topic == "loop.state")


def experiment(*steps: Mapping[str, Any], **keys: Any) -> ExperimentFile:
    return ExperimentFile.model_validate({"name": "test", "torque_source": WRENCH, "steps": list(steps), **keys})


class Cell:
    """Robot, gripper and loop, whose time passes in `cycles`."""

    def __init__(
        self, control_loop: ControlLoop | None = None, arm: FakeArm | None = None, gripper: Gripper | None = None
    ) -> None:
        self.robot, self.gripper, self.published = Robot(arm), gripper or Gripper(), Published()
        source = wrench_source(SETTINGS.rate_hz)
        self.died: dict[str, str] = {}
        self.control_loop = control_loop or ControlLoop(
            LoopConfig(), {WRENCH: source}, ("robot",), dead_tasks=self.died
        )
        # As after a tare.
        self.control_loop.on_zero(WRENCH)
        clock = self.clock = StepClock(self.robot.bench)
        self.sensors: dict[str, Any] = {}
        self.runner = ControlLoopRunner(
            self.control_loop, self.robot, self.gripper, self.sensors, self.published, clock, NoMemory().save_present
        )
        self.task: asyncio.Task[None] | None = None
        self.holding = True
        # What the gripper's state has besides.
        self.hand: dict[str, Any] = {}

    def drive(self) -> None:
        self.task = asyncio.create_task(self.runner.run())

    async def loop_died(self) -> None:
        """Wait for the loop's end, which `no_tick` brings about."""
        with pytest.raises(ZeroDivisionError):
            await self.task

    def sense(self) -> None:
        """Take what the sensors measure before a state of the robot."""
        width_mm = 30.0 if self.holding else 140.0
        status = GripperStatus(self.robot.bench.now_ns, width_mm, holding=self.holding, moving=False)
        self.control_loop.on_gripper(replace(status, **self.hand))

    async def cycles(self, count: int) -> None:
        for _ in range(count):
            self.sense()
            self.robot.cycle()
            for _ in range(TURNS):
                await asyncio.sleep(0)

    def exceed_torque(self) -> None:
        """Measure a torque beyond the limit."""
        now_ns = self.robot.bench.now_ns
        self.control_loop.on_torque(TorqueSample(WRENCH, 0.9, "", now_ns, now_ns))

    async def start(self, *steps: Mapping[str, Any], **keys: Any) -> None:
        starting = asyncio.create_task(self.runner.start(experiment(*steps, **keys)))
        while not starting.done():
            await self.cycles(1)
        assert starting.result() is None

    async def until_ended(self, most: int = 500) -> None:
        for _ in range(most):
            await self.cycles(1)
            if self.phase not in (ExperimentPhase.RUNNING, ExperimentPhase.PAUSED):
                return
        raise AssertionError("the experiment goes on and on")

    async def until_done(self) -> None:
        await self.until_ended()
        assert self.phase is ExperimentPhase.DONE, self.why

    @property
    def phase(self) -> ExperimentPhase:
        return self.control_loop.experiment.phase

    @property
    def why(self) -> str:
        return self.control_loop.experiment.stop_reason

    @property
    def state(self) -> RobotState:
        return self.robot.bench.state


def no_tick(*_: object) -> ControlOutput:
    """Die, in place of the control loop's `tick`."""
    raise ZeroDivisionError("a tick went wrong")


@asynccontextmanager
async def driven(*steps: Mapping[str, Any], cycles: int = 0, cell: Cell | None = None) -> AsyncIterator[Cell]:
    """Yield a cell that has begun an experiment of these steps, if any, so many cycles ago."""
    cell = cell or Cell()
    cell.drive()
    # Until the wrench is known.
    await cell.cycles(WRENCH_STATES + publish_every(SETTINGS.rate_hz))
    try:
        if steps:
            await cell.start(*steps)
        await cell.cycles(cycles)
        yield cell
    finally:
        cell.task.cancel()
        await asyncio.gather(cell.task, return_exceptions=True)
