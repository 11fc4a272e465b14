"""A handler that drives a fake arm, cycle by cycle."""

import copy
import dataclasses
import math
from collections.abc import Callable

import pytest

from shearloop.drivers.errors import DriverError
from shearloop.drivers.ur import messages
from shearloop.drivers.ur import settings as ur
from shearloop.drivers.ur.command_handler import CommandHandler
from shearloop.drivers.ur.settings import JointRange, UrLimits, UrSettings, Workspace

LIMITS = UrLimits(
    joints=JointRange((-6.0, -6.0, -3.0, -6.0, -6.0, -2.0), (6.0, 6.0, 3.0, 6.0, 6.0, 2.0), 0.1),
    workspace=Workspace((-0.8, -0.8, 0.0), (0.8, 0.8, 0.9), 0.02),
    wrist_speed_rad_per_s=ur.WristSpeedBound(0.8, 1.0),
    wrist_acceleration_rad_per_s2=ur.WristAccelerationBound(4.0, 8.0),
    linear_speed_m_per_s=ur.SpeedBound(0.1, 0.15),
    linear_acceleration_m_per_s2=ur.AccelerationBound(0.5, 1.0),
    force_n=ur.ForceBound(40.0, 60.0),
    torque_nm=ur.TorqueBound(4.0, 6.0),
)
SETTINGS = UrSettings(host="10.0.0.1", limits=LIMITS, command_timeout_s=0.3, silence_timeout_s=0.3)
AT_REST = messages.RtdeSample(
    read_ns=0,
    timestamp_s=0.0,
    age_ns=0,
    connected=True,
    q_rad=(0.0, -1.5, 1.5, -1.5, -1.5, 0.0),
    qd_rad_per_s=(0.0,) * 6,
    tcp_pose=(-0.5, -0.1, 0.5, 0.0, math.pi, 0.0),
    tcp_speed=(0.0,) * 6,
    wrench=(0.0,) * 6,
    robot_mode=7,
    safety_mode=1,
    runtime_state=2,
    speed_slider=1.0,
    limiter_scaling=1.0,
    script_state=1,
    script_ticks=0,
    script_step_s=0.002,
    payload_kg=1.0,
    payload_cog_m=(0.0, 0.0, 0.06),
    tcp_offset=(0.0,) * 6,
    moving_linearly=False,
)
CYCLE_NS, WATCHDOG_NS = 8_000_000, 100_000_000
POSE = (-0.5, -0.1, 0.45, 0.0, math.pi, 0.0)


def received(
    timestamp_s: float, runtime_state: int = 2, script_state: int = 1, script_ticks: int = 0
) -> messages.RtdeOutputs:
    """Return a sample as the controller sends it."""
    sample = dataclasses.replace(
        AT_REST,
        timestamp_s=timestamp_s,
        runtime_state=runtime_state,
        script_state=script_state,
        script_ticks=script_ticks,
    )
    return messages.RtdeOutputs(*(getattr(sample, field.name) for field in dataclasses.fields(messages.RtdeOutputs)))


class FakeArm:
    """A wrist that follows speeds, a controller with modes and a watchdog, and a list of all calls.

    As in the real program, the speed thread runs until it is ended, also after a pause.
    """

    def __init__(self) -> None:
        self.calls: list[str] = []
        self.reading = dataclasses.replace(AT_REST, runtime_state=1)
        self.target, self.acceleration = 0.0, 4.0
        self.accepts = True
        self.wrench_zero = (0.0,) * 6
        self.stops_moves = True
        self.other_client = False
        self.unlockable = self.stoppable = True
        # The controller's words against a request: of an error, and of an answer that may be ignored.
        self.refuses: dict[str, str] = {}
        self.ignores: dict[str, str] = {}
        self.stale_command = False
        # Whether the load has been measured since this start began.
        self.load_is_new = False
        self._resumed_target = 0.0
        self._watched = False
        self._since_call_ns = 0

    def cycle(self) -> None:
        if self.reading.runtime_state == 2:
            self._since_call_ns += CYCLE_NS
            if self._watched and self._since_call_ns > WATCHDOG_NS:
                self.end_program()
        wrist, speed = self.reading.q_rad[5], self.reading.qd_rad_per_s[5]
        step = self.acceleration * CYCLE_NS / 1e9
        now = speed + min(max(self.target - speed, -step), step)
        wrist += 0.5 * (now + speed) * CYCLE_NS / 1e9
        self.be(
            read_ns=self.reading.read_ns + CYCLE_NS,
            timestamp_s=self.reading.timestamp_s + CYCLE_NS / 1e9,
            q_rad=(*self.reading.q_rad[:5], wrist),
            qd_rad_per_s=(0.0, 0.0, 0.0, 0.0, 0.0, now),
        )

    def be(self, **changes: object) -> None:
        # As dataclasses.replace does, in a fraction of its time: it is called several times in a cycle.
        assert changes.keys() <= vars(self.reading).keys()
        self.reading = copy.copy(self.reading)
        vars(self.reading).update(changes)

    def read(self) -> messages.RtdeSample:
        return self.reading

    def has_other_client(self) -> bool:
        return self.other_client

    def take_errors(self) -> list[messages.ControllerError]:
        return []

    def end_program(self) -> None:
        self.target = self._resumed_target = 0.0
        self._watched = False
        self.be(runtime_state=1, moving_linearly=False)

    def protective_stop(self) -> None:
        self._resumed_target = self.target
        self.target, self.acceleration = 0.0, 20.0
        self.be(safety_mode=3, runtime_state=4 if self.reading.runtime_state == 2 else 1)

    def be_resumed_at_the_pendant(self) -> None:
        self.target = self._resumed_target
        self.be(safety_mode=1, runtime_state=2)

    def note(self, call: str) -> None:
        self.calls.append(call)
        self._since_call_ns = 0

    def wrist(self, command: messages.WristSpeed, _left_s: float) -> bool:
        self.note("wrist")
        if self.accepts:
            self.target, self.acceleration = command.rad_per_s, command.acceleration_rad_per_s2
            self.stale_command = True
        return self.accepts

    def end_speed(self, deceleration_rad_per_s2: float) -> bool:
        self.note("end_speed")
        self.target, self.acceleration = 0.0, deceleration_rad_per_s2
        return True

    def move(self, _command: messages.MoveLinear) -> bool:
        self.note("move")
        self.be(moving_linearly=self.accepts)
        return self.accepts

    def stop_move(self, _deceleration_rad_per_s2: float) -> bool:
        self.note("stop_move")
        if self.stops_moves:
            self.be(moving_linearly=False)
        return self.accepts

    def send_heartbeat(self, _left_s: float | None = None) -> bool:
        self.note("send_heartbeat")
        return True

    def withdraw_deadline(self) -> None:
        self._resumed_target = 0.0

    def clear_command(self) -> bool:
        self.calls.append("clear_command")
        self.stale_command = False
        return True

    def measure_load_anew(self) -> None:
        self.load_is_new = True

    def knows_load(self, *, held: bool) -> bool:  # noqa: ARG002 - nothing is measured here
        return True

    def zero_wrench(self) -> bool:
        self.note("zero_wrench")
        return True

    def ask_dashboard(self, *requests: str) -> str:
        self.calls.append(requests[0])
        if requests[0] in self.refuses:
            raise DriverError(self.refuses[requests[0]])
        if requests[0] in self.ignores:
            return self.ignores[requests[0]]
        match requests[0]:
            case "unlock protective stop":
                if not self.unlockable:
                    raise DriverError("not in the first 5 s")
                self.be(safety_mode=1)
            case "power on":
                self.be(robot_mode=5)
            case "brake release":
                self.be(robot_mode=7)
            case "stop":
                if not self.stoppable:
                    raise DriverError("the dashboard does not answer")
                self.end_program()
        return ""

    def forget_load(self) -> None:
        self.calls.append("forget_load")

    def upload(self, *, held: bool = False) -> None:
        assert self.load_is_new, "a load from before this start could be of another zero"
        self.calls.append("upload, held" if held else "upload")
        if self.stale_command:
            self.target = 0.8
        self._watched = False
        self.be(runtime_state=2)

    def arm_watchdog(self) -> bool:
        self.note("arm_watchdog")
        self._watched = True
        self.load_is_new = False
        return True


