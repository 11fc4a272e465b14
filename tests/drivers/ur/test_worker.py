"""The worker over a fake arm: its exit and what it does before."""

import subprocess
import sys

import pytest

from shearloop.drivers.ur import worker
from shearloop.drivers.ur.messages import CommandReply, Disconnect, Enable, Unlock, WristSpeed
from tests.drivers.ur.handler_bench import HandlerBench, enabled
from tests.drivers.ur.process import CyclingArm, drive
from tests.drivers.ur.robots import ROOT


def test_unlocking_ended_by_a_disconnection_is_answered(daemon):
    arm = CyclingArm()
    arm.be(robot_mode=3)
    daemon.send(Unlock(), Disconnect())
    drive(daemon, arm)
    assert arm.calls == []
    replies = {number: message for number, message in daemon.receive() if isinstance(message, CommandReply)}
    assert "disconnects" in replies[1].refusal
    assert replies[2].accepted


def test_commands_after_a_disconnection_are_refused(daemon):
    arm = CyclingArm()
    daemon.send(Disconnect(), Enable(), WristSpeed(0.5, 4.0), Unlock())
    drive(daemon, arm)
    assert arm.calls == []
    replies = [message for _, message in daemon.receive() if isinstance(message, CommandReply)]
    assert [reply.accepted for reply in replies] == [True, False, False, False]


@pytest.mark.parametrize("runtime_state", [2, 4], ids=["playing", "paused"])
def test_foreign_program_is_left_alone_on_exit(daemon, runtime_state):
    """For example the program of another daemon."""
    arm = CyclingArm()
    arm.be(runtime_state=runtime_state)
    daemon.send(Disconnect())
    drive(daemon, arm)
    assert arm.calls == []
    assert arm.reading.runtime_state == runtime_state


CRASHING = """
import threading
from shearloop.drivers.ur import worker
from tests.drivers.ur.handler_bench import SETTINGS, FakeArm

class Arm(FakeArm):
    def read(self):
        raise ValueError("an unforeseen error")

# As the client's threads may, this one keeps the interpreter from ending.
threading.Thread(target=threading.Event().wait).start()
worker.receive_settings = lambda pipe: SETTINGS
worker.connect = lambda pipe, settings, receiver: Arm()
worker.main()
"""


def test_exception_ends_the_process_and_is_printed():
    command = [sys.executable, "-c", CRASHING]
    ended = subprocess.run(command, cwd=ROOT, stdin=subprocess.DEVNULL, capture_output=True, timeout=30, check=False)
    assert ended.returncode == worker.EXIT_FAILED
    assert b"ValueError: an unforeseen error" in ended.stderr


def test_state_is_dropped_while_others_are_unsent(daemon):
    state = HandlerBench().state
    while not daemon.pipe.unsent:
        daemon.pipe.send(state)
    unsent = daemon.pipe.unsent
    daemon.pipe.send_latest(state)
    assert daemon.pipe.unsent == unsent
    daemon.receive()
    daemon.pipe.send_latest(state)
    assert not daemon.pipe.unsent


def test_each_command_is_answered_at_once(daemon):
    bench = enabled()
    for acceleration, accepted in ((4.0, True), (-4.0, False)):
        daemon.send(WristSpeed(0.1, acceleration))
        bench.handler.take(bench.state)
        worker.handle_commands(daemon.pipe, bench.handler)
        assert [message.accepted for _, message in daemon.receive() if isinstance(message, CommandReply)] == [accepted]


def test_unsent_output_is_bounded(daemon):
    state = HandlerBench().state
    for _ in range(10_000):
        daemon.pipe.send(state)
        if not daemon.pipe.open:
            return
    raise AssertionError("it grows and grows")
