"""The URCap's client against a scripted peer over a real socket."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from itertools import count
from types import SimpleNamespace

import pytest

from shearloop.drivers.errors import DeviceLostError, ProtocolError
from shearloop.drivers.robotiq import socket_client
from shearloop.drivers.robotiq.gripper import RobotiqGripper
from shearloop.drivers.robotiq.messages import GripperAction, GripperCommand, GripperMove
from shearloop.drivers.robotiq.socket_client import ALWAYS, IN_TURN, SocketClient
from shearloop.drivers.robotiq.widths import WidthCalibration
from shearloop.tools.commission.gripper import judge_exchanges
from shearloop.tools.commission.limits import REAL

VALUES = {"ACT": 1, "STA": 3, "GTO": 1, "PRE": 100, "OBJ": 3, "POS": 100, "FLT": 0, "COU": 7}


class Peer:
    """Answers each line with `answer`; None closes the connection."""

    def __init__(self, answer: Callable[[str], bytes | None]) -> None:
        self.answer = answer
        self.lines: list[str] = []
        self.serving: list[asyncio.Task[None]] = []

    def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.serving.append(asyncio.create_task(self._serve(reader, writer)))

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            while line := (await reader.readline()).decode().strip():
                self.lines.append(line)
                answer = self.answer(line)
                if answer is None:
                    return
                writer.write(answer)
        except ConnectionError:
            return
        finally:
            writer.close()


def usual(line: str) -> bytes:
    what, variable, *_ = line.split()
    return f"{variable} {VALUES[variable]}\n".encode() if what == "GET" else b"ack"


@asynccontextmanager
async def connected(peer: Peer, deadline_s: float = 20.0) -> AsyncIterator[SocketClient]:
    server = await asyncio.start_server(peer.serve, "127.0.0.1", 0)
    async with server:
        client = SocketClient("127.0.0.1", server.sockets[0].getsockname()[1], reply_deadline_s=deadline_s)
        await client.connect()
        try:
            yield client
        finally:
            await client.close()
            await asyncio.gather(*peer.serving)


async def test_requests_are_answered_in_order():
    peer = Peer(usual)
    async with connected(peer) as client:
        assert (await client.read()).pos == 100
        await client.write(GripperAction.RESET)
        await client.write(GripperMove(10, 20, 30))
        assert (await client.read(whole=True)).current == 7
    asked = [f"GET {variable}" for variable in (*IN_TURN, *ALWAYS)]
    assert peer.lines == [*asked, "SET GTO 0", "SET ACT 0", "SET ATR 0", "SET POS 10 SPE 20 FOR 30 GTO 1", *asked]


@pytest.fixture
def slow_link(monkeypatch) -> None:
    """A connection on which one variable takes longer than all of those in turn may."""
    monkeypatch.setattr(socket_client, "IN_TURN_S", -1.0)


@pytest.mark.usefixtures("slow_link")
async def test_a_slow_connection_asks_for_object_and_position_each_time_and_for_the_others_in_turn():
    peer = Peer(usual)
    async with connected(peer) as client:
        await client.read()
        peer.lines.clear()
        for _ in IN_TURN:
            await client.read()
        assert peer.lines == [f"GET {name}" for turn in IN_TURN for name in (turn, *ALWAYS)]
        # What a request changes comes first, and together.
        for request, changed in (
            (GripperMove(10, 20, 30), ["PRE"]),
            (GripperAction.HALT, ["GTO"]),
            (GripperAction.ACTIVATE, ["ACT", "FLT", "GTO", "STA"]),
        ):
            await client.write(request)
            peer.lines.clear()
            await client.read()
            *first, _, _ = (line.removeprefix("GET ") for line in peer.lines)
            assert sorted(first) == changed
        # A new connection, and whoever asks for it, knows nothing of before.
        peer.lines.clear()
        await client.read(whole=True)
        assert len(peer.lines) == len(IN_TURN) + len(ALWAYS)


@pytest.mark.parametrize(("answer_s", "verdict"), [(0.001, "passed"), (0.012, "passed"), (0.032, "failed")])
async def test_commissioning_judges_the_exchange_that_the_daemon_polls_with(answer_s, verdict, monkeypatch):
    """A slow connection answers within the limit where the daemon's poll does, not where all eight variables would."""
    now_s = 0.0

    def slow(line: str) -> bytes:
        nonlocal now_s
        now_s += answer_s
        return usual(line)

    async with connected(Peer(slow)) as client:
        own_time = SimpleNamespace(get_running_loop=lambda: SimpleNamespace(time=lambda: now_s))
        monkeypatch.setattr(socket_client, "asyncio", own_time)
        gripper = RobotiqGripper(client, WidthCalibration.nominal())
        await gripper.read()
        times_s = []
        for _ in range(20):
            begun_s = now_s
            await gripper.poll()
            times_s.append(now_s - begun_s)
        monkeypatch.undo()
    assert judge_exchanges(times_s, REAL.longest_exchange_s).verdict == verdict


