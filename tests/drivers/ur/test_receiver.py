"""RTDE samples from bytes and on a connection."""

import contextlib
import errno
import math
import socket
import struct
from collections.abc import Callable, Iterator
from unittest import mock

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shearloop.drivers.errors import ProtocolError
from shearloop.drivers.ur.messages import RobotLostError, RtdeOutputs
from shearloop.drivers.ur.ports import lose_dead_peers_of_ports
from shearloop.drivers.ur.receiver import RtdeReceiver, SampleParser

TYPES = b"DOUBLE,VECTOR6D,VECTOR6D,VECTOR6D,VECTOR6D,VECTOR6D,INT32,INT32,UINT32,DOUBLE,DOUBLE,INT32,INT32,DOUBLE"
TOOL_TYPES = TYPES + b",DOUBLE,VECTOR3D,VECTOR6D"
# The answer of a controller before PolyScope 5.5.1.
WITHOUT_TOOL = TYPES + b",NOT_FOUND,NOT_FOUND,NOT_FOUND"
TOOL = (1.5, 0.1, 0.2, 0.3, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0)


def package(kind: bytes, payload: bytes) -> bytes:
    return struct.pack(">Hc", 3 + len(payload), kind) + payload


def data(number: int, *, tool: bool = True) -> bytes:
    """Return the package of a sample with this timestamp."""
    values = [round(number + 0.01 * index, 2) for index in range(30)]
    content = struct.pack(">d30diiIddiid", number, *values, 7, -1, 2, 0.75, 0.5, 1, 4750, 0.002)
    return package(b"U", b"\x01" + content + (struct.pack(">10d", *TOOL) if tool else b""))


def text(length: int) -> bytes:
    return package(b"M", bytes(length))


def test_sample_has_the_values_in_their_order():
    sample = SampleParser().feed(data(3))
    assert sample == RtdeOutputs(
        timestamp_s=3.0,
        q_rad=(3.0, 3.01, 3.02, 3.03, 3.04, 3.05),
        qd_rad_per_s=(3.06, 3.07, 3.08, 3.09, 3.1, 3.11),
        tcp_pose=(3.12, 3.13, 3.14, 3.15, 3.16, 3.17),
        tcp_speed=(3.18, 3.19, 3.2, 3.21, 3.22, 3.23),
        wrench=(3.24, 3.25, 3.26, 3.27, 3.28, 3.29),
        robot_mode=7,
        safety_mode=-1,
        runtime_state=2,
        speed_slider=0.75,
        limiter_scaling=0.5,
        payload_kg=1.5,
        payload_cog_m=(0.1, 0.2, 0.3),
        tcp_offset=(1.0, 2.0, 3.0, 4.0, 5.0, 6.0),
        script_state=1,
        script_ticks=4750,
        script_step_s=0.002,
    )


@given(st.lists(st.one_of(st.none(), st.integers(0, 40)), max_size=8), st.lists(st.integers(1, 300), max_size=20))
def test_newest_sample_is_found_however_the_stream_is_cut(kinds, cuts):
    """None is a sample, a number the length of a text message."""
    packages = [data(index) if kind is None else text(kind) for index, kind in enumerate(kinds)]
    ends = [sum(map(len, packages[: index + 1])) for index in range(len(packages))]
    stream = b"".join(packages)
    parser, at, latest = SampleParser(), 0, None
    for cut in (*cuts, len(stream)):
        found = parser.feed(stream[at : at + cut])
        at += cut
        complete = [index for index, end in enumerate(ends) if end <= at and kinds[index] is None]
        newest = complete[-1] if complete else None
        assert (found.timestamp_s if found is not None else None) == (newest if newest != latest else None)
        latest = newest


@pytest.mark.parametrize("bad", [package(b"U", bytes(8)), b"\x00\x02U", data(1)[:-1] + b"\x00" + data(2)])
def test_invalid_package_is_refused(bad):
    with pytest.raises(ProtocolError):
        SampleParser().feed(bad + bytes(300))


Play = Callable[..., socket.socket]


@pytest.fixture
def play(monkeypatch) -> Iterator[Play]:
    """Begin a controller: its end of the next connection, on which the answers and a sample have been sent."""
    ends: list[socket.socket] = []
    connect = socket.create_connection

    def begin(
        types: tuple[bytes, ...] = (TOOL_TYPES,), started: bytes = b"\x01", inputs: bytes = b"\x01DOUBLE"
    ) -> socket.socket:
        with socket.create_server(("127.0.0.1", 0)) as server:
            client = connect(server.getsockname())
            controller, _ = server.accept()
        ends.extend((controller, client))
        outputs = b"".join(package(b"O", b"\x01" + one) for one in types)
        answers = package(b"V", b"\x01") + outputs + package(b"I", inputs) + package(b"S", started)
        controller.sendall(answers + data(1, tool=types[-1] == TOOL_TYPES))
        monkeypatch.setattr(socket, "create_connection", lambda *_, timeout: client.settimeout(timeout) or client)
        return controller

    yield begin
    for end in ends:
        end.close()


