"""A worker that fails on a signal while its process runs, so that only the script on the robot stops the arm.

`python -m shearloop.tools.commission.failing_worker` runs it like the daemon's worker. After the signal `NO_DEADLINES`
it continues without writing a deadline. `CLOSE_RTDE` closes its RTDE connections.
"""

import os
import signal
import socket
from contextlib import suppress
from pathlib import Path
from typing import ClassVar, Final

from shearloop.drivers.defaults import RTDE_PORT
from shearloop.drivers.ur.receiver import RtdeReceiver
from shearloop.drivers.ur.worker import main

NO_DEADLINES: Final = signal.SIGUSR1
CLOSE_RTDE: Final = signal.SIGUSR2


class ForgetfulReceiver(RtdeReceiver):
    """A connection that can stop writing deadlines."""

    _forgets: ClassVar[bool] = False

    @classmethod
    def forget(cls) -> None:
        """Write no deadline from now on."""
        cls._forgets = True

    def write_deadline(self, script_ticks: int) -> None:
        """Write when the motion has to end, unless deadlines have ended."""
        if not self._forgets:
            super().write_deadline(script_ticks)


def close_rtde() -> None:
    """Close every RTDE connection of this process, also the connections of ur-rtde."""
    for entry in Path("/proc/self/fd").iterdir():
        # A socket without a peer, or one that was closed meanwhile, does not belong to RTDE.
        with suppress(OSError):
            if entry.is_socket():
                _shut_down(os.dup(int(entry.name)))


def _shut_down(fd: int) -> None:
    """Close a connection if it is one to RTDE, for all who hold it."""
    with socket.socket(fileno=fd) as connection:
        # The pipe to the daemon is a local socket: its peer has no port.
        is_network = connection.family in (socket.AF_INET, socket.AF_INET6)
        if is_network and connection.getpeername()[1] == RTDE_PORT:
            connection.shutdown(socket.SHUT_RDWR)


if __name__ == "__main__":
    signal.signal(NO_DEADLINES, lambda *_: ForgetfulReceiver.forget())
    signal.signal(CLOSE_RTDE, lambda *_: close_rtde())
    main(receiver=ForgetfulReceiver)
