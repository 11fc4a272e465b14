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


def test_script_differs_in_its_speed_thread_and_in_named_lines():
    own, guarded = control_script().splitlines(), control_script(DELIVERED).splitlines()
    first, after = own.index("    thread speed_thread():"), own.index("    thread servo_thread():")
    changes = [
        ([one.strip() for one in own[begin:end]], [one.strip() for one in guarded[here:there]])
        for tag, begin, end, here, there in difflib.SequenceMatcher(None, own, guarded, autojunk=False).get_opcodes()
        if tag != "equal" and not first <= begin <= end < after
    ]
    offsets = [f"global reg_offset_{kind} = " for kind in ("float", "int")]
    armed = f'rtde_set_watchdog("input_int_register_24", {DELIVERED.watchdog_hz:g}, "stop")'
    assert changes == [
        ([f"{one}0" for one in offsets], [f"{one}24" for one in offsets]),
        # A new zero of the wrench is the script's too.
        ([], ["guard_bias = [0, 0, 0, 0, 0, 0]"]),
        ([], [armed, "clock_thrd = run guard_clock()"]),
    ]
    # Nothing that it reads comes before the watchdog in the program itself, beside functions.
    started = next(number for number, one in enumerate(guarded) if one.strip() == armed)
    assert started < guarded.index("        while keep_running:")
    main = guarded[guarded.index("# HEADER_END") : started]
    assert not any("read_input" in line for line in main if not line.startswith("        "))


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
