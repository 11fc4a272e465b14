"""Whose program is on the robot: an unlock does nothing to one that may be another daemon's.

A stop of the other daemon may wait for its own operator.
"""

import pytest
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, rule

from shearloop.drivers.ur.messages import CommandReply, Enable, RobotLostError, Unlock
from tests.drivers.ur.handler_bench import SETTINGS, FakeArm, HandlerBench, turning

ANOTHERS = "may be another daemon's: another client writes the robot's input registers"
STOPPED, PLAYING, PAUSED = 1, 2, 4
# Longer than a sample may be missed.
SLOW_S = 2 * SETTINGS.state_timeout_s


class SharedArm(FakeArm):
    """An arm that another daemon drives as well; nothing may be done to it while that daemon's program is on it."""

    def __init__(self) -> None:
        super().__init__()
        self.has_anothers = False
        # The state in which the other daemon's program is found after the next request, whose answer is slow.
        self.meanwhile: int | None = None

    def begin_anothers(self, runtime_state: int = PLAYING) -> None:
        """The other daemon's operator unlocks the robot, which ends any program and starts that daemon's."""
        self.end_program()
        self.other_client = self.has_anothers = True
        self.be(safety_mode=1, robot_mode=7, runtime_state=runtime_state)

    def end_program(self) -> None:
        super().end_program()
        self.has_anothers = False

    def ask_dashboard(self, *requests: str) -> str:
        assert not self.has_anothers, f"`{requests[0]}` goes to another daemon's program"
        answer = super().ask_dashboard(*requests)
        if self.meanwhile is not None:
            self.begin_anothers(self.meanwhile)
            self.be(timestamp_s=self.reading.timestamp_s + SLOW_S)
            self.meanwhile = None
        return answer

    def upload(self, *, held: bool = False) -> None:
        assert not self.has_anothers, "an upload ends another daemon's program"
        super().upload(held=held)

    def arm_watchdog(self) -> bool:
        # The other daemon's program does not answer.
        return not self.has_anothers and super().arm_watchdog()


def paused() -> HandlerBench:
    """Return a bench whose own program is paused by a protective stop."""
    bench = turning(arm=SharedArm())
    bench.arm.protective_stop()
    bench.run(20)
    bench.arm.calls.clear()
    return bench


def begin_unlock(bench: HandlerBench) -> None:
    """Begin an unlock, which has to go through all its steps."""
    bench.number += 1
    assert bench.handler.request(bench.number, Unlock(), bench.now_ns) is None


def run_until(bench: HandlerBench, call: str) -> None:
    """Run up to a call to the arm."""
    for _ in range(500):
        if call in bench.arm.calls:
            return
        bench.run(1)
    raise AssertionError(f"{call} was not called")


def reply_of(bench: HandlerBench) -> CommandReply:
    """Return the reply to the latest unlock."""
    for _ in range(5000):
        if bench.number in bench.decided:
            break
        bench.run(1)
    return bench.decided[bench.number]


@pytest.mark.parametrize("runtime_state", [2, 3, 4, 5], ids=["playing", "pausing", "paused", "resuming"])
@pytest.mark.parametrize(
    "modes",
    [{}, {"safety_mode": 3}, {"robot_mode": 3}, {"robot_mode": 5}],
    ids=["normal", "protective stop", "power off", "brakes"],
)
def test_an_unlock_leaves_alone_what_another_daemon_runs_whose_stop_may_wait(runtime_state, modes):
    """Another daemon keeps its program alive, and a stop of the robot leaves it paused."""
    bench = HandlerBench()
    bench.arm.other_client = True
    bench.arm.be(runtime_state=runtime_state, **modes)
    bench.run(60)
    reply = bench.ask(Unlock())
    assert "may be another daemon's: another client writes the robot's input registers" in reply.refusal
    assert bench.arm.calls == [], "nothing is stopped, unlocked or powered"
    assert bench.arm.reading.has_program
    bench.arm.end_program()
    assert bench.ask(Unlock()).accepted


