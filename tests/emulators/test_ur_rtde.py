"""RTDE bytes in and out of the emulated controller."""

import asyncio
import struct
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shearloop.drivers.defaults import RTDE_PORT
from shearloop.emulators import ur_controller
from shearloop.emulators.ur_robot import Robot
from shearloop.emulators.ur_rtde import RtdeSession, pack, package, unpack, variable
from tests.emulator_process import own_address
from tests.slices import slices

GREETING = package(ord("V"), b"\x00\x02") + package(ord("v"), b"")
COMMAND = b"input_int_register_0,input_double_register_0,"
CONVERSATION = (
    GREETING
    + package(ord("O"), struct.pack(">d", 125.0) + b"timestamp,actual_q,safety_mode,")
    + package(ord("I"), COMMAND)
    + package(ord("S"), b"")
    + package(ord("U"), struct.pack(">Bid", 1, 9, 0.25))
)

# A header, the number of the recipe, and a timestamp, six angles and a mode.
DATA_BYTES = 3 + 1 + 8 + 6 * 8 + 4
HOST = own_address(2)


def session() -> RtdeSession:
    return RtdeSession(Robot(), 500.0, set())


def replies(data: bytes) -> list[tuple[int, bytes]]:
    found = []
    while data:
        size, kind = struct.unpack_from(">HB", data)
        found.append((kind, data[3:size]))
        data = data[size:]
    return found


def test_a_client_sets_up_its_recipes_and_receives_the_requested_values():
    rtde = session()
    assert replies(rtde.receive(CONVERSATION)) == [
        (ord("V"), b"\x01"),
        (ord("v"), struct.pack(">4I", 5, 17, 3, 0)),
        (ord("O"), b"\x01DOUBLE,VECTOR6D,INT32"),
        (ord("I"), b"\x01INT32,DOUBLE"),
        (ord("S"), b"\x01"),
    ]
    assert rtde.robot.registers["input_int_register_0"] == 9
    assert rtde.robot.registers["input_double_register_0"] == 0.25
    ((kind, data),) = replies(rtde.data())
    assert kind == ord("U")
    assert data[:1] == b"\x01"
    timestamp_s, *_q, safety_mode = struct.unpack(">d6di", data[1:])
    assert (timestamp_s, safety_mode) == (0.0, 1)


@given(st.lists(st.integers(0, len(CONVERSATION)), max_size=20))
def test_bytes_may_arrive_in_any_pieces(cuts):
    whole, pieces = session(), session()
    answer = whole.receive(CONVERSATION)
    got = b"".join(pieces.receive(part) for part in slices(CONVERSATION, cuts))
    assert got == answer
    assert pieces.robot.registers["input_double_register_0"] == 0.25


def test_data_comes_at_the_rate_asked_for_and_not_before_the_start():
    rtde = session()
    rtde.receive(GREETING + package(ord("O"), struct.pack(">d", 125.0) + b"timestamp"))
    packages = 0
    for _ in range(100):
        rtde.robot.step(0.002)
        packages += bool(rtde.data())
    assert packages == 0
    rtde.receive(package(ord("S"), b""))
    for _ in range(500):
        rtde.robot.step(0.002)
        packages += bool(rtde.data())
    # One at once, then one every 8 ms.
    assert packages == 126


def test_inputs_of_another_client_are_in_use_until_it_leaves():
    clients: list[RtdeSession] = []
    one, other = (RtdeSession(Robot(), 500.0, set(), clients) for _ in range(2))
    clients += [one, other]
    names = b"input_int_register_24,input_double_register_24"
    assert one.receive(package(ord("I"), names))[3:] == b"\x01INT32,DOUBLE"
    assert one.receive(package(ord("I"), names))[3:] == b"\x02INT32,DOUBLE", "a client may have several recipes"
    assert other.receive(package(ord("I"), b"input_int_register_24,input_int_register_0"))[3:] == b"\x00IN_USE,INT32"
    clients.remove(one)
    assert other.receive(package(ord("I"), names))[3:] == b"\x01INT32,DOUBLE"


