"""The control script as sent: ur-rtde's own, with our limits."""

import asyncio
import difflib
import sys

import pytest

from shearloop.drivers.ur.script import KNOWN_SCRIPTS, guard_script, hash_of
from tests.drivers.ur.robots import DELIVERED, ROOT, VERSIONS, control_script

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


def test_script_differs_in_its_speed_thread_and_before_its_loop():
    own, guarded = control_script().splitlines(), control_script(DELIVERED).splitlines()
    *speeds, start = [
        change
        for change in difflib.SequenceMatcher(None, own, guarded, autojunk=False).get_opcodes()
        if change[0] != "equal"
    ]
    first, after = own.index("    thread speed_thread():"), own.index("    thread servo_thread():")
    assert all(first <= begin <= end < after for _, begin, end, *_ in speeds)
    _, begin, end, here, _ = start
    assert begin == end < own.index("        while keep_running:")
    armed = f'rtde_set_watchdog("input_int_register_0", {DELIVERED.watchdog_hz:g}, "stop")'
    assert guarded[here].strip() == armed
    # What comes before it in the program itself, beside functions, reads nothing.
    assert not any("read_input" in line for line in own[own.index("# HEADER_END") : begin])


@pytest.mark.parametrize("version", [version for version in VERSIONS if version[0] != 10])
def test_scripts_of_the_installed_client_are_known(version):
    script_client = pytest.importorskip("script_client", reason="ur-rtde has wheels for CPython up to 3.12 only")
    assert hash_of(script_client.ScriptClient("", *version).getScript()) in KNOWN_SCRIPTS


def test_unknown_script_is_not_guarded():
    assert not guard_script("def other():\n  sync()\nend\n", DELIVERED)
    assert not guard_script("        keep_running = True\n" * 2, DELIVERED)


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
