"""Paused programs on the emulated controller: ours is stopped, a foreign one is left alone."""

import asyncio
import os
import signal
import time

import pytest

from shearloop.drivers.emulators.ur_controller import SCRIPT_PORT
from shearloop.drivers.ur.client import UrRobot
from tests.drivers.ur.robots import enable, pid_of, running, settings_for, until
from tests.emulator_process import EmulatorProcess as ControllerProcess
from tests.running import LinkEvents

pytestmark = pytest.mark.real_time

pytest.importorskip("rtde_control", reason="ur-rtde has wheels for CPython up to 3.12 on x86-64 only")

STOPPED = "stopped from the dashboard"
PAUSED = 4


async def begin_foreign_program(controller: ControllerProcess) -> None:
    since_ns = time.monotonic_ns()
    _, writer = await asyncio.open_connection(controller.host, SCRIPT_PORT)
    writer.write(b"def theirs():\n  while True:\n    sync()\n  end\nend\n")
    await controller.event("program-started", since_ns)
    writer.close()
    await writer.wait_closed()


async def kill(robot: UrRobot, link: LinkEvents) -> None:
    """Kill the worker and wait for the next one's first state."""
    os.kill(pid_of(robot), signal.SIGKILL)
    await link.down()
    await robot.next_state()


async def test_foreign_paused_program_outlives_a_lost_worker(controller):
    """It was paused before we connected."""
    await begin_foreign_program(controller)
    since_ns = await controller.fault("protective-stop")
    link = LinkEvents()
    async with running(settings_for(controller.host), link) as robot:
        await until(robot, lambda state: state.runtime_state == PAUSED and not state.recovering)
        await kill(robot, link)
        await until(robot, lambda state: not state.recovering)
        # As long as ours takes to be stopped, ten times over.
        for _ in range(100):
            state = await robot.next_state()
        assert state.runtime_state == PAUSED
    assert not controller.happened("program-ended", since_ns)


async def test_program_started_after_a_lost_worker_is_left_alone(controller):
    link = LinkEvents()
    async with running(settings_for(controller.host), link) as robot:
        await enable(robot)
        since_ns = time.monotonic_ns()
        os.kill(pid_of(robot), signal.SIGKILL)
        await controller.event("program-ended", since_ns)
        await begin_foreign_program(controller)
        since_ns = time.monotonic_ns()
        await link.down()
        state = await until(robot, lambda state: not state.recovering)
        assert state.program_running
        assert "someone else" in state.blocked
    assert not controller.happened("program-ended", since_ns)


@pytest.mark.parametrize("hangs", [0, 1])
async def test_our_paused_program_is_stopped_by_the_next_worker(controller, hangs):
    link = LinkEvents()
    async with running(settings_for(controller.host), link) as robot:
        await enable(robot)
        os.kill(pid_of(robot), signal.SIGSTOP)
        await controller.fault(f"stop-hangs {hangs}")
        since_ns = await controller.fault("protective-stop")
        os.kill(pid_of(robot), signal.SIGKILL)
        await link.down()
        assert (await controller.event("program-ended", since_ns))["detail"] == STOPPED
        assert robot.failed_program_stops == hangs


async def test_hanging_dashboard_is_retried_and_reported(controller):
    async with running(settings_for(controller.host)) as robot:
        await enable(robot)
        await controller.fault("stop-hangs 1")
        since_ns = await controller.fault("protective-stop")
        state = await until(robot, lambda state: "do not resume it" in state.blocked)
        assert state.runtime_state == PAUSED
        assert (await controller.event("program-ended", since_ns))["detail"] == STOPPED
        await until(robot, lambda state: "do not resume it" not in state.blocked)
        assert robot.failed_program_stops == 1
        assert not robot.losses
