"""`UrRobot` without a controller: the worker's end, and the message about it."""

import asyncio
import gc
import sys
import weakref
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from shearloop.drivers.ur import client
from shearloop.drivers.ur.client import LAST_WORDS_BYTES, UrRobot, WorkerConnection
from shearloop.drivers.ur.messages import CommandReply, Held, RobotLostError, Stop, Unlock, WristSpeed, ZeroForceTorque
from tests import running as tasks
from tests.drivers.ur.handler_bench import SETTINGS, HandlerBench
from tests.drivers.ur.robots import ROOT, running, settings_for
from tests.fixtures.daemons import DEADLINE_S

RESTORED = (0.0, 0.0, 0.0, 0.0, 0.0, 0.5)


async def test_absent_controller_is_explained(link):
    pytest.importorskip("rtde_control", reason="ur-rtde has wheels for CPython up to 3.12 on x86-64 only")
    async with running(settings_for("127.0.0.254"), link) as robot:
        loss = await link.down()
        assert robot.losses == {"unreachable": 1}
        assert "No UR controller at 127.0.0.254" in loss.sentence
        assert "refused" in loss.sentence


@pytest.fixture
def play(tmp_path, monkeypatch) -> Callable[[str], None]:
    """Run shell commands instead of the worker."""

    def write(commands: str) -> None:
        script = tmp_path / "process"
        script.write_text(f"#!/bin/sh\n{commands}\n")
        script.chmod(0o700)
        monkeypatch.setattr(sys, "executable", str(script))

    return write


@pytest.mark.parametrize(
    ("commands", "kind", "said", "ends"),
    [
        ("echo 'waiting for the dashboard' >&2; kill -ALRM $$", "hung", "", "words: waiting for the dashboard."),
        (
            "head -c 300000 /dev/zero | tr '\\0' x >&2; echo >&2; echo 'no memory' >&2; exit 3",
            *("crashed", "ended with status 3", "xxx / no memory."),
        ),
    ],
    ids=["ended by its alarm", "long"],
)
async def test_error_output_of_a_worker_is_quoted_and_shortened(play, link, commands, kind, said, ends):
    play(commands)
    async with running(settings_for("127.0.0.254"), link) as robot:
        loss = await link.down()
    assert [*robot.losses] == [kind]
    assert said in loss.sentence
    assert loss.sentence.endswith(ends)
    assert len(loss.sentence) < LAST_WORDS_BYTES + 400


DISCONNECTS = """
import os, sys
from shearloop.drivers.ur.command_handler import CommandHandler
from shearloop.drivers.ur.messages import Disconnect, MessageDecoder, encode
from tests.drivers.ur.handler_bench import SETTINGS, FakeArm

handler = CommandHandler(SETTINGS, FakeArm(), 0)
handler.take(FakeArm().reading)
os.write(1, encode(handler.state(0)))
decoder, last = MessageDecoder(), None
while heard := os.read(0, 1 << 16):
    for _, last in decoder.feed(heard):
        pass
with open(sys.argv[1], "a") as log:
    print(isinstance(last, Disconnect), file=log)
"""


async def test_disconnects_and_refuses_what_is_unanswered(play, tmp_path):
    log = tmp_path / "log"
    play(f"cd '{ROOT}' && exec '{sys.executable}' -c '{DISCONNECTS}' '{log}'")
    async with asyncio.timeout(60):
        async with running(settings_for("127.0.0.254")) as robot:
            await robot.next_state()
            replied = robot.send(Stop(1.0))
        assert "ended before it answered" in (await replied).refusal
    assert robot.state is None
    assert log.read_text() == "True\n", "it exits on Disconnect"


async def test_who_gave_up_waiting_for_a_state_is_not_kept():
    """A robot may be off for days, and the loop waits ten times a second."""
    robot = UrRobot(settings_for("127.0.0.254"))
    kept: weakref.WeakSet[asyncio.Future[Any]] = weakref.WeakSet()
    loop = asyncio.get_running_loop()
    create_future = loop.create_future

    def noted() -> asyncio.Future[Any]:
        future = create_future()
        kept.add(future)
        return future

    loop.create_future = noted
    for _ in range(20):
        waiter = asyncio.ensure_future(robot.next_state())
        await asyncio.sleep(0)
        waiter.cancel()
        await asyncio.gather(waiter, return_exceptions=True)
    del waiter
    gc.collect()
    assert len(kept) <= 1


async def test_worker_that_ends_during_shutdown_is_awaited(play, monkeypatch):
    play("exit 1")
    begun, may_end = asyncio.Event(), asyncio.Event()
    real, ended = WorkerConnection.end, []

    async def end(conversation: WorkerConnection) -> None:
        begun.set()
        await may_end.wait()
        await real(conversation)
        ended.append(conversation)

    monkeypatch.setattr(WorkerConnection, "end", end)
    run = asyncio.create_task(UrRobot(settings_for("127.0.0.254")).run())
    await begun.wait()
    run.cancel()
    asyncio.get_running_loop().call_soon(may_end.set)
    with pytest.raises(asyncio.CancelledError):
        await run
    assert len(ended) == 1