def asked(controller: socket.socket) -> list[tuple[bytes, bytes]]:
    """Return the kind and the content of each package that the controller has received."""
    received, found = controller.recv(1 << 16), []
    while received:
        size, kind = struct.unpack_from(">Hc", received)
        found.append((kind, received[3:size]))
        received = received[size:]
    return found


def arrived(receiver: RtdeReceiver, timestamp_s: float) -> bool:
    """Wait for the sample or the end of the connection."""
    while receiver.latest().timestamp_s != timestamp_s and receiver.connected:
        pass
    return receiver.latest().timestamp_s == timestamp_s


def test_outputs_are_requested_at_the_rate_and_the_newest_kept(play):
    controller = play()
    receiver = RtdeReceiver("127.0.0.1", 125.0, 5.0)
    kinds, contents = zip(*asked(controller), strict=True)
    assert kinds == (b"V", b"O", b"I", b"S")
    assert contents[1].startswith(struct.pack(">d", 125.0) + b"timestamp,actual_q,")
    assert receiver.latest().timestamp_s == 1.0
    controller.sendall(data(2) + data(3) + data(4)[:100])
    assert arrived(receiver, 3.0)
    assert receiver.latest().timestamp_s == 3.0
    assert not receiver.wait(0.0)
    controller.sendall(data(4)[100:])
    assert receiver.wait(5.0)
    assert arrived(receiver, 4.0)
    receiver.close()
    assert not receiver.wait(5.0)


def test_deadline_is_written_to_its_register(play):
    controller = play(inputs=b"\x05INT32")
    receiver = RtdeReceiver("127.0.0.1", 125.0, 5.0)
    assert asked(controller)[2] == (b"I", b"input_int_register_47")
    receiver.write_deadline(-1)
    assert asked(controller) == [(b"U", b"\x05" + struct.pack(">i", -1))]
    receiver.close()
    receiver.write_deadline(1)
    assert not receiver.connected


def test_connections_that_a_library_hides_lose_a_vanished_controller_too():
    with contextlib.ExitStack() as stack:
        listening = [stack.enter_context(socket.create_server(("127.0.0.1", 0))) for _ in range(2)]
        ports = [one.getsockname()[1] for one in listening]
        robot, other = (stack.enter_context(socket.create_connection(("127.0.0.1", port))) for port in ports)
        lose_dead_peers_of_ports(ports[:1])
        timeouts_ms = [one.getsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT) for one in (robot, other)]
        assert timeouts_ms == [3000, 0]
        assert robot.send(b"it is still open") == 16


def test_controller_that_vanishes_is_lost_in_seconds(play):
    """A pulled cable: nothing is acknowledged. Each deadline leaves at once."""
    play()
    receiver = RtdeReceiver("127.0.0.1", 125.0, 5.0)
    connection = receiver.connection
    assert connection.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE)
    assert connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
    assert connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT) == 3000
    idle, interval, count = (
        connection.getsockopt(socket.IPPROTO_TCP, option)
        for option in (socket.TCP_KEEPIDLE, socket.TCP_KEEPINTVL, socket.TCP_KEEPCNT)
    )
    assert idle + interval * count <= 4
    receiver.close()


def test_controller_without_payload_and_tool_centre_point_is_accepted(play):
    play((WITHOUT_TOOL, TYPES))
    receiver = RtdeReceiver("127.0.0.1", 125.0, 5.0)
    sample = receiver.latest()
    receiver.close()
    assert sample.script_state == 1
    assert math.isnan(sample.payload_kg)
    assert all(map(math.isnan, (*sample.payload_cog_m, *sample.tcp_offset)))


@pytest.mark.parametrize("last", [b"", package(b"U", bytes(8))])
def test_closed_or_invalid_stream_is_a_lost_connection(play, last):
    controller = play()
    receiver = RtdeReceiver("127.0.0.1", 125.0, 5.0)
    controller.sendall(data(2) + last)
    if not last:
        controller.close()
    while receiver.connected:
        receiver.latest()
    assert receiver.latest().timestamp_s in (1.0, 2.0)
    receiver.close()


@pytest.mark.parametrize("number", [errno.ETIMEDOUT, errno.EHOSTUNREACH, errno.ECONNRESET])
def test_network_error_is_a_lost_connection(play, number):
    play()
    receiver = RtdeReceiver("127.0.0.1", 125.0, 5.0)
    receiver.close()
    receiver.connected = True
    with mock.patch.object(receiver, "connection") as connection:
        connection.recv.side_effect = OSError(number, "given up")
        connection.gettimeout.return_value = 0.0
        assert receiver.latest().timestamp_s == 1.0
    assert not receiver.connected


@pytest.mark.parametrize(
    ("answers", "refusal"),
    [
        ({"types": [one.replace(b"UINT32", b"NOT_FOUND") for one in (TOOL_TYPES, TYPES)]}, "NOT_FOUND"),
        ({"started": b"\x00"}, "does not send its state"),
        ({"inputs": b"\x00IN_USE"}, "already in use by another RTDE client"),
    ],
)
def test_controller_without_the_needed_outputs_is_refused(play, answers, refusal):
    play(**answers)
    with pytest.raises(RobotLostError, match=refusal):
        RtdeReceiver("127.0.0.1", 125.0, 5.0)