def test_registers_in_use_and_unknown_variables_are_refused_by_name():
    rtde = RtdeSession(Robot(), 500.0, {"registers-in-use"})
    ((_, answer),) = replies(rtde.receive(package(ord("I"), COMMAND)))
    assert answer == b"\x00IN_USE,IN_USE"
    ((_, answer),) = replies(rtde.receive(package(ord("O"), struct.pack(">d", 125.0) + b"timestamp,ft_raw_wrench")))
    assert answer == b"\x00DOUBLE,NOT_FOUND"


def test_reported_tool_speed_is_the_change_of_the_pose():
    robot = Robot()
    robot.arm.turn(np.array([0.2, -0.1, 0.3, 0.1, -0.2, 0.4]), 100.0)
    robot.arm.advance(0.1)
    before, speed = np.array(variable(robot, "actual_TCP_pose")), np.array(variable(robot, "actual_TCP_speed"))
    robot.arm.advance(1e-5)
    change = (np.array(variable(robot, "actual_TCP_pose")) - before)[:3] / 1e-5
    assert speed[:3] == pytest.approx(change, abs=1e-4)
    assert np.linalg.norm(speed[:3]) > 0.1


def test_short_vector_is_dropped():
    rtde = session()
    rtde.receive(CONVERSATION)
    rtde.receive(package(ord("U"), struct.pack(">Bi", 1, 11)))
    assert rtde.robot.registers["input_int_register_0"] == 9


@given(st.lists(st.floats(allow_nan=False), min_size=7, max_size=7), st.integers(-(2**31), 2**31 - 1))
def test_values_survive_the_wire(numbers, integer):
    kinds = ["VECTOR6D", "INT32", "DOUBLE"]
    data = pack(kinds, [numbers[:6], integer, numbers[6]])
    assert unpack(kinds, data) == [*numbers[:6], integer, numbers[6]]
    assert unpack(kinds, data[:-1]) is None


async def test_clock_runs_on_while_the_emulator_is_paused(monkeypatch):
    """Samples carry the present time; the robot's time, which the watchdog uses, stands still."""
    robot, now_s, pauses_s = Robot(), 50.0, iter([0.002, 0.3, 0.002])

    async def sleep(_seconds: float) -> None:
        nonlocal now_s
        try:
            now_s += next(pauses_s)
        except StopIteration:
            raise asyncio.CancelledError from None

    monkeypatch.setattr(ur_controller, "time", SimpleNamespace(monotonic=lambda: now_s))
    controller = ur_controller.Controller(robot, rate_hz=500.0)
    monkeypatch.setattr(ur_controller, "asyncio", SimpleNamespace(sleep=sleep))
    with pytest.raises(asyncio.CancelledError):
        async for _ in controller.run():
            pass
    assert variable(robot, "timestamp") == pytest.approx(0.304, abs=0.004)
    assert robot.time_s == pytest.approx(0.024, abs=0.004)


async def test_what_is_held_back_comes_late_and_whole(monkeypatch):
    now_s = 50.0
    monkeypatch.setattr(ur_controller, "time", SimpleNamespace(monotonic=lambda: now_s))
    controller = ur_controller.Controller(Robot(), host=HOST)
    received = bytearray()

    async def pass_time() -> None:
        async for _ in controller.run():
            pass

    async def receive(reader: asyncio.StreamReader) -> None:
        while data := await reader.read(65536):
            received.extend(data)

    async with controller.open():
        reader, writer = await asyncio.open_connection(HOST, RTDE_PORT)
        writer.write(CONVERSATION)
        await reader.readuntil(package(ord("S"), b"\x01"))
        controller.command("hold-back 0.5")
        tasks = [asyncio.create_task(pass_time()), asyncio.create_task(receive(reader))]
        while len(received) < 80 * DATA_BYTES:
            assert not received or now_s >= 50.5
            now_s += 0.008
            await asyncio.sleep(0.004)
        writer.close()
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
    whole = len(received) // DATA_BYTES * DATA_BYTES
    times_s = [struct.unpack_from(">d", content, 1)[0] for _, content in replies(bytes(received[:whole]))]
    assert times_s[0] < 0.1
    assert max(np.diff(times_s)) < 0.05
