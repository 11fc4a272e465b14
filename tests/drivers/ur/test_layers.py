"""Worker and script stop the wrist independently: each with the other disabled, on the script itself."""

import dataclasses
import itertools
import math

import pytest

from shearloop.drivers.ur.messages import ARRIVED, MoveLinear, Stop, WristSpeed
from shearloop.drivers.ur.script import UPPER
from shearloop.emulators.ur_robot import PLAYING, Robot
from tests.drivers.ur import robots
from tests.drivers.ur.handler_bench import CYCLE_NS, HandlerBench, enabled
from tests.drivers.ur.robots import DELIVERED, control_script, do
from tests.drivers.ur.scripted_arm import (
    FASTEST,
    FLOOR,
    HARDEST,
    LIMITS,
    PROMISED_S,
    STEPS,
    TIMEOUT_S,
    TWO_CYCLES_S,
    ScriptedArm,
    at_full_speed,
    guarded_arm,
    moving_at_full_speed,
    send_after_another,
    stands_within,
    turn,
)


def test_worker_alone_stops_the_wrist_in_time():
    """ur-rtde's own script has no deadline; the daemon is alive and decides nothing."""
    bench, _ = at_full_speed(control_script())
    decided_ns = bench.now_ns
    while not bench.arm.reading.rests:
        bench.run(1)
        assert bench.now_ns - decided_ns <= PROMISED_S * 1e9
    assert "was not renewed" in bench.state.end_reason


@pytest.mark.parametrize("guarded", [True, False], ids=["guarded", "own"])
def test_script_alone_stops_the_wrist_in_time(guarded):
    """The worker repeats its last command for ever, which feeds the watchdog. Without our script the wrist turns on."""
    bench, command = at_full_speed(control_script(DELIVERED if guarded else None))
    arm, rested_s = bench.arm, None
    for cycle in range(1, 126):
        arm.repeat(command)
        arm.cycle()
        rested_s = rested_s or (cycle * CYCLE_NS / 1e9 if arm.reading.rests else None)
    assert arm.reading.program_running
    assert arm.reading.rests == guarded
    if guarded:
        # The deadline and the time to brake, and no earlier than that.
        assert TIMEOUT_S - CYCLE_NS / 1e9 < rested_s - FASTEST / HARDEST <= PROMISED_S - FASTEST / HARDEST
        # A new decision turns it again.
        turn(arm, command, 0.3)
        assert arm.reading.qd_rad_per_s[5] == pytest.approx(FASTEST)


def test_worker_alone_stops_a_linear_move_in_time():
    bench = moving_at_full_speed(control_script())
    bench.run(round(PROMISED_S * 1e9 / CYCLE_NS), daemon_alive=False)
    assert bench.arm.reading.rests
    assert "was silent" in bench.state.end_reason


@pytest.mark.parametrize("guarded", [True, False], ids=["guarded", "own"])
def test_script_alone_ends_a_linear_move_in_time(guarded):
    """The worker feeds the watchdog for ever, and does not stop."""
    bench = moving_at_full_speed(control_script(DELIVERED if guarded else None))
    for _ in range(round(PROMISED_S * 1e9 / CYCLE_NS)):
        bench.arm.send_heartbeat()
        bench.arm.cycle()
    assert bench.arm.reading.rests == guarded
    assert bench.arm.reading.program_running != guarded


def ends(bench: HandlerBench) -> list[str]:
    """Write nothing for a second, and return how the robot's programs have ended, and its stops."""
    told = ("motion-stopped", "program-ended", "protective-stop")
    bench.arm.robot.take_events()
    for _ in range(125):
        bench.arm.cycle()
    return [event.name for event in bench.arm.robot.take_events() if event.name in told]


@pytest.mark.parametrize("straight", [False, True])
def test_stop_by_the_robot_itself_is_gentle(straight):
    """A killed worker causes no protective stop, also where a program that ends while the arm moves would."""
    script = control_script(DELIVERED)
    bench = moving_at_full_speed(script) if straight else at_full_speed(script)[0]
    bench.arm.robot.protects_abrupt_ends = True
    assert ends(bench) == ["motion-stopped", "program-ended"]
    assert "not renewed in time" in bench.arm.robot.log[-1]


@pytest.mark.parametrize("protects", [True, False])
def test_watchdog_alone_is_the_last_resort(protects):
    """A program without our deadlines has nothing else; what then happens differs between controllers."""
    bench, _ = at_full_speed(control_script())
    bench.arm.robot.protects_abrupt_ends = protects
    found = ends(bench)
    assert ("protective-stop" in found) == protects
    assert bench.arm.reading.rests


