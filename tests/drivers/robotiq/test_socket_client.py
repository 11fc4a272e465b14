"""The URCap's client against a scripted peer over a real socket."""

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager

import pytest

from shearloop.drivers.errors import DeviceLostError, ProtocolError
from shearloop.drivers.robotiq.messages import GripperAction, GripperMove
from shearloop.drivers.robotiq.socket_client import READ_ORDER, SocketClient

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
        assert (await client.read()).current == 7
    asked = [f"GET {variable}" for variable in READ_ORDER]
    assert peer.lines == [*asked, "SET ACT 0", "SET ATR 0", "SET POS 10 SPE 20 FOR 30 GTO 1", *asked]


@pytest.mark.parametrize(
    ("answer", "error", "says"),
    [
        (lambda _: None, DeviceLostError, "has closed the connection"),
        (lambda _: b"POS 1\n", ProtocolError, "to 'GET ACT'"),
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
    async with connected(Peer(lambda line: usual(line) if "ACT" in line else b""), deadline_s=0.05) as client:
        with pytest.raises(DeviceLostError, match=r"'GET STA' within 0\.05 s"):
            await client.read()
