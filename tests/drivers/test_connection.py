import asyncio
import os
import re
import time
from types import SimpleNamespace

import pytest

from shearloop.drivers import connection
from shearloop.drivers.connection import LinkMonitor, SerialLink, SerialPort, TcpPort, find_port
from shearloop.drivers.errors import DeviceLostError, DeviceNotFoundError, DeviceUnavailableError
from shearloop.emulators.ports import PtyPort
from tests.running import DEADLINE_S, LinkEvents, read_exactly

SECOND_NS = 1_000_000_000


async def sent_to(peer: PtyPort, n_bytes: int) -> bytes:
    data = b""
    async with asyncio.timeout(DEADLINE_S):
        while len(data) < n_bytes:
            data += await peer.received.get()
    return data


def listed(monkeypatch: pytest.MonkeyPatch, *ports: tuple[str, str | None]) -> None:
    class Entry(SimpleNamespace):
        def __lt__(self, other: "Entry") -> bool:
            return self.device < other.device

    found = [Entry(device=device, serial_number=number, description="USB Serial") for device, number in ports]
    monkeypatch.setattr(connection.list_ports, "comports", lambda: found)


def test_a_port_is_found_by_its_usb_serial_number(monkeypatch):
    listed(monkeypatch, ("/dev/ttyS0", None), ("/dev/ttyACM1", "123"), ("/dev/ttyACM0", "456"))
    assert find_port(serial_number="123") == "/dev/ttyACM1"
    with pytest.raises(DeviceNotFoundError, match=r"789; available: /dev/ttyACM0 .*456.*, /dev/ttyACM1 .*123"):
        find_port(serial_number="789")


def test_a_serial_number_with_two_ports_is_not_guessed_at(monkeypatch):
    listed(monkeypatch, ("/dev/ttyACM0", "123"), ("/dev/ttyACM1", "123"))
    with pytest.raises(DeviceNotFoundError, match="/dev/ttyACM0 and /dev/ttyACM1; name one by its path"):
        find_port(serial_number="123")


async def test_another_board_at_a_path_is_refused(monkeypatch, tmp_path):
    """Two fingertips that are plugged in again, each into the other's port, would be taken for each other."""
    link = tmp_path / "eit-right"
    with PtyPort() as right, PtyPort() as left, SerialLink(path=link) as device:
        listed(monkeypatch, (right.path, "123"), (left.path, "456"))
        link.symlink_to(right.path)
        (await device.open_once()).close()
        (await device.open_once()).close()
        link.unlink()
        link.symlink_to(left.path)
        with pytest.raises(DeviceUnavailableError, match=r"serial number is 456, and that of the first one was 123"):
            await device.open_once()
        # A board that has no number may be the same one.
        listed(monkeypatch)
        (await device.open_once()).close()


def test_a_path_without_a_port_is_said_to_be_empty(monkeypatch, tmp_path):
    listed(monkeypatch)
    with pytest.raises(DeviceNotFoundError, match=r"no serial port .*eit; no USB serial port is plugged in"):
        find_port(path=str(tmp_path / "eit"))