@pytest.mark.parametrize("guarded", [True, False], ids=["guarded", "own"])
def test_linear_move_of_a_living_daemon_arrives(guarded):
    bench = moving_at_full_speed(control_script(DELIVERED if guarded else None))
    state = bench.run_until(lambda state: state.motion != "linear")
    assert state.end_reason == "arrived"
    assert not state.blocked


def test_killed_worker_stops_the_wrist_in_time():
    """Nothing is written: the deadline, and later the watchdog."""
    bench, _ = at_full_speed(control_script(DELIVERED))
    for _ in range(round(PROMISED_S * 1e9 / CYCLE_NS)):
        bench.arm.cycle()
    assert bench.arm.reading.rests
    assert bench.arm.reading.program_running
    for _ in range(round(1e9 / DELIVERED.watchdog_hz / CYCLE_NS)):
        bench.arm.cycle()
    assert not bench.arm.reading.program_running


@pytest.mark.parametrize("worker_lives", [True, False])
def test_resumed_program_does_not_turn_the_wrist(worker_lives):
    """The worker has withdrawn the deadline. Without a worker the wrist turns until the deadline."""
    bench, _ = at_full_speed(control_script(DELIVERED))
    arm = bench.arm
    arm.robot.protective_stop("a person")
    for _ in range(10):
        if worker_lives:
            bench.run(1)
        else:
            arm.cycle()
    assert arm.reading.rests
    arm.robot.safety_mode, arm.robot.runtime_state = 1, PLAYING
    speeds = []
    for _ in range(round(PROMISED_S * 1e9 / CYCLE_NS)):
        arm.cycle()
        speeds.append(arm.reading.fastest_rad_per_s)
    assert (max(speeds) == 0) == worker_lives
    assert not arm.reading.program_running
    assert arm.reading.rests


@pytest.mark.parametrize(("asked", "carried_out"), [(5.0, 5.0), (4.0, 4.0), (1.0, FLOOR), (1e-4, FLOOR)])
def test_stop_of_the_worker_is_as_gentle_as_asked_within_the_inner_limit(asked, carried_out):
    bench, _ = at_full_speed(control_script(DELIVERED))
    assert bench.ask(Stop(asked)).sent == Stop(carried_out)
    bench.run(10)
    assert bench.wrist_speed == pytest.approx(FASTEST - carried_out * 10 * CYCLE_NS / 1e9, abs=0.02)


@pytest.mark.parametrize("asked", [1e-4, 0.0, -1.0, math.nan, math.inf])
@pytest.mark.parametrize("command", [robots.SPEED_J, robots.SPEED_STOP, robots.STOP_J])
def test_a_stop_that_a_faulty_worker_sends_is_no_gentler_than_the_inner_limit(command, asked):
    """The program that ends a motion so slowly is fed, and the deadline has passed."""
    arm = guarded_arm()
    turn(arm, WristSpeed(FASTEST, 4.0), 0.3)
    numbers = (0, 0, 0, 0, 0, 0, asked) if command == robots.SPEED_J else (asked,)
    robots.send(arm.robot, command, *numbers, asynchronous=True)
    assert stands_within(arm, FASTEST / FLOOR + TWO_CYCLES_S)


@pytest.mark.parametrize("asked", [1e-4, math.nan])
@pytest.mark.parametrize("command", [robots.SPEED_STOP, robots.STOP_J])
def test_a_stop_of_a_straight_move_is_no_gentler_than_the_inner_limit(command, asked):
    bench = moving_at_full_speed(control_script(DELIVERED))
    arm = bench.arm
    send_after_another(arm, command, asked)
    assert stands_within(arm, arm.reading.fastest_rad_per_s / FLOOR + TWO_CYCLES_S)


def test_a_straight_move_that_changes_its_speed_slowly_stops_in_time():
    """The acceleration of a straight move is that of its own beginning and end; the script's stop has another one."""
    arm = guarded_arm()
    x, y, z, *turned = arm.robot.arm.pose
    arm.send_heartbeat(DELIVERED.silence_timeout_s)
    arm.run_once(robots.MOVE_L, x, y, z - 0.2, *turned, 0.1, 0.02)
    for _ in range(250):
        arm.send_heartbeat(DELIVERED.silence_timeout_s)
        arm.cycle()
    assert not arm.reading.rests
    arm.run_once(robots.MOVE_L, x, y, z, *turned, 0.1, 1e-6)
    assert stands_within(arm, PROMISED_S)


