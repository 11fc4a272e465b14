"""A commissioning of a robot that another program has left with a stop, a crash or a grip."""

from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import replace

import pytest

from shearloop.daemon.config import load_daemon_config
from shearloop.daemon.control.faults import FaultCode
from shearloop.daemon.rig_memory import Remembered, read_memories, read_memory, write_memory
from shearloop.daemon.robot_files import RobotFiles, memory_path
from shearloop.errors import UserError
from shearloop.tools.commission.operator import DeclinedError, Operator
from shearloop.tools.commission.remembered import LeftRobot
from shearloop.tools.left_tool import left_tool
from tests.tools.commission.test_procedure import Lab

pytestmark = pytest.mark.usefixtures("ur_rtde")

HOST = "127.0.0.9"
GRIP = Remembered(origin_rad=0.3, force_n=60.0, width_mm=30.0)
LEFT = replace(GRIP, running="loosen", stop=((FaultCode.GRIP_LOST.name, "the object is gone"),))


@pytest.fixture
def lab(tmp_path) -> Iterator[Lab]:
    lab = Lab(tmp_path)
    yield lab
    lab.close()


def motions(lab: Lab) -> list[str]:
    return [question for question in lab.operator.asked if question.startswith("MOTION")]


def test_stop_crash_and_grip_are_shown_and_acknowledged_before_anything_is_asked_of_the_robot(lab, monkeypatch):
    write_memory(memory_path(HOST), LEFT)
    with monkeypatch.context() as patched:
        patched.setattr(lab.rig, "controller", lambda: pytest.fail("the robot was asked before"))
        lab.operator.declined = "Look at the rig"
        with pytest.raises(DeclinedError, match="Look at the rig"):
            lab.run("0")
    assert read_memory(memory_path(HOST)) == LEFT
    shown = " ".join(lab.operator.said)
    for part in ("the object is gone", "'loosen' was under way", "60 N, 30.0 mm wide, its angle counts from 0.300 rad"):
        assert part in shown
    lab.operator.declined = ""
    lab.run("0")
    assert read_memory(memory_path(HOST)) == GRIP


def test_without_anything_to_remember_nothing_is_asked(lab):
    write_memory(memory_path(HOST), Remembered())
    lab.run("0")
    assert lab.operator.asked[0] == "Your name:"


def test_each_motion_says_that_a_tool_may_be_held(lab):
    write_memory(memory_path(HOST), GRIP)
    lab.run("3")
    assert len(motions(lab)) > 0
    assert all("a tool may be held, gripped with at most 60 N" in motion for motion in motions(lab))
    assert read_memory(memory_path(HOST)) == GRIP


def test_the_fingers_open_once_a_tool_that_may_be_held_is_secured_and_the_grip_is_over(lab):
    write_memory(memory_path(HOST), GRIP)
    lab.operator.declined = "Stage 2 gripper opens the fingers, and it drops"
    with pytest.raises(DeclinedError, match="A tool may be held"):
        lab.run("2")
    assert motions(lab) == []
    assert read_memory(memory_path(HOST)) == GRIP
    lab.operator.declined = ""
    lab.run("2")
    assert read_memory(memory_path(HOST)) == Remembered()
    assert not any("may be in the fingers" in motion for motion in motions(lab))


@pytest.mark.parametrize("fails", [False, True])
def test_a_commissioning_that_is_killed_in_a_stage_leaves_a_stop(fails):
    files = RobotFiles(HOST)
    left = LeftRobot(files, Operator(pytest.fail, pytest.fail), opens=True, keeps=True, state=Remembered())
    with pytest.raises(UserError) if fails else nullcontext(), left.during("3 empty gripper"):
        # As another process finds it after a kill at this moment.
        (fault,) = read_memories(files).faults
        assert "'commissioning, stage 3 empty gripper' was under way" in fault.sentence
        if fails:
            raise UserError("the arm does not come to rest")
    assert read_memories(files) == Remembered()


def test_a_commissioning_leaves_no_zero_of_the_wrench_under_a_held_tool():
    """Its programs have let the controller zero it with the load."""
    files, zero = RobotFiles(HOST), (0.0, 0.0, 0.0, 0.0, 0.0, 0.4)
    tared = replace(GRIP, wrench_zero=zero, wrench_tared=True, load_zero=8321.0, load_nm_per_count=0.001)
    left = LeftRobot(files, Operator(pytest.fail, pytest.fail), opens=True, keeps=True, state=tared)
    with left.during("0 identity"):
        assert left.state == tared, "nothing is started"
    with left.during("1 no motion"):
        assert not read_memories(files).wrench_tared
    after = read_memories(files)
    assert after.wrench_zero == (0.0,) * 6
    assert not after.wrench_tared
    assert after.load_zero == 8321.0, "the load cell's is its own"
    assert left_tool(after) == left_tool(tared)


def test_an_acknowledgement_that_cannot_be_kept_is_none(lab):
    memory_path(HOST).mkdir(parents=True)
    with pytest.raises(UserError, match="the robot's state cannot be kept in"):
        lab.run("0")


def test_devices_that_end_with_the_rehearsal_have_no_past(lab):
    write_memory(memory_path(HOST), LEFT)
    config = load_daemon_config(lab.path).model_copy(update={"autostart": True})
    operator = Operator(pytest.fail, lambda _: None)
    left = LeftRobot.acknowledged(config, RobotFiles(HOST), operator)
    with left.during("2 gripper") as asked:
        assert asked is operator
    assert read_memory(memory_path(HOST)) == LEFT


def test_a_state_without_a_grip_is_said_to_have_none():
    """Zeros are kept wherever the fingers were not known to be empty, also where nothing was gripped."""
    only_zeros = Remembered(wrench_zero=(0.0,) * 6)
    assert "no grip is known" in left_tool(only_zeros)
    assert left_tool(GRIP).startswith("a tool may be held, gripped with at most 60 N")
    assert left_tool(Remembered()) == ""
