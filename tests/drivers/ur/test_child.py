"""The robot's own process without a robot: how it leaves, and what it does to an arm before."""

import os
import subprocess
import sys
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import NoReturn

import pytest

from drivers.ur import child
from drivers.ur.messages import (
    Configure,
    Disconnect,
    Ease,
    Enable,
    Heartbeat,
    Message,
    Reading,
    Reply,
    RobotState,
    Stop,
    Unlock,
    WristSpeed,
)
from drivers.ur.pace import Pace
from drivers.ur.pilot import Pilot
from drivers.ur.wire import Decoder, encode
from tests.drivers.ur.flight import SETTINGS, FakeArm, Flight, flying

ROOT = Path(__file__).parents[3]


class LeftError(Exception):
    """The process would have ended here."""


class Daemon:
    """The daemon's ends of the two pipes."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        its_stdin, self._stdin = os.pipe()
        self._stdout, its_stdout = os.pipe()
        os.set_blocking(self._stdout, False)
        self._all = [its_stdin, self._stdin, self._stdout, its_stdout]
        self.pipe = child.Pipe(its_stdin, its_stdout)
        monkeypatch.setattr(child, "_alarm", lambda _seconds: None)
        monkeypatch.setattr(child, "_leave", self._left)

    @staticmethod
    def _left(_status: int) -> NoReturn:
        raise LeftError

    def say(self, *messages: Message) -> None:
        for number, message in enumerate(messages, 1):
            os.write(self._stdin, encode(message, number))

    def hear(self) -> list[tuple[int, Message]]:
        return Decoder().feed(os.read(self._stdout, 1 << 20))

    def close(self) -> None:
        for descriptor in self._all:
            os.close(descriptor)


class CyclingArm(FakeArm):
    """An arm that goes through a cycle whenever it is read."""

    def read(self) -> Reading:
        self.cycle()
        return super().read()

    def end_program(self) -> None:
        self.calls.append("end_program")
        super().end_program()


@pytest.fixture
def daemon(monkeypatch: pytest.MonkeyPatch) -> Iterator[Daemon]:
    daemon = Daemon(monkeypatch)
    yield daemon
    daemon.close()


def fly(daemon: Daemon, arm: CyclingArm) -> None:
    with pytest.raises(LeftError):
        child._fly(daemon.pipe, Configure(SETTINGS), arm)  # type: ignore[arg-type]  # an arm in all that counts


def test_disconnecting_while_the_robot_is_made_ready_starts_nothing(daemon: Daemon) -> None:
    arm = CyclingArm()
    daemon.say(Disconnect())
    fly(daemon, arm)
    assert arm.calls == []


def test_unlocking_that_a_disconnection_ends_is_answered(daemon: Daemon) -> None:
    arm = CyclingArm()
    arm.be(robot_mode=3)
    daemon.say(Unlock(), Disconnect())
    fly(daemon, arm)
    assert arm.calls == []
    replies = {number: message for number, message in daemon.hear() if isinstance(message, Reply)}
    assert "disconnects" in replies[1].refused
    assert replies[2].accepted


def test_nothing_that_comes_after_a_disconnection_is_carried_out(daemon: Daemon) -> None:
    arm = CyclingArm()
    daemon.say(Disconnect(), Enable(), WristSpeed(0.5, 4.0), Unlock())
    fly(daemon, arm)
    assert arm.calls == []
    replies = [message for _, message in daemon.hear() if isinstance(message, Reply)]
    assert [reply.accepted for reply in replies] == [True, False, False, False]


def test_program_that_this_very_cycle_started_is_ended(daemon: Daemon, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever started it: what counts is what runs when the process leaves, not when its last cycle began."""
    arm = CyclingArm()

    def starts_a_program(*_: object) -> None:
        arm.upload()

    monkeypatch.setattr("drivers.ur.pilot.Pilot.tick", starts_a_program)
    daemon.say(Disconnect())
    fly(daemon, arm)
    assert arm.calls == ["upload", "end_program"]
    assert not arm.reading.program_running


def test_program_that_is_paused_is_stopped_before_the_process_leaves(daemon: Daemon) -> None:
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


def test_program_of_somebody_else_is_not_stopped_by_a_process_that_leaves(daemon: Daemon) -> None:
    arm = CyclingArm()
    arm.be(runtime_state=4)
    daemon.say(Disconnect())
    fly(daemon, arm)
    assert arm.calls == []


class Time:
    """A clock that only waiting moves on."""

    def __init__(self) -> None:
        self.now_s = 1000.0

    def monotonic(self) -> float:
        return self.now_s

    def monotonic_ns(self) -> int:
        return round(self.now_s * 1e9)

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds


class TimedArm(CyclingArm):
    """An arm that is read in the process's own time; `read_s` keeps when."""

    def __init__(self) -> None:
        super().__init__()
        self.read_s: list[float] = []

    def read(self) -> Reading:
        super().read()
        self.read_s.append(child.time.monotonic() - 1000.0)
        self.be(t_mono_ns=child.time.monotonic_ns())
        return self.reading


class Eased:
    """A flight in a time of its own: at some times the daemon says something; what was done when is kept."""

    def __init__(
        self,
        daemon: Daemon,
        monkeypatch: pytest.MonkeyPatch,
        *script: tuple[float, Message],
        arm: "TimedArm | None" = None,
    ) -> None:
        self.time = Time()
        self.arm = arm or TimedArm()
        self._daemon = daemon
        self._script = [(1000.0 + at_s, message) for at_s, message in script]
        monkeypatch.setattr(child, "time", self.time)
        monkeypatch.setattr(daemon.pipe, "wait", self._wait)
        fly(daemon, self.arm)
        self.states = [message for _, message in daemon.hear() if isinstance(message, RobotState)]

    def _wait(self, timeout_s: float) -> bool:
        if self._script and self._script[0][0] <= self.time.now_s + timeout_s:
            at_s, message = self._script.pop(0)
            self.time.now_s = max(self.time.now_s, at_s)
            self._daemon.say(message)
            return True
        self.time.now_s += timeout_s
        return False

    def cycles_between(self, from_s: float, to_s: float) -> list[int]:
        """Return the numbers of the cycles that were gone through in that time, as the readings tell."""
        periods = [read_s * SETTINGS.rate_hz for read_s in self.arm.read_s if from_s < read_s < to_s]
        return sorted({round(period) for period in periods if abs(period - round(period)) < 1e-6})

    def told_between(self, from_s: float, to_s: float) -> list[int]:
        """Return the numbers of the cycles whose states were told in that time."""
        return sorted({state.cycle for state in self.states if from_s < state.t_mono_ns / 1e9 - 1000.0 < to_s})


def test_at_ease_every_third_cycle_is_gone_through_until_the_daemon_says_something(
    daemon: Daemon, monkeypatch: pytest.MonkeyPatch
) -> None:
    eased = Eased(daemon, monkeypatch, (0.101, Ease(5)), (0.225, Heartbeat()), (0.301, Ease(5)), (0.405, Disconnect()))
    assert eased.cycles_between(-0.001, 0.101) == [*range(13)]
    assert eased.cycles_between(0.101, 0.225) == [13, 15, 18, 21, 24, 27]
    assert eased.cycles_between(0.225, 0.301) == [*range(29, 38)]
    assert eased.cycles_between(0.301, 0.405) == [38, 39, 42, 45, 48]
    assert eased.cycles_between(0.405, 1.0) == [51]


def test_at_ease_one_state_is_told_of_so_many_cycles_as_the_daemon_says(
    daemon: Daemon, monkeypatch: pytest.MonkeyPatch
) -> None:
    eased = Eased(daemon, monkeypatch, (0.101, Ease(5)), (0.225, Heartbeat()), (0.301, Ease(5)), (0.405, Disconnect()))
    # While the robot is made ready something happens in each cycle, then nothing: every third, and every fifth.
    assert eased.told_between(-0.001, 0.101) == [0, 1, 2, 5, 8, 10]
    # Of those that are gone through the first in each five; then as before.
    assert eased.told_between(0.101, 0.225) == [15, 21, 27]
    assert eased.told_between(0.225, 0.301) == [30, 33, 35]
    assert eased.told_between(0.301, 0.405) == [42, 45]
    assert eased.told_between(0.405, 1.0) == [51]


def test_a_command_at_ease_is_carried_out_when_it_comes_and_ends_the_ease(
    daemon: Daemon, monkeypatch: pytest.MonkeyPatch
) -> None:
    told_s: list[float] = []

    class Told(TimedArm):
        def wrist(self, command: WristSpeed) -> bool:
            told_s.append(child.time.monotonic())
            return super().wrist(command)

    eased = Eased(
        daemon, monkeypatch,
        (0.1, Enable()), (0.101, Ease(5)), (0.203, WristSpeed(0.1, 4.0)), (0.204, Ease(5)), (0.3, Disconnect()),
        arm=Told(),
    )  # fmt: skip
    assert told_s[0] == pytest.approx(1000.203, abs=1e-9)
    # It turns: at ease or not, each cycle is gone through, but slow as it is not each is told.
    assert eased.cycles_between(0.201, 0.3) == [*range(26, 38)]
    assert eased.told_between(0.201, 0.3) == [26, 29, 30, 33, 35]
    assert all(state.motion == "wrist" for state in eased.states if 26 <= state.cycle < 38)


