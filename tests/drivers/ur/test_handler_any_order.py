"""In any order of events, no motion begins or continues by itself."""

import sys

from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from shearloop.drivers.ur.messages import Enable, Stop, Unlock, WristSpeed
from tests.drivers.ur.handler_bench import CYCLE_NS, LIMITS, HandlerBench

# From a command until the wrist rests again, if no other follows.
COMES_TO_REST_NS = 700_000_000


class AnyOrder(RuleBasedStateMachine):
    """Any order of events: commands stay within the limits, and only a recent command moves the arm."""

    def __init__(self) -> None:
        super().__init__()
        self.bench = HandlerBench()
        self.allowed_until_ns = 0

    @initialize()
    def start(self) -> None:
        self.run(5)

    @rule(speed=st.floats(-5, 5), acceleration=st.floats(1e-3, 100), enabled=st.booleans())
    def turn(self, speed: float, acceleration: float, enabled: bool) -> None:
        if enabled:
            self.bench.ask(Enable())
        if self.bench.ask(WristSpeed(speed, acceleration)).accepted:
            self.allowed_until_ns = self.bench.now_ns + COMES_TO_REST_NS

    @rule()
    def enable(self) -> None:
        self.bench.ask(Enable())

    @rule()
    def stop(self) -> None:
        self.bench.ask(Stop(4.0))

    @rule()
    def unlock(self) -> None:
        if self.bench.arm.reading.safety_mode != 7:
            self.bench.ask(Unlock())

    @rule(cycles=st.integers(1, 120), daemon_alive=st.booleans())
    def run(self, cycles: int, daemon_alive: bool = True) -> None:
        for _ in range(cycles):
            self.bench.run(1, daemon_alive=daemon_alive)
            self.moves_only_as_asked()

    @rule()
    def protective_stop(self) -> None:
        if self.bench.arm.reading.safety_mode == 1:
            self.bench.arm.protective_stop()

    @rule(answers=st.booleans())
    def dashboard(self, answers: bool) -> None:
        self.bench.arm.stoppable = answers

    @precondition(lambda self: self.bench.arm.reading.runtime_state == 4)
    @rule()
    def program_is_resumed(self) -> None:
        self.bench.arm.be_resumed_at_the_pendant()
        if self.bench.arm.target:
            # No cycle has seen the pause: the program goes on until its watchdog ends it.
            self.allowed_until_ns = self.bench.now_ns + 500_000_000
        self.run(100)

    @rule(cycles=st.integers(1, 10))
    def samples_get_old(self, cycles: int) -> None:
        self.bench.arm.be(age_ns=300_000_000)
        self.run(cycles)
        self.bench.arm.be(age_ns=0)
        self.run(100)

    @rule()
    def program_ends(self) -> None:
        self.bench.arm.end_program()

    @precondition(lambda self: not self.bench.arm.reading.wrench[0])
    @rule(force_n=st.floats(0, 100))
    def push(self, force_n: float) -> None:
        self.bench.arm.be(wrench=(force_n, 0.0, 0.0, 0.0, 0.0, 0.0))

    @rule()
    def let_go(self) -> None:
        self.bench.arm.be(wrench=(0.0,) * 6)

    @invariant()
    def moves_only_as_asked(self) -> None:
        arm = self.bench.arm
        assert abs(arm.target) <= LIMITS.wrist_speed_rad_per_s.inner
        assert abs(arm.reading.wrist_rad) <= 1.9 + 1e-6
        if self.bench.now_ns > self.allowed_until_ns:
            # The emulated arm's speed is a sum of one step a cycle, so it ends at 0 but for each one's rounding.
            n_cycles = COMES_TO_REST_NS // CYCLE_NS
            rounding = n_cycles * sys.float_info.epsilon * LIMITS.wrist_speed_rad_per_s.inner
            assert abs(arm.reading.qd_rad_per_s[5]) <= rounding, "it moves without a command"


AnyOrder.TestCase.settings = hypothesis_settings(max_examples=60, stateful_step_count=25, deadline=None)
TestAnyOrder = AnyOrder.TestCase
