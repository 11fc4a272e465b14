"""The commissioning's end of what drives the robot: which process gets a signal, and what a failed request reports."""

import asyncio
import io
import json
import os
import signal
import socket
import subprocess
from typing import Any

import pytest

from shearloop.drivers.defaults import RTDE_PORT
from shearloop.drivers.ur.messages import CommandReply
from shearloop.drivers.ur.receiver import RtdeReceiver
from shearloop.drivers.ur.script import UPPER
from shearloop.errors import UserError
from shearloop.tools.commission import mover
from shearloop.tools.commission.failing_worker import ForgetfulReceiver, close_rtde
from shearloop.tools.commission.mover import MoverProcess
from shearloop.tools.commission.mover_process import Driver
from shearloop.tools.commission.observer_process import ObserverProcess
from tests.drivers.ur.robots import DELIVERED
from tests.emulator_process import own_address
from tests.running import DEADLINE_S

HOST = own_address(6)
WORKER, LATER_WORKER = 4_190_001, 4_190_002


class FakeProcess:
    """A process that names a worker at once, and another one in its last line."""

    pid = 4_190_000

    def __init__(self, *_arguments: object, **_options: object) -> None:
        stdout, self._writes = os.pipe()
        self.stdin, self.stdout = io.StringIO(), os.fdopen(stdout)
        self._say(WORKER)

    def _say(self, worker: int) -> None:
        os.write(self._writes, f"{json.dumps({'event': 'connected', 't_ns': 1, 'worker': worker})}\n".encode())

    def kill(self) -> None:
        """Be killed."""

    def wait(self) -> None:
        self._say(LATER_WORKER)
        os.close(self._writes)


@pytest.fixture
def signals(monkeypatch) -> list[tuple[int, signal.Signals]]:
    """Return the signals that were sent; none arrives anywhere."""
    sent: list[tuple[int, signal.Signals]] = []
    monkeypatch.setattr(os, "kill", lambda pid, number: sent.append((pid, number)))
    monkeypatch.setattr(subprocess, "Popen", FakeProcess)
    assert mover.subprocess.Popen is FakeProcess
    return sent


@pytest.mark.usefixtures("default_signals")
def test_ctrl_c_ends_the_processes_without_a_word_also_while_they_load(capfd, monkeypatch):
    """The terminal sends it to each of them, at any time. The commissioning ends its observer by itself."""
    started: list[subprocess.Popen[Any]] = []
    popen = subprocess.Popen
    monkeypatch.setattr(
        subprocess, "Popen", lambda *words, **options: started.append(popen(*words, **options)) or started[-1]
    )
    with MoverProcess(DELIVERED):
        started[0].send_signal(signal.SIGINT)
        assert started[0].wait(DEADLINE_S) == 0
    observer = ObserverProcess(HOST, 125.0, UPPER)
    monkeypatch.setattr(observer, "wait_for", lambda *_: "a sample")
    with observer:
        started[1].send_signal(signal.SIGINT)
    assert started[1].returncode == -signal.SIGKILL
    assert capfd.readouterr() == ("", "")


def test_a_worker_that_is_not_known_is_not_stopped(signals):
    """Process 0 is the whole group of the caller."""
    with pytest.raises(UserError, match="not been connected"):
        MoverProcess(DELIVERED).stop_worker()
    assert signals == []


def test_a_worker_is_forgotten_once_it_was_killed(signals):
    """Its number may be another process's later, also where the last lines of the process name another worker."""
    process = MoverProcess(DELIVERED)
    process.start()
    assert process.event("connected", 0, 5.0) is not None
    process.kill()
    assert [pid for pid, number in signals if number == signal.SIGKILL and pid != FakeProcess.pid][-1] == LATER_WORKER
    signals.clear()
    with pytest.raises(UserError, match="not been connected"):
        process.stop_worker()
    process.kill()
    assert signals == []


class Here:
    """The surroundings of a request, and a robot that has a state."""

    state = object()

    def __init__(self) -> None:
        self.reports: list[tuple[str, dict[str, object]]] = []

    def report(self, event: str, **facts: object) -> None:
        self.reports.append((event, facts))


def test_a_request_that_fails_is_reported(capsys):
    here = Here()
    asyncio.run(Driver(DELIVERED, here, here).handle({"do": "turn"}))
    ((event, facts),) = here.reports
    assert (event, facts["do"]) == ("ended", "turn")
    assert "rad_per_s" in str(facts["refusal"])
    assert "Traceback" in capsys.readouterr().err


def test_a_motion_is_asked_about_before_its_request_and_no_other_request_is():
    done: list[object] = []

    class Noted(MoverProcess):
        def send(self, request: dict[str, object]) -> None:
            done.append((request["do"], request["asked_boot_ns"]))

    noted = Noted(DELIVERED, lambda: len(done))
    noted.before_motion = lambda: done.append("asked")
    for do in ("unlock", "turn", "line", "swing", "stop"):
        noted.request(do)
    assert done == [("unlock", 0), "asked", ("turn", 2), "asked", ("line", 4), "asked", ("swing", 6), ("stop", 7)]


@pytest.mark.parametrize(("do", "refused"), [("turn", True), ("swing", True), ("line", True), ("unlock", False)])
def test_no_motion_begins_that_was_asked_for_before_a_standstill(do, refused):
    """Its request was on the way while the computer was suspended."""
    here, sent = Here(), []

    async def send(command: object) -> CommandReply:
        sent.append(command)
        return CommandReply(refusal="enough")

    here.send = send
    driver = Driver(DELIVERED, here, here, lambda: 47_000_000_000)
    asyncio.run(driver.handle({"do": do, "asked_boot_ns": 6_000_000_000}))
    ((_, facts),) = here.reports
    assert ("asked for 41 s ago" in facts["refusal"]) is refused
    assert bool(sent) is not refused


def test_a_worker_without_deadlines_writes_none_from_its_signal_on(monkeypatch):
    class Receiver(ForgetfulReceiver):
        """One of this test's own."""

        def __init__(self) -> None:
            """Connect nowhere."""

    written: list[int] = []
    monkeypatch.setattr(RtdeReceiver, "write_deadline", lambda _, ticks: written.append(ticks))
    receiver = Receiver()
    receiver.write_deadline(3)
    Receiver.forget()
    receiver.write_deadline(4)
    assert written == [3]


def test_a_worker_closes_each_of_its_connections_to_rtde_and_no_other():
    with socket.create_server((HOST, RTDE_PORT)) as rtde, socket.create_server((HOST, 0)) as other:
        # As the pipe to the daemon is one.
        ends = [socket.socketpair()]
        for server in (rtde, rtde, other):
            client = socket.create_connection(server.getsockname())
            ends.append((client, server.accept()[0]))
        close_rtde()
        for client, peer in ends:
            client.settimeout(5.0)
            with client, peer:
                if client.getpeername()[1:2] != (RTDE_PORT,):
                    peer.sendall(b"x")
                    assert client.recv(1) == b"x"
                else:
                    assert client.recv(1) == b""
