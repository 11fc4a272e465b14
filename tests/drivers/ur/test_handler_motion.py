"""Motions and their ends: turning, linear moves, stops."""

from dataclasses import replace

import pytest

from shearloop.drivers.ur.messages import Disconnect, MoveLinear, Stop, WristSpeed
from shearloop.drivers.ur.motion import REST_SAMPLES
from tests.drivers.ur.flight import CYCLE_NS, LIMITS, POSE, SETTINGS, Flight, flying, turning


def cycles_with_calls(flight: Flight, cycles: int) -> list[int]:
    """Run cycles and return the numbers of those in which something was sent."""
    said = []
    for number in range(cycles):
        before = len(flight.arm.calls)
        flight.fly(1)
        said += [number] * (len(flight.arm.calls) - before)
    return said


def test_wrist_speed_ends_when_it_is_not_renewed():
    flight = turning(0.5)
    state = flight.fly_until(lambda state: state.motion == "idle")
    assert state.end_reason == "the wrist speed was not renewed within 0.3 s"
    assert flight.wrist_speed == 0
    # 0.3 s of turning, then 0.5/8 s of braking, then the speed thread is ended and the watchdog kicked.
    assert state.wrist_rad == pytest.approx(0.5 * 0.3, abs=0.03)
    assert flight.arm.calls[-1] == "end_speed"
    flight.fly(3)
    assert flight.arm.calls[-1] == "send_heartbeat"


def test_wrist_speed_holds_from_its_decision_and_not_from_its_arrival() -> None:
    flight = flying()
    late = WristSpeed(0.5, 4.0, decided_ns=flight.now_ns - 60_000_000)
    assert flight.ask(late).accepted
    decided_ns = flight.now_ns - 60_000_000
    flight.fly_until(lambda _: flight.arm.target == 0.0)
    assert flight.now_ns - decided_ns <= 300_000_000 + 2 * CYCLE_NS
    flight.fly_until(lambda state: state.motion == "idle")
    refused = flight.ask(WristSpeed(0.5, 4.0, decided_ns=flight.now_ns - 301_000_000))
    assert refused.refusal == "The wrist speed was decided 0.30 s ago: the computer is too busy."
    flight.fly(1)
    assert flight.state.motion == "idle"


def test_wrist_does_not_turn_on_without_a_state():
    """As on a link that is open one way: commands arrive, states are lost."""
    flight = flying(replace(SETTINGS, command_timeout_s=0.1))
    assert flight.ask(WristSpeed(0.5, 4.0)).accepted
    flight.fly(5)
    flight.arm.be(age_ns=90_000_000)
    flight.fly(1)
    assert flight.state.motion == "wrist"
    flight.arm.be(age_ns=101_000_000)
    flight.fly(1)
    assert flight.state.motion == "stopping"
    assert flight.state.end_reason == "the robot's last state is 0.10 s old"
    assert (flight.arm.target, flight.arm.acceleration) == (0.0, LIMITS.wrist_acceleration_rad_per_s2.hard)
    flight.fly_until(lambda state: state.motion == "idle")
    refused = flight.ask(WristSpeed(0.5, 4.0))
    assert refused.refusal == "The robot's last state is 0.10 s old: the wrist does not begin to turn."
    flight.arm.be(age_ns=2_000_000)
    assert flight.ask(WristSpeed(0.5, 4.0)).accepted


def test_something_is_sent_in_each_cycle_of_a_motion():
    flight = flying()
    assert flight.ask(WristSpeed(0.1, 4.0)).accepted
    assert cycles_with_calls(flight, 30) == [*range(30)]
    assert flight.arm.calls[-1] == "wrist"
    assert flight.ask(Stop(4.0)).accepted
    flight.fly_until(lambda state: state.motion == "idle")
    assert flight.ask(MoveLinear(POSE, 0.1, 0.1)).accepted
    assert cycles_with_calls(flight, 30) == [*range(30)]
    assert flight.arm.calls[-1] == "send_heartbeat"


def test_speed_changed_by_a_limit_is_sent_in_the_same_cycle():
    flight = turning(0.5)
    flight.arm.be(wrench=(0.0, 0.0, 50.0, 0.0, 0.0, 0.0))
    flight.fly(1)
    assert flight.arm.target == pytest.approx(0.4), "half of the fastest, half way to the hard limit"


