"""A hundred thousand malformed frames and requests: no crash, no leak, no motion, and every one of them counted."""

import asyncio
import os
import random
import tty
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from typing import Any
from unittest.mock import AsyncMock

import pytest
import zmq
import zmq.asyncio

from shearloop.daemon.config import load_daemon_config
from shearloop.daemon.messaging import command_server
from shearloop.daemon.messaging.command_server import RateLimit
from shearloop.daemon.messaging.messages import decode, encode
from shearloop.daemon.supervisor import resident_memory_mb
from shearloop.drivers.ur.client import UrRobot
from shearloop.drivers.ur.messages import CommandReply
from tests.fixtures.daemons import of_now, running_daemon
from tests.fixtures.robots import write_filled_in

FRAMES = REQUESTS = 50_000
DEADLINE_S = 120
# What the daemon may keep of it all: caches, free lists, its sockets' buffers.
MAX_GROWTH_MB = 16.0
COMMANDS = ("tare", "start", "pause", "resume", "stop", "status", "unlock")


def malformed_requests(count: int) -> Iterator[list[bytes]]:
    """Yield requests, each one or several frames, of which none is a command."""
    chance = random.Random(1)
    sound = [encode({"command": name, "experiment": "config/experiments/hold_torque.yaml"}) for name in COMMANDS]
    kinds: list[Callable[[], list[bytes]]] = [
        lambda: [chance.randbytes(chance.randrange(60))],
        lambda: [(whole := chance.choice(sound))[: chance.randrange(len(whole))]],
        lambda: [flipped(chance.choice(sound), chance)],
        lambda: [encode({"command": chance.choice(COMMANDS).upper()})],
        lambda: [encode({"command": chance.choice([None, 1, ["start"], {"start": 1}, b"start", 1.5, True])})],
        lambda: [encode({"commands": "start"})],
        lambda: [chance.choice(sound), chance.choice(sound)],
        lambda: [b"", b"", chance.choice(sound)],
        lambda: [b"\x81" * chance.randrange(300)],
        lambda: [encode({"command": "x" * chance.randrange(2000)})],
    ]
    made = 0
    while made < count:
        frames = chance.choice(kinds)()
        # What is a command after all, by a flip of a bit elsewhere, is not sent; nor the delimiter alone of a REQ.
        if len(frames) == 1 and is_command(frames[0]):
            continue
        made += 1
        yield frames


def flipped(payload: bytes, chance: random.Random) -> bytes:
    position = chance.randrange(len(payload))
    return payload[:position] + bytes([payload[position] ^ 1 << chance.randrange(8)]) + payload[position + 1 :]


def is_command(payload: bytes) -> bool:
    try:
        return decode(payload).get("command") in COMMANDS
    except (ValueError, TypeError):
        return False


def malformed_frames(count: int) -> Iterator[bytes]:
    """Yield lines that are no frame of the EIT-kit: as a whole 10 MB of them."""
    chance = random.Random(2)
    for number in range(count):
        if number % 500 == 0:
            yield b"0.1234, " * chance.choice([1023, 1025, 3000]) + b"\n"
        elif number % 500 == 1:
            yield b"nan, " * 1024 + b"\n"
        else:
            yield chance.randbytes(chance.randrange(80)).replace(b"\n", b"") + b"\n"


