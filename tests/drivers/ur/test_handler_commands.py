"""Commands that the handler sends and refuses."""

import dataclasses

import pytest

from shearloop.drivers.ur.messages import Enable, MoveLinear, RtdeSample, Stop, WristSpeed, ZeroForceTorque
from tests.drivers.ur.handler_bench import POSE, HandlerBench, enabled, turning


def test_nothing_moves_before_it_is_enabled():
    bench = HandlerBench()
    assert "being made ready (its control program starts)" in bench.ask(WristSpeed(0.1, 1.0)).refusal, "no power"
    bench.run(5)
    assert "not been enabled" in bench.ask(WristSpeed(0.1, 1.0)).refusal
    assert "not been enabled" in bench.ask(MoveLinear(POSE, 0.1, 0.1)).refusal
    assert bench.state.blocked
    assert bench.state.awaits_enable
    assert {"wrist", "move"}.isdisjoint(bench.arm.calls)
    assert bench.ask(Enable()).accepted
    assert not bench.state.blocked
    assert not bench.state.awaits_enable
    bench.run(100)
    assert {"wrist", "move"}.isdisjoint(bench.arm.calls)


def test_clipped_command_is_returned_and_reported():
    bench = enabled()
    reply = bench.ask(WristSpeed(3.0, 2.0))
    assert reply.sent == WristSpeed(0.8, 2.0)
    assert reply.clipped == ("wrist speed is limited to 0.8 rad/s",)
    assert (bench.state.sent, bench.state.clipped) == (reply.sent, reply.clipped)
    assert (bench.state.motion, bench.state.motion_id) == ("wrist", bench.number)


@pytest.mark.parametrize(
    "command", [WristSpeed(0.1, 0.0), MoveLinear(POSE, 0.0, 0.1), MoveLinear(POSE, 0.1, -1.0), Stop(0.0)]
)
def test_invalid_numbers_are_refused(command):
    bench = enabled()
    assert "above 0" in bench.ask(command).refusal
    assert not bench.arm.calls


def test_wrench_is_zeroed_at_rest_and_within_its_limits_only():
    bench = turning()
    assert "only at rest" in bench.ask(ZeroForceTorque()).refusal
    bench.run_until(lambda state: state.motion == "idle")
    bench.arm.be(wrench=(0.0, 0.0, 70.0, 0.0, 0.0, 0.0))
    assert "Force is 70.00 N" in bench.ask(ZeroForceTorque()).refusal
    assert "zero_wrench" not in bench.arm.calls
    bench.arm.be(wrench=(0.0,) * 6)
    assert bench.ask(ZeroForceTorque()).accepted
    assert bench.arm.calls[-1] == "zero_wrench"


def test_sample_is_part_of_the_state():
    bench = enabled()
    for field in dataclasses.fields(RtdeSample):
        assert getattr(bench.state, field.name) == getattr(bench.arm.reading, field.name)
