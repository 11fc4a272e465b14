"""One robot has one lock and one memory, however its address is spelt."""

import os
import socket
import threading
import time
from pathlib import Path

import pytest

from shearloop.daemon.control.faults import FaultCode
from shearloop.daemon.rig_memory import Remembered, RigMemory, read_memories, read_memory, write_memories, write_memory
from shearloop.daemon.robot_files import RobotFiles, lock_robot, memory_path
from shearloop.drivers import hosts
from shearloop.errors import UserError
from tests.daemon.control.loop_rig import new_loop

STOP = (FaultCode.GRIP_LOST.name, "the object is gone")
# What a name server knows: names with their addresses.
NAMES = {"localhost": ["::1", "127.0.0.1"], "ur.lab": ["192.168.1.10"], "other.lab": ["192.168.1.11"]}


@pytest.fixture
def names(monkeypatch) -> dict[str, list[str]]:
    """A name server of our own; a name that it does not have is not found."""
    known = {name: list(addresses) for name, addresses in NAMES.items()}

    def answer(name: str, *_: object, **__: object) -> list[tuple[object, ...]]:
        if name not in known:
            raise socket.gaierror(socket.EAI_AGAIN, "Temporary failure in name resolution")
        return [(socket.AF_INET, socket.SOCK_STREAM, 6, "", (address, 0)) for address in known[name]]

    monkeypatch.setattr(hosts.socket, "getaddrinfo", answer)
    return known


SAME = [
    *(("localhost", "127.0.0.1"), ("LocalHost", "localhost"), ("localhost.", "127.0.0.1"), ("::1", "127.0.0.1")),
    *(("0:0:0:0:0:0:0:1", "localhost"), ("0x7f.1", "127.0.0.1"), ("::", "127.0.0.1")),
    *(("::ffff:127.5.6.7", "127.5.6.7"), ("0x7f050607", "127.5.6.7")),
    *(("ur.lab", "192.168.1.10"), ("UR.lab.", "192.168.1.10"), ("ur.lab", "::ffff:192.168.1.10")),
    *(("2001:DB8::1", "2001:db8:0:0:0:0:0:1"), ("fe80::1%eth0", "FE80::1%eth0")),
]


@pytest.mark.usefixtures("names")
@pytest.mark.parametrize(("one", "other"), [*SAME, *((other, one) for one, other in SAME)])
def test_one_robot_under_two_spellings_has_one_lock_and_one_stop(one, other):
    files = RobotFiles.of(one)
    with lock_robot(files), pytest.raises(UserError, match=rf"{other} is driven by another program"):
        lock_robot(RobotFiles.of(other)).__enter__()
    write_memory(files.states[0], Remembered(stop=(STOP,)))
    assert read_memories(RobotFiles.of(other)).stop == (STOP,)


@pytest.mark.usefixtures("names")
@pytest.mark.parametrize(
    ("one", "other"),
    [
        *(("127.0.0.1", "127.0.0.2"), ("localhost", "127.0.0.2"), ("127.1.2.3", "127.1.2.4")),
        *(("ur.lab", "other.lab"), ("ur.lab", "192.168.1.11"), ("2001:db8::1", "2001:db8::2")),
    ],
)
def test_two_robots_have_two_locks_and_two_memories(one, other):
    with lock_robot(RobotFiles.of(one)), lock_robot(RobotFiles.of(other)):
        write_memory(RobotFiles.of(one).states[0], Remembered(stop=(STOP,)))
    assert read_memories(RobotFiles.of(other)) == Remembered()


@pytest.mark.usefixtures("names")
@pytest.mark.parametrize(("earlier", "now"), [("ur.lab", "ur.lab"), ("Ur.Lab", "192.168.1.10"), ("ur.lab", "UR.lab.")])
async def test_a_stop_that_was_kept_under_a_name_is_found_and_moves_to_the_address(earlier, now):
    write_memory(memory_path(earlier), Remembered(stop=(STOP,)))
    memory = RigMemory(RobotFiles.of(now), loop := new_loop())
    assert [fault.code.name for fault in loop.safety.waiting.faults] == [STOP[0]]
    await memory.save_present()
    assert read_memory(memory_path("192.168.1.10")).stop[0][0] == STOP[0]
    loop.acknowledge()
    await memory.save_present()
    for spelling in ("ur.lab", "192.168.1.10", earlier, now):
        assert read_memories(RobotFiles.of(spelling)).stop == ()


