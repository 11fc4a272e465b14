"""A place before other programs in the queue for the processor: the robot's loop runs 125 times a second."""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

# Before everything that runs as usual, behind what the system itself needs.
NICENESS = -10
# Where the kernel groups processes by session, niceness counts within a group only, and the group has its own.
AUTOGROUP = Path("/proc/self/autogroup")


@contextlib.contextmanager
def first_in_line() -> Iterator[bool]:
    """Let this process, all that it starts, and its session run first; yields whether the system allows it.

    The session's place is given back at the end; the process keeps its own.
    """
    try:
        os.setpriority(os.PRIO_PROCESS, 0, min(NICENESS, os.getpriority(os.PRIO_PROCESS, 0)))
    except PermissionError:
        yield False
        return
    before = _session_niceness()
    try:
        if before is not None:
            _set_session_niceness(min(before, NICENESS))
        yield True
    finally:
        if before is not None:
            _set_session_niceness(before)


def _session_niceness() -> int | None:
    try:
        # "/autogroup-3 nice 0"
        return int(AUTOGROUP.read_text().split()[-1])
    except (OSError, ValueError, IndexError):
        return None


def _set_session_niceness(niceness: int) -> None:
    # A kernel that groups nothing, or a container that does not let us, leaves things as they are.
    with contextlib.suppress(OSError):
        AUTOGROUP.write_text(str(niceness))
