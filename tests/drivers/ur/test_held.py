"""What the gripper holds while a program starts: an e-Series zeroes its wrench then."""

import pytest

from shearloop.drivers.ur import worker
from shearloop.drivers.ur.messages import Disconnect, Held, Unlock
from shearloop.drivers.ur.recovery import LOAD_WITHIN_S
from tests.drivers.ur.handler_bench import SETTINGS, HandlerBench
from tests.drivers.ur.process import CyclingArm

ZERO = (0.0, 0.0, 0.0, 0.0, 0.0, 0.5)


@pytest.mark.parametrize("held", [True, False])
def test_the_first_program_of_a_worker_knows_what_the_gripper_holds(held):
    bench = HandlerBench()
    bench.handler.take_held(Held(held, ZERO))
    bench.run(5)
    assert ("upload, held" in bench.arm.calls) == held
    assert bench.state.wrench_zero == ZERO


def test_a_program_waits_until_the_load_has_been_measured(monkeypatch):
    """A new worker has read a few noisy samples: each restart would move the kept zero by their error."""
    bench, measured = HandlerBench(), [False]
    monkeypatch.setattr(bench.arm, "knows_load", lambda *, held: not held or measured[0])
    bench.handler.take_held(Held(True, ZERO))
    bench.run(50)
    assert bench.arm.calls == ["clear_command"]
    measured[0] = True
    bench.run(1)
    assert bench.arm.calls[-1] == "upload, held"


def test_an_arm_that_does_not_come_to_rest_keeps_no_program_waiting(monkeypatch):
    bench = HandlerBench()
    monkeypatch.setattr(bench.arm, "knows_load", lambda *, held: not held)
    bench.handler.take_held(Held(True, ZERO))
    bench.run(round(LOAD_WITHIN_S * 125) + 2)
    assert bench.arm.calls[:2] == ["clear_command", "upload, held"]


@pytest.mark.parametrize("held", [True, False])
def test_unlock_starts_a_program_that_knows_what_the_gripper_holds_now(held):
    bench = HandlerBench()
    bench.handler.take_held(Held(not held, ZERO))
    bench.run(5)
    bench.arm.calls.clear()
    bench.arm.end_program()
    bench.run(1)
    bench.handler.take_held(Held(held, ZERO))
    assert bench.ask(Unlock()).accepted
    assert [one for one in bench.arm.calls if one.startswith("upload")] == ["upload, held" if held else "upload"]


def test_what_the_daemon_sends_behind_the_settings_is_not_lost(daemon):
    """Both are there before the worker's interpreter has started."""
    daemon.send(SETTINGS, Held(held=True, wrench_zero=ZERO))
    assert worker.receive_settings(daemon.pipe) == SETTINGS
    daemon.send(Disconnect())
    assert daemon.pipe.receive() == [(2, Held(held=True, wrench_zero=ZERO)), (1, Disconnect())]


def test_a_new_worker_keeps_the_zero_under_the_tool_that_is_held(daemon, timed):
    """Its predecessor was killed, or lost the robot."""
    arm = CyclingArm()
    daemon.send(SETTINGS, Held(held=True, wrench_zero=ZERO))
    assert worker.receive_settings(daemon.pipe) == SETTINGS
    timed(arm, (0.1, Disconnect()))
    assert arm.calls[:2] == ["clear_command", "upload, held"]
    assert arm.wrench_zero == ZERO
