"""Paused programs: their owner, and the requests to stop them."""

from itertools import pairwise

import pytest

from shearloop.drivers.ur.command_handler import STOP_RETRIES_S
from shearloop.drivers.ur.messages import Disconnect, Enable, Unlock
from tests.drivers.ur.flight import CYCLE_NS, Flight, flying, turning

STOP_REQUEST = "stop"


def paused() -> Flight:
    """Return a flight in a protective stop that its dashboard does not stop the program of."""
    flight = turning()
    flight.arm.stoppable = False
    flight.arm.protective_stop()
    return flight


def stop_requests_s(flight: Flight, seconds: float) -> list[float]:
    """Let time pass and return the times of the requests to stop a program."""
    since_ns, times = flight.now_ns, []
    for _ in range(round(seconds * 1e9 / CYCLE_NS)):
        before = flight.arm.calls.count(STOP_REQUEST)
        flight.fly(1)
        times += [(flight.now_ns - CYCLE_NS - since_ns) / 1e9] * (flight.arm.calls.count(STOP_REQUEST) - before)
    return times


def test_paused_program_of_the_last_worker_is_stopped():
    flight = Flight(takes_over=True)
    flight.arm.target = 0.5
    flight.arm.be(runtime_state=2)
    flight.arm.protective_stop()
    flight.fly(4)
    assert flight.arm.calls == ["stop"]
    assert not flight.handler.recovering
    flight.arm.be_resumed_at_the_pendant()
    flight.fly(5)
    assert flight.wrist_speed == 0.0


def test_failed_program_stop_does_not_prevent_unlocking():
    flight = Flight(takes_over=True)
    flight.arm.stoppable = False
    flight.arm.be(safety_mode=3, runtime_state=4)
    flight.fly(300)
    assert not flight.handler.recovering
    assert "Protective stop" in flight.state.blocked
    flight.arm.stoppable = True
    assert flight.ask(Unlock()).accepted


@pytest.mark.parametrize("takes_over", [False, True], ids=["ours", "of the process before"])
def test_silent_dashboard_is_retried_with_growing_pauses(takes_over):
    flight = Flight(takes_over=True) if takes_over else turning()
    flight.arm.be(runtime_state=2)
    flight.arm.stoppable = False
    flight.arm.protective_stop()
    times = stop_requests_s(flight, 200.0)
    pauses = [later - sooner for sooner, later in pairwise(times)]
    assert times[0] < 0.05
    assert pauses == pytest.approx(STOP_RETRIES_S, abs=0.02)
    assert flight.state.failed_program_stops == len(times)
    assert "the dashboard does not answer): stop it at the teach pendant, do not resume it" in flight.state.blocked
    assert flight.state.blocked.startswith("Protective stop")


def test_ineffective_stop_is_retried_and_reported():
    flight = turning()
    flight.arm.stop_fails_silently = True
    flight.arm.protective_stop()
    flight.fly(100)
    assert flight.state.failed_program_stops == 0, "it may take a moment"
    flight.fly(50)
    assert flight.state.failed_program_stops == 1
    assert "said that it is stopped, and it is not" in flight.state.blocked
    flight.arm.stop_fails_silently = False
    flight.fly_until(lambda state: "could not be stopped" not in state.blocked, 400)
    assert flight.arm.reading.runtime_state == 1
    assert flight.state.failed_program_stops == 1
    assert len(flight.state.blocked) > 0


def test_long_cycles_are_announced():
    flight = paused()
    for _ in range(400):
        announced, before = flight.state.recovering, flight.arm.calls.count(STOP_REQUEST)
        flight.fly(1)
        assert announced == (flight.arm.calls.count(STOP_REQUEST) > before)


def test_each_pause_gets_new_requests():
    flight = paused()
    flight.fly(5000)
    flight.arm.stoppable = True
    assert flight.ask(Unlock()).accepted
    assert "could not be stopped" not in flight.state.blocked
    flight.arm.calls.clear()
    flight.arm.protective_stop()
    flight.fly(3)
    assert flight.arm.calls == [STOP_REQUEST]


