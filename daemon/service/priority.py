"""A place before other programs in the queue for the processor: the robot's loop runs 125 times a second."""

import os

# Before everything that runs as usual, behind what the system itself needs.
NICENESS = -10


def raise_priority() -> bool:
    """Let this process, and every one that it starts from now on, run first; return whether the system allows it."""
    try:
        os.setpriority(os.PRIO_PROCESS, 0, min(NICENESS, os.getpriority(os.PRIO_PROCESS, 0)))
    except PermissionError:
        return False
    return True