class HandlerBench:
    """A handler, its arm and the time."""

    def __init__(self, settings: UrSettings = SETTINGS, *, arm: FakeArm | None = None) -> None:
        self.arm = arm or FakeArm()
        self.now_ns = 10**12
        self.number = self.cycle = 0
        self.decided: dict[int, messages.CommandReply] = {}
        self._settings = settings
        self.replace_handler()

    def replace_handler(self) -> None:
        """Replace the handler."""
        self.cycle = 0
        self.handler = CommandHandler(self._settings, self.arm, self.now_ns)

    def run_without_handler(self) -> None:
        """Run a cycle of the program without a handler."""
        self.arm.cycle()
        self.now_ns += CYCLE_NS

    def ask(self, command: messages.Command) -> messages.CommandReply:
        """Send a command, run cycles until its reply comes, and return it."""
        self.number += 1
        self.handler.take(self.arm.reading)
        reply = self.handler.request(self.number, command, self.now_ns)
        for _ in range(6000):
            if reply is not None or self.number in self.decided:
                break
            self.run(1)
        return reply or self.decided[self.number]

    def run(self, cycles: int, *, daemon_alive: bool = True) -> None:
        for _ in range(cycles):
            self.handler.take(self.arm.reading)
            if daemon_alive:
                self.handler.request(0, messages.Heartbeat(), self.now_ns)
            decided = self.handler.tick(self.now_ns)
            if decided is not None:
                assert decided[0] not in self.decided
                self.decided[decided[0]] = decided[1]
            self.arm.cycle()
            self.now_ns += CYCLE_NS
            self.cycle += 1

    def tick(self) -> tuple[int, messages.CommandReply] | None:
        """Run a cycle of the handler alone."""
        self.handler.take(self.arm.reading)
        return self.handler.tick(self.now_ns)

    def run_until(self, condition: Callable[[messages.RobotState], bool], cycles: int = 1000) -> messages.RobotState:
        for _ in range(cycles):
            if condition(self.state):
                return self.state
            self.run(1)
        raise AssertionError(f"never came about; now {self.state}")

    @property
    def state(self) -> messages.RobotState:
        self.handler.take(self.arm.reading)
        return self.handler.state(self.cycle)

    @property
    def wrist_speed(self) -> float:
        return self.arm.reading.qd_rad_per_s[5]


def enabled(settings: UrSettings = SETTINGS, arm: FakeArm | None = None) -> HandlerBench:
    bench = HandlerBench(settings, arm=arm)
    bench.run(5)
    assert bench.ask(messages.Enable()).accepted
    bench.arm.calls.clear()
    return bench


def moving(cycles: int) -> HandlerBench:
    """Return a bench that has begun a straight move so many cycles ago."""
    bench = enabled()
    assert bench.ask(messages.MoveLinear(POSE, 0.1, 0.1)).accepted
    bench.run(cycles)
    return bench


def turning(speed: float = 0.5, arm: FakeArm | None = None) -> HandlerBench:
    bench = enabled(arm=arm)
    assert bench.ask(messages.WristSpeed(speed, 4.0)).accepted
    bench.run(30)
    assert bench.wrist_speed == pytest.approx(speed)
    return bench
