"""What the gripper holds while a program starts: an e-Series zeroes its wrench then."""

import pytest

from shearloop.drivers.ur.messages import Held, Unlock
from tests.drivers.ur.handler_bench import HandlerBench

ZERO = (0.0, 0.0, 0.0, 0.0, 0.0, 0.5)


@pytest.mark.parametrize("held", [True, False])
def test_the_first_program_of_a_worker_knows_what_the_gripper_holds(held):
    bench = HandlerBench()
    bench.handler.take_held(Held(held, ZERO))
    bench.run(5)
    assert ("upload, held" in bench.arm.calls) == held
    assert bench.state.wrench_zero == ZERO


@pytest.mark.parametrize("held", [True, False])
def test_unlock_starts_a_program_that_knows_what_the_gripper_holds_now(held):
    bench = HandlerBench()
    bench.handler.take_held(Held(not held, ZERO))
    bench.run(5)
    bench.arm.calls.clear()
    bench.arm.end_program()
    bench.run(1)
    bench.handler.take_held(Held(held, ZERO))
    assert bench.ask(Unlock()).accepted
    assert [one for one in bench.arm.calls if one.startswith("upload")] == ["upload, held" if held else "upload"]
