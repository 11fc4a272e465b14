import asyncio
import ctypes
import resource
import signal
import socket
from collections.abc import Iterator
from contextlib import closing
from types import SimpleNamespace

import pytest
import zmq

from shearloop.daemon import supervisor as supervision
from shearloop.daemon.clock import Clock
from shearloop.daemon.messaging.publisher import Publisher
from shearloop.daemon.process import lock_memory
from shearloop.daemon.sd_notify import notify
from shearloop.daemon.supervisor import Supervisor, TaskRecord
from shearloop.errors import UserError
from tests.fixtures.daemons import DEADLINE_S, shearloop
from tests.running import running


@pytest.fixture
def manager(tmp_path, monkeypatch) -> Iterator[socket.socket]:
    """What systemd listens with."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening:
        listening.bind(str(tmp_path / "notify"))
        listening.settimeout(DEADLINE_S)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        yield listening


def test_no_notification_without_a_service_manager(monkeypatch, tmp_path):
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    assert not notify("READY=1")
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "gone"))
    assert not notify("READY=1")


def test_states_arrive_at_a_path_and_an_abstract_address(manager, monkeypatch):
    assert notify("READY=1", "STATUS=well")
    assert manager.recv(4096) == b"READY=1\nSTATUS=well"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as abstract:
        # The kernel chooses a free abstract name.
        abstract.bind("")
        abstract.settimeout(DEADLINE_S)
        monkeypatch.setenv("NOTIFY_SOCKET", "@" + abstract.getsockname()[1:].decode())
        assert notify("WATCHDOG=1")
        assert abstract.recv(4096) == b"WATCHDOG=1"


def test_a_blocked_manager_does_not_block_the_daemon(manager):
    # The kernel queues a few datagrams; the daemon must not wait for room.
    assert not all(notify("WATCHDOG=1") for _ in range(2000))
    assert manager.recv(4096) == b"WATCHDOG=1"


async def test_the_daemon_notifies_ready_alive_and_stopping(manager, config):
    async with shearloop("run", str(config())) as daemon:
        assert await asyncio.to_thread(manager.recv, 4096) == b"READY=1"
        said = await asyncio.to_thread(manager.recv, 4096)
        assert said.startswith(b"WATCHDOG=1\nSTATUS=6 tasks are alive")
        daemon.send_signal(signal.SIGTERM)
        assert await daemon.wait() == 0
    while said != b"STOPPING=1":
        said = manager.recv(4096)


async def test_the_watchdog_is_fed_only_while_all_tasks_are_alive(manager, tmp_path, monkeypatch):
    monkeypatch.setattr(supervision, "HEALTH_PERIOD_S", 0.0)
    supervisor = Supervisor({"right": TaskRecord(alive=True), "experiment": TaskRecord(done=True)})
    with zmq.Context() as context, closing(Publisher(context, f"ipc://{tmp_path}/publish", Clock())) as publisher:
        async with running(supervision.HealthReporter(publisher, supervisor, Clock()).run()):
            said = await asyncio.to_thread(manager.recv, 4096)
            assert said == b"WATCHDOG=1\nSTATUS=2 tasks are alive", "an experiment that has ended is not dead"
            supervisor.dead["right"] = "ValueError: no number"
            while said.startswith(b"WATCHDOG=1"):
                said = await asyncio.to_thread(manager.recv, 4096)
            assert said == b"STATUS=dead, restarting: right"
            assert await asyncio.to_thread(manager.recv, 4096) == said, "and it stays hungry"


async def test_a_finished_task_is_not_dead():
    supervisor = Supervisor()

    async def ends() -> None:
        assert not supervisor.dead

    await supervisor.keep_running("experiment", SimpleNamespace(run=ends))
    assert not supervisor.dead


def test_failing_to_lock_memory_is_one_sentence(monkeypatch):
    monkeypatch.setattr("os.geteuid", lambda: 1000)
    monkeypatch.setattr(resource, "getrlimit", lambda _: (8 << 20, 8 << 20))
    with pytest.raises(UserError, match="needs an unlimited RLIMIT_MEMLOCK, and it is 8192 kB: run `sudo shearloop"):
        lock_memory()

    class Libc:
        @staticmethod
        def mlockall(flags: int) -> int:
            assert flags == 3
            ctypes.set_errno(1)
            return -1

    monkeypatch.setattr(resource, "getrlimit", lambda _: (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    monkeypatch.setattr(ctypes, "CDLL", lambda *_, **__: Libc)
    with pytest.raises(UserError, match="the system refused"):
        lock_memory()