def test_a_file_is_no_port(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(DeviceUnavailableError, match="cannot be opened as a serial port"):
        SerialPort(str(tmp_path / "file"))


async def test_bytes_pass_unchanged_in_both_directions():
    data = bytes(range(256)) * 100
    with PtyPort() as peer, SerialPort(peer.path) as port:
        async with asyncio.timeout(DEADLINE_S):
            sending = asyncio.create_task(peer.write(data))
            assert await read_exactly(port, len(data)) == data
            await sending
            await port.write(bytes(range(256)))
            assert await sent_to(peer, 256) == bytes(range(256))


async def test_a_port_is_had_by_one_program_at_a_time():
    in_use = pytest.raises(DeviceUnavailableError, match="in use by another program")
    with PtyPort() as peer, SerialPort(peer.path), in_use:
        SerialPort(peer.path)


async def test_silence_is_no_loss_and_a_cancelled_read_loses_nothing():
    with PtyPort() as peer, SerialPort(peer.path) as port:
        assert await port.read(0.01) is None
        reading = asyncio.create_task(port.read(DEADLINE_S))
        await asyncio.sleep(0)
        await peer.write(b"kept")
        # The bytes are read by the loop before the task learns that it is cancelled.
        asyncio.get_running_loop().call_later(0.01, reading.cancel)
        received = await asyncio.gather(reading, return_exceptions=True)
        rest = received[0] if isinstance(received[0], connection.Received) else await port.read(DEADLINE_S)
        assert rest.data == b"kept"


async def test_bytes_that_waited_while_the_reader_was_away_say_since_when(monkeypatch):
    away_ns = 0
    real_ns = time.monotonic_ns
    monkeypatch.setattr(
        connection, "time", SimpleNamespace(monotonic=time.monotonic, monotonic_ns=lambda: real_ns() + away_ns)
    )
    with PtyPort() as peer, SerialPort(peer.path) as port:
        async with asyncio.timeout(DEADLINE_S):
            reading = asyncio.create_task(port.read(DEADLINE_S))
            await asyncio.sleep(0)
            await peer.write(b"in time")
            assert (await reading).waited_since_ns is None
            before_ns = connection.time.monotonic_ns()
            # Nobody reads while these bytes come.
            await peer.write(b"waited")
            away_ns += 2 * connection.AWAY_NS
            received = await port.read(DEADLINE_S)
            assert received.data == b"waited"
            assert received.waited_since_ns <= before_ns
            # So may bytes that the kernel delivers late.
            await peer.write(b"too")
            assert (await port.read(DEADLINE_S)).waited_since_ns == received.waited_since_ns
            assert await port.read(0.0) is None
            away_ns += 2 * connection.AWAY_NS
            assert await port.read(0.0) is None
            reading = asyncio.create_task(port.read(DEADLINE_S))
            await asyncio.sleep(0)
            await peer.write(b"in time again")
            assert (await reading).waited_since_ns is None


async def test_a_read_or_write_after_the_port_has_gone_raises_device_lost():
    with PtyPort() as peer, SerialPort(peer.path) as port:
        reading = asyncio.create_task(port.read(DEADLINE_S))
        await asyncio.sleep(0)
        peer.unplug()
        with pytest.raises(DeviceLostError, match="has gone"):
            await reading
        with pytest.raises(DeviceLostError, match="has gone"):
            await port.write(b"y")


async def test_a_write_that_nobody_takes_ends(monkeypatch):
    monkeypatch.setattr(connection, "WRITE_TIMEOUT_S", 0.05)
    with PtyPort() as peer, SerialPort(peer.path) as port:
        asyncio.get_running_loop().remove_reader(peer.master)

        async def write_for_ever() -> None:
            while True:
                await port.write(b"y" * 4096)

        with pytest.raises(DeviceLostError, match="takes no bytes"):
            await write_for_ever()


async def test_a_link_opens_a_device_that_comes_late_and_again_after_it_went(tmp_path):
    links = LinkEvents()
    path = tmp_path / "port"
    with PtyPort(path) as peer, SerialLink(path=str(path), monitor=LinkMonitor(links, 0.01, 0.02)) as link:
        peer.unplug()
        opening = asyncio.create_task(link.open())
        async with asyncio.timeout(DEADLINE_S):
            await links.down()
            peer.plug()
            port = await opening
            peer.unplug()
            with pytest.raises(DeviceLostError) as lost:
                await port.read(DEADLINE_S)
            await link.lost(lost.value)
            assert link.port is None
            peer.plug()
            port = await link.open()
            await port.write(b"again")
            assert await sent_to(peer, 5) == b"again"
    assert link.diagnostics()["connections"] == 2
    assert re.search("has gone|no serial port", str(link.diagnostics()["last_loss"]))
    assert links.events[-1].up
    assert not path.is_symlink()
    assert link.port is None


async def test_a_link_that_leads_elsewhere_by_now_is_left_alone(tmp_path):
    path = tmp_path / "port"
    with PtyPort(path), PtyPort(path) as second:
        assert os.readlink(path) == second.terminal
    assert not path.is_symlink()


def test_waits_grow_and_only_the_first_failure_is_news():
    links = LinkEvents()
    monitor = LinkMonitor(links)
    loss = DeviceLostError("The device at port 1 has gone.")
    assert [monitor.failed(loss, 0) for _ in range(8)] == [0.2, 0.4, 0.8, 1.6, 3.2, 5.0, 5.0, 5.0]
    assert [event.repeated for event in links.losses] == [False] + 7 * [True]
    monitor.connected("up", 100 * SECOND_NS)
    assert monitor.failed(loss, 105 * SECOND_NS) == 0.2, "it held, so it is a new loss"
    monitor.connected("up", 106 * SECOND_NS)
    assert monitor.failed(loss, 107 * SECOND_NS) == 0.4, "it did not hold"
    monitor.failed(DeviceLostError("Another reason."), 108 * SECOND_NS)
    assert not links.events[-1].repeated


async def test_bytes_at_the_deadline_count():
    """After a pause of this process both the bytes and the timer are due."""
    reader = asyncio.StreamReader()
    receiving = asyncio.create_task(TcpPort("device", reader, SimpleNamespace()).read(0.01))
    await asyncio.sleep(0)
    time.sleep(0.05)  # noqa: ASYNC251 - the pause
    reader.feed_data(b"ACT 1\n")
    assert (await receiving).data == b"ACT 1\n"


async def test_a_reply_that_comes_after_a_pause_of_this_process_is_awaited():
    """Until the pause ends, this process has not waited for it."""
    reader = asyncio.StreamReader()
    receiving = asyncio.create_task(TcpPort("device", reader, SimpleNamespace()).read(0.05))
    await asyncio.sleep(0)
    time.sleep(0.2)  # noqa: ASYNC251 - the pause
    asyncio.get_running_loop().call_later(0.01, reader.feed_data, b"ack")
    assert (await receiving).data == b"ack"
    assert await TcpPort("device", reader, SimpleNamespace()).read(0.01) is None
