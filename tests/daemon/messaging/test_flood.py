"""A flood of connections or datagrams: `stop` and `status` get through."""

import asyncio
import os
import resource
import socket
import subprocess
import sys
import threading
from collections.abc import AsyncIterator, Iterator
from contextlib import ExitStack, asynccontextmanager, closing, suppress

import pytest
import zmq
import zmq.asyncio

from shearloop.cli import main
from shearloop.daemon.messaging import stop_client
from shearloop.daemon.messaging.addresses import stop_name
from shearloop.daemon.messaging.client import receive_messages
from shearloop.daemon.messaging.command_server import (
    LARGEST_REQUEST_BYTES,
    CommandRefusedError,
    CommandServer,
    Reply,
    Request,
)
from shearloop.daemon.messaging.messages import encode
from shearloop.daemon.messaging.refusals import Refusals
from shearloop.daemon.messaging.stop_client import StopSocketTakenError, owners, send_to_stop_socket
from shearloop.daemon.messaging.stop_socket import StopSocket
from shearloop.daemon.process import MAX_DESCRIPTORS, raise_descriptor_limit
from shearloop.daemon.supervisor import resident_memory_mb
from shearloop.errors import UserError
from tests.fixtures.daemons import DEADLINE_S, free_port
from tests.running import running

DESCRIPTORS, CONNECTIONS = 512, 1200


def test_the_limit_of_descriptors_is_raised_as_far_as_the_system_allows():
    for hard, raised in ((512, 512), (MAX_DESCRIPTORS + 1, MAX_DESCRIPTORS)):
        code = (
            "import resource as r; from shearloop.daemon.process import raise_descriptor_limit\n"
            f"r.setrlimit(r.RLIMIT_NOFILE, (64, {hard})); raise_descriptor_limit()\n"
            "print(r.getrlimit(r.RLIMIT_NOFILE)[0])"
        )
        assert int(subprocess.run([sys.executable, "-c", code], capture_output=True, check=True).stdout) == raised


@pytest.fixture
def descriptors() -> Iterator[None]:
    """Let this process have the descriptors of all connections: a user has 1024 at first."""
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    raise_descriptor_limit()
    yield
    resource.setrlimit(resource.RLIMIT_NOFILE, limits)


@pytest.mark.long
@pytest.mark.usefixtures("descriptors")
@pytest.mark.parametrize("key", ["publish", "commands"])
async def test_stop_is_fast_in_a_flood_of_idle_connections(key, config):
    """Also when the connections take every descriptor that the daemon may have."""
    addresses = {one: f"tcp://127.0.0.1:{free_port()}" for one in ("publish", "commands")}
    port = int(addresses[key].rpartition(":")[2])
    command = f"ulimit -n {DESCRIPTORS}; exec {sys.executable} -m shearloop run {config(**addresses)}"
    daemon = await asyncio.create_subprocess_shell(command, stderr=asyncio.subprocess.PIPE)
    health = receive_messages(addresses["publish"], ["health"], DEADLINE_S)
    with closing(health), ExitStack() as stack:
        stack.callback(lambda: daemon.returncode is None and daemon.kill())
        await asyncio.to_thread(next, health)
        await asyncio.to_thread(open_connections, ("127.0.0.1", port), stack)
        # The subscriber from before is still served.
        await asyncio.to_thread(next, health)
        for name in ("status", "stop"):
            assert await asyncio.to_thread(main, ["command", name, "--connect", addresses["commands"]]) == 0
        await daemon.communicate()
    assert daemon.returncode == 0


@asynccontextmanager
async def stop_socket(address: str, refusals: Refusals) -> AsyncIterator[None]:
    """Serve the stop socket of a command address: `stop` is accepted and `start` refused."""

    async def handle(_request: Request) -> Reply:
        return {"stopped": "test"}

    async def refuse(_request: Request) -> Reply:
        raise CommandRefusedError("not here")

    with closing(StopSocket(address, {"stop": handle, "start": refuse}, refusals)) as stop:
        async with running(stop.run()):
            yield


async def test_the_stop_socket_answers_in_a_flood_of_datagrams():
    refusals, address = Refusals(), f"tcp://127.0.0.1:{free_port()}"
    flooding = threading.Event()
    flood = threading.Thread(target=send_garbage, args=(stop_name(address), flooding))
    async with stop_socket(address, refusals):
        with pytest.raises(UserError, match="is another daemon running"):
            StopSocket(address, {}, refusals)
        flooding.set()
        flood.start()
        try:
            for name, reply in (
                ("stop", {"ok": True, "stopped": "test"}),
                ("start", {"ok": False, "reason": "not here"}),
            ):
                replied = await asyncio.to_thread(send_to_stop_socket, address, {"command": name}, DEADLINE_S)
                assert replied == reply
            assert sum(refusals.counts.values()) > 1
        finally:
            flooding.clear()
            flood.join()
    assert send_to_stop_socket(address, {"command": "stop"}, DEADLINE_S) is None
    assert send_to_stop_socket("ipc:///" + "ä" * 500, {"command": "stop"}, DEADLINE_S) is None
    assert stop_name("tcp://0.0.0.0:7762") == stop_name("tcp://127.0.0.1:7762")


