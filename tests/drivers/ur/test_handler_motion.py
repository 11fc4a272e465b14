"""Motions and their ends: turning, straight moves, stops."""

import math
from dataclasses import replace

import pytest

from shearloop.drivers.ur.messages import Disconnect, MoveLinear, Stop, WristSpeed
from shearloop.drivers.ur.motion import REST_SAMPLES
from tests.drivers.ur.handler_bench import CYCLE_NS, LIMITS, POSE, SETTINGS, HandlerBench, enabled, turning


def cycles_with_calls(bench: HandlerBench, cycles: int) -> list[int]:
    """Run cycles and return the numbers of those in which something was sent."""
    said = []
    for number in range(cycles):
        before = len(bench.arm.calls)
        bench.run(1)
        said += [number] * (len(bench.arm.calls) - before)
    return said


def test_wrist_speed_ends_when_it_is_not_renewed():
    bench = turning(0.5)
    state = bench.run_until(lambda state: state.motion == "idle")
    assert state.end_reason == "the wrist speed was not renewed within 0.3 s"
    assert bench.wrist_speed == 0
    # 0.3 s of turning, then 0.5/8 s of braking, then the speed thread is ended and the watchdog kicked.
    assert state.wrist_rad == pytest.approx(0.5 * 0.3, abs=0.03)
    assert bench.arm.calls[-1] == "end_speed"
    bench.run(3)
    assert bench.arm.calls[-1] == "send_heartbeat"


def test_wrist_speed_holds_from_its_decision_and_not_from_its_arrival() -> None:
    bench = enabled()
    late = WristSpeed(0.5, 4.0, decided_ns=bench.now_ns - 60_000_000)
    assert bench.ask(late).accepted
    decided_ns = bench.now_ns - 60_000_000
    bench.run_until(lambda _: bench.arm.target == 0.0)
    assert bench.now_ns - decided_ns <= 300_000_000 + 2 * CYCLE_NS
    bench.run_until(lambda state: state.motion == "idle")
    refused = bench.ask(WristSpeed(0.5, 4.0, decided_ns=bench.now_ns - 301_000_000))
    assert refused.refusal == "The wrist speed was decided 0.30 s ago: the computer is too busy."
    bench.run(1)
    assert bench.state.motion == "idle"


def test_wrist_does_not_turn_on_without_a_state():
    """As on a link that is open one way: commands arrive, states are lost."""
    bench = enabled(replace(SETTINGS, command_timeout_s=0.1))
    assert bench.ask(WristSpeed(0.5, 4.0)).accepted
    bench.run(5)
    bench.arm.be(age_ns=90_000_000)
    bench.run(1)
    assert bench.state.motion == "wrist"
    bench.arm.be(age_ns=101_000_000)
    bench.run(1)
    assert bench.state.motion == "stopping"
    assert bench.state.end_reason == "the robot's last state is 0.10 s old"
    assert (bench.arm.target, bench.arm.acceleration) == (0.0, LIMITS.wrist_acceleration_rad_per_s2.hard)
    bench.run_until(lambda state: state.motion == "idle")
    refused = bench.ask(WristSpeed(0.5, 4.0))
    assert refused.refusal == "The robot's last state is 0.10 s old: the wrist does not begin to turn."
    bench.arm.be(age_ns=2_000_000)
    assert bench.ask(WristSpeed(0.5, 4.0)).accepted


def test_something_is_sent_in_each_cycle_of_a_motion():
    bench = enabled()
    assert bench.ask(WristSpeed(0.1, 4.0)).accepted
    assert cycles_with_calls(bench, 30) == [*range(30)]
    assert bench.arm.calls[-1] == "wrist"
    assert bench.ask(Stop(4.0)).accepted
    bench.run_until(lambda state: state.motion == "idle")
    assert bench.ask(MoveLinear(POSE, 0.1, 0.1)).accepted
    assert cycles_with_calls(bench, 30) == [*range(30)]
    assert bench.arm.calls[-1] == "send_heartbeat"


def test_speed_changed_by_a_limit_is_sent_in_the_same_cycle():
    bench = turning(0.5)
    bench.arm.be(wrench=(0.0, 0.0, 50.0, 0.0, 0.0, 0.0))
    bench.run(1)
    assert bench.arm.target == pytest.approx(0.4), "half of the fastest, half way to the hard limit"


