"""The robot's own process without a robot: how it leaves, and what it does to an arm before."""

import subprocess
import sys
from pathlib import Path

from shearloop.drivers.ur import worker
from shearloop.drivers.ur.messages import CommandReply, Disconnect, Enable, Message, RtdeSample, Unlock, WristSpeed
from tests.drivers.ur.process import CyclingArm, Daemon, fly

ROOT = Path(__file__).parents[3]


def test_disconnecting_while_the_robot_is_made_ready_starts_nothing(daemon: Daemon) -> None:
    arm = CyclingArm()
    daemon.say(Disconnect())
    fly(daemon, arm)
    assert arm.calls == []


def test_unlocking_ended_by_a_disconnection_is_answered(daemon: Daemon) -> None:
    arm = CyclingArm()
    arm.be(robot_mode=3)
    daemon.say(Unlock(), Disconnect())
    fly(daemon, arm)
    assert arm.calls == []
    replies = {number: message for number, message in daemon.hear() if isinstance(message, CommandReply)}
    assert "disconnects" in replies[1].refusal
    assert replies[2].accepted


def test_commands_after_a_disconnection_are_refused(daemon: Daemon) -> None:
    arm = CyclingArm()
    daemon.say(Disconnect(), Enable(), WristSpeed(0.5, 4.0), Unlock())
    fly(daemon, arm)
    assert arm.calls == []
    replies = [message for _, message in daemon.hear() if isinstance(message, CommandReply)]
    assert [reply.accepted for reply in replies] == [True, False, False, False]


class Uploading(CyclingArm):
    """Its upload takes only when it is read so many times more; when it is sent, the daemon says something."""

    def __init__(self, daemon: Daemon, *said: Message, reads: int) -> None:
        super().__init__()
        self._daemon, self._said, self._reads = daemon, said, reads
        self._left: int | None = None

    def upload(self) -> bool:
        if self._left is None:
            self.calls.append("upload")
            self._daemon.say(*self._said)
            self._left = self._reads
        return True

    def read(self) -> RtdeSample:
        if self._left is not None:
            self._left -= 1
            if self._left == 0:
                self.be(runtime_state=2)
        return super().read()


def test_program_started_by_a_late_upload_is_ended(daemon: Daemon) -> None:
    """What counts is what runs when the process leaves, not when its last cycle began."""
    # The next cycle's reading still shows none; that by which the process leaves shows it.
    arm = Uploading(daemon, Disconnect(), reads=2)
    fly(daemon, arm)
    assert arm.calls == ["clear_command", "upload", "end_program"]
    assert not arm.reading.program_running


def test_our_program_is_ended_on_exit(daemon: Daemon) -> None:
    class Ready(CyclingArm):
        def arm_watchdog(self) -> bool:
            daemon.say(Disconnect())
            return super().arm_watchdog()

    arm = Ready()
    fly(daemon, arm)
    assert [call for call in arm.calls if call != "send_heartbeat"] == [
        "clear_command",
        "upload",
        "arm_watchdog",
        "end_program",
    ]


def test_foreign_program_plays_on_after_exit(daemon: Daemon) -> None:
    """As of another daemon on the same robot."""
    arm = CyclingArm()
    arm.be(runtime_state=2)
    daemon.say(Disconnect())
    fly(daemon, arm)
    assert arm.calls == []
    assert arm.reading.program_running


def test_our_paused_program_is_stopped_on_exit(daemon: Daemon) -> None:
    """Resumed by somebody later, it would turn on where it was."""

    class Stopped(CyclingArm):
        """In a protective stop as soon as its program is ready."""

        def arm_watchdog(self) -> bool:
            super().arm_watchdog()
            self.protective_stop()
            daemon.say(Disconnect())
            return True

    arm = Stopped()
    fly(daemon, arm)
    assert arm.calls[:4] == ["clear_command", "upload", "arm_watchdog", "stop_program"]


def test_foreign_paused_program_is_not_stopped_on_exit(daemon: Daemon) -> None:
    arm = CyclingArm()
    arm.be(runtime_state=4)
    daemon.say(Disconnect())
    fly(daemon, arm)
    assert arm.calls == []


CRASHING = """
import threading
from shearloop.drivers.ur import worker
from shearloop.drivers.ur.messages import Configure
from tests.drivers.ur.flight import SETTINGS, FakeArm

class Arm(FakeArm):
    def read(self):
        raise ValueError("what nobody thought of")

# As the client's threads may, this one keeps the interpreter from ending.
threading.Thread(target=threading.Event().wait).start()
worker._receive_configuration = lambda pipe: Configure(SETTINGS)
worker._connect = lambda pipe, settings: Arm()
worker.main()
"""


def test_exception_ends_the_process_and_is_printed() -> None:
    command = [sys.executable, "-c", CRASHING]
    ended = subprocess.run(command, cwd=ROOT, stdin=subprocess.DEVNULL, capture_output=True, timeout=30, check=False)
    assert ended.returncode == worker.EXIT_FAILED
    assert b"ValueError: what nobody thought of" in ended.stderr