@pytest.mark.parametrize(
    ("bound", "asked", "reached"),
    [
        ("tcp://127.0.0.22:{port}", "tcp://127.0.0.22:{port}", True),
        ("tcp://127.0.0.22:{port}", "tcp://127.0.0.99:{port}", False),
        ("tcp://127.0.0.22:{port}", "tcp://127.0.0.1:{port}", False),
        ("tcp://0.0.0.0:{port}", "tcp://127.0.0.99:{port}", True),
        # No other daemon of this computer can be meant.
        ("tcp://192.168.1.5:{port}", "tcp://127.0.0.1:{port}", True),
        ("tcp://eth0:{port}", "tcp://192.168.1.5:{port}", True),
        ("tcp://127.0.0.1:{port}", "tcp://localhost:{port}", True),
        ("tcp://[::1]:{port}", "tcp://[0:0:0:0:0:0:0:1]:{port}", True),
    ],
)
async def test_a_stop_reaches_the_daemon_at_its_address_alone(bound, asked, reached):
    """The stop socket's name has only the port."""
    port = free_port()
    async with stop_socket(bound.format(port=port), Refusals()):
        request = {"command": "stop"}
        reply = await asyncio.to_thread(send_to_stop_socket, asked.format(port=port), request, DEADLINE_S)
        assert reply == ({"ok": True, "stopped": "test"} if reached else None)


async def test_a_client_that_reads_no_replies_does_not_keep_those_of_others(capsys):
    address = f"tcp://127.0.0.1:{free_port()}"
    async with stop_socket(address, Refusals()):
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as idle:
            idle.bind("")
            idle.connect(stop_name(address))
            # Far more than the send buffer of a socket holds.
            for _ in range(2000):
                await asyncio.to_thread(idle.send, encode({"command": "start"}))
            assert await asyncio.to_thread(main, ["command", "stop", "--connect", address]) == 0
    assert capsys.readouterr().out.endswith("\nstop: stopped test\n")


@pytest.mark.parametrize("answer", [b"", b"no", b"\x01", b"\x91\x01", b"\x81\x01\x01"])
async def test_a_foreign_reply_to_a_stop_is_one_sentence(answer):
    address = f"tcp://127.0.0.1:{free_port()}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as foreign:
        foreign.bind(stop_name(address))
        asked = asyncio.create_task(asyncio.to_thread(send_to_stop_socket, address, {"command": "stop"}, DEADLINE_S))
        _, client = await asyncio.to_thread(foreign.recvfrom, 1024)
        foreign.sendto(answer, client)
        with pytest.raises(UserError, match="is not a shearloop daemon"):
            await asked


async def test_a_stop_without_a_reply_is_sent_again_and_spares_the_daemon():
    received: list[Request] = []

    async def stop(request: Request) -> Reply:
        received.append(request)
        return {}

    with (
        zmq.asyncio.Context() as context,
        socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as silent,
        closing(CommandServer(context, "tcp://127.0.0.1:*", {"stop": stop}, Refusals())) as server,
    ):
        silent.bind(stop_name(server.address))
        async with running(server.run()):
            assert await asyncio.to_thread(main, ["command", "stop", "--connect", server.address]) == 0
    assert [(one["command"], one["spare_daemon"]) for one in received] == [("stop", True)]


def open_connections(address: tuple[str, int], stack: ExitStack) -> None:
    """Open connections one after another; once one has to wait, begin the others without waiting."""
    wait_s = 1.0
    for _ in range(CONNECTIONS):
        client = stack.enter_context(socket.socket())
        client.settimeout(wait_s)
        try:
            client.connect(address)
        except (TimeoutError, BlockingIOError):
            wait_s = 0.0


def send_garbage(name: bytes, flooding: threading.Event) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as client:
        client.bind("")
        client.setblocking(False)
        while flooding.is_set():
            with suppress(OSError):
                client.sendto(b"\x81" * 1000, name)


