"""A robot as in the daemon, with the delivered settings."""

import asyncio
import contextlib
import dataclasses
import re
from collections.abc import AsyncIterator, Callable
from functools import partial
from pathlib import Path

import pytest

from shearloop.drivers.connection import LinkMonitor, LinkObserver
from shearloop.drivers.ur.client import UrRobot
from shearloop.drivers.ur.messages import Enable, RobotState
from shearloop.drivers.ur.script import LOWER, UPPER, control_program
from shearloop.drivers.ur.settings import UrSettings, read_settings
from shearloop.emulators.ur_robot import Robot

ROOT = Path(__file__).parents[3]


DELIVERED = read_settings(ROOT / "config" / "demo_ur.yaml")
# Commands of ur-rtde's client, and the cycle of the controller.
MOVE_L, ZERO_FT, SPEED_J, SPEED_STOP, STOP_J, SET_WATCHDOG = 3, 8, 9, 15, 34, 35
STEP_S = 0.002
# What a script reports of itself.
READY, DONE = 1, 2


def control_script(settings: UrSettings | None = None) -> str:
    """Return a control script as a controller receives it: ours for these settings, or ur-rtde's own."""
    if settings is not None:
        return control_program(settings)
    script_client = pytest.importorskip("script_client", reason="ur-rtde has wheels for CPython up to 3.12 only")
    text = script_client.ScriptClient("", 5, 17).getScript()
    # ur-rtde inserts the registers' numbers when it sends it.
    return re.sub(r"= # (?:float|int) register offset\n", "= 0\n", f"def rtde_control():\n{text}end\n")


def send(robot: Robot, command: int, *numbers: float, asynchronous: bool = False) -> None:
    """Write a command's registers as ur-rtde does, in both halves: a script reads one of them."""
    for first in (LOWER.first, UPPER.first):
        for index, number in enumerate(numbers):
            robot.registers.write(f"input_double_register_{first + index}", number, robot.time_s)
        robot.registers.write(f"input_int_register_{first + 1}", int(asynchronous), robot.time_s)
        robot.registers.write(f"input_int_register_{first}", command, robot.time_s)


def states(robot: Robot) -> tuple[float, float]:
    """Return what a script reports of itself: it writes one half of the registers."""
    return robot.registers[LOWER.state], robot.registers[UPPER.state]


def moving_asynchronously(robot: Robot) -> bool:
    """Return whether the script reports a straight move under way."""
    states = (int(robot.registers[f"output_int_register_{half.first + 2}"]) for half in (LOWER, UPPER))
    return any(state & 1 << 15 for state in states)


def do(
    robot: Robot, command: int, *numbers: float, asynchronous: bool = False, step: Callable[[], None] | None = None
) -> float:
    """Run a command until the script is ready for the next; return its duration in s. `step` makes a cycle pass."""
    step = step or partial(robot.step, STEP_S)
    begun_s, took_s = robot.time_s, 0.0
    for written, state in ((command, DONE), (0, READY)):
        send(robot, written, *numbers, asynchronous=asynchronous)
        while state not in states(robot):
            step()
            assert robot.program_running, robot.events[-1]
            assert robot.time_s < begun_s + 20
        took_s = took_s or robot.time_s - begun_s
    return took_s


def settings_for(host: str, **changes: object) -> UrSettings:
    """Return the delivered settings, with a wrist speed that holds until its test has seen it."""
    changes = {"command_timeout_s": 0.3, "silence_timeout_s": 0.3, **changes}
    return dataclasses.replace(DELIVERED, host=host, **changes)


@contextlib.asynccontextmanager
async def running(settings: UrSettings, link: LinkObserver | None = None) -> AsyncIterator[UrRobot]:
    robot = UrRobot(settings, LinkMonitor(link))
    task = asyncio.create_task(robot.run())
    try:
        yield robot
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


async def until(robot: UrRobot, condition: Callable[[RobotState], bool], within_s: float = 15.0) -> RobotState:
    state = robot.state
    try:
        async with asyncio.timeout(within_s):
            while not (state and condition(state)):
                state = await robot.next_state()
                robot.keep_moving()
    except TimeoutError:
        raise AssertionError(f"never came about; link {robot.monitor}, state {state}") from None
    return state


async def enable(robot: UrRobot) -> None:
    await until(robot, lambda state: state.program_running and not state.recovering)
    assert (await robot.send(Enable())).accepted


def pid_of(robot: UrRobot) -> int:
    """Return the process id of the worker that the robot is connected by."""
    assert robot.state is not None
    children = " ".join(path.read_text() for path in Path("/proc/self/task").glob("*/children")).split()
    workers = [pid for pid in children if b"drivers.ur.worker" in Path(f"/proc/{pid}/cmdline").read_bytes()]
    (pid,) = map(int, workers)
    return pid
