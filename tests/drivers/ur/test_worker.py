"""The worker over a fake arm: its exit and what it does before."""

import subprocess
import sys
from pathlib import Path

import pytest

from shearloop.drivers.ur import worker
from shearloop.drivers.ur.messages import CommandReply, Disconnect, Enable, Message, RtdeSample, Unlock, WristSpeed
from tests.drivers.ur.flight import Flight, flying
from tests.drivers.ur.process import CyclingArm, Daemon, fly

ROOT = Path(__file__).parents[3]


def test_unlocking_ended_by_a_disconnection_is_answered(daemon):
    arm = CyclingArm()
    arm.be(robot_mode=3)
    daemon.send(Unlock(), Disconnect())
    fly(daemon, arm)
    assert arm.calls == []
    replies = {number: message for number, message in daemon.receive() if isinstance(message, CommandReply)}
    assert "disconnects" in replies[1].refusal
    assert replies[2].accepted


def test_commands_after_a_disconnection_are_refused(daemon):
    arm = CyclingArm()
    daemon.send(Disconnect(), Enable(), WristSpeed(0.5, 4.0), Unlock())
    fly(daemon, arm)
    assert arm.calls == []
    replies = [message for _, message in daemon.receive() if isinstance(message, CommandReply)]
    assert [reply.accepted for reply in replies] == [True, False, False, False]


class Uploading(CyclingArm):
    """Its upload takes effect after `reads` more reads; at the upload the daemon sends messages."""

    def __init__(self, daemon: Daemon, *said: Message, reads: int) -> None:
        super().__init__()
        self._daemon, self._said, self._reads = daemon, said, reads
        self._left: int | None = None

    def upload(self) -> bool:
        if self._left is None:
            self.calls.append("upload")
            self._daemon.send(*self._said)
            self._left = self._reads
        return True

    def read(self) -> RtdeSample:
        if self._left is not None:
            self._left -= 1
            if self._left == 0:
                self.be(runtime_state=2)
        return super().read()


def test_program_started_by_a_late_upload_is_ended(daemon):
    """The state at the exit counts, not the one at the last cycle's start."""
    # The next cycle's reading still shows none; that by which the process leaves shows it.
    arm = Uploading(daemon, Disconnect(), reads=2)
    fly(daemon, arm)
    assert arm.calls == ["clear_command", "upload", "end_program"]
    assert not arm.reading.program_running


def test_our_program_is_ended_on_exit(daemon):
    class Ready(CyclingArm):
        def arm_watchdog(self) -> bool:
            daemon.send(Disconnect())
            return super().arm_watchdog()

    arm = Ready()
    fly(daemon, arm)
    assert [call for call in arm.calls if call != "send_heartbeat"] == [
        "clear_command",
        "upload",
        "arm_watchdog",
        "end_program",
    ]


@pytest.mark.parametrize("runtime_state", [2, 4], ids=["playing", "paused"])
def test_foreign_program_is_left_alone_on_exit(daemon, runtime_state):
    """For example the program of another daemon."""
    arm = CyclingArm()
    arm.be(runtime_state=runtime_state)
    daemon.send(Disconnect())
    fly(daemon, arm)
    assert arm.calls == []
    assert arm.reading.runtime_state == runtime_state


def test_our_paused_program_is_stopped_on_exit(daemon):
    """If resumed later, it would turn the wrist on."""

    class Stopped(CyclingArm):
        """Has a protective stop as soon as its program is ready."""

        def arm_watchdog(self) -> bool:
            super().arm_watchdog()
            self.protective_stop()
            daemon.send(Disconnect())
            return True

    arm = Stopped()
    fly(daemon, arm)
    assert arm.calls[:4] == ["clear_command", "upload", "arm_watchdog", "stop"]


CRASHING = """
import threading
from shearloop.drivers.ur import worker
from shearloop.drivers.ur.messages import Configure
from tests.drivers.ur.flight import SETTINGS, FakeArm

class Arm(FakeArm):
    def read(self):
        raise ValueError("an unforeseen error")

# As the client's threads may, this one keeps the interpreter from ending.
threading.Thread(target=threading.Event().wait).start()
worker._receive_configuration = lambda pipe: Configure(SETTINGS)
worker._connect = lambda pipe, settings: Arm()
worker.main()
"""


def test_exception_ends_the_process_and_is_printed():
    command = [sys.executable, "-c", CRASHING]
    ended = subprocess.run(command, cwd=ROOT, stdin=subprocess.DEVNULL, capture_output=True, timeout=30, check=False)
    assert ended.returncode == worker.EXIT_FAILED
    assert b"ValueError: an unforeseen error" in ended.stderr


def test_state_is_dropped_while_others_are_unsent(daemon):
    state = Flight().state
    while not daemon.pipe._unsent:
        daemon.pipe.send(state)
    unsent = daemon.pipe._unsent
    daemon.pipe.send_latest(state)
    assert daemon.pipe._unsent == unsent
    daemon.receive()
    daemon.pipe.send_latest(state)
    assert not daemon.pipe._unsent


def test_each_command_is_answered_at_once(daemon):
    flight = flying()
    for acceleration, accepted in ((4.0, True), (-4.0, False)):
        daemon.send(WristSpeed(0.1, acceleration))
        worker._handle_commands(daemon.pipe, flight.handler, flight.state)
        assert [message.accepted for _, message in daemon.receive() if isinstance(message, CommandReply)] == [accepted]


def test_unsent_output_is_bounded(daemon):
    state = Flight().state
    for _ in range(10_000):
        daemon.pipe.send(state)
        if not daemon.pipe.open:
            return
    raise AssertionError("it grows and grows")