def test_a_paused_program_of_our_own_is_ended_beside_a_fieldbus_that_writes_registers():
    bench = turning()
    bench.arm.other_client = True
    bench.arm.protective_stop()
    bench.run(100)
    assert bench.ask(Unlock()).accepted


@pytest.mark.parametrize("unknown", [{"runtime_state": 1}, {"age_ns": 300_000_000}], ids=["stopped", "old"])
def test_a_program_after_ours_may_be_anothers(unknown):
    bench = turning()
    bench.arm.other_client = True
    bench.arm.be(**unknown)
    bench.run(5)
    bench.arm.be(age_ns=0, runtime_state=4)
    bench.run(5)
    assert "may be another daemon's" in bench.ask(Unlock()).refusal


@pytest.mark.parametrize("runtime_state", [PLAYING, PAUSED], ids=["playing", "paused"])
@pytest.mark.parametrize("n_without", [0, 1], ids=["replaced", "ended before"])
@pytest.mark.parametrize("call", ["unlock protective stop", "close popup", "stop"])
def test_a_program_that_begins_during_an_unlock_is_left_alone(call, n_without, runtime_state):
    bench = paused()
    begin_unlock(bench)
    run_until(bench, call)
    if n_without:
        bench.arm.end_program()
        bench.run(1)
    bench.arm.calls.clear()
    bench.arm.begin_anothers()
    bench.run(1)
    bench.arm.be(runtime_state=runtime_state)
    assert ANOTHERS in reply_of(bench).refusal
    assert bench.arm.calls == []
    assert bench.arm.has_anothers


@pytest.mark.parametrize(
    ("runtime_state", "why"), [(PLAYING, "did not get ready"), (PAUSED, ANOTHERS)], ids=["playing", "paused"]
)
def test_a_program_that_begins_after_ours_was_sent_is_left_alone(runtime_state, why):
    bench = paused()
    begin_unlock(bench)
    run_until(bench, "upload")
    bench.arm.begin_anothers(runtime_state)
    assert why in reply_of(bench).refusal
    assert bench.arm.calls[-1] == "upload"
    assert bench.arm.has_anothers


@pytest.mark.parametrize("runtime_state", [PLAYING, PAUSED], ids=["playing", "paused"])
@pytest.mark.parametrize("call", ["unlock protective stop", "close popup"])
def test_a_program_that_begins_while_the_dashboard_is_slow_is_left_alone(call, runtime_state):
    bench = paused()
    if call == "close popup":
        bench.arm.be(safety_mode=1)
    bench.arm.meanwhile = runtime_state
    begin_unlock(bench)
    assert ANOTHERS in reply_of(bench).refusal
    assert bench.arm.calls == [call]
    assert bench.arm.has_anothers


def test_a_paused_program_of_our_own_after_a_resumed_one_is_left_alone():
    """A person has resumed ours, or another daemon's began: the samples do not tell."""
    bench = paused()
    bench.arm.other_client = True
    bench.arm.be_resumed_at_the_pendant()
    bench.run(1)
    bench.arm.be(runtime_state=PAUSED)
    bench.run(1)
    assert ANOTHERS in bench.ask(Unlock()).refusal


def test_another_daemon_is_asked_for_before_each_request():
    """A program of an unknown client is paused; another daemon connects, and starts its own."""
    bench = HandlerBench(arm=SharedArm())
    bench.arm.be(safety_mode=3, runtime_state=PAUSED)
    bench.run(300)
    begin_unlock(bench)
    run_until(bench, "unlock protective stop")
    bench.arm.begin_anothers(PAUSED)
    assert ANOTHERS in reply_of(bench).refusal
    assert bench.arm.calls == ["unlock protective stop"]


def test_a_program_that_ends_by_itself_is_waited_for_each_time():
    """Two workers end during an unlock; each leaves a program, which its watchdog ends."""
    bench = HandlerBench(arm=SharedArm())
    bench.arm.begin_anothers()
    bench.run(300)
    begin_unlock(bench)
    for _ in range(2):
        bench.run(200)
        bench.arm.end_program()
        bench.run(1)
        bench.arm.begin_anothers()
    bench.run(200)
    bench.arm.end_program()
    assert reply_of(bench).accepted


