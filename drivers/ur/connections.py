"""Which of this process's connections go to a port, and whether one is the same still.

ur-rtde connects anew by itself, from a thread of its own and without a word, and what is sent meanwhile meets a
connection on which nothing is agreed yet: the controller may close it, or the process crash. The kernel gives each
connection a number of its own, which a descriptor that is used again does not keep.
"""

import contextlib
import os
import socket
import stat
from typing import NamedTuple


class Connection(NamedTuple):
    """A connection of this process: its descriptor, and the kernel's number of it."""

    descriptor: int
    inode: int

    @property
    def lasts(self) -> bool:
        """Whether the descriptor is of this connection still."""
        try:
            return os.fstat(self.descriptor).st_ino == self.inode
        except OSError:
            return False


def connections_to(port: int) -> set[Connection]:
    """Return the connections of this process over TCP that go to such a port, at whichever address."""
    found = set()
    for name in os.listdir("/proc/self/fd"):
        # Of a descriptor that was closed meanwhile, or of a socket that is not connected.
        with contextlib.suppress(OSError):
            status = os.fstat(int(name))
            if stat.S_ISSOCK(status.st_mode):
                with socket.socket(fileno=os.dup(int(name))) as one:
                    if one.family == socket.AF_INET and one.getpeername()[1] == port:
                        found.add(Connection(int(name), status.st_ino))
    return found
