"""Ports and local addresses of this computer that no program has."""

import socket
from typing import Final

from shearloop.drivers.defaults import DASHBOARD_PORT, PRIMARY_PORT, RTDE_PORT, SCRIPT_PORT, URCAP_PORT
from shearloop.errors import UserError

# Robot and gripper are emulated on the first of these local addresses with free ports.
LOOPBACKS: Final = tuple(f"127.0.0.{number}" for number in range(1, 255))
_ROBOT_PORTS: Final = (RTDE_PORT, SCRIPT_PORT, DASHBOARD_PORT, PRIMARY_PORT, URCAP_PORT)


def is_free(host: str, port: int) -> bool:
    """Return whether a server can listen at this address of this computer."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError:
            return False
    return True


def free_port(host: str) -> int:
    """Return a port of this address that the system chooses."""
    with socket.socket() as probe:
        probe.bind((host, 0))
        port: int = probe.getsockname()[1]
    return port


def plays_no_robot(host: str) -> bool:
    """Return whether the ports of robot and gripper are free at this address of this computer."""
    return all(is_free(host, port) for port in _ROBOT_PORTS)


def free_loopback() -> str:
    """Return an address of this computer with free ports for robot and gripper; raises UserError without one."""
    for host in LOOPBACKS:
        if plays_no_robot(host):
            return host
    raise UserError("every loopback address plays a robot already: end one of the other rigs")