@pytest.mark.usefixtures("slow_link")
async def test_no_state_of_a_slow_gripper_is_older_than_the_loop_accepts(monkeypatch):
    """Between a state's beginning and the next one's end lie at most seven exchanges: 224 ms at 32 ms each."""
    # A busy computer delays no state here.
    monkeypatch.setattr("shearloop.drivers.robotiq.gripper._POLLS_WAITED", 10_000)
    monkeypatch.setattr("shearloop.drivers.robotiq.gripper.time", SimpleNamespace(monotonic_ns=count().__next__))
    values = dict(VALUES)
    began: list[int] = []

    def answer(line: str) -> bytes:
        what, name, *rest = line.split()
        if what == "GET":
            return f"{name} {values[name]}\n".encode()
        values.update(PRE=int(rest[0]), POS=int(rest[0]))
        return b"ack"

    peer = Peer(answer)
    async with connected(peer) as client:
        own_read = client.read

        async def noted(*, whole: bool = False) -> object:
            began.append(len(peer.lines))
            return await own_read(whole=whole)

        client.read = noted
        gripper = RobotiqGripper(client, WidthCalibration.nominal(), poll_s=0.01)

        async def move() -> None:
            for width_mm in (20.0, 90.0):
                await gripper.activate(may_drop=True)
                await gripper.finish(await gripper.move(GripperCommand(width_mm)))

        async with contextlib.aclosing(gripper.states()) as states:
            await anext(states)
            moving = asyncio.create_task(move())
            begun, exchanges = began[-1], []
            async for _ in states:
                exchanges.append(len(peer.lines) - begun)
                begun = began[-1]
                if moving.done():
                    break
            await moving
    # The first state asks for everything.
    assert max(exchanges[1:]) <= 7
    assert values["POS"] == gripper.request_of(GripperCommand(90.0)).position


@pytest.mark.parametrize(
    ("answer", "error", "says"),
    [
        (lambda _: None, DeviceLostError, "has closed the connection"),
        (lambda _: b"POS 1\n", ProtocolError, "to 'GET PRE'"),
        (lambda _: b"x" * 100, ProtocolError, "is this the URCap's port"),
        (lambda line: usual(line) * 2, ProtocolError, "without a request"),
    ],
)
async def test_invalid_answer_ends_the_connection(answer, error, says):
    async with connected(Peer(answer)) as client:
        with pytest.raises(error, match=says):
            await client.read()
        with pytest.raises(DeviceLostError, match="no connection"):
            await client.read()
        await client.connect()


async def test_cancelled_request_leaves_no_answer_behind():
    async with connected(Peer(lambda _: b"")) as client:
        asking = asyncio.create_task(client.read())
        await asyncio.sleep(0)
        asking.cancel()
        with pytest.raises(asyncio.CancelledError):
            await asking
        with pytest.raises(DeviceLostError, match="no connection"):
            await client.read()


async def test_late_answer_is_named():
    async with connected(Peer(lambda line: usual(line) if "PRE" in line else b""), deadline_s=0.05) as client:
        with pytest.raises(DeviceLostError, match=r"'GET GTO' within 0\.05 s"):
            await client.read()
