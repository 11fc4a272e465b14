"""In any order of commands and deadlines, the script keeps its limits, and no motion outlives its deadline."""

import math

from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from shearloop.drivers.ur.script import NO_MOTION_TICKS, UPPER
from shearloop.drivers.ur.settings import MOVE_GRACE_S
from shearloop.emulators.ur_robot import Robot
from tests.drivers.ur import robots
from tests.drivers.ur.robots import DELIVERED, control_script, send

CYCLE_S = 0.008
LIMITS = DELIVERED.limits
# An arm that brakes as softly as a client asks here, from the largest speed.
SOFTEST_RAD_PER_S2 = 4.0
BRAKING_S = LIMITS.wrist_speed_rad_per_s.inner / SOFTEST_RAD_PER_S2 + 4 * CYCLE_S
SCRIPT = control_script(DELIVERED)
# What a client may do at no time, and what the emulated controller cannot play.
MISTAKES = ("another thread", "cannot play", "does not end")

accelerations = st.floats(SOFTEST_RAD_PER_S2, 100.0)


class AnyOrder(RuleBasedStateMachine):
    """Any order of commands, deadlines and silences of one client."""

    @initialize()
    def start(self) -> None:
        self.robot = Robot()
        x, y, z, *self.turned = map(float, self.robot.arm.pose)
        self.home = x, y, z
        # The command that is written in each cycle, and until when the arm may move.
        self.command, self.numbers = 0, [0.0] * 8
        self.is_new = True
        self.may_move_until_s = 0.0
        self.begin_program()

    def begin_program(self) -> None:
        self.command = 0
        send(self.robot, 0)
        self.robot.upload(SCRIPT)
        self.step()

    def write(self, command: int, *numbers: float) -> None:
        # A client clears each command.
        self.command = 0
        self.step()
        self.command, self.numbers = command, [*numbers, *[0.0] * (8 - len(numbers))]
        self.is_new = True

    @rule(speed=st.floats(-3.0, 3.0), acceleration=accelerations, others=st.floats(-3.0, 3.0))
    def turn(self, speed: float, acceleration: float, others: float) -> None:
        self.write(robots.SPEED_J, *[others] * 5, speed, acceleration)

    @rule(way_m=st.tuples(*[st.floats(-0.03, 0.03)] * 3), speed=st.floats(0.001, 3.0), acceleration=st.floats(0.1, 100))
    def move(self, way_m: tuple[float, float, float], speed: float, acceleration: float) -> None:
        end = (here + way for here, way in zip(self.home, way_m, strict=True))
        self.write(robots.MOVE_L, *end, *self.turned, speed, acceleration)

    @rule(deceleration=accelerations)
    def brake(self, deceleration: float) -> None:
        self.write(robots.STOP_J, deceleration)

    @rule(deceleration=accelerations)
    def end_turn(self, deceleration: float) -> None:
        self.write(robots.SPEED_STOP, deceleration)

    @rule(command=st.sampled_from([0, robots.ZERO_FT, robots.SET_WATCHDOG]))
    def ask(self, command: int) -> None:
        self.write(command)

    @rule(command=st.sampled_from([1, 2, 10, 11, 33, 99]))
    def ask_the_unknown(self, command: int) -> None:
        self.write(command)
        for _ in range(25):
            self.step()
        assert not self.robot.program_running
        self.begin_program()

    @rule(seconds=st.floats(0.0, DELIVERED.command_timeout_s))
    def extend(self, seconds: float) -> None:
        until = self.robot.registers[UPPER.clock] + int(seconds / CYCLE_S)
        self.robot.registers.write(UPPER.deadline, until, self.robot.time_s)
        self.allow(seconds + MOVE_GRACE_S)

    @rule(ticks=st.sampled_from([NO_MOTION_TICKS, -(1 << 31), 1_000_000, (1 << 31) - 1]))
    def leave_a_useless_deadline(self, ticks: int) -> None:
        self.robot.registers.write(UPPER.deadline, ticks, self.robot.time_s)

    @rule(cycles=st.integers(1, 40), writes=st.booleans())
    def run(self, cycles: int, writes: bool = True) -> None:
        for _ in range(cycles):
            self.step(writes=writes)
        if not self.robot.program_running:
            self.begin_program()

    def allow(self, seconds: float) -> None:
        """Expect motion for this long at most, and the time to brake."""
        self.may_move_until_s = max(self.may_move_until_s, self.robot.time_s + seconds + BRAKING_S)

    def step(self, *, writes: bool = True) -> None:
        if writes:
            send(self.robot, self.command, *self.numbers, asynchronous=True)
            if self.is_new:
                # A straight move that has just begun is not judged; an order that ends a motion takes its time.
                self.allow(MOVE_GRACE_S)
            self.is_new = False
        self.robot.step(CYCLE_S)
        self.keeps_its_limits()

    @invariant()
    def keeps_its_limits(self) -> None:
        arm = self.robot.arm
        assert abs(arm.qd_rad_per_s[5]) <= LIMITS.wrist_speed_rad_per_s.inner + 1e-9
        assert math.hypot(*arm.speed[:3]) <= LIMITS.linear_speed_m_per_s.inner + 1e-3
        assert LIMITS.joints.lower_rad[5] <= arm.q_rad[5] <= LIMITS.joints.upper_rad[5]
        ended = [event.detail for event in self.robot.take_events() if event.name == "program-ended"]
        assert not [detail for detail in ended if any(mistake in detail for mistake in MISTAKES)]
        if self.robot.time_s > self.may_move_until_s:
            assert not arm.moving, "it moves after its deadline"


AnyOrder.TestCase.settings = hypothesis_settings(max_examples=60, stateful_step_count=25, deadline=None)
TestAnyOrder = AnyOrder.TestCase