@pytest.mark.parametrize("delay_s", [0.0, 0.09, 0.11, 0.5])
def test_decision_that_comes_late_does_not_turn_the_wrist(delay_s):
    """The deadline counts from the sample before the decision, so that a slow network does not prolong it."""
    arm = guarded_arm()
    until = arm.robot.registers[UPPER.clock] + int(TIMEOUT_S / robots.STEP_S)
    for _ in range(round(delay_s / robots.STEP_S / STEPS)):
        arm.send_heartbeat()
        arm.cycle()
    arm.robot.registers.write(UPPER.deadline, until, arm.robot.time_s)
    arm.repeat(WristSpeed(FASTEST, HARDEST))
    arm.cycle()
    assert arm.reading.rests == (delay_s > TIMEOUT_S)


def test_deadline_of_an_earlier_program_does_not_count():
    arm = guarded_arm()
    arm.robot.registers.write(UPPER.deadline, 1_800_000, arm.robot.time_s)
    arm.repeat(WristSpeed(FASTEST, HARDEST))
    arm.cycle()
    assert arm.reading.rests


def test_script_clips_speed_and_acceleration():
    samples = turn(guarded_arm(), WristSpeed(-3.0, 40.0), 0.5)
    speeds = [sample.qd_rad_per_s[5] for sample in samples]
    assert min(speeds) == pytest.approx(-FASTEST)
    steps = [abs(later - earlier) for earlier, later in itertools.pairwise([0.0, *speeds])]
    assert max(steps) == pytest.approx(HARDEST * CYCLE_NS / 1e9)


@pytest.mark.parametrize("direction", [-1.0, 1.0])
def test_script_keeps_the_wrist_within_its_range(direction):
    arm = guarded_arm()
    samples = turn(arm, WristSpeed(direction * FASTEST, 4.0), 16.0)
    inner = LIMITS.joints.upper_rad[5] - LIMITS.joints.margin_rad
    assert LIMITS.joints.lower_rad[5] == -LIMITS.joints.upper_rad[5]
    assert max(abs(sample.wrist_rad) for sample in samples) == pytest.approx(inner, abs=0.005)
    assert arm.reading.rests
    turn(arm, WristSpeed(-direction * FASTEST, 4.0), 0.5)
    assert arm.reading.qd_rad_per_s[5] == pytest.approx(-direction * FASTEST)


@pytest.mark.parametrize(
    ("part", "hard"),
    [(slice(0, 3), LIMITS.force_n.hard), (slice(3, 6), LIMITS.torque_nm.hard)],
    ids=["force", "torque"],
)
def test_script_stops_beyond_the_hard_force_and_torque_until_rest_is_asked_for(part, hard):
    arm, command = guarded_arm(), WristSpeed(FASTEST, 4.0)
    arm.robot.arm.wrench_error_factor = 0.0
    load = arm.robot.arm.load
    load[part] = 0.57 * hard
    assert not turn(arm, command, 0.3)[-1].rests
    # The norm of three such components.
    load[part] = 0.58 * hard
    assert turn(arm, command, 0.1)[-1].rests
    load[part] = 0.0
    assert turn(arm, command, 0.3)[-1].rests
    turn(arm, WristSpeed(0.0, 4.0), 0.1)
    assert not turn(arm, command, 0.1)[-1].rests


@pytest.mark.parametrize("comes", [True, False])
def test_a_straight_move_may_begin_before_its_deadline_arrives(comes):
    """Move and deadline come over two connections; the register holds the deadline of an earlier motion."""
    arm = guarded_arm()
    arm.withdraw_deadline()
    for _ in range(50):
        arm.send_heartbeat()
        arm.cycle()
    x, y, z, *turned = arm.robot.arm.pose
    arm.run_once(robots.MOVE_L, x, y, z - 0.2, *turned, 0.05, 0.5)
    for _ in range(2):
        arm.cycle()
    for _ in range(round(PROMISED_S * 1e9 / CYCLE_NS)):
        arm.send_heartbeat(DELIVERED.silence_timeout_s if comes else None)
        arm.cycle()
    assert arm.reading.program_running == comes
    assert arm.reading.rests != comes


