"""An arm whose controller runs a control script, without a process and a clock."""

import dataclasses
import math

import pytest

from shearloop.drivers.ur.messages import MoveLinear, RtdeSample, WristSpeed
from shearloop.drivers.ur.script import NO_MOTION_TICKS, UPPER, control_program
from shearloop.drivers.ur.settings import UrSettings
from shearloop.emulators.ur_robot import Robot
from tests.drivers.ur import robots
from tests.drivers.ur.handler_bench import AT_REST, CYCLE_NS, FakeArm, HandlerBench, enabled
from tests.drivers.ur.robots import DELIVERED, control_script

LIMITS, TIMEOUT_S = DELIVERED.limits, DELIVERED.command_timeout_s
FASTEST = LIMITS.wrist_speed_rad_per_s.inner
# No stop is gentler.
FLOOR = LIMITS.wrist_acceleration_rad_per_s2.inner
HARDEST = LIMITS.wrist_acceleration_rad_per_s2.hard
# From the last decision to rest.
PROMISED_S = 0.2
# Until a command takes effect.
TWO_CYCLES_S = 2 * CYCLE_NS / 1e9

# Of the controller, in a cycle of the worker.
STEPS = 4


class ScriptedArm(FakeArm):
    """An arm whose controller runs a control script; writes the registers that `UrArm` and ur-rtde write."""

    def __init__(
        self, script: str, settings: UrSettings = DELIVERED, robot: Robot | None = None, step_s: float = robots.STEP_S
    ) -> None:
        super().__init__()
        self.robot, self._script, self._settings, self._step_s = robot or Robot(), script, settings, step_s

    def step(self) -> None:
        """Let one cycle of the controller pass."""
        self.robot.step(self._step_s)

    def cycle(self) -> None:
        for _ in range(STEPS):
            self.step()
        arm = self.robot.arm
        self.reading = dataclasses.replace(
            AT_REST,
            read_ns=self.reading.read_ns + CYCLE_NS,
            timestamp_s=self.robot.clock_s,
            q_rad=tuple(arm.q_rad),
            qd_rad_per_s=tuple(arm.qd_rad_per_s),
            tcp_pose=tuple(map(float, arm.pose)),
            wrench=tuple(arm.wrench),
            runtime_state=self.robot.runtime_state,
            moving_linearly=robots.moving_asynchronously(self.robot),
        )

    def _write(self, command: int, *values: float) -> bool:
        robots.send(self.robot, command, *values)
        return True

    def _write_deadline(self, left_s: float) -> None:
        until = self.robot.registers[UPPER.clock] + int(left_s / self._step_s)
        self.robot.registers.write(UPPER.deadline, until, self.robot.time_s)

    def withdraw_deadline(self) -> None:
        self.robot.registers.write(UPPER.deadline, NO_MOTION_TICKS, self.robot.time_s)

    def wrist(self, command: WristSpeed, left_s: float) -> bool:
        self._write_deadline(left_s)
        return self.repeat(command)

    def repeat(self, command: WristSpeed) -> bool:
        """Send a speed without another deadline, as a worker does that decides nothing."""
        return self._write(robots.SPEED_J, 0, 0, 0, 0, 0, command.rad_per_s, command.acceleration_rad_per_s2, 0)

    def end_speed(self, deceleration_rad_per_s2: float) -> bool:
        return self._write(robots.SPEED_STOP, deceleration_rad_per_s2)

    def run_once(self, command: int, *values: float) -> bool:
        # As ur-rtde's client does: a command that comes while the one before is being answered is lost.
        robots.send(self.robot, 0)
        while self.robot.program_running and robots.READY not in robots.states(self.robot):
            self.step()
        robots.do(self.robot, command, *values, asynchronous=True, step=self.step)
        return True

    def move(self, command: MoveLinear) -> bool:
        self._write_deadline(self._settings.silence_timeout_s)
        return self.run_once(robots.MOVE_L, *command.pose, command.speed_m_per_s, command.acceleration_m_per_s2)

    def stop_move(self, deceleration_rad_per_s2: float) -> bool:
        return self.run_once(robots.STOP_J, deceleration_rad_per_s2)

    def send_heartbeat(self, left_s: float | None = None) -> bool:
        if left_s is not None:
            self._write_deadline(left_s)
        return self._write(0)

    def clear_command(self) -> bool:
        return self._write(0)

    def upload(self, *, held: bool = False) -> None:
        load = tuple(self.robot.arm.wrench)
        self.robot.upload(control_program(self._settings, load=load) if held else self._script)

    def arm_watchdog(self) -> bool:
        return self._write(robots.SET_WATCHDOG, self._settings.watchdog_hz)


def guarded_arm(robot: Robot | None = None) -> ScriptedArm:
    """Return an arm that runs our script, without a worker; its watchdog is fed as long as something is written."""
    arm = ScriptedArm(control_script(DELIVERED), robot=robot)
    arm.send_heartbeat()
    arm.upload()
    arm.cycle()
    return arm


def turn(arm: ScriptedArm, command: WristSpeed, seconds: float) -> list[RtdeSample]:
    """Decide on a speed in each cycle, and return the samples."""
    found = []
    for _ in range(round(seconds / (STEPS * robots.STEP_S))):
        arm.wrist(command, TIMEOUT_S)
        arm.cycle()
        found.append(arm.reading)
    return found


def at_full_speed(script: str) -> tuple[HandlerBench, WristSpeed]:
    """Return a bench at the largest speed, at the moment of a decision, and the command."""
    bench = enabled(DELIVERED, ScriptedArm(script))
    for _ in range(50):
        command = WristSpeed(FASTEST, LIMITS.wrist_acceleration_rad_per_s2.inner, bench.now_ns)
        assert bench.ask(command).accepted
        bench.run(1)
    assert bench.wrist_speed == pytest.approx(FASTEST)
    assert bench.ask(dataclasses.replace(command, decided_ns=bench.now_ns)).accepted
    return bench, command


def moving_at_full_speed(script: str, settings: UrSettings = DELIVERED) -> HandlerBench:
    """Return a bench in a straight move at its largest speed, at the moment of the daemon's last message."""
    bench = enabled(settings, ScriptedArm(script, settings))
    bench.run(1)
    x, y, z, *turned = bench.arm.robot.arm.pose
    inner = LIMITS.linear_speed_m_per_s.inner
    assert bench.ask(MoveLinear((x, y, z - 0.2, *turned), inner, LIMITS.linear_acceleration_m_per_s2.inner)).accepted
    bench.run(60)
    assert bench.state.motion == "linear"
    assert not bench.arm.reading.rests
    return bench


def stands_within(arm: ScriptedArm, seconds: float) -> bool:
    """Let cycles pass without another command, and return whether the arm then rests."""
    for _ in range(math.ceil(1e9 * seconds / CYCLE_NS)):
        arm.cycle()
    return arm.reading.rests


def send_after_another(arm: ScriptedArm, command: int, *numbers: float) -> None:
    """Clear the command before, and write another one; nothing waits for its answer."""
    robots.send(arm.robot, 0)
    arm.cycle()
    robots.send(arm.robot, command, *numbers, asynchronous=True)