@pytest.mark.long
@pytest.mark.usefixtures("ur_rtde")
async def test_a_flood_of_malformed_frames_and_requests(config, tiny_bank, tmp_path, monkeypatch):
    arm = AsyncMock(return_value=CommandReply())
    monkeypatch.setattr(UrRobot, "send", arm)
    for name in ("run", "next_state"):
        monkeypatch.setattr(UrRobot, name, lambda _: asyncio.Event().wait())
    board, port = os.openpty()
    tty.setraw(port)
    fingertip = {"device": {"path": os.ttyname(port)}, "bank": str(tiny_bank)}
    path = config(robot=str(write_filled_in(tmp_path)), fingertips={"right": fingertip})
    published: Counter[str] = Counter()
    published_one = asyncio.Event()

    def count(topic: str, _content: dict[str, Any]) -> None:
        published[topic] += 1
        published_one.set()

    async with running_daemon(path) as daemon:
        daemon.publisher.add_listener(count)
        address = load_daemon_config(path).commands
        await asyncio.to_thread(exchange, address, malformed_requests(200))
        before_mb, tasks = resident_memory_mb(), len(asyncio.all_tasks())
        replies, _ = await asyncio.gather(
            asyncio.to_thread(exchange, address, malformed_requests(REQUESTS)),
            asyncio.to_thread(write_all, board, malformed_frames(FRAMES)),
        )
        while (refused := count_lines(daemon.sensors.tasks["right"].diagnostics())) < FRAMES - 1:
            published_one.clear()
            await published_one.wait()
        assert replies == {False: REQUESTS}, "each is answered, and none is carried out"
        refusals = daemon.health.tasks()["commands"]["errors"]
        assert sum(refusals.values()) == REQUESTS + 200
        assert set(refusals) <= {"malformed request", "unknown command", "too many requests"}
        assert refused <= FRAMES
        assert published["eit.estimate"] == published["eit.frame"] == 0
        assert not arm.called, "nothing was asked of the robot"
        assert daemon.rig.control_loop.experiment is None
        assert not daemon.supervisor.dead
        assert all(record.restarts == 0 for record in daemon.supervisor.records.values())
        assert resident_memory_mb() - before_mb < MAX_GROWTH_MB
        assert len(asyncio.all_tasks()) <= tasks + command_server.MAX_CONCURRENT
        status = await asyncio.to_thread(exchange, address, iter([[encode({"command": "stop", **of_now()})]]))
        assert status == {True: 1}, "stop is heard in the middle of it all"
        await daemon.ending.wait()
    os.close(port)
    os.close(board)


def count_lines(diagnostics: Mapping[str, Any]) -> int:
    """Return how many lines were refused, or dropped because they may have waited before the opening."""
    return sum(diagnostics["errors"].values()) + diagnostics["dropped_at_opening"]


def exchange(address: str, requests: Iterator[list[bytes]]) -> Counter[bool]:
    """Send requests as a client that keeps some under way, and count the replies by whether they were accepted."""
    replies: Counter[bool] = Counter()
    with zmq.Context() as context, context.socket(zmq.DEALER) as socket:
        socket.setsockopt(zmq.LINGER, 0)
        socket.setsockopt(zmq.RCVTIMEO, DEADLINE_S * 1000)
        socket.connect(address)
        waiting = 0
        for frames in requests:
            socket.send_multipart(frames)
            waiting += 1
            if waiting >= 500:
                replies[decode(socket.recv())["ok"]] += 1
                waiting -= 1
        for _ in range(waiting):
            replies[decode(socket.recv())["ok"]] += 1
    return replies


def write_all(board: int, lines: Iterator[bytes]) -> None:
    batch = b""
    for line in lines:
        batch += line
        if len(batch) > 4096:
            batch = batch[os.write(board, batch) :]
    while batch:
        batch = batch[os.write(board, batch) :]


def test_the_rate_limit_of_a_client_recovers():
    limit = RateLimit()
    allowed = [limit.allow(b"loud", 0) for _ in range(1000)]
    assert sum(allowed) == command_server.CLIENT_BURST
    assert limit.allow(b"quiet", 0)
    assert sum(limit.allow(b"loud", 10**9) for _ in range(1000)) == command_server.CLIENT_PER_S


def test_many_clients_share_the_total_limit():
    limit = RateLimit()
    allowed = sum(limit.allow(b"%d" % number, number * 1000) for number in range(100_000))
    assert allowed <= command_server.TOTAL_BURST + 0.1 * command_server.TOTAL_PER_S + 1
    assert limit.remembered <= 256
