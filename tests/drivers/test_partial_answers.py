"""Instruments and grippers whose answers do not end are quoted; only those that send nothing are called silent."""

import asyncio
from contextlib import asynccontextmanager
from types import SimpleNamespace

import pytest

from shearloop.drivers.connection import Link, Port, Received
from shearloop.drivers.errors import DeviceLostError, DeviceNotFoundError, DeviceSilentError
from shearloop.drivers.robotiq.socket_client import SocketClient
from shearloop.drivers.shear_skin.instruments import MAX_REPLY_BYTES, Keithley6430, ScpiScanner


class Answering(Link):
    """A link whose port gives some bytes, and then nothing."""

    def __init__(self, *answers: bytes) -> None:
        super().__init__()
        arriving = iter(answers)

        async def read(_timeout_s: float) -> Received | None:
            data = next(arriving, None)
            return None if data is None else Received(data, 0)

        async def write(_data: bytes) -> None:
            pass

        self.port = SimpleNamespace(path="/dev/instrument", read=read, write=write, close=lambda: None)

    async def _connect(self) -> Port:
        raise DeviceNotFoundError("this link is open from the beginning")


@pytest.mark.parametrize("kind", [Keithley6430, ScpiScanner])
@pytest.mark.parametrize(
    ("answers", "part"),
    [
        ((b"KEITH", b"LEY"), "with 'KEITHLEY' and no line end"),
        ((b"\xf8\x80\xfe",), r"with '\xf8\x80\xfe' and no line end"),
        ((b"7" * (MAX_REPLY_BYTES + 1),), "with '7777"),
        ((), "has not answered '*IDN?'"),
        ((b"\r\n",), "has not answered '*IDN?'"),
    ],
)
async def test_an_answer_without_an_end_is_quoted(kind, answers, part):
    with pytest.raises(DeviceSilentError) as silent:
        await kind(Answering(*answers)).ask("*IDN?")
    assert part in str(silent.value)
    assert "baud rate" in str(silent.value)


@asynccontextmanager
async def gripper_saying(answer: bytes):
    """Serve a socket that answers everything with the same bytes."""

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while await reader.read(100):
            writer.write(answer)
        writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    try:
        yield server.sockets[0].getsockname()[1]
    finally:
        server.close()
        await server.wait_closed()


@pytest.mark.parametrize(("answer", "part"), [(b"ACT", ", only 'ACT'"), (b"", "within 0.05 s; check")])
async def test_what_came_of_a_grippers_answer_is_quoted(answer, part):
    async with gripper_saying(answer) as port:
        client = SocketClient("127.0.0.1", port, reply_deadline_s=0.05)
        await client.connect()
        with pytest.raises(DeviceLostError) as lost:
            await client.read()
        assert part in str(lost.value)
        while left := asyncio.all_tasks() - {asyncio.current_task()}:
            await asyncio.wait(left)