async def test_worker_lost_during_shutdown_is_not_restarted(play, monkeypatch):
    """The cancellation must not get lost, also when it comes together with the loss."""
    play("exec cat")
    listened: list[WorkerConnection] = []

    async def listen(conversation: WorkerConnection) -> None:
        assert not listened, "it was started again"
        listened.append(conversation)
        run.cancel()
        raise RobotLostError("crashed", "The worker died.")

    monkeypatch.setattr(WorkerConnection, "listen", listen)
    run = asyncio.create_task(UrRobot(settings_for("127.0.0.254")).run())
    with pytest.raises(asyncio.CancelledError):
        await run
    assert len(listened) == 1


@pytest.fixture
def told(monkeypatch) -> list[Held]:
    """What a worker is told of what is held."""
    messages: list[Held] = []
    send = WorkerConnection.send

    def note(connection: WorkerConnection, message: object, number: int = 0) -> None:
        if isinstance(message, Held):
            messages.append(message)
        send(connection, message, number)

    monkeypatch.setattr(WorkerConnection, "send", note)
    return messages


async def worker_told(told: list[Held]) -> None:
    """Wait for the first message to the worker, whose start is no event."""
    async with asyncio.timeout(DEADLINE_S):
        while not told:  # noqa: ASYNC110 - the worker's start is no event
            await asyncio.sleep(0)


async def test_a_worker_gets_what_is_held_at_its_start_and_at_each_change(play, told):
    play("exec cat")
    holds = [True]
    robot = UrRobot(settings_for("127.0.0.254"), holds=lambda: holds[0])
    robot.restore_wrench_zero(RESTORED)
    bench = HandlerBench()
    async with tasks.running(robot.run()):
        await worker_told(told)
        for now in (True, False, False, True):
            holds[0] = now
            robot.handle_message(0, bench.state)
            await asyncio.sleep(0)
    assert told == [Held(held=True, wrench_zero=RESTORED), Held(held=False), Held(held=True)]


async def test_an_unlock_comes_after_what_is_held_now(play, told):
    """It may start a program, which keeps the wrench's zero under a tool; a wrist speed starts none."""
    play("exec cat")
    holds = [True]
    robot = UrRobot(settings_for("127.0.0.254"), holds=lambda: holds[0])
    async with tasks.running(robot.run()):
        await worker_told(told)
        robot.handle_message(0, HandlerBench().state)
        holds[0] = False
        robot.send(WristSpeed(0.1, 1.0))
        assert told[-1].held
        robot.send(Unlock())
        assert told[-1] == Held(held=False)


async def test_a_restored_zero_that_is_taken_back_leaves_what_the_program_has_added(play, told):
    play("exec cat")
    robot = UrRobot(settings_for("127.0.0.254"), holds=lambda: True)
    robot.restore_wrench_zero(RESTORED)
    async with tasks.running(robot.run()):
        await worker_told(told)
        # The start of its program made it another one.
        robot.handle_message(0, replace(HandlerBench().state, wrench_zero=(0.0, 0.0, 0.0, 0.0, 0.0, 0.75)))
        robot.forget_wrench_zero()
    assert robot.wrench_zero == (0.0, 0.0, 0.0, 0.0, 0.0, 0.25)
    assert told[-1] == Held(held=True, wrench_zero=robot.wrench_zero)


@pytest.mark.parametrize("tared", [True, False], ids=["by a tare", "by a program's start without a load"])
async def test_a_restored_zero_that_has_ended_is_not_taken_back(play, told, tared):
    play("exec cat")
    # After a tare, the zero of a controller that cannot zero its own wrench is any value.
    new_zero = (0.0, 0.0, 0.0, 0.0, 0.0, 1.5 if tared else 0.0)
    robot = UrRobot(settings_for("127.0.0.254"), holds=lambda: True)
    robot.restore_wrench_zero(RESTORED)
    async with tasks.running(robot.run()):
        await worker_told(told)
        robot.handle_message(0, replace(HandlerBench().state, wrench_zero=RESTORED))
        if tared:
            reply = robot.send(ZeroForceTorque())
            robot.handle_message(1, CommandReply())
            await reply
            await asyncio.sleep(0)
        robot.handle_message(0, replace(HandlerBench().state, wrench_zero=new_zero))
        robot.forget_wrench_zero()
    assert robot.wrench_zero == new_zero


async def test_a_worker_is_not_silent_while_the_daemon_stood_still(monkeypatch):
    """What it sends meanwhile is unread."""
    now_s = 100.0
    monkeypatch.setattr(client, "time", SimpleNamespace(monotonic=lambda: now_s))
    monkeypatch.setattr(client, "WATCH_S", 0.001)
    monkeypatch.setattr(client, "GRACE_S", 0.0)
    settings = replace(SETTINGS, connect_timeout_s=0.02)
    worker = WorkerConnection(settings, UrRobot(settings))
    monkeypatch.setattr(worker, "_kill", lambda: None)
    looks = 0

    def look() -> bool:
        """Let 10 s pass before the second look, and then less than the interval of the looks."""
        nonlocal looks, now_s
        looks += 1
        now_s += 10.0 if looks == 2 else 0.0009
        return False

    monkeypatch.setattr(worker, "_closed", SimpleNamespace(is_set=look, wait=lambda: asyncio.sleep(1)))
    with pytest.raises(RobotLostError):
        await worker.listen()
    assert looks > 10, "the ten seconds were the daemon's own"
