"""The controller's ports: connecting with a reason for each failure, and connections that end with their peer."""

import os
import socket
import struct
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Final

from shearloop.drivers.defaults import DASHBOARD_PORT, RTDE_PORT, SCRIPT_PORT
from shearloop.drivers.errors import system_reason
from shearloop.drivers.ur.messages import RobotLostError, silent_sentence

# The services behind the ports, as PolyScope's menu names them.
SERVICES: Final = {RTDE_PORT: "RTDE", SCRIPT_PORT: "Real-Time Client", DASHBOARD_PORT: "Dashboard Server"}
# From this version on an e-Series opens only the enabled interfaces.
FIRST_WITH_SERVICES: Final = (5, 10)
SERVICES_MENU: Final = "Settings → Security → Services"
# The other menus, of both generations: a controller that does not answer has no version.
NETWORK_MENU: Final = "Settings → System → Network at the teach pendant, on a CB3 Setup Robot → Network"
FIELDBUS_MENU: Final = "Installation → Fieldbus, on a CB3 under Installation"
# A peer that acknowledges nothing for this time is gone.
_PEER_GONE_S = 3


def probe_ports(host: str, timeout_s: float) -> dict[int, str]:
    """Return why each of the controller's ports cannot be reached; empty texts for those that are open."""
    found: dict[int, str] = {}
    for port in SERVICES:
        try:
            with socket.create_connection((host, port), timeout_s):
                found[port] = ""
        except TimeoutError:
            # No controller answers; each further port would take as long.
            return {**dict.fromkeys(SERVICES, "no answer"), **found}
        except OSError as error:
            found[port] = system_reason(error)
    return found


def closed_ports_sentence(host: str, closed: Sequence[int], version: tuple[int, ...]) -> str:
    """Return which ports are closed at a controller of this version, empty if unknown, and where to open them."""
    names = " and ".join(f"{port} ({SERVICES[port]})" for port in closed)
    refuses = f"The controller at {host} does not serve {'port' if len(closed) == 1 else 'the ports'} {names}"
    enable = f"enable {' and '.join(SERVICES[port] for port in closed)} under {SERVICES_MENU}"
    if not version:
        older = "a CB3 or an older version always serves them: look for a firewall"
        return f"{refuses}; on an e-Series from PolyScope 5.10 on, {enable} ({older})."
    if version >= FIRST_WITH_SERVICES:
        return f"{refuses}; {enable}."
    series = "a CB3" if version[0] == 3 else f"PolyScope {'.'.join(map(str, version))}"
    return f"{refuses}; {series} has no menu for them: wait until it has started, and look for a firewall between."


@contextmanager
def explain_failure(host: str, timeout_s: float, activity: str) -> Iterator[None]:
    """Turn a failed or unanswered exchange with the controller into a RobotLostError."""
    try:
        yield
    except TimeoutError as error:
        raise RobotLostError("silent", silent_sentence(host, timeout_s, activity)) from error
    except (OSError, struct.error) as error:
        reason = system_reason(error) if isinstance(error, OSError) else "it does not answer as one"
        raise RobotLostError(
            "unreachable",
            f"No UR controller at {host}: {reason}. Check that it is switched on and that this computer is in its "
            f"network ({NETWORK_MENU}){_all_refused_hint(error)}.",
        ) from error


@contextmanager
def connected(host: str, port: int, timeout_s: float, activity: str) -> Iterator[socket.socket]:
    """Connect to a port of the controller until the end of the block."""
    with explain_failure(host, timeout_s, activity):
        try:
            connection = socket.create_connection((host, port), timeout_s)
        except ConnectionRefusedError as error:
            closed = [number for number, reason in probe_ports(host, timeout_s).items() if reason]
            if len(closed) == len(SERVICES):
                raise
            # Without asking for the version, which needs the same ports.
            raise RobotLostError("unreachable", closed_ports_sentence(host, closed or [port], ())) from error
        with connection:
            yield connection


def _all_refused_hint(error: Exception) -> str:
    # Something at that address answers, so that it is no matter of the cable.
    if not isinstance(error, ConnectionRefusedError):
        return ""
    return f", and on an e-Series from PolyScope 5.10 on that its services are enabled ({SERVICES_MENU})"


def lose_dead_peers(connection: socket.socket) -> None:
    """Send each package at once, and end the connection some seconds after its peer has vanished."""
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for option, value in (
        (socket.TCP_KEEPIDLE, 1),
        (socket.TCP_KEEPINTVL, 1),
        (socket.TCP_KEEPCNT, _PEER_GONE_S),
        (socket.TCP_USER_TIMEOUT, 1000 * _PEER_GONE_S),
    ):
        connection.setsockopt(socket.IPPROTO_TCP, option, value)


def lose_dead_peers_of_ports(ports: Iterable[int] = tuple(SERVICES)) -> None:
    """Call `lose_dead_peers` for all connections of this process to these ports: ur-rtde hides its sockets."""
    for descriptor in os.listdir("/proc/self/fd"):
        # The listing's own descriptor is closed by then, and a socket that waits for clients has no peer.
        with suppress(OSError):
            if not os.readlink(f"/proc/self/fd/{descriptor}").startswith("socket:"):
                continue
            with socket.socket(fileno=os.dup(int(descriptor))) as connection:
                if connection.family in (socket.AF_INET, socket.AF_INET6) and connection.getpeername()[1] in ports:
                    lose_dead_peers(connection)
