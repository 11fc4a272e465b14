"""The script in the emulated controller keeps its limits, whatever its client writes: a worker may fail in any way."""

import math

import pytest
from scipy.spatial.transform import Rotation

from shearloop.drivers.ur.messages import WristSpeed
from shearloop.drivers.ur.script import UPPER
from shearloop.emulators.ur_arm import HOME_RAD
from shearloop.emulators.ur_robot import ControllerSpec, Robot
from tests.drivers.ur import robots
from tests.drivers.ur.robots import DELIVERED, control_script
from tests.drivers.ur.scripted_arm import (
    FASTEST,
    FLOOR,
    LIMITS,
    PROMISED_S,
    TIMEOUT_S,
    ScriptedArm,
    guarded_arm,
    moving_at_full_speed,
    send_after_another,
    turn,
)


@pytest.mark.parametrize("asked", [-1e-3, 0.1])
def test_the_range_is_kept_whatever_the_command_asks_for(asked):
    """The wrist still moves towards the end of its range; the command asks for another speed, and all too gently."""
    arm = guarded_arm()
    inner = LIMITS.joints.upper_rad[5] - LIMITS.joints.margin_rad
    braking_rad = FASTEST**2 / 2 / FLOOR
    while arm.reading.wrist_rad < inner - 2 * braking_rad:
        turn(arm, WristSpeed(FASTEST, 4.0), 0.008)
    assert arm.reading.qd_rad_per_s[5] == pytest.approx(FASTEST)
    samples = turn(arm, WristSpeed(asked, 1e-4), 0.5)
    assert max(sample.wrist_rad for sample in samples) <= inner + 0.005


def test_a_speed_after_a_straight_move_is_the_one_that_came_with_its_command():
    """The move is braked first, and meanwhile the client writes another command's numbers."""
    bench = moving_at_full_speed(control_script(DELIVERED))
    arm = bench.arm
    send_after_another(arm, robots.SPEED_J, 0, 0, 0, 0, 0, 0.05, 4.0)
    arm.cycle()
    assert not arm.reading.rests
    robots.send(arm.robot, 0, 0, 0, 0, 0, 0, -0.5, 8.0)
    speeds = []
    for _ in range(30):
        arm.send_heartbeat(TIMEOUT_S)
        arm.cycle()
        speeds.append(arm.reading.qd_rad_per_s[5])
    assert speeds[-1] == pytest.approx(0.05)
    assert min(speeds[5:]) >= 0.0


def test_straight_moves_one_after_the_other_go_on_no_longer_than_one_without_a_deadline():
    arm = guarded_arm()
    x, y, z, *turned = arm.robot.arm.pose
    for number in range(25):
        if not arm.robot.program_running:
            break
        send_after_another(arm, robots.MOVE_L, x, y, z - 0.2 * (number % 2), *turned, 0.1, 0.5)
        arm.cycle()
        arm.cycle()
    assert not arm.robot.program_running
    assert arm.robot.time_s < PROMISED_S
    assert "not renewed in time" in arm.robot.log[-1]


@pytest.mark.parametrize("number", [2, 5, 6])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e300])
def test_numbers_that_are_none_move_nothing(number, value):
    """Of a speed and its acceleration, and of a pose."""
    for command in (robots.SPEED_J, robots.MOVE_L):
        arm = guarded_arm()
        x, y, z, *turned = arm.robot.arm.pose
        numbers = [0.0] * 8 if command == robots.SPEED_J else [x, y, z - 0.1, *turned, 0.1, 0.5]
        numbers[number] = value
        for _ in range(30):
            arm.send_heartbeat(TIMEOUT_S)
            send_after_another(arm, command, *numbers)
            arm.cycle()
            assert abs(arm.reading.qd_rad_per_s[5]) <= FASTEST
            assert arm.reading.tcp_speed_m_per_s <= 1.01 * LIMITS.linear_speed_m_per_s.inner
        if (command, number) in {(robots.SPEED_J, 5), (robots.MOVE_L, 2), (robots.MOVE_L, 5)}:
            assert arm.reading.rests
            assert not arm.reading.program_running


@pytest.mark.parametrize("command", [robots.SPEED_J, robots.MOVE_L])
def test_what_was_written_before_the_program_moves_nothing(command):
    """Registers outlive programs: a command, and a deadline that the clock has yet to reach."""
    arm = ScriptedArm(control_script(DELIVERED))
    x, y, z, *turned = arm.robot.arm.pose
    speed = (0, 0, 0, 0, 0, FASTEST, FLOOR)
    numbers = speed if command == robots.SPEED_J else (x, y, z - 0.2, *turned, 0.1, 0.5)
    arm.robot.registers.write(UPPER.deadline, 100, 0.0)
    arm.upload()
    for _ in range(30):
        robots.send(arm.robot, command, *numbers, asynchronous=True)
        arm.cycle()
        assert arm.reading.rests
    # A client that clears the command is answered, and moves the wrist with a deadline of its own.
    send_after_another(arm, robots.SPEED_J, *speed)
    arm.cycle()
    assert arm.reading.rests
    arm.wrist(WristSpeed(FASTEST, FLOOR), TIMEOUT_S)
    arm.cycle()
    assert not arm.reading.rests


def test_a_deadline_of_an_earlier_program_that_the_clock_reaches_does_not_count():
    arm = ScriptedArm(control_script(DELIVERED))
    arm.robot.registers.write(UPPER.deadline, 100, 0.0)
    arm.send_heartbeat()
    arm.upload()
    for _ in range(30):
        arm.repeat(WristSpeed(FASTEST, FLOOR))
        arm.cycle()
        assert arm.reading.rests


