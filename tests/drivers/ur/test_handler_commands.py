"""Commands that the handler sends and refuses."""

import dataclasses

import pytest

from shearloop.drivers.ur.messages import Enable, MoveLinear, RtdeSample, Stop, WristSpeed, ZeroForceTorque
from tests.drivers.ur.flight import POSE, Flight, flying, turning


def test_nothing_moves_before_it_is_enabled():
    flight = Flight()
    assert "made ready" in flight.ask(WristSpeed(0.1, 1.0)).refusal
    flight.fly(5)
    assert "not been enabled" in flight.ask(WristSpeed(0.1, 1.0)).refusal
    assert "not been enabled" in flight.ask(MoveLinear(POSE, 0.1, 0.1)).refusal
    assert flight.state.blocked
    assert flight.state.awaits_enable
    assert {"wrist", "move"}.isdisjoint(flight.arm.calls)
    assert flight.ask(Enable()).accepted
    assert not flight.state.blocked
    assert not flight.state.awaits_enable
    flight.fly(100)
    assert {"wrist", "move"}.isdisjoint(flight.arm.calls)


def test_clipped_command_is_returned_and_reported():
    flight = flying()
    reply = flight.ask(WristSpeed(3.0, 2.0))
    assert reply.sent == WristSpeed(0.8, 2.0)
    assert reply.clipped == ("wrist speed is limited to 0.8 rad/s",)
    assert (flight.state.sent, flight.state.clipped) == (reply.sent, reply.clipped)
    assert (flight.state.motion, flight.state.motion_id) == ("wrist", flight.number)


@pytest.mark.parametrize(
    "command", [WristSpeed(0.1, 0.0), MoveLinear(POSE, 0.0, 0.1), MoveLinear(POSE, 0.1, -1.0), Stop(0.0)]
)
def test_invalid_numbers_are_refused(command):
    flight = flying()
    assert "above 0" in flight.ask(command).refusal
    assert not flight.arm.calls


def test_wrench_is_zeroed_at_rest_and_within_its_limits_only():
    flight = turning()
    assert "only at rest" in flight.ask(ZeroForceTorque()).refusal
    flight.fly_until(lambda state: state.motion == "idle")
    flight.arm.be(wrench=(0.0, 0.0, 70.0, 0.0, 0.0, 0.0))
    assert "Force is 70.00 N" in flight.ask(ZeroForceTorque()).refusal
    assert "zero_wrench" not in flight.arm.calls
    flight.arm.be(wrench=(0.0,) * 6)
    assert flight.ask(ZeroForceTorque()).accepted
    assert flight.arm.calls[-1] == "zero_wrench"


def test_sample_is_part_of_the_state():
    flight = flying()
    for field in dataclasses.fields(RtdeSample):
        assert getattr(flight.state, field.name) == getattr(flight.arm.reading, field.name)
