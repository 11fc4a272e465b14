"""An arm whose controller runs a control script, without a process and a clock."""

import dataclasses

from shearloop.drivers.ur.messages import MoveLinear, WristSpeed
from shearloop.drivers.ur.script import NO_MOTION_TICKS, UPPER, control_program
from shearloop.drivers.ur.settings import UrSettings
from shearloop.emulators.ur_robot import Robot
from tests.drivers.ur import robots
from tests.drivers.ur.handler_bench import AT_REST, CYCLE_NS, FakeArm
from tests.drivers.ur.robots import DELIVERED

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
            t_mono_ns=self.reading.t_mono_ns + CYCLE_NS,
            timestamp_s=self.robot.clock_s,
            q_rad=tuple(arm.q_rad),
            qd_rad_per_s=tuple(arm.qd_rad_per_s),
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
