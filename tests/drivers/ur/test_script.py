"""The control script as sent: ur-rtde's own, with its watchdog armed before its loop."""

import asyncio
import sys

import pytest

from tests.drivers.ur.robots import ROOT

arm_watchdog_in = pytest.importorskip(
    "shearloop.drivers.ur.arm", reason="ur-rtde has wheels for CPython up to 3.12 on x86-64 only"
).arm_watchdog_in

# Uploads the script, and is gone before the watchdog is armed by a command.
DIES_TOO_SOON = """
import os, sys
from shearloop.drivers.ur.arm import UrArm
from tests.drivers.ur.robots import settings_for
arm = UrArm(settings_for(sys.argv[1]), "5.17.3.0")
while not arm.clear_command():
    pass
arm.upload()
os._exit(0)
"""


def test_script_differs_by_one_line_before_its_loop():
    import script_client

    text = script_client.ScriptClient("", 5, 17).getScript()
    program = arm_watchdog_in(text, 10.0)
    lines, its = program.splitlines(), ["def rtde_control():", *text.splitlines(), "end"]
    (at,) = [number for number, line in enumerate(lines) if "rtde_set_watchdog(" in line and ", 10," in line]
    assert lines[at].strip() == 'rtde_set_watchdog("input_int_register_0", 10, "stop")'
    assert lines[:at] + lines[at + 1 :] == its
    (loop,) = [number for number, line in enumerate(lines) if line.strip() == "while keep_running:"]
    assert at < loop
    # What comes before it in the program itself, beside functions, reads nothing.
    assert not any("read_input" in line for line in lines[at:loop])
    assert program.endswith("\nend\n")


def test_unknown_script_is_not_changed():
    assert not arm_watchdog_in("def other():\n  sync()\nend\n", 10.0)
    assert not arm_watchdog_in("        keep_running = True\n" * 2, 10.0)


@pytest.mark.real_time
async def test_program_of_a_worker_killed_before_arming_ends(controller):
    """Nothing moves: the register was cleared before."""
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-c", DIES_TOO_SOON, controller.host, cwd=ROOT, stdout=asyncio.subprocess.DEVNULL
    )
    assert await process.wait() == 0
    started = await controller.event("program-started", 0)
    ended = await controller.event("program-ended", started["t_mono_ns"])
    assert "watchdog" in ended["detail"]
    assert not controller.happened("motion-started", 0)
