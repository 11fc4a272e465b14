"""In any order of commands, numbers and deadlines the script keeps its limits, and no motion outlives its deadline."""

import math
import random

from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from shearloop.drivers.ur.script import NO_MOTION_TICKS, UPPER
from shearloop.drivers.ur.settings import MOVE_GRACE_S
from shearloop.emulators.ur_arm import HOME_RAD
from shearloop.emulators.ur_robot import ControllerSpec, Robot
from tests.drivers.ur import robots
from tests.drivers.ur.robots import DELIVERED, control_script, send
from tests.drivers.ur.scripted_arm import FASTEST, FLOOR, LIMITS

CYCLE_S = 0.008
SCRIPT = control_script(DELIVERED)
# The longest deadline that counts; the script allows some rounding.
LONGEST_S = max(DELIVERED.command_timeout_s, DELIVERED.silence_timeout_s) + 0.01
# The arm brakes at the gentlest deceleration from the largest speed.
BRAKING_S = FASTEST / FLOOR
# A straight move has this time to be stopped after its deadline, and moves together have it before their first one;
# each brakes for less than half as long.
GRACES_S = 2 * 1.5 * MOVE_GRACE_S
# Until a command is seen, and until a motion that it ends is no longer one.
CYCLES_OF_A_COMMAND = 3
# How often a thread is interrupted before a statement.
INTERRUPTED = 0.002
# What a client may do at no time, and what the emulated controller cannot play.
MISTAKES = ("another thread", "cannot play", "does not end")
TOO_FAST_FOR_A_JOINT = "the line asks a joint for more than its largest speed"

any_number = st.floats()
speeds = st.floats(-3.0, 3.0) | st.sampled_from([-FASTEST, -1e-3, 0.0, 1e-3, FASTEST])
accelerations = st.floats(0.0, 10.0) | st.sampled_from([0.0, 1e-9, 1e-4, FLOOR, 100.0, math.nan, math.inf])
ways_m = st.tuples(*[st.floats(-0.05, 0.05)] * 3)
ENDS_RAD = LIMITS.joints.lower_rad[5] + LIMITS.joints.margin_rad, LIMITS.joints.upper_rad[5] - LIMITS.joints.margin_rad
int32 = st.integers(-(1 << 31), (1 << 31) - 1)