def test_deadline_of_an_earlier_program_ends_a_straight_move():
    """The clock starts at 0 in each program, so that an old deadline can be hours ahead."""
    arm = guarded_arm()
    x, y, z, *turned = arm.robot.arm.pose
    arm.run_once(robots.MOVE_L, x, y, z - 0.2, *turned, 0.05, 0.5)
    arm.robot.registers.write(UPPER.deadline, 1_800_000, arm.robot.time_s)
    for _ in range(round(PROMISED_S * 1e9 / CYCLE_NS)):
        arm.send_heartbeat()
        arm.cycle()
    assert arm.reading.rests
    assert not arm.reading.program_running


@pytest.mark.parametrize(("silence_s", "late_s", "goes_on"), [(0.1, 0.06, True), (1.0, 0.9, True), (1.0, 1.1, False)])
def test_a_worker_that_is_late_for_less_than_the_silence_costs_no_straight_move(silence_s, late_s, goes_on):
    """1 s is what an emulated rig allows a busy computer."""
    settings = dataclasses.replace(DELIVERED, command_timeout_s=silence_s, silence_timeout_s=silence_s)
    bench = moving_at_full_speed(control_script(settings), settings)
    for _ in range(round(late_s * 1e9) // CYCLE_NS):
        bench.run_without_handler()
    assert bench.arm.reading.program_running == goes_on


@pytest.mark.parametrize(("silence_s", "arrives"), [(0.1, False), (1.0, True)])
def test_an_emulated_robot_whose_time_stands_still_has_longer_for_a_straight_move(silence_s, arrives):
    """The controller is on a busy computer: five of six cycles pass without it."""
    settings = dataclasses.replace(DELIVERED, command_timeout_s=silence_s, silence_timeout_s=silence_s)
    bench = enabled(settings, ScriptedArm(control_script(settings), settings))
    bench.run(1)
    x, y, z, *turned = bench.arm.robot.arm.pose
    cycle, numbers = bench.arm.cycle, itertools.count()
    bench.arm.cycle = lambda: cycle() if next(numbers) % 6 == 0 else None
    assert bench.ask(MoveLinear((x, y, z - 0.03, *turned), 0.05, 0.5)).accepted
    state = bench.run_until(lambda state: state.motion == "idle" or "within its time" in state.end_reason)
    assert (state.end_reason == ARRIVED) == arrives


@pytest.mark.parametrize("held", [True, False])
def test_a_program_that_starts_while_something_is_held_keeps_its_limits(held):
    """An e-Series zeroes its wrench then: with 0.7 of the largest torque held, and with 0.4 that come later."""
    arm, command = guarded_arm(), WristSpeed(FASTEST, 4.0)
    arm.robot.arm.wrench_error_factor = 0.0
    load = arm.robot.arm.load
    load[5] = 0.7 * LIMITS.torque_nm.hard
    assert not turn(arm, command, 0.3)[-1].rests
    turn(arm, WristSpeed(0.0, 8.0), 0.3)
    arm.send_heartbeat()
    arm.upload(held=held)
    arm.cycle()
    assert arm.robot.arm.wrench == pytest.approx([0.0] * 6)
    assert not turn(arm, command, 0.3)[-1].rests
    load[5] = 1.1 * LIMITS.torque_nm.hard
    assert turn(arm, command, 0.3)[-1].rests == held
    # A new zero counts for the program too.
    load[5] = 0.9 * LIMITS.torque_nm.hard
    turn(arm, WristSpeed(0.0, 8.0), 0.3)
    do(arm.robot, robots.SPEED_STOP, 4.0)
    do(arm.robot, robots.ZERO_FT)
    load[5] = 1.7 * LIMITS.torque_nm.hard
    arm.send_heartbeat()
    assert not turn(arm, command, 0.3)[-1].rests


def test_script_reports_its_clock():
    robot = Robot()
    robot.registers.write(UPPER.command, 0, 0.0)
    robot.upload(control_script(DELIVERED))
    for _ in range(10):
        robot.step(0.008)
    assert robot.program_running
    # A thread starts in the cycle after the one that starts it.
    assert robot.registers[UPPER.clock] == 9
    assert robot.registers[UPPER.step] == 0.008


def test_deadline_counts_during_a_gentle_ramp():
    """ur-rtde's own thread looks at nothing until its speed is reached."""
    arm, command = guarded_arm(), WristSpeed(FASTEST, 0.5)
    assert 0.1 < turn(arm, command, 0.3)[-1].qd_rad_per_s[5] < 0.2
    for _ in range(round(PROMISED_S * 1e9 / CYCLE_NS)):
        arm.repeat(command)
        arm.cycle()
    assert arm.reading.rests
