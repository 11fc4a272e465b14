"""The controller's error codes, from its Primary Client Interface to the log."""

import asyncio
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shearloop.drivers.defaults import PRIMARY_PORT
from shearloop.drivers.errors import ProtocolError
from shearloop.drivers.ur.messages import ControllerError
from shearloop.drivers.ur.primary_port import ErrorCodeParser, PrimaryPort
from shearloop.emulators.ur_controller import Controller
from shearloop.emulators.ur_robot import Robot
from tests.emulator_process import own_address
from tests.running import running

HOST = own_address(6)


def package(kind: int, content: bytes) -> bytes:
    return struct.pack(">iB", 5 + len(content), kind) + content


def message(kind: int, content: bytes) -> bytes:
    """Return a robot message, with the controller's time and source."""
    return package(20, struct.pack(">QbB", 123, -2, kind) + content)


def code(number: int, argument: int, level: int, text: bytes = b"") -> bytes:
    return message(6, struct.pack(">iiiII", number, argument, level, 0, 0) + text)


# States, a version, a text and what is for developers only are passed over.
STREAM = (
    *(package(16, bytes(1000)), message(3, bytes(30)), code(204, 3, 3, b"C204A3")),
    *(message(0, b"C999A9"), code(10, 0, 0), code(11, 0, 131), code(153, 0, 4), package(25, b"")),
)


@given(st.lists(st.integers(1, 300), max_size=20))
def test_codes_are_found_however_the_stream_is_cut(cuts):
    parser, stream, found = ErrorCodeParser(), b"".join(STREAM), []
    for cut in (*cuts, len(stream)):
        found += parser.feed(stream[:cut])
        stream = stream[cut:]
    assert found == [ControllerError(204, 3, "violation"), ControllerError(153, 0, "fault")]
    assert [*map(str, found)] == ["C204A3", "C153A0"]


@pytest.mark.parametrize("size", [0, 4, -1, 1 << 30])
def test_a_package_without_a_possible_size_is_refused(size):
    with pytest.raises(ProtocolError, match=str(PRIMARY_PORT)):
        ErrorCodeParser().feed(struct.pack(">iB", size, 20))


def until_read(port: PrimaryPort) -> list[ControllerError]:
    while not (found := port.read()):
        pass
    return found


async def test_a_protective_stop_has_its_code():
    controller = Controller(Robot(), host=HOST)

    async def play() -> None:
        async for _ in controller.run():
            pass

    async with controller.open(), asyncio.timeout(60), running(play()):
        port = await asyncio.to_thread(PrimaryPort, HOST, 5.0)
        assert port.missing is None
        # The controller takes the connection at some time.
        found: list[ControllerError] = []
        while not found:
            controller.command("error-code 153")
            found = await asyncio.to_thread(port.read)
        assert set(found) == {ControllerError(153, 0, "warning")}
        controller.command("protective-stop")
        while ControllerError(204, 3, "violation") not in (found := await asyncio.to_thread(until_read, port)):
            assert set(found) == {ControllerError(153, 0, "warning")}
    # The end of the connection is no error.
    assert port.read() == []
    assert port.read() == []


async def test_a_closed_port_is_named_with_its_menu():
    async with Controller(Robot(), host=HOST, closed_ports=(PRIMARY_PORT,)).open():
        port = await asyncio.to_thread(PrimaryPort, HOST, 5.0)
    assert f"does not serve port {PRIMARY_PORT} (Primary Client Interface" in port.missing.cause
    assert "Settings → Security → Services" in port.missing.cure
    assert port.read() == []