class AnyOrder(RuleBasedStateMachine):
    """Any order of commands, deadlines and silences of one client, which may be mad."""

    @initialize(wrist_rad=st.floats(-3.0, 3.0) | st.sampled_from(ENDS_RAD), seed=st.none() | st.integers(0, 1000))
    def start(self, wrist_rad: float, seed: int | None) -> None:
        self.robot = Robot(ControllerSpec(joints_rad=(*HOME_RAD[:5], wrist_rad)))
        if seed is not None:
            self.random = random.Random(seed)
            self.robot.interrupts = self.is_interrupted
        x, y, z, *self.turned = map(float, self.robot.arm.pose)
        self.home = x, y, z
        # What is written in each cycle.
        self.command, self.numbers, self.asynchronous = 0, [0.0] * 8, True
        self.deadline = 0
        # Since a deadline has held: for how long the arm has moved, and may move at most.
        self.moved_s = self.may_move_s = self.last_rad_per_s = 0.0
        self.has_moved_on_line, self.too_fast_cycles = False, 0
        # Whether a straight move was written and has not begun: it waits until the motion before it is braked.
        self.line_is_due = False
        self.begin_program()

    def is_interrupted(self, _thread: int) -> bool:
        interrupted = self.random.random() < INTERRUPTED
        self.may_move_s += CYCLE_S * interrupted
        return interrupted

    def begin_program(self) -> None:
        self.command = 0
        send(self.robot, 0)
        for _ in range(25):
            self.step()
        self.robot.upload(SCRIPT)
        # Nothing was written since.
        self.deadline = NO_MOTION_TICKS
        self.moved_s, self.may_move_s, self.has_moved_on_line = 0.0, 0.0, False
        self.step()

    def write(self, command: int, *numbers: float, asynchronous: bool = True) -> None:
        """Clear the command before, as ur-rtde's client does, and write one."""
        self.command = 0
        for _ in range(CYCLES_OF_A_COMMAND):
            self.step()
        self.scribble(command, [*numbers, *[0.0] * (8 - len(numbers))], asynchronous=asynchronous)

    def scribble(self, command: int, numbers: list[float], *, asynchronous: bool = True) -> None:
        """Write a command, whatever was written before."""
        self.command, self.numbers, self.asynchronous = command, numbers, asynchronous
        self.may_move_s += CYCLES_OF_A_COMMAND * CYCLE_S
        self.line_is_due = command == robots.MOVE_L
        if command == robots.MOVE_L and not self.has_moved_on_line:
            self.has_moved_on_line = True
            self.may_move_s += GRACES_S

    @rule(speed=speeds, acceleration=accelerations, others=any_number)
    def turn(self, speed: float, acceleration: float, others: float) -> None:
        self.write(robots.SPEED_J, *[others] * 5, speed, acceleration)

    @rule(way_m=ways_m, speed=st.floats(0.001, 3.0), acceleration=accelerations)
    def move(self, way_m: tuple[float, float, float], speed: float, acceleration: float) -> None:
        end = (here + way for here, way in zip(self.home, way_m, strict=True))
        self.write(robots.MOVE_L, *end, *self.turned, speed, acceleration)

    @rule(speed=speeds, acceleration=accelerations, cycles=st.integers(1, 60))
    def go_on_turning(self, speed: float, acceleration: float, cycles: int) -> None:
        self.turn(speed, acceleration, 0.0)
        self.go_on(cycles)

    @rule(way_m=ways_m, cycles=st.integers(1, 60))
    def go_on_moving(self, way_m: tuple[float, float, float], cycles: int) -> None:
        self.move(way_m, 0.1, 0.5)
        self.go_on(cycles)

    def go_on(self, cycles: int) -> None:
        """Renew the deadline in each cycle, as long as the program runs."""
        for _ in range(cycles if self.robot.program_running else 0):
            self.extend(0.05)
            self.step()

    @rule(
        command=int32 | st.sampled_from([3, 8, 9, 15, 34, 35]),
        numbers=st.lists(any_number, min_size=8, max_size=8),
        place=st.integers(0, 5),
        value=st.sampled_from([math.nan, math.inf, -math.inf, 1e4, -1e300]),
        asynchronous=st.booleans(),
    )
    def write_nonsense(self, command: int, numbers: list[float], place: int, value: float, asynchronous: bool) -> None:
        if command == robots.MOVE_L:
            # The emulated arm cannot go anywhere.
            numbers = [*self.home, *self.turned, *numbers[6:]]
            numbers[place] = value
        self.scribble(command, numbers, asynchronous=asynchronous)
        self.step()

    @rule(command=st.sampled_from([robots.STOP_J, robots.SPEED_STOP]), deceleration=accelerations)
    def stop(self, command: int, deceleration: float) -> None:
        self.write(command, deceleration)

    @rule(command=st.sampled_from([0, 0, 0, 0, robots.ZERO_FT, robots.SET_WATCHDOG, robots.SET_WATCHDOG, 255]))
    def ask(self, command: int) -> None:
        self.write(command)

    @rule(command=st.sampled_from([1, 2, 10, 11, 33, 99]))
    def ask_the_unknown(self, command: int) -> None:
        # The script sees a command once the one before has ended.
        self.run_for(0, 40)
        self.write(command)
        self.run_for(command, 40)
        assert not self.robot.program_running
        self.begin_program()

    def run_for(self, command: int, cycles: int) -> None:
        self.command = command
        for _ in range(cycles):
            self.step()

    @rule(seconds=st.floats(0.0, LONGEST_S))
    def extend(self, seconds: float) -> None:
        self.write_deadline(int(self.robot.registers[UPPER.clock]) + int(seconds / CYCLE_S))

    @rule(ticks=st.sampled_from([NO_MOTION_TICKS, -(1 << 31), 0, 50, 1_000_000, (1 << 31) - 1]) | int32)
    def write_deadline(self, ticks: int) -> None:
        self.deadline = ticks
        self.robot.registers.write(UPPER.deadline, ticks, self.robot.time_s)
        self.note_deadline()

    @rule(cycles=st.integers(1, 60), writes=st.booleans())
    def run(self, cycles: int, writes: bool = True) -> None:
        for _ in range(cycles):
            self.step(writes=writes)
        if not self.robot.program_running:
            self.begin_program()

    def note_deadline(self) -> None:
        """Expect motion until the deadline, and while it ends, where the deadline counts."""
        left_s = (self.deadline - self.robot.registers[UPPER.clock]) * CYCLE_S
        if -CYCLE_S <= left_s <= LONGEST_S:
            self.has_moved_on_line = self.line_is_due or robots.moving_asynchronously(self.robot)
            self.moved_s, self.may_move_s = 0.0, left_s + BRAKING_S + CYCLES_OF_A_COMMAND * CYCLE_S
            self.may_move_s += GRACES_S * self.has_moved_on_line

    def step(self, *, writes: bool = True) -> None:
        if writes:
            send(self.robot, self.command, *self.numbers, asynchronous=self.asynchronous)
        self.robot.step(CYCLE_S)
        self.line_is_due = self.line_is_due and not robots.moving_asynchronously(self.robot)
        self.note_deadline()
        self.moved_s += CYCLE_S * self.robot.arm.moving
        self.keeps_its_limits()

    def keeps_the_wrists_speed(self, rad_per_s: float) -> None:
        """Check the wrist's speed; a straight move turns the wrist as its line needs it, until the script sees it."""
        if robots.moving_asynchronously(self.robot):
            is_too_fast = rad_per_s > LIMITS.wrist_speed_rad_per_s.hard
            self.too_fast_cycles = self.too_fast_cycles + 1 if is_too_fast else 0
            assert self.too_fast_cycles <= CYCLES_OF_A_COMMAND
        else:
            self.too_fast_cycles = 0
            assert rad_per_s <= max(FASTEST, self.last_rad_per_s) + 1e-9
        self.last_rad_per_s = rad_per_s

    @invariant()
    def keeps_its_limits(self) -> None:
        arm = self.robot.arm
        self.keeps_the_wrists_speed(abs(arm.qd_rad_per_s[5]))
        assert math.hypot(*arm.speed[:3]) <= 1.05 * LIMITS.linear_speed_m_per_s.inner, "beyond the emulated steps"
        assert LIMITS.joints.lower_rad[5] <= arm.q_rad[5] <= LIMITS.joints.upper_rad[5]
        assert self.moved_s <= self.may_move_s, "it moves after its deadline"
        events = self.robot.take_events()
        ended = [event.detail for event in events if event.name == "program-ended"]
        assert not [detail for detail in ended if any(mistake in detail for mistake in MISTAKES)]
        if self.robot.safety_mode != 1:
            # The worker slows a short way on which the tool turns far; of another client's the controller takes care.
            assert [event.detail for event in events if event.name == "protective-stop"] == [TOO_FAST_FOR_A_JOINT]
            self.start(float(arm.q_rad[5]), None)


AnyOrder.TestCase.settings = hypothesis_settings(max_examples=100, stateful_step_count=25, deadline=None)
TestAnyOrder = AnyOrder.TestCase
