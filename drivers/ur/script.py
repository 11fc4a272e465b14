"""The control script as it is sent to the robot: ur-rtde's own, which arms its watchdog before it reads a register.

ur-rtde arms it by a command, once the script runs. Until then it would run for ever if nobody came. So would one that
the controller has begun late: sent twice, the second takes the place of the first, whose watchdog was armed, and nobody
knows. (URScript manual, `rtde_set_watchdog`: a program's watchdogs are removed when it stops.)
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager

# The last thing before the script's loop; ur-rtde 1.6.5.
_BEFORE_ITS_LOOP = "        keep_running = True\n"


def watched(text: str, watchdog_hz: float) -> str:
    """Return ur-rtde's text as a program whose watchdog is armed before its loop; empty where that is not in it."""
    if text.count(_BEFORE_ITS_LOOP) != 1:
        return ""
    armed = f'        rtde_set_watchdog("input_int_register_0", {watchdog_hz:g}, "stop")\n'
    return f"def rtde_control():\n{text.replace(_BEFORE_ITS_LOOP, armed + _BEFORE_ITS_LOOP)}end\n"


@contextmanager
def in_a_file(program: str) -> Iterator[str]:
    """Give the path of a file with a program, in memory alone and for so long."""
    descriptor = os.memfd_create("control.script")
    try:
        with os.fdopen(os.dup(descriptor), "w") as file:
            file.write(program)
        yield f"/proc/self/fd/{descriptor}"
    finally:
        os.close(descriptor)