async def test_requests_of_many_frames_do_not_fill_the_memory():
    frames = [b"x" * LARGEST_REQUEST_BYTES] * 8
    refusals = Refusals()
    with zmq.asyncio.Context() as context, zmq.Context() as theirs, theirs.socket(zmq.DEALER) as client:
        server = CommandServer(context, "tcp://127.0.0.1:*", {}, refusals)
        client.setsockopt(zmq.LINGER, 0)
        client.setsockopt(zmq.SNDHWM, 1)
        client.setsockopt(zmq.SNDTIMEO, 500)
        client.connect(server.address)
        before_mb, sent = resident_memory_mb(), 0
        # Nothing reads yet.
        with suppress(zmq.Again):
            for sent in range(4000):  # noqa: B007 - the number of those before the last
                client.send_multipart(frames)
        assert resident_memory_mb() - before_mb < 50
        serving = asyncio.create_task(server.run())
        while sum(refusals.counts.values()) < sent:  # noqa: ASYNC110 - counts have no event
            await asyncio.sleep(0.01)
        serving.cancel()
        await asyncio.gather(serving, return_exceptions=True)
        server.close()


NOBODY = 65534


def hold_name(address: str, held: int) -> None:
    """Take the name of a stop socket as another user, and answer one request as a daemon would."""
    os.setuid(NOBODY)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as taken:
        taken.bind(stop_name(address))
        os.write(held, b"1")
        _, client = taken.recvfrom(1024)
        taken.sendto(encode({"ok": True, "stopped": "everything"}), client)


@pytest.mark.skipif(os.getuid() != 0, reason="only root can pose as another user")
def test_a_stop_socket_of_another_user_is_not_believed():
    address = f"tcp://127.0.0.1:{free_port()}"
    ready, held = os.pipe()
    pid = os.fork()
    if pid == 0:
        try:
            hold_name(address, held)
        finally:
            os._exit(0)
    try:
        assert os.read(ready, 1) == b"1"
        with pytest.raises(UserError, match="if another user holds its name"):
            StopSocket(address, {}, Refusals())
        with pytest.raises(StopSocketTakenError, match=f"held by the user {NOBODY}, who does not run the daemon"):
            send_to_stop_socket(address, {"command": "stop"}, DEADLINE_S)
    finally:
        os.waitpid(pid, 0)
        os.close(ready)
        os.close(held)


def test_the_owner_of_the_command_address_is_believed(tmp_path):
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen()
        assert owners(f"tcp://127.0.0.1:{listener.getsockname()[1]}") == {0, os.getuid()}
    path = tmp_path / "commands"
    path.touch()
    if os.getuid() == 0:
        os.chown(path, NOBODY, NOBODY)
        assert owners(f"ipc://{path}") == {0, NOBODY}
    assert owners(f"ipc://{tmp_path}/none") == {0, os.getuid()}


def listener_of(user: int, host: str, port: int) -> socket.socket:
    """Listen as another user."""
    os.seteuid(user)
    try:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        listener = socket.socket(family)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((host, port))
        listener.listen()
    finally:
        os.seteuid(0)
    return listener


@pytest.mark.skipif(os.getuid() != 0, reason="only root can pose as another user")
@pytest.mark.parametrize(
    ("theirs", "asked", "believed"),
    [
        ("127.0.0.1", "127.0.0.1", True),
        ("127.0.0.1", "localhost", True),
        ("0.0.0.0", "127.0.0.1", True),  # noqa: S104 - a daemon with keys
        ("::", "127.0.0.1", True),
        ("::1", "[::1]", True),
        ("::ffff:127.0.0.1", "127.0.0.1", True),
        ("127.0.0.2", "127.0.0.1", False),
        ("127.0.0.2", "localhost", False),
        ("::1", "localhost", False),
        ("::1", "127.0.0.1", False),
    ],
)
def test_who_listens_at_another_address_of_the_same_port_is_not_believed(theirs, asked, believed):
    port = free_port()
    with listener_of(NOBODY, theirs, port):
        assert (NOBODY in owners(f"tcp://{asked}:{port}")) is believed


async def test_a_stop_to_a_daemon_of_this_computer_at_its_network_address_needs_no_key(monkeypatch):
    address = f"tcp://192.0.2.1:{free_port()}"
    # An address of this computer, which a test cannot know.
    monkeypatch.setattr(stop_client, "is_here", lambda asked: asked == address)
    async with stop_socket(address, Refusals()):
        assert await asyncio.to_thread(main, ["command", "stop", "--connect", address]) == 0


@pytest.mark.parametrize(
    ("address", "here"),
    [
        ("tcp://127.0.0.1:7762", True),
        ("tcp://127.5.6.7:7762", True),
        ("tcp://192.0.2.254:7762", False),
        ("tcp://[2001:db8::1]:7762", False),
        ("tcp://lab-pc:7762", False),
        ("ipc:///tmp/commands", False),
    ],
)
def test_only_the_number_of_an_interface_is_of_this_computer(address, here):
    assert stop_client.is_here(address) is here
