"""What the gripper holds while a program starts: an e-Series zeroes its wrench then."""

import pytest

from shearloop.drivers.ur.messages import Held, Unlock
from tests.drivers.ur.flight import Flight

ZERO = (0.0, 0.0, 0.0, 0.0, 0.0, 0.5)


@pytest.mark.parametrize("held", [True, False])
def test_the_first_program_of_a_worker_knows_what_the_gripper_holds(held):
    flight = Flight()
    flight.handler.take_held(Held(held, ZERO))
    flight.fly(5)
    assert ("upload, held" in flight.arm.calls) == held
    assert flight.state.wrench_zero == ZERO


@pytest.mark.parametrize("held", [True, False])
def test_unlock_starts_a_program_that_knows_what_the_gripper_holds_now(held):
    flight = Flight()
    flight.handler.take_held(Held(not held, ZERO))
    flight.fly(5)
    flight.arm.calls.clear()
    flight.arm.end_program()
    flight.fly(1)
    flight.handler.take_held(Held(held, ZERO))
    assert flight.ask(Unlock()).accepted
    assert [one for one in flight.arm.calls if one.startswith("upload")] == ["upload, held" if held else "upload"]