def test_for_a_command_soon_after_a_cycle_the_arm_is_not_read_again(
    daemon: Daemon, monkeypatch: pytest.MonkeyPatch
) -> None:
    eased = Eased(daemon, monkeypatch, (0.041, Enable()), (0.051, Enable()), (0.065, Disconnect()))
    assert eased.arm.read_s[5:9] == pytest.approx([0.04, 0.048, 0.051, 0.056])


@pytest.mark.parametrize("stopped_s", [0.2001, 0.2005, 0.2079])
def test_a_stop_that_the_readings_tell_later_than_the_commands_is_told_as_what_it_is(
    daemon: Daemon, monkeypatch: pytest.MonkeyPatch, stopped_s: float
) -> None:
    class Late(TimedArm):
        def wrist(self, command: WristSpeed) -> bool:
            self.takes = child.time.monotonic() < 1000.0 + stopped_s
            return super().wrist(command)

        def read(self) -> Reading:
            if child.time.monotonic() > 1000.003 + stopped_s and self.reading.safety_mode == 1:
                self.protective_stop()
            return super().read()

    speeds = [(0.1005 + 0.008 * number, WristSpeed(0.1, 4.0)) for number in range(20)]
    eased = Eased(daemon, monkeypatch, (0.1, Enable()), *speeds, (0.3, Disconnect()), arm=Late())
    assert {state.blocked[:15] for state in eased.states if state.cycle > 15} == {"", "Protective stop"}
    assert {state.motion for state in eased.states if state.blocked} == {"idle"}