def test_a_name_that_is_not_found_for_now_has_the_robot_that_it_had(names):
    RobotFiles.of("ur.lab")
    with lock_robot(RobotFiles.of("192.168.1.10")):
        write_memory(memory_path("192.168.1.10"), Remembered(stop=(STOP,)))
        names.clear()
        with pytest.raises(UserError, match="driven by another program"):
            lock_robot(RobotFiles.of("UR.lab")).__enter__()
    assert read_memories(RobotFiles.of("ur.lab")).stop == (STOP,)


def test_a_name_that_has_moved_is_the_robot_at_its_present_address(names):
    RobotFiles.of("ur.lab")
    names["ur.lab"] = ["192.168.1.20"]
    with lock_robot(RobotFiles.of("ur.lab")), lock_robot(RobotFiles.of("192.168.1.10")):
        pass


GRIP = Remembered(running="loosen", stop=(STOP,), origin_rad=0.3, force_n=60.0, width_mm=30.0)
OTHERS_GRIP = Remembered(origin_rad=1.0, force_n=20.0, width_mm=80.0)


@pytest.mark.parametrize("has_own_file", [False, True])
async def test_a_robot_with_a_new_address_keeps_stop_crash_and_grip(names, has_own_file):
    files = RobotFiles.of("ur.lab")
    if has_own_file:
        write_memories(files, GRIP)
    else:
        write_memory(memory_path("192.168.1.10"), GRIP)
    names["ur.lab"] = ["192.168.1.20"]
    memory = RigMemory(RobotFiles.of("UR.lab"), loop := new_loop())
    details = [fault.detail for fault in loop.safety.waiting.faults]
    assert details[0] == STOP[1]
    assert any("'loosen' was under way" in detail for detail in details)
    assert any("had the address 192.168.1.10 then and has 192.168.1.20 at present" in detail for detail in details)
    assert (loop.tool.grip.origin_rad, loop.tool.grip.force_n) == (0.3, 60.0)
    # Until it is written, the next program meets the same.
    assert read_memories(RobotFiles.of("ur.lab")).running == "loosen"
    loop.acknowledge()
    await memory.save_present()
    after = read_memories(RobotFiles.of("ur.lab"))
    assert (after.stop, after.running, after.origin_rad) == ((), "", 0.3)


def test_a_new_address_with_nothing_to_remember_waits_for_the_operator(names):
    write_memories(RobotFiles.of("ur.lab"), Remembered())
    names["ur.lab"] = ["192.168.1.20"]
    assert "make sure that this is the same robot" in read_memories(RobotFiles.of("ur.lab")).stop[0][1]


def test_a_name_with_a_further_address_is_the_same_robot(names):
    write_memories(RobotFiles.of("ur.lab"), Remembered())
    names["ur.lab"] = ["192.168.1.10", "192.168.1.20"]
    assert read_memories(RobotFiles.of("ur.lab")) == Remembered()


@pytest.mark.parametrize("both_are_found", [True, False])
def test_two_robots_with_exchanged_addresses_keep_their_own_grips_and_stops(names, both_are_found):
    write_memories(RobotFiles.of("ur.lab"), GRIP)
    write_memories(RobotFiles.of("other.lab"), OTHERS_GRIP)
    names["ur.lab"] = ["192.168.1.11"]
    if both_are_found:
        names["other.lab"] = ["192.168.1.10"]
    else:
        del names["other.lab"]
    files = RobotFiles.of("ur.lab")
    own = read_memories(files)
    assert (own.origin_rad, own.running) == (0.3, "loosen")
    write_memories(files, Remembered())
    assert read_memories(RobotFiles.of("ur.lab")) == Remembered()
    names["other.lab"] = ["192.168.1.10"]
    other = RobotFiles.of("other.lab")
    assert read_memories(other).origin_rad == 1.0
    assert read_memories(other).stop
    write_memories(other, OTHERS_GRIP)
    assert read_memories(RobotFiles.of("other.lab")) == OTHERS_GRIP