def test_linear_move_ends_the_thread_for_speeds_first():
    bench = enabled()
    assert bench.ask(WristSpeed(0.0, 4.0)).accepted
    bench.run(2)
    assert bench.ask(MoveLinear(POSE, 0.1, 0.1)).accepted
    assert bench.arm.calls[-2:] == ["end_speed", "move"]


def test_linear_move_gets_heartbeats_and_reports_its_arrival():
    bench = enabled()
    reply = bench.ask(MoveLinear((-0.78, *POSE[1:]), 9.0, 0.1))
    assert reply.sent == MoveLinear((-0.78, *POSE[1:]), 0.1, 0.1)
    assert len(reply.clipped) == 1
    bench.run(20)
    assert set(bench.arm.calls) == {"move", "send_heartbeat"}
    assert "straight move is under way" in bench.ask(WristSpeed(0.1, 1.0)).refusal
    bench.arm.be(moving_linearly=False, qd_rad_per_s=(0.1, 0.0, 0.0, 0.0, 0.0, 0.0))
    bench.tick()
    assert bench.state.motion == "linear", "its joints still move"
    bench.run(1 + REST_SAMPLES)
    assert (bench.state.motion, bench.state.end_reason) == ("idle", "arrived")


def test_linear_move_has_a_deadline_and_inner_limits():
    bench = enabled()
    bench.ask(MoveLinear(POSE, 0.1, 0.5))
    state = bench.run_until(lambda state: state.motion == "idle")
    assert "did not end within its time" in state.end_reason
    bench.ask(MoveLinear(POSE, 0.1, 0.5))
    bench.run(3)
    bench.arm.be(wrench=(0.0, 0.0, 45.0, 0.0, 0.0, 0.0))
    bench.run(2)
    assert "force of 45.00 N is above the inner limit" in bench.state.end_reason
    assert bench.arm.calls.count("stop_move") == 2


def test_stop_is_sent_at_once_and_ends_before_another_motion_begins():
    bench = turning(0.5)
    bench.arm.calls.clear()
    assert bench.ask(Stop(5.0)).sent == Stop(5.0)
    assert (bench.arm.calls, bench.arm.target) == (["wrist"], 0.0)
    bench.run(1)
    assert bench.state.motion == "stopping"
    assert bench.ask(WristSpeed(0.5, 1.0)).refusal == "The arm is still stopping (stopped on command)."
    assert "stop it before" in bench.ask(MoveLinear(POSE, 0.1, 0.1)).refusal
    state = bench.run_until(lambda state: state.motion == "idle")
    assert state.end_reason == "stopped on command"
    assert bench.ask(MoveLinear(POSE, 0.1, 0.1)).accepted


def test_gentle_stop_becomes_a_hard_one_when_the_daemon_falls_silent():
    bench = enabled(replace(SETTINGS, silence_timeout_s=0.03))
    assert bench.ask(WristSpeed(0.5, 4.0)).accepted
    bench.run(30)
    assert bench.ask(Stop(4.5)).accepted
    bench.run(1)
    assert bench.arm.acceleration == 4.5
    bench.run(4, daemon_alive=False)
    assert bench.state.motion == "stopping"
    assert bench.arm.acceleration == LIMITS.wrist_acceleration_rad_per_s2.hard


def test_harder_of_two_stops_counts():
    bench = turning(0.5)
    assert bench.ask(Stop(5.0)).sent == Stop(5.0)
    assert bench.ask(Stop(4.5)).sent == Stop(5.0)
    assert bench.ask(Stop(6.0)).sent == Stop(6.0)
    assert bench.arm.acceleration == 6.0


def test_gentlest_stop_brakes_at_the_inner_acceleration():
    inner = LIMITS.wrist_acceleration_rad_per_s2.inner
    bench = turning(0.5)
    assert bench.ask(Stop(1e-3)).sent == Stop(inner)
    bench.run(math.ceil(0.5 / inner * 1e9 / CYCLE_NS) + 5)
    assert bench.state.motion == "idle"
    assert bench.wrist_speed == 0


def test_disconnecting_stops_first():
    bench = turning()
    bench.arm.calls.clear()
    assert bench.ask(Disconnect()).accepted
    assert bench.arm.calls == ["wrist"], "at once, not in the next cycle"
    assert not bench.handler.at_rest
    bench.run_until(lambda _state: bench.handler.at_rest)
    assert bench.wrist_speed == 0