def test_an_arm_that_is_moved_is_watched_in_every_cycle(daemon: Daemon, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever moves it: at ease it takes one of the fewer cycles to be seen, and each one from then on."""

    class Moved(TimedArm):
        def cycle(self) -> None:
            super().cycle()
            self.be(qd_rad_per_s=(0.0,) * 5 + (0.01 * (child.time.monotonic() > 1000.201),))

    eased = Eased(daemon, monkeypatch, (0.101, Ease(5)), (0.301, Disconnect()), arm=Moved())
    assert eased.cycles_between(0.101, 0.301) == [13, 15, 18, 21, 24, *range(27, 38)]
    assert eased.told_between(0.101, 0.301) == [15, 21, 27, 30, 33, 35]


@pytest.mark.parametrize(("rad_per_s", "gaps"), [(0.5, {1}), (0.2, {1, 2}), (0.05, {2, 3})])
def test_the_faster_a_wrist_turns_the_more_of_its_cycles_are_told(
    daemon: Daemon, monkeypatch: pytest.MonkeyPatch, rad_per_s: float, gaps: set[int]
) -> None:
    eased = Eased(daemon, monkeypatch, (0.1, Enable()), (0.2, WristSpeed(rad_per_s, 4.0)), (0.5, Disconnect()))
    # As fast as it was told, until the command has to be given anew.
    turning = [state for state in eased.states if 1000.35 < state.t_mono_ns / 1e9 < 1000.48]
    assert {round(state.qd_rad_per_s[5], 9) for state in turning} == {rad_per_s}
    assert {later.cycle - earlier.cycle for earlier, later in pairwise(turning)} == gaps


@pytest.mark.parametrize("cycle", [31, 32, 34])
def test_what_happens_is_told_in_the_cycle_that_sees_it(
    daemon: Daemon, monkeypatch: pytest.MonkeyPatch, cycle: int
) -> None:
    """Of a wrist so slow that not each is told."""

    class Stopping(TimedArm):
        def read(self) -> Reading:
            if child.time.monotonic() > 1000.0 + 0.008 * cycle - 1e-6 and self.reading.safety_mode == 1:
                self.protective_stop()
            return super().read()

    said = (0.1, Enable()), (0.2, WristSpeed(0.01, 4.0)), (0.3, Disconnect())
    eased = Eased(daemon, monkeypatch, *said, arm=Stopping())
    assert next(state.cycle for state in eased.states if state.protective_stop) == cycle


def test_what_happened_while_the_daemon_did_not_read_is_told_as_soon_as_it_does(
    daemon: Daemon, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of the cycles that see it first two cannot be told; then the next is, and not only the third one."""
    send, lost = daemon.pipe.send_latest, list[int]()

    class Reduced(TimedArm):
        def read(self) -> Reading:
            super().read()
            if self.reading.t_mono_ns > 1000.24e9 - 1e3:
                self.be(safety_mode=2)
            return self.reading

    def send_latest(state: RobotState) -> bool:
        if state.safety_mode == 2 and len(lost) < 2:
            lost.append(state.cycle)
            return False
        return send(state)

    monkeypatch.setattr(daemon.pipe, "send_latest", send_latest)
    said = (0.1, Enable()), (0.2, WristSpeed(0.01, 4.0)), (0.4, Disconnect())
    eased = Eased(daemon, monkeypatch, *said, arm=Reduced())
    assert lost == [30, 31]
    assert next(state.cycle for state in eased.states if state.safety_mode == 2) == 32


def test_state_that_finds_others_waiting_is_not_sent_and_says_so(daemon: Daemon) -> None:
    state = Flight().state
    assert daemon.pipe.send_latest(state)
    while not daemon.pipe._unsent:
        daemon.pipe.send(state)
    assert not daemon.pipe.send_latest(state)
    daemon.hear()
    assert daemon.pipe.send_latest(state)


def test_robot_that_is_made_ready_no_more_is_told_at_once_however_soon(
    daemon: Daemon, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Announced as being made ready, and given up in the same cycle: all is as before the announcement."""
    arm = TimedArm()
    arm.be(robot_mode=3)
    given_up = Pilot.tick

    def tick(pilot: Pilot, reading: Reading, now_ns: int) -> tuple[int, Reply] | None:
        if now_ns > 1000.1e9 and pilot._recovery is not None:
            pilot._recovery.give_up("Nobody waits for it.")
        return given_up(pilot, reading, now_ns)

    monkeypatch.setattr("drivers.ur.pilot.Pilot.tick", tick)
    eased = Eased(daemon, monkeypatch, (0.201, Unlock()), (0.4, Disconnect()), arm=arm)
    ready = [state for state in eased.states if 1000.195 < state.t_mono_ns / 1e9 < 1000.3]
    announced = next(number for number, state in enumerate(ready) if state.recovering)
    assert not ready[announced + 1].recovering
    assert ready[announced + 1].cycle == ready[announced].cycle


def test_refused_wrist_speed_is_answered_at_once_one_that_is_taken_with_the_next_state(daemon: Daemon) -> None:
    flight, pace = flying(), Pace(SETTINGS, 0.0)
    daemon.say(WristSpeed(0.1, 4.0))
    child._obey(daemon.pipe, flight.pilot, pace, flight.state)
    with pytest.raises(BlockingIOError):
        daemon.hear()
    daemon.say(WristSpeed(0.1, -4.0))
    child._obey(daemon.pipe, flight.pilot, pace, flight.state)
    assert [message.accepted for _, message in daemon.hear() if isinstance(message, Reply)] == [True, False]


def test_reply_to_a_wrist_speed_comes_with_the_next_state_in_one_piece(daemon: Daemon) -> None:
    pipe, state = daemon.pipe, Flight().state
    pipe.hold(Reply(sent=WristSpeed(0.1, 4.0)), 1)
    with pytest.raises(BlockingIOError):
        daemon.hear()
    pipe.send_latest(state)
    assert daemon.hear() == [(1, Reply(sent=WristSpeed(0.1, 4.0))), (0, state)]


def test_what_was_held_back_comes_before_what_is_sent_at_once(daemon: Daemon) -> None:
    daemon.pipe.hold(Reply(sent=WristSpeed(0.1, 4.0)), 1)
    daemon.pipe.send(Reply(sent=Stop(4.0)), 2)
    assert [number for number, _ in daemon.hear()] == [1, 2]


def test_what_is_held_back_from_a_daemon_that_reads_nothing_has_a_bound(daemon: Daemon) -> None:
    pipe, state = daemon.pipe, Flight().state
    for _ in range(10_000):
        pipe.hold(Reply(), 1)
        pipe.send_latest(state)
        if not pipe.open:
            return
    raise AssertionError("it grows and grows")


CRASHING = """
import threading
from drivers.ur import child
from drivers.ur.messages import Configure
from tests.drivers.ur.flight import SETTINGS, FakeArm

class Arm(FakeArm):
    def read(self):
        raise ValueError("what nobody thought of")

# As the client's threads may, this one keeps the interpreter from ending.
threading.Thread(target=threading.Event().wait).start()
child._configuration = lambda pipe: Configure(SETTINGS)
child._connect = lambda pipe, settings: Arm()
child.main()
"""


def test_exception_ends_the_process_at_once_and_is_told() -> None:
    command = [sys.executable, "-c", CRASHING]
    ended = subprocess.run(command, cwd=ROOT, stdin=subprocess.DEVNULL, capture_output=True, timeout=30, check=False)
    assert ended.returncode == child.EXIT_FAILED
    assert b"ValueError: what nobody thought of" in ended.stderr
