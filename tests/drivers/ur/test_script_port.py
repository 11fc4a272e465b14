"""Programs sent over the controller's script port, whose peer streams."""

import asyncio
import contextlib
import socket
from collections.abc import AsyncIterator, Iterator

import pytest

from shearloop.drivers.defaults import SCRIPT_PORT
from shearloop.drivers.ur.messages import RobotLostError
from shearloop.drivers.ur.script_port import ScriptPort
from shearloop.emulators.ur_controller import Controller
from shearloop.emulators.ur_robot import Robot
from tests.emulator_process import own_address

HOST = own_address(6)
# A write that takes this long has met a client that does not read.
BLOCKED_S = 0.3
# Longer than the buffers.
PROGRAM = "def program():\n" + "  # a comment\n" * 3000 + "  sync()\nend\n"


@contextlib.asynccontextmanager
async def serving() -> AsyncIterator[Robot]:
    """Yield the robot of a controller with open ports."""
    robot = Robot()
    async with Controller(robot, host=HOST).open():
        yield robot


def started(robot: Robot) -> int:
    return sum(event.name == "program-started" for event in robot.take_events())


async def send(port: ScriptPort, robot: Robot) -> None:
    """Send the program, and return once it has started."""
    await asyncio.to_thread(port.send, PROGRAM)
    async with asyncio.timeout(2):
        while not started(robot):
            await asyncio.to_thread(port.drain)


async def test_program_is_sent_again_over_a_connection_of_its_own():
    port = ScriptPort(HOST, 1.0)
    async with serving() as robot:
        for _ in range(3):
            await send(port, robot)
    port.close()


async def test_client_that_does_not_read_is_not_heard(monkeypatch):
    """As on a real controller: a second program over ur-rtde's connection never arrives."""
    buffers_are_full = asyncio.Event()
    drain = asyncio.StreamWriter.drain

    async def note(writer: asyncio.StreamWriter) -> None:
        # A buffer that is full for a moment is emptied by the kernel; one that stays so is not.
        stays = asyncio.get_running_loop().call_later(BLOCKED_S, buffers_are_full.set)
        try:
            await drain(writer)
        finally:
            stays.cancel()

    monkeypatch.setattr(asyncio.StreamWriter, "drain", note)
    async with serving() as robot:
        unread = socket.create_connection((HOST, SCRIPT_PORT))
        unread.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        async with asyncio.timeout(10):
            await buffers_are_full.wait()
        unread.sendall(PROGRAM.encode())
        port = ScriptPort(HOST, 1.0)
        await send(port, robot)
        port.close()
        assert not started(robot)
        unread.close()


@contextlib.contextmanager
def listening() -> Iterator[socket.socket]:
    with socket.create_server((HOST, 0)) as server:
        server.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        yield server


def test_peer_that_takes_nothing_is_lost_in_time():
    with listening() as server:
        port = ScriptPort(HOST, 0.2, server.getsockname()[1])
        with pytest.raises(RobotLostError, match="it does not read the program") as lost:
            port.send("x" * (1 << 24))
    assert lost.value.kind == "script"


def test_closed_port_is_named():
    with listening() as server:
        number = server.getsockname()[1]
    with pytest.raises(RobotLostError, match=f"port {number} of the robot at {HOST}: Connection refused"):
        ScriptPort(HOST, 0.2, number).send(PROGRAM)


def test_connection_that_the_peer_closes_is_closed():
    with listening() as server:
        port = ScriptPort(HOST, 1.0, server.getsockname()[1])
        port.send("sync()\n")
        peer, _ = server.accept()
        assert port.drain()
        peer.close()
        while port.drain():
            pass
        # Closing twice is allowed.
        port.close()
