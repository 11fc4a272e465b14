"""`UrRobot` without a controller: the worker's end, and the message about it."""

import asyncio
import gc
import sys
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from shearloop.drivers.ur.client import LAST_WORDS_BYTES, LostError, UrRobot, WorkerConnection
from shearloop.drivers.ur.messages import Failed, Stop, encode
from tests.drivers.ur.flight import SETTINGS, Flight, flying
from tests.drivers.ur.robots import ROOT, running, settings_for
from tests.running import LinkEvents


async def test_absent_controller_is_explained():
    pytest.importorskip("rtde_control", reason="ur-rtde has wheels for CPython up to 3.12 on x86-64 only")
    link = LinkEvents()
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
async def test_error_output_of_a_worker_is_quoted_and_shortened(play, commands, kind, said, ends):
    play(commands)
    link = LinkEvents()
    async with running(settings_for("127.0.0.254"), link) as robot:
        loss = await link.down()
    assert [*robot.losses] == [kind]
    assert said in loss.sentence
    assert loss.sentence.endswith(ends)
    assert len(loss.sentence) < LAST_WORDS_BYTES + 400


BRIEFLY = """
import os, sys
from shearloop.drivers.ur.messages import MessageDecoder, encode
from tests.drivers.ur.flight import Flight

decoder = MessageDecoder()
while not (heard := decoder.feed(os.read(0, 1 << 16))):
    pass
with open(sys.argv[1], "a") as log:
    print(heard[0][1].takes_over, file=log)
flight = Flight()
flight.fly(CYCLES)
os.write(1, encode(flight.state))
"""


DISCONNECTS = """
import os, sys
from shearloop.drivers.ur.command_handler import CommandHandler
from shearloop.drivers.ur.messages import Disconnect, MessageDecoder, encode
from tests.drivers.ur.flight import SETTINGS, FakeArm

os.write(1, encode(CommandHandler(SETTINGS, FakeArm(), 0).state(FakeArm().reading, 0)))
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


# In the first cycle the register is cleared, in the second the program is sent.
@pytest.mark.parametrize(("cycles", "may_stop"), [(0, "False"), (1, "False"), (2, "True"), (5, "True")])
async def test_next_worker_may_stop_the_program_left_behind(play, tmp_path, cycles, may_stop):
    log = tmp_path / "log"
    briefly = BRIEFLY.replace("CYCLES", str(cycles))
    play(f"cd '{ROOT}' && exec '{sys.executable}' -c '{briefly}' '{log}'")
    link = LinkEvents()
    async with running(settings_for("127.0.0.254"), link):
        await link.down(2)
    assert log.read_text().split()[:2] == ["False", may_stop]


STALE, PAUSED = {"age_ns": 400_000_000}, {"safety_mode": 3, "runtime_state": 4}


def lost_after(*readings: dict[str, int], flight: Flight) -> UrRobot:
    """Return a robot that was lost after these samples."""
    robot = UrRobot(SETTINGS)
    for reading in readings:
        flight.arm.be(**reading)
        flight.fly(1)
        robot.handle_message(0, flight.state)
    robot._disconnect()
    return robot


@pytest.mark.parametrize("cycles", [1, 500], ids=["just connected", "for long"])
@pytest.mark.parametrize("last", [{}, STALE, PAUSED], ids=["playing", "silent", "paused"])
@pytest.mark.parametrize("first", [{"runtime_state": 2}, PAUSED], ids=["played", "was paused"])
async def test_earlier_program_does_not_count_as_left_behind(first, last, cycles):
    assert not lost_after(*[first] * cycles, last, flight=Flight()).takes_over


@pytest.mark.parametrize("last", [{}, STALE, PAUSED], ids=["playing", "silent", "paused"])
async def test_our_program_counts_as_left_behind(last):
    flight = flying()
    flight.arm.stoppable = False
    assert lost_after({}, *[last] * 5, flight=flight).takes_over
    # And so on, from process to process, until it was seen to be gone.
    after = Flight(takes_over=True)
    after.arm.be(**{"runtime_state": 2, **last})
    after.arm.stoppable = False
    assert lost_after(*[{}] * 5, flight=after).takes_over


async def test_program_started_after_ours_ended_is_foreign():
    flight = flying()
    flight.arm.end_program()
    assert not lost_after({}, PAUSED, flight=flight).takes_over


async def test_failed_stops_are_counted_across_workers():
    robot = UrRobot(SETTINGS)
    for counts in ((0, 1, 1, 2), (0, 3)):
        for count in counts:
            robot.handle_message(0, replace(Flight().state, failed_program_stops=count))
        robot._disconnect()
    assert robot.failed_program_stops == 5


async def test_unretrieved_loss_causes_no_asyncio_complaint():
    complaints: list[dict[str, Any]] = []
    asyncio.get_running_loop().set_exception_handler(lambda _loop, context: complaints.append(context))
    connection = WorkerConnection(SETTINGS, UrRobot(SETTINGS))
    connection.pipe_data_received(1, encode(Failed("lost", "The connection is lost.")))
    del connection
    gc.collect()
    assert complaints == []


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
        raise LostError("crashed", "The robot's process died.")

    monkeypatch.setattr(WorkerConnection, "listen", listen)
    run = asyncio.create_task(UrRobot(settings_for("127.0.0.254")).run())
    with pytest.raises(asyncio.CancelledError):
        await run
    assert len(listened) == 1
