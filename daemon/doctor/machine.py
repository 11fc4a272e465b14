"""The computer: clock, disk, memory, the robot's library."""

import ctypes
import importlib.util
import os
import shutil
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from shearloop.daemon.doctor.finding import Finding, good, note, trouble

# An hour of recording is some 80 MB.
LITTLE_DISK_BYTES, NO_DISK_BYTES = 2e9, 2e8
LITTLE_MEMORY_BYTES = 5e8
# A clock before this has never been set.
FIRST_SANE_UNIX_S = 1_704_067_200
_TIME_ERROR = 5


def examine_machine() -> Iterator[Finding]:
    """Examine this computer."""
    yield clock_finding(time.time(), clock_state())
    yield memory_finding()
    yield robot_library_finding()


def clock_state() -> int:
    """Return adjtimex(2)'s answer: 5 when the clock is not synchronised, -1 where it cannot be asked."""
    # struct timex is 208 bytes on Linux of 64 bits; `modes` is 0, so that nothing is changed.
    try:
        return int(ctypes.CDLL(None).adjtimex(ctypes.create_string_buffer(512)))
    except (OSError, AttributeError):
        return -1


def clock_finding(unix_s: float, state: int) -> Finding:
    """Judge the system's clock by its time and by adjtimex's answer."""
    today = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(unix_s))
    if unix_s < FIRST_SANE_UNIX_S:
        return trouble(
            "clock",
            f"it says {today}",
            "recordings and messages bear a wrong time",
            "set it: `sudo timedatectl set-ntp true`",
        )
    if state == _TIME_ERROR:
        return note(
            "clock",
            f"it says {today} and is not synchronised",
            "times on the wire and in recordings drift against other computers; the loop itself goes by another clock",
            "`sudo timedatectl set-ntp true`, where the network allows it",
        )
    return good("clock", f"it says {today}" + (" and is synchronised" if state >= 0 else ""))


def disk_finding(folder: Path) -> Finding:
    """Judge the room that is left for recordings in a folder, or in the nearest one above it that is there."""
    there = next(path for path in (folder, *folder.absolute().parents) if path.is_dir())
    free = shutil.disk_usage(there).free
    found = f"{free / 1e9:.1f} GB are free in {there}"
    if not os.access(there, os.W_OK):
        return note(
            "disk", f"{there} may not be written by you", "recordings cannot be put there", "choose another folder"
        )
    if free < NO_DISK_BYTES:
        return trouble("disk", found, "recordings will fail, and experiments are not started then", "make room")
    if free < LITTLE_DISK_BYTES:
        return note("disk", found, "a day of recordings at most", "make room before a long experiment")
    return good("disk", found)


def memory_finding() -> Finding:
    """Judge the memory that is left."""
    available = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    meminfo = Path("/proc/meminfo")
    if meminfo.exists():
        fields = dict(line.split(":", 1) for line in meminfo.read_text().splitlines() if ":" in line)
        available = int(fields.get("MemAvailable", "0 kB").split()[0]) * 1000
    found = f"{available / 1e9:.1f} GB are available, {len(os.sched_getaffinity(0))} processors"
    if available < LITTLE_MEMORY_BYTES:
        return note("memory", found, "the bank may be read from disk again and again", "end other programs")
    return good("memory", found)


def robot_library_finding() -> Finding:
    """Say whether the robot's library is installed; there are no builds of it for every Python."""
    version = ".".join(map(str, sys.version_info[:2]))
    if importlib.util.find_spec("rtde_control") is None:
        return note(
            "robot's library",
            f"ur-rtde is not installed for Python {version}",
            "everything but the robot works",
            "use Python 3.11 or 3.12 on x86-64, then `pip install ur-rtde`",
        )
    return good("robot's library", f"ur-rtde is installed, Python {version}")