def test_linear_move_ends_the_thread_for_speeds_first():
    flight = flying()
    assert flight.ask(WristSpeed(0.0, 4.0)).accepted
    flight.fly(2)
    assert flight.ask(MoveLinear(POSE, 0.1, 0.1)).accepted
    assert flight.arm.calls[-2:] == ["end_speed", "move"]


def test_linear_move_gets_heartbeats_and_reports_its_arrival():
    flight = flying()
    reply = flight.ask(MoveLinear((-0.78, *POSE[1:]), 9.0, 0.1))
    assert reply.sent == MoveLinear((-0.78, *POSE[1:]), 0.1, 0.1)
    assert len(reply.clipped) == 1
    flight.fly(20)
    assert set(flight.arm.calls) == {"move", "send_heartbeat"}
    assert "linear move is under way" in flight.ask(WristSpeed(0.1, 1.0)).refusal
    flight.arm.be(moving_linearly=False, qd_rad_per_s=(0.1, 0.0, 0.0, 0.0, 0.0, 0.0))
    flight.handler.tick(flight.arm.reading, flight.now_ns)
    assert flight.state.motion == "linear", "its joints still move"
    flight.fly(1 + REST_SAMPLES)
    assert (flight.state.motion, flight.state.end_reason) == ("idle", "arrived")


def test_linear_move_has_a_deadline_and_inner_limits():
    flight = flying()
    flight.ask(MoveLinear(POSE, 0.1, 0.5))
    state = flight.fly_until(lambda state: state.motion == "idle")
    assert "did not end within its time" in state.end_reason
    flight.ask(MoveLinear(POSE, 0.1, 0.5))
    flight.fly(3)
    flight.arm.be(wrench=(0.0, 0.0, 45.0, 0.0, 0.0, 0.0))
    flight.fly(2)
    assert "force of 45.00 N is above the inner limit" in flight.state.end_reason
    assert flight.arm.calls.count("stop_move") == 2


def test_stop_is_sent_at_once_and_ends_before_another_motion_begins():
    flight = turning(0.5)
    flight.arm.calls.clear()
    assert flight.ask(Stop(2.0)).sent == Stop(2.0)
    assert (flight.arm.calls, flight.arm.target) == (["wrist"], 0.0)
    flight.fly(1)
    assert flight.state.motion == "stopping"
    assert flight.ask(WristSpeed(0.5, 1.0)).refusal == "The arm is still stopping (stopped on command)."
    assert "stop it before" in flight.ask(MoveLinear(POSE, 0.1, 0.1)).refusal
    state = flight.fly_until(lambda state: state.motion == "idle")
    assert state.end_reason == "stopped on command"
    assert flight.ask(MoveLinear(POSE, 0.1, 0.1)).accepted


def test_gentle_stop_becomes_a_hard_one_when_the_daemon_falls_silent():
    flight = turning(0.5)
    assert flight.ask(Stop(0.6)).accepted
    flight.fly(1)
    assert flight.arm.acceleration == 0.6
    flight.fly(40, daemon_alive=False)
    assert flight.arm.acceleration == LIMITS.wrist_acceleration_rad_per_s2.hard


def test_harder_of_two_stops_counts():
    flight = turning(0.5)
    assert flight.ask(Stop(4.0)).sent == Stop(4.0)
    assert flight.ask(Stop(1.0)).sent == Stop(4.0)
    assert flight.ask(Stop(6.0)).sent == Stop(6.0)
    assert flight.arm.acceleration == 6.0


def test_gentlest_stop_ends_within_a_second():
    flight = turning(0.5)
    assert flight.ask(Stop(1e-3)).sent == Stop(0.5)
    flight.fly(130)
    assert flight.state.motion == "idle"
    assert flight.wrist_speed == 0


def test_disconnecting_stops_first():
    flight = turning()
    flight.arm.calls.clear()
    assert flight.ask(Disconnect()).accepted
    assert flight.arm.calls == ["wrist"], "at once, not in the next cycle"
    assert not flight.handler.at_rest
    flight.fly_until(lambda _state: flight.handler.at_rest)
    assert flight.wrist_speed == 0
