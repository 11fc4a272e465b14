"""One robot has one lock and one memory, however its address is spelt."""

import os
from pathlib import Path

import pytest

from shearloop.daemon.control.faults import FaultCode
from shearloop.daemon.rig_memory import Remembered, read_memories, read_memory, write_memory
from shearloop.daemon.robot_files import RobotFiles, lock_robot, memory_path
from shearloop.errors import UserError
from tests.daemon.control.loop_rig import memory_of, new_loop

STOP = (FaultCode.GRIP_LOST.name, "the object is gone")
SAME = [
    *(("localhost", "127.0.0.1"), ("LocalHost", "localhost"), ("localhost.", "127.0.0.1"), ("::1", "127.0.0.1")),
    *(("0:0:0:0:0:0:0:1", "localhost"), ("0x7f.1", "127.0.0.1"), ("::", "127.0.0.1")),
    *(("::ffff:127.5.6.7", "127.5.6.7"), ("0x7f050607", "127.5.6.7")),
    *(("2001:DB8::1", "2001:db8:0:0:0:0:0:1"), ("fe80::1%eth0", "FE80::1%eth0")),
]


@pytest.mark.parametrize(("one", "other"), [*SAME, *((other, one) for one, other in SAME)])
def test_one_robot_under_two_spellings_has_one_lock_and_one_stop(one, other):
    files = RobotFiles(one)
    with lock_robot(files), pytest.raises(UserError, match=rf"{other} is driven by another program"):
        lock_robot(RobotFiles(other)).__enter__()
    write_memory(files.state, Remembered(stop=(STOP,)))
    assert read_memories(RobotFiles(other)).stop == (STOP,)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        *(("127.0.0.1", "127.0.0.2"), ("localhost", "127.0.0.2"), ("127.1.2.3", "127.1.2.4")),
        *(("2001:db8::1", "2001:db8::2"), ("fe80::1%eth0", "fe80::1%eth1")),
    ],
)
def test_two_robots_have_two_locks_and_two_memories(one, other):
    with lock_robot(RobotFiles(one)), lock_robot(RobotFiles(other)):
        write_memory(RobotFiles(one).state, Remembered(stop=(STOP,)))
    assert read_memories(RobotFiles(other)) == Remembered()


async def test_a_stop_under_a_name_stops_every_robot_until_a_person_removes_its_file():
    """The configuration named the robot `ur.lab` then, and which address that was is not known any more."""
    grip = Remembered(origin_rad=0.3, force_n=60.0, width_mm=30.0, wrench_zero=(0.0,) * 6)
    files, by_name = RobotFiles("192.168.1.10"), memory_path("ur.lab")
    write_memory(files.state, grip)
    write_memory(memory_path("other.lab"), grip)
    write_memory(by_name, Remembered(running="loosen", stop=(STOP,)))
    memory = memory_of(loop := new_loop(), files=files)
    (fault,) = loop.safety.waiting.faults
    assert f"{by_name} keeps a stop of a robot by its name, which may be this one" in fault.detail
    assert "the object is gone" in fault.detail
    assert "'loosen' was under way" in fault.detail
    loop.acknowledge()
    await memory.save_present()
    assert read_memory(by_name).stop == (STOP,), "it may be another robot's"
    assert memory_of(new_loop(), files=RobotFiles("192.168.1.11")).loop.safety.waiting is not None
    by_name.unlink()
    assert read_memories(files) == grip, "the other name keeps no stop"


@pytest.mark.parametrize("host", ["192.168.1.10", "localhost", "2001:db8::1", "fe80::1%eth0", "fe80::1%my_eth_0"])
def test_a_state_under_an_address_stops_no_other_robot(host):
    write_memory(RobotFiles(host).state, Remembered(stop=(STOP,)))
    # Another version kept it under both.
    write_memory(memory_path("127.0.0.1").with_name("robot-localhost.json"), Remembered(stop=(STOP,)))
    assert read_memories(RobotFiles("192.168.1.99")) == Remembered()


def test_the_file_is_in_systemds_state_folder_or_the_users(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    assert memory_path("192.168.1.10") == tmp_path / "shearloop" / "robot-192.168.1.10.json"
    monkeypatch.setenv("STATE_DIRECTORY", "/var/lib/shearloop:/var/lib/other")
    assert memory_path("a/../b") == Path("/var/lib/shearloop/robot-a_.._b.json")


def test_the_command_that_stops_the_other_daemon_can_be_copied():
    files = RobotFiles("192.168.1.10")
    stop = "with `shearloop command stop --connect 'ipc:///tmp/my rig/commands'`"
    with lock_robot(files, "ipc:///tmp/my rig/commands"), pytest.raises(UserError, match=stop), lock_robot(files):
        pytest.fail("it has the robot as well")


def test_one_daemon_at_a_time_drives_a_robot():
    files = RobotFiles("192.168.1.10")
    with lock_robot(files, "tcp://127.0.0.1:27762"):
        taken = rf"driven by another program of this computer \(process {os.getpid()}\): "
        taken += "stop that one first, with `shearloop command stop --connect tcp://127.0.0.1:27762`"
        with pytest.raises(UserError, match=taken), lock_robot(files):
            pytest.fail("it has the robot as well")
        with lock_robot(RobotFiles("192.168.1.11")):
            pass
    with lock_robot(files):
        pass


def test_a_gripper_is_not_driven_with_two_robots():
    """Its socket serves any number of programs."""
    one, other = RobotFiles("192.168.1.10"), RobotFiles("192.168.1.11")
    with lock_robot(one, gripper=("192.168.1.10", 63352)):
        taken = r"the gripper at ::ffff:192\.168\.1\.10:63352 is driven by another program .* name another gripper"
        with pytest.raises(UserError, match=taken):
            lock_robot(other, gripper=("::ffff:192.168.1.10", 63352)).__enter__()
        with lock_robot(other, gripper=("192.168.1.10", 63353)):
            pass


def test_a_robot_whose_lock_cannot_be_written_can_be_watched(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "file"))
    files = RobotFiles("192.168.1.10")
    with lock_robot(files):
        assert read_memory(files.state).stop
