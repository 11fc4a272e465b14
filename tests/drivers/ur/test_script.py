"""The program for the robot: our control script behind the settings' values."""

import asyncio
import sys

import pytest

from tests.drivers.ur.robots import ROOT

# Uploads the script, and is gone before the watchdog is armed by a command.
DIES_TOO_SOON = """
import os, sys
from shearloop.drivers.ur.arm import UrArm
from tests.drivers.ur.robots import settings_for
arm = UrArm(settings_for(sys.argv[1]))
while not arm.clear_command():
    pass
arm.upload()
os._exit(0)
"""


@pytest.mark.real_time
async def test_program_of_a_worker_killed_before_arming_ends(controller):
    """Nothing moves: the register was cleared before."""
    pytest.importorskip("rtde_control", reason="ur-rtde has wheels for CPython up to 3.12 on x86-64 only")
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-c", DIES_TOO_SOON, controller.host, cwd=ROOT, stdout=asyncio.subprocess.DEVNULL
    )
    assert await process.wait() == 0
    started = await controller.event("program-started", 0)
    ended = await controller.event("program-ended", started["t_mono_ns"])
    assert "watchdog" in ended["detail"]
    assert not controller.happened("motion-started", 0)