@pytest.mark.parametrize("safety_mode", [6, 7])
def test_the_button_is_named_first_because_nothing_is_done_before_it_is_released(safety_mode):
    bench = HandlerBench(arm=SharedArm())
    bench.arm.begin_anothers(PAUSED)
    bench.arm.be(safety_mode=safety_mode, robot_mode=3)
    bench.run(60)
    assert bench.ask(Unlock()).refusal.startswith("The emergency stop is still pressed")
    bench.arm.be(safety_mode=1)
    assert ANOTHERS in bench.ask(Unlock()).refusal


def no_answer(*_: str) -> str:
    raise RobotLostError("silent", "The UR controller said nothing for 1.2 s.")


def test_a_slow_controller_refuses_an_unlock_and_is_asked_again(monkeypatch):
    bench = HandlerBench()
    bench.arm.be(safety_mode=3, runtime_state=PAUSED)
    bench.run(300)
    with monkeypatch.context() as slow:
        slow.setattr(bench.arm, "has_other_client", no_answer)
        refusal = bench.ask(Unlock()).refusal
        assert refusal.startswith("The UR controller said nothing for 1.2 s. So it is not known whether the program")
        assert bench.arm.calls == []
    assert bench.ask(Unlock()).accepted


@pytest.mark.parametrize(
    "found", [{"safety_mode": 3}, {"robot_mode": 3}, {}], ids=["protective stop", "power off", "paused"]
)
def test_a_silent_dashboard_refuses_an_unlock_and_is_asked_again(monkeypatch, found):
    bench = HandlerBench()
    bench.arm.be(runtime_state=PAUSED, **found)
    bench.run(300)
    with monkeypatch.context() as slow:
        slow.setattr(bench.arm, "ask_dashboard", no_answer)
        assert bench.ask(Unlock()).refusal == "The UR controller said nothing for 1.2 s."
    assert bench.ask(Unlock()).accepted


class BesideAnother(RuleBasedStateMachine):
    """Two daemons drive one robot, in any order; `SharedArm` asserts that ours leaves the other's program alone."""

    @initialize()
    def start(self) -> None:
        self.bench = turning(arm=SharedArm())
        self.arm = self.bench.arm

    @rule(cycles=st.integers(1, 150))
    def run(self, cycles: int) -> None:
        self.bench.run(cycles)

    @rule()
    def unlock(self) -> None:
        self.bench.number += 1
        self.bench.handler.request(self.bench.number, Unlock(), self.bench.now_ns)

    @rule()
    def enable(self) -> None:
        self.bench.handler.request(0, Enable(), self.bench.now_ns)

    @rule(runtime_state=st.sampled_from([PLAYING, PAUSED]))
    def another_begins_while_a_request_waits(self, runtime_state: int) -> None:
        self.arm.meanwhile = runtime_state

    @rule()
    def another_begins(self) -> None:
        if self.arm.reading.runtime_state == PLAYING:
            self.arm.end_program()
        # The next program takes several samples to begin: the end or the pause of the one before is seen.
        self.bench.run(1)
        self.arm.begin_anothers()
        # No program plays and is paused within one cycle.
        self.bench.run(1)

    @rule()
    def program_ends(self) -> None:
        self.arm.end_program()
        # The next program takes several samples to begin.
        self.bench.run(1)

    @rule()
    def another_leaves(self) -> None:
        if not self.arm.has_anothers:
            self.arm.other_client = False

    @rule()
    def protective_stop(self) -> None:
        if self.arm.reading.runtime_state == PLAYING:
            self.arm.protective_stop()
        else:
            self.arm.be(safety_mode=3)

    @rule()
    def resume(self) -> None:
        if self.arm.reading.runtime_state == PAUSED:
            self.arm.be_resumed_at_the_pendant()

    @rule()
    def lose_power(self) -> None:
        self.arm.be(robot_mode=3)


BesideAnother.TestCase.settings = hypothesis_settings(max_examples=60, stateful_step_count=25, deadline=None)
TestBesideAnother = BesideAnother.TestCase
