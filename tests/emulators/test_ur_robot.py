"""The emulated controller without I/O, with ur-rtde's own script: registers, watchdog, safety."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from shearloop.emulators.ur_controller import Controller
from shearloop.emulators.ur_robot import MODE_IDLE, MODE_POWER_OFF, MODE_RUNNING, PAUSED, ControllerSpec, Robot
from tests.drivers.ur import robots
from tests.drivers.ur.robots import control_script, do, moving_asynchronously, send


def wait(robot: Robot, seconds: float) -> None:
    for _ in range(round(seconds / robots.STEP_S)):
        robot.step(robots.STEP_S)


def turn(robot: Robot, speed: float, acceleration: float = 2.0) -> None:
    send(robot, robots.SPEED_J, 0, 0, 0, 0, 0, speed, acceleration, 0)


def down(robot: Robot) -> list[float]:
    """Return the arguments of a straight move downwards: pose, speed, acceleration."""
    x, y, z, *turn = robot.arm.pose
    return [x, y, z - 0.2, *turn, 0.1, 0.5]


def started(**spec: float) -> Robot:
    robot = Robot(ControllerSpec(**spec))
    robot.upload(control_script())
    wait(robot, robots.STEP_S)
    return robot


def turning(seconds: float) -> Robot:
    """Return a robot that has turned its wrist for so long, to 0.4 rad/s."""
    robot = started()
    turn(robot, 0.4)
    wait(robot, seconds)
    return robot


def happened(robot: Robot, name: str) -> list[float]:
    return [event.time_s for event in robot.events if event.name == name]


def test_watchdog_ends_with_its_program():
    robot = started()
    do(robot, robots.SET_WATCHDOG, 10.0)
    robot.upload(control_script())
    wait(robot, 1.0)
    assert robot.program_running


def test_watchdog_ends_the_program_under_a_blocking_move():
    robot = started()
    do(robot, robots.SET_WATCHDOG, 10.0)
    send(robot, robots.MOVE_L, *down(robot))
    wait(robot, 0.2)
    assert not robot.program_running


def test_new_program_obeys_old_registers():
    robot = turning(0.1)
    robot.end_program("test")
    wait(robot, 0.2)
    assert not robot.arm.qd_rad_per_s.any()
    robot.upload(control_script())
    wait(robot, 0.1)
    assert robot.arm.qd_rad_per_s[5] > 0, "a driver has to clear the registers"


def test_linear_move_arrives_at_the_pose_on_a_straight_line():
    robot = started()
    begin = robot.arm.pose
    target = begin.copy()
    target[:3] += (0.05, -0.03, -0.1)
    target[3:] = (Rotation.from_rotvec(begin[3:]) * Rotation.from_rotvec([0.2, 0, 0.3])).as_rotvec()
    do(robot, robots.MOVE_L, *target, 0.1, 0.5, asynchronous=True)
    assert moving_asynchronously(robot)
    way = target[:3] - begin[:3]
    while moving_asynchronously(robot):
        wait(robot, 0.02)
        off = np.cross(robot.arm.pose[:3] - begin[:3], way / np.linalg.norm(way))
        assert np.linalg.norm(off) < 1e-5
    assert robot.arm.pose[:3] == pytest.approx(target[:3], abs=1e-6)
    error = Rotation.from_rotvec(robot.arm.pose[3:]).inv() * Rotation.from_rotvec(target[3:])
    assert error.magnitude() < 1e-5
    # A trapezoid: the way at 0.1 m/s and once its ramp of 0.2 s.
    assert happened(robot, "motion-stopped")[0] == pytest.approx(np.linalg.norm(way) / 0.1 + 0.2, abs=0.03)


def test_linear_move_out_of_reach_ends_in_a_protective_stop():
    robot = started()
    send(robot, robots.MOVE_L, 2.0, 0.0, 0.5, 0, math.pi, 0, 1.0, 1.0, asynchronous=True)
    wait(robot, 4.0)
    assert happened(robot, "protective-stop")
    assert not robot.arm.qd_rad_per_s.any()


def test_protective_stop_pauses_and_is_not_unlocked_at_once():
    robot = turning(0.3)
    robot.protective_stop("test")
    wait(robot, 0.1)
    assert robot.runtime_state == PAUSED
    assert robot.safety_mode == 3
    assert not robot.arm.qd_rad_per_s.any()
    wait(robot, 4.8)
    assert not robot.unlock()
    wait(robot, 0.2)
    assert robot.unlock()
    wait(robot, 1.0)
    assert not robot.arm.qd_rad_per_s.any(), "unlocking must not resume"


def test_emergency_stop_cuts_power_that_returns_in_two_steps():
    robot = started(power_on_s=0.5)
    robot.emergency_stop()
    robot.begin_power_step(MODE_POWER_OFF)
    wait(robot, 1.0)
    assert robot.robot_mode == MODE_POWER_OFF, "the button is still pressed"
    robot.release()
    robot.begin_power_step(MODE_POWER_OFF)
    wait(robot, 0.6)
    robot.upload(control_script())
    assert not robot.program_running, "the brakes are on"
    robot.begin_power_step(MODE_IDLE)
    wait(robot, 0.6)
    assert robot.robot_mode == MODE_RUNNING
    robot.upload(control_script())
    assert robot.program_running


class Spring:
    """A spring of 2 N·m/rad on the wrist."""

    seen_s = 0.0

    def step(self, dt_s: float, wrist_rad: float) -> float:
        self.seen_s += dt_s
        return -2.0 * wrist_rad


def test_wrench_is_the_plants_torque_about_the_tool_axis():
    spring = Spring()
    robot = Robot(plant=spring)
    robot.arm.wrench_error_factor = 0.0
    robot.upload(control_script())
    turn(robot, 0.5, 10.0)
    wait(robot, 1.0)
    assert spring.seen_s == pytest.approx(robot.time_s)
    expected = -2.0 * robot.arm.q_rad[5]
    # The tool points down: its axis is -z of the base.
    assert robot.arm.wrench == pytest.approx([0, 0, 0, 0, 0, -expected], abs=1e-9)
    robot.arm.wrench_error_factor = 1.0
    wait(robot, 0.5)
    error = np.abs(robot.arm.wrench - robot.arm.load)
    assert 0.0 < np.linalg.norm(error[:3]) <= 3.5
    assert 0.0 < np.linalg.norm(error[3:]) <= 0.2
    robot.arm.wrench_error_factor = 0.0
    robot.registers.write("input_int_register_0", 0, robot.time_s)
    do(robot, robots.SPEED_STOP, 10.0)
    do(robot, robots.ZERO_FT)
    assert robot.arm.wrench == pytest.approx(np.zeros(6), abs=1e-9)


def test_text_that_is_no_program_is_refused():
    robot = Robot()
    robot.upload("def unfinished():\n  while True:\nend\n")
    assert not robot.program_running
    assert "block" in robot.events[-1].detail


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("version 5", "'5' is not a version such as 5.4.0.0"),
        ("fire", "there are protective-stop, emergency-stop"),
        ("silence long", "long"),
        ("silence", "nothing"),
    ],
)
def test_unknown_fault_is_refused(line, said):
    with pytest.raises(ValueError, match=said):
        Controller(Robot()).command(line)
