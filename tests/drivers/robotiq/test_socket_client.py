"""The connection to the URCap, with a peer that answers as it likes, over a real socket; and with time passed in."""

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import cast

import pytest

from shearloop.drivers.errors import DeviceLostError, ProtocolError
from shearloop.drivers.robotiq.messages import GripperMove, Reset
from shearloop.drivers.robotiq.socket_client import SocketClient, _Connection
from shearloop.drivers.robotiq.urcap import READ_ORDER, STANDING_ORDER

VALUES = {"ACT": 1, "STA": 3, "GTO": 1, "PRE": 100, "OBJ": 3, "POS": 100, "FLT": 0, "COU": 7}


class Peer:
    """Answers each line as `answer` says: with bytes, or by closing where it says None."""

    def __init__(self, answer: Callable[[str], bytes | None]) -> None:
        self.answer = answer
        self.lines: list[str] = []
        # Sent without being asked, together with the next answer.
        self.unasked = b""
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
                writer.write(answer + self.unasked)
                self.unasked = b""
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


async def test_what_is_asked_is_answered_in_order() -> None:
    peer = Peer(usual)
    async with connected(peer) as client:
        assert (await client.read()).pos == 100
        await client.write(Reset())
        await client.write(GripperMove(10, 20, 30))
        assert (await client.read()).current == 7
    asked = [f"GET {variable}" for variable in READ_ORDER]
    assert peer.lines == [*asked, "SET ACT 0", "SET ATR 0", "SET POS 10 SPE 20 FOR 30 GTO 1", *asked]


async def test_of_a_gripper_that_stands_as_before_no_more_is_asked_than_tells_that() -> None:
    values = {"STA": 3, "COU": 7}

    def answer(line: str) -> bytes:
        variable = line.split()[1]
        return f"{variable} {values.get(variable, 1)}\n".encode()

    peer = Peer(answer)
    whole, some = ([f"GET {variable}" for variable in order] for order in (READ_ORDER, STANDING_ORDER))
    async with connected(peer) as client:
        before = await client.read()
        values["COU"] = 9
        assert await client.read_again(before) is before
        assert peer.lines == [*whole, *some]
        for changed, now in (("POS", 50), ("OBJ", 2), ("FLT", 9), ("STA", 0), ("GTO", 0), ("PRE", 60)):
            peer.lines.clear()
            values.update({changed: now, "COU": now})
            after = await client.read_again(before)
            assert peer.lines == [*some, *whole]
            assert after.current == now
            assert after != before
            values.pop(changed)
            values["STA"] = 3


@pytest.mark.parametrize(
    ("answer", "error", "says"),
    [
        (lambda _: None, DeviceLostError, "closed the gripper's socket"),
        (lambda _: b"POS 1\n", ProtocolError, "when asked for ACT"),
        (lambda _: b"x" * 100, ProtocolError, "is this the URCap's port"),
        (lambda line: usual(line) * 2, ProtocolError, "without being asked"),
    ],
)
async def test_an_answer_that_is_none_ends_the_connection(
    answer: Callable[[str], bytes | None], error: type[Exception], says: str
) -> None:
    async with connected(Peer(answer)) as client:
        with pytest.raises(error, match=says):
            await client.read()
        with pytest.raises(DeviceLostError, match="no connection"):
            await client.read()
        await client.connect()


async def test_bytes_that_nobody_asked_for_are_no_answer_to_what_is_asked_next() -> None:
    peer = Peer(usual)
    async with connected(peer) as client:
        peer.unasked = b"ack"
        await client.write(GripperMove(1, 2, 3))
        with pytest.raises(ProtocolError, match="without being asked"):
            await client.read()


async def test_a_question_that_was_given_up_leaves_no_answer_behind() -> None:
    async with connected(Peer(lambda _: b"")) as client:
        asking = asyncio.create_task(client.read())
        await asyncio.sleep(0)
        asking.cancel()
        with pytest.raises(asyncio.CancelledError):
            await asking
        with pytest.raises(DeviceLostError, match="given up"):
            await client.read()


class Loop:
    """As much of an event loop as the connection uses, with a time of its own."""

    def __init__(self) -> None:
        self.now_s = 100.0
        self.timers: list[tuple[float, Callable[[], None]]] = []

    def time(self) -> float:
        return self.now_s

    def create_future(self) -> asyncio.Future[object]:
        return asyncio.get_running_loop().create_future()

    def call_at(self, due_s: float, callback: Callable[[], None]) -> asyncio.TimerHandle:
        self.timers.append((due_s, callback))
        return asyncio.get_running_loop().call_later(3600, lambda: None)

    def pass_to(self, now_s: float) -> None:
        self.now_s = now_s
        due = [timer for timer in self.timers if timer[0] <= now_s]
        self.timers = [timer for timer in self.timers if timer[0] > now_s]
        for _, callback in due:
            callback()


class Transport(asyncio.Transport):
    def __init__(self) -> None:
        super().__init__()
        self.written: list[bytes] = []
        self.aborted = False

    def write(self, data: bytes | bytearray | memoryview) -> None:
        self.written.append(bytes(data))

    def abort(self) -> None:
        self.aborted = True


async def test_every_answer_has_the_whole_time_and_the_one_that_is_late_is_named() -> None:
    loop, transport = Loop(), Transport()
    connection = _Connection("gripper", 0.5)
    connection._loop = cast(asyncio.AbstractEventLoop, loop)
    connection.connection_made(transport)
    asking = asyncio.create_task(connection.ask([(b"GET ACT\n", "ACT"), (b"GET POS\n", "POS"), (b"SET GTO 0\n", "")]))
    await asyncio.sleep(0)
    loop.pass_to(100.4)
    connection.data_received(b"ACT 1\n")
    loop.pass_to(100.8)
    connection.data_received(b"POS ")
    connection.data_received(b"9\n")
    assert transport.written == [b"GET ACT\n", b"GET POS\n", b"SET GTO 0\n"]
    loop.pass_to(101.2)
    assert not transport.aborted, "1.2 s for three answers, none of them late"
    loop.pass_to(101.31)
    with pytest.raises(DeviceLostError, match=r"'SET GTO 0' within 0\.5 s"):
        await asking
    assert transport.aborted


async def test_an_answer_that_comes_late_with_the_deadline_is_an_answer() -> None:
    """Where the computer stood still: what came meanwhile is read first, and then the timer is due."""
    loop, transport = Loop(), Transport()
    connection = _Connection("gripper", 0.5)
    connection._loop = cast(asyncio.AbstractEventLoop, loop)
    connection.connection_made(transport)
    asking = asyncio.create_task(connection.ask([(b"GET ACT\n", "ACT")]))
    await asyncio.sleep(0)
    loop.now_s = 103.0
    connection.data_received(b"ACT 1\n")
    loop.pass_to(103.0)
    assert await asking == ["1"]
    assert not transport.aborted