@pytest.mark.parametrize(("runtime_state", "times"), [(0, 0), (1, 0), (3, 1), (4, 1), (5, 1)])
def test_only_paused_programs_are_stopped(runtime_state, times):
    """Runtime states: 0 stopping, 1 stopped, 3 pausing, 4 paused, 5 resuming."""
    flight = turning()
    flight.arm.stoppable = False
    flight.arm.be(runtime_state=runtime_state)
    assert len(stop_requests_s(flight, 0.5)) == times


def test_old_sample_causes_no_program_stop():
    """Another client's program may be there by now."""
    flight = turning()
    flight.arm.protective_stop()
    flight.arm.be(age_ns=300_000_000)
    assert stop_requests_s(flight, 5.0) == []


def test_program_started_at_the_pendant_after_ours_is_left_alone():
    flight = flying()
    flight.arm.end_program()
    flight.fly(3)
    flight.arm.be(runtime_state=2)
    flight.fly(3)
    flight.arm.protective_stop()
    assert stop_requests_s(flight, 5.0) == []
    flight.handler.end_program(flight.arm.reading, flight.now_ns)
    assert STOP_REQUEST not in flight.arm.calls


def test_paused_program_left_behind_is_left_to_the_exit():
    flight = Flight(takes_over=True)
    flight.arm.stoppable = False
    flight.arm.be(safety_mode=3, runtime_state=4)
    flight.fly(10)
    assert flight.ask(Disconnect()).accepted
    assert stop_requests_s(flight, 5.0) == [], "the exit stops it"
    flight.arm.stoppable = True
    flight.handler.end_program(flight.arm.reading, flight.now_ns)
    assert flight.arm.calls[-1] == STOP_REQUEST


def test_stopped_program_restarts_only_on_unlock():
    flight = turning()
    flight.arm.protective_stop()
    flight.fly(100)
    # Cleared at the pendant.
    flight.arm.be(safety_mode=1)
    flight.arm.calls.clear()
    flight.fly(300)
    assert flight.arm.calls == []
    assert not flight.ask(Enable()).accepted
    assert flight.ask(Unlock()).accepted


def test_program_being_started_is_ours_during_an_unlock():
    flight = Flight()
    flight.fly(2)
    assert flight.arm.calls == ["clear_command", "upload"]
    assert flight.handler.request(1, Unlock(), flight.arm.reading, flight.now_ns) is None
    assert flight.state.owns_program


@pytest.mark.parametrize(("played_s", "times"), [(0.5, 1), (4.0, 0)])
def test_program_that_plays_without_heartbeats_is_foreign(played_s, times):
    """Our program may end while the dashboard hangs and no sample is read."""
    flight = paused()
    flight.fly(3)
    flight.arm._watched = False
    flight.arm.be(safety_mode=1, runtime_state=2)
    assert stop_requests_s(flight, played_s) == []
    flight.arm.be(runtime_state=4)
    # Ours may have been resumed just now, and is paused again.
    assert len(stop_requests_s(flight, 1.5)) == times


def test_our_program_stays_ours_while_it_plays():
    flight = flying()
    flight.fly(500)
    flight.arm.protective_stop()
    assert len(stop_requests_s(flight, 0.5)) == 1


def test_old_samples_do_not_make_a_program_foreign():
    flight = turning()
    # Its last state, which is repeated.
    flight.arm._watched = False
    flight.arm.be(age_ns=300_000_000)
    flight.fly(500)
    flight.arm.be(age_ns=0, runtime_state=4)
    assert len(stop_requests_s(flight, 0.5)) == 1


def test_paused_program_of_unknown_owner_is_reported_and_left_alone():
    """If resumed at the pendant, it would turn the wrist."""
    flight = Flight()
    flight.arm.be(safety_mode=3, runtime_state=4)
    flight.fly(300)
    assert "Protective stop" in flight.state.blocked
    flight.arm.be(safety_mode=1)
    flight.fly(5)
    assert "is paused" in flight.state.blocked
    assert "unlock, which stops it" in flight.state.blocked
    assert flight.arm.calls == []
    assert flight.ask(Unlock()).accepted
    assert "stop" in flight.arm.calls
    assert not flight.state.blocked