@pytest.mark.parametrize("moves", [True, False])
def test_the_wrench_is_zeroed_only_at_rest_and_below_its_hard_limits(moves):
    """Another zero would hide a load that is too large."""
    arm = guarded_arm()
    arm.robot.arm.wrench_error_factor = 0.0
    arm.robot.arm.load[5] = 0.9 * LIMITS.torque_nm.hard if moves else 1.1 * LIMITS.torque_nm.hard
    if moves:
        turn(arm, WristSpeed(0.5, 4.0), 0.2)
    send_after_another(arm, robots.ZERO_FT)
    arm.robot.take_events()
    for _ in range(20):
        arm.cycle()
    assert [event.name for event in arm.robot.take_events()] == [*["motion-stopped"] * moves, "program-ended"]
    assert arm.robot.arm.wrench[5] == pytest.approx(arm.robot.arm.load[5])


def test_a_straight_move_ends_at_the_hard_force_and_torque():
    for part, hard in ((2, LIMITS.force_n.hard), (5, LIMITS.torque_nm.hard)):
        for share, ends in ((0.9, False), (1.1, True)):
            arm = moving_at_full_speed(control_script(DELIVERED)).arm
            arm.robot.arm.load[part] = share * hard
            for _ in range(20):
                arm.send_heartbeat(DELIVERED.silence_timeout_s)
                arm.cycle()
            assert arm.reading.program_running != ends
            assert arm.reading.rests == ends


def test_a_straight_move_that_turns_a_joint_too_fast_ends():
    """A short way with a large turn: the speed on the line is within its limits."""
    arm = guarded_arm()
    x, y, z, *_ = arm.robot.arm.pose
    home = Rotation.from_rotvec(arm.robot.arm.pose[3:])
    turned = (Rotation.from_rotvec([0.0, 0.0, 1.5]) * home).as_rotvec()
    arm.send_heartbeat(DELIVERED.silence_timeout_s)
    arm.run_once(robots.MOVE_L, x, y, z - 0.1, *turned, 0.1, 0.5)
    speeds = []
    for _ in range(60):
        arm.send_heartbeat(DELIVERED.silence_timeout_s)
        arm.cycle()
        speeds.append(arm.reading.fastest_rad_per_s)
    assert max(speeds) <= 1.1 * LIMITS.wrist_speed_rad_per_s.hard
    assert arm.reading.rests
    assert "beyond a hard limit" in arm.robot.log[-1]


def test_a_straight_move_ends_before_the_hard_end_of_the_wrists_range():
    settings = DELIVERED
    robot = Robot(ControllerSpec(joints_rad=(*HOME_RAD[:5], LIMITS.joints.upper_rad[5] - 0.15)))
    arm = guarded_arm(robot)
    x, y, z, *_ = robot.arm.pose
    home = Rotation.from_rotvec(robot.arm.pose[3:])
    for sign in (1.0, -1.0):
        turned = (home * Rotation.from_rotvec([0.0, 0.0, sign * 1.0])).as_rotvec()
        arm.send_heartbeat(settings.silence_timeout_s)
        if not arm.robot.program_running:
            arm.upload()
            arm.cycle()
        arm.run_once(robots.MOVE_L, x, y, z - 0.25, *turned, 0.1, 0.5)
        for _ in range(300):
            arm.send_heartbeat(settings.silence_timeout_s)
            arm.cycle()
            assert arm.reading.wrist_rad <= LIMITS.joints.upper_rad[5]
    assert any("beyond a hard limit" in line for line in robot.log)


class Held:
    """Holds a thread of the script before one of its statements, for so many cycles."""

    def __init__(self, thread: int, statement: int, cycles: int) -> None:
        self.begun = False
        self._thread, self._statements_left, self._cycles_left = thread, statement, cycles

    def __call__(self, thread: int) -> bool:
        if not self.begun or thread != self._thread:
            return False
        self._statements_left -= 1
        if self._statements_left >= 0 or self._cycles_left == 0:
            return False
        self._cycles_left -= 1
        return True


MAIN, WATCHING = 1, 2


@pytest.mark.parametrize("thread", [MAIN, WATCHING])
@pytest.mark.parametrize(
    ("command", "numbers"),
    [
        (robots.SPEED_J, (0, 0, 0, 0, 0, FASTEST, FLOOR)),
        (robots.MOVE_L, None),
        (robots.STOP_J, (FLOOR,)),
        (robots.SPEED_STOP, (FLOOR,)),
        (255, ()),
        (99, ()),
    ],
)
def test_no_motion_begins_after_the_stop_that_ends_the_program(thread, command, numbers):
    """A controller may interrupt a thread before any statement: a command comes while the script ends its program."""
    for statement in range(40):
        for cycles in (1, 6):
            held = Held(thread, statement, cycles)
            robot = Robot()
            robot.interrupts = held
            arm = guarded_arm(robot)
            x, y, z, *turned = robot.arm.pose
            line = (x, y, z - 0.2, *turned, 0.1, 0.5)
            send_after_another(arm, robots.MOVE_L, *line)
            # In the second cycle after these the move has gone on for too long without a deadline.
            for _ in range(24):
                robot.step(robots.STEP_S)
            robots.send(robot, 0)
            robot.step(robots.STEP_S)
            held.begun = True
            if thread == WATCHING:
                robot.step(robots.STEP_S)
            robots.send(robot, command, *(numbers or line), asynchronous=True)
            for _ in range(round(0.2 / robots.STEP_S)):
                robot.step(robots.STEP_S)
            ended = [event.detail for event in robot.events if event.name == "program-ended"]
            assert set(ended) <= {"it has halted itself", "it has run to its end"}, (statement, cycles)
            # The arm stands before its program ends.
            assert not ended or robot.events[-1].name == "program-ended", (statement, cycles)
            assert not robot.arm.moving, (statement, cycles)