def test_a_stop_under_a_name_that_is_not_found_for_now_is_acknowledged_by_number_once(names):
    write_memories(RobotFiles.of("ur.lab"), Remembered(stop=(STOP,)))
    names.clear()
    files = RobotFiles.of("192.168.1.10")
    assert read_memories(files).stop == (STOP,)
    write_memories(files, Remembered())
    assert read_memories(RobotFiles.of("192.168.1.10")) == Remembered()


async def test_a_name_that_was_never_found_waits_for_the_operator_until_it_was(names):
    names.clear()
    memory = RigMemory(RobotFiles.of("ur.lab"), loop := new_loop())
    assert "the name 'ur.lab' has no address at present" in loop.safety.waiting.faults[0].sentence
    with lock_robot(memory.files), pytest.raises(UserError, match="driven by another program"):
        lock_robot(RobotFiles.of("UR.lab")).__enter__()
    loop.acknowledge()
    await memory.save_present()
    assert not memory.files.note_addresses()
    names.update(NAMES)
    assert memory.files.note_addresses()
    names.clear()
    assert read_memories(RobotFiles.of("ur.lab")).stop == ()


@pytest.mark.usefixtures("names")
def test_a_robot_that_is_driven_under_a_name_without_an_address_is_found_by_its_number(names):
    names.clear()
    with lock_robot(RobotFiles.of("ur.lab")):
        names.update(NAMES)
        with pytest.raises(UserError, match="driven by another program"):
            lock_robot(RobotFiles.of("192.168.1.10")).__enter__()


def test_a_name_server_that_does_not_answer_delays_no_start_for_long(monkeypatch):
    answered = threading.Event()

    def answer_late(*_: object, **__: object) -> list[tuple[object, ...]]:
        answered.wait()
        return []

    monkeypatch.setattr(hosts.socket, "getaddrinfo", answer_late)
    monkeypatch.setattr(hosts, "RESOLVED_WITHIN_S", 0.1)
    for name in ("one.lab", "two.lab", "three.lab"):
        write_memory(memory_path(name), Remembered())
    began_s = time.monotonic()
    try:
        assert not RobotFiles.of("ur.lab").known
        assert RobotFiles.of("192.168.1.10").keys == ("192.168.1.10",)
        assert time.monotonic() - began_s < 2.0
    finally:
        answered.set()
        # Nobody waits for a late answer.
        for asking in [one for one in threading.enumerate() if one.name == "look-up"]:
            asking.join()


def test_the_file_is_in_systemds_state_folder_or_the_users(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    assert memory_path("192.168.1.10") == tmp_path / "shearloop" / "robot-192.168.1.10.json"
    monkeypatch.setenv("STATE_DIRECTORY", "/var/lib/shearloop:/var/lib/other")
    assert memory_path("a/../b") == Path("/var/lib/shearloop/robot-a_.._b.json")


def test_one_daemon_at_a_time_drives_a_robot():
    files = RobotFiles.of("192.168.1.10")
    with lock_robot(files, "tcp://127.0.0.1:27762"):
        taken = rf"driven by another program of this computer \(process {os.getpid()}\): "
        taken += "stop that one first, with `shearloop command stop --connect tcp://127.0.0.1:27762`"
        with pytest.raises(UserError, match=taken), lock_robot(files):
            pytest.fail("it has the robot as well")
        with lock_robot(RobotFiles.of("192.168.1.11")):
            pass
    with lock_robot(files):
        pass


@pytest.mark.usefixtures("names")
def test_a_gripper_is_not_driven_with_two_robots():
    """Its socket serves any number of programs."""
    one, other = RobotFiles.of("ur.lab"), RobotFiles.of("other.lab")
    with lock_robot(one, gripper=("ur.lab", 63352)):
        taken = r"the gripper at 192\.168\.1\.10:63352 is driven by another program .* name another gripper"
        with pytest.raises(UserError, match=taken):
            lock_robot(other, gripper=("192.168.1.10", 63352)).__enter__()
        with lock_robot(other, gripper=("192.168.1.10", 63353)):
            pass


def test_a_robot_whose_lock_cannot_be_written_can_be_watched(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "file"))
    files = RobotFiles.of("192.168.1.10")
    with lock_robot(files):
        assert read_memory(files.states[0]).stop
