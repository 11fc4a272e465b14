"""The controller's script port: a program is sent over a connection of its own, which reads what the controller sends.

The controller streams its state to each client of that port, 10 to 500 times a second (UR's page "Overview of client
interfaces"). It stops listening to a client that does not read, and ur-rtde does not.
"""

import select
import socket
import time
from typing import Final

from shearloop.drivers.defaults import SCRIPT_PORT
from shearloop.drivers.errors import system_reason
from shearloop.drivers.ur.messages import RobotLostError
from shearloop.drivers.ur.ports import lose_dead_peers

# Some seconds of states.
_READ_BYTES: Final = 1 << 18


class ScriptPort:
    """Sends programs to a controller: `send` opens a connection, `drain` reads from it until `close`."""

    def __init__(self, host: str, timeout_s: float, port: int = SCRIPT_PORT) -> None:
        """Name the controller, and the longest time for sending a program; nothing is opened yet."""
        self._address, self._timeout_s = (host, port), timeout_s
        self._connection: socket.socket | None = None

    def send(self, program: str) -> None:
        """Send a program over a new connection, which stays open.

        Raises:
            RobotLostError: the controller does not take all of it in time.
        """
        self.close()
        until_s = time.monotonic() + self._timeout_s
        unsent = memoryview(program.encode())
        try:
            self._connection = socket.create_connection(self._address, self._timeout_s)
            lose_dead_peers(self._connection)
            self._connection.setblocking(False)
            while unsent:
                waited = max(0.0, until_s - time.monotonic())
                readable, writable, _ = select.select([self._connection], [self._connection], [], waited)
                if not (readable or writable):
                    raise TimeoutError("it does not read the program")
                if readable and not self.drain():
                    raise ConnectionResetError("it closed the connection")
                if writable:
                    unsent = unsent[self._connection.send(unsent) :]
        except OSError as error:
            self.close()
            host, port = self._address
            raise RobotLostError(
                "script",
                f"The control program could not be sent to port {port} of the robot at {host}: {system_reason(error)}. "
                "Look at the teach pendant; the robot's worker is started again.",
            ) from error

    def drain(self) -> bool:
        """Read and drop what the controller has sent; return whether the connection is still open."""
        try:
            while self._connection is not None:
                if not self._connection.recv(_READ_BYTES):
                    self.close()
        except BlockingIOError:
            return True
        except OSError:
            self.close()
        return False

    def close(self) -> None:
        """Close the connection, where one is open: the program goes on."""
        if self._connection is not None:
            self._connection.close()
        self._connection = None
