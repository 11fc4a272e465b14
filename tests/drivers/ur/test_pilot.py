"""The pilot without a robot: what is sent, what is refused, what ends a motion; and that none begins by itself."""

import dataclasses
import math
from collections.abc import Callable

import pytest
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from drivers.errors import DriverError
from drivers.ur.messages import (
    Command,
    Disconnect,
    Enable,
    MoveLinear,
    Reading,
    Reply,
    RobotState,
    Stop,
    Unlock,
    WristSpeed,
    ZeroForceTorque,
)
from drivers.ur.pilot import Pilot
from drivers.ur.settings import UrSettings
from tests.drivers.ur.test_limits import AT_REST, LIMITS

SETTINGS = UrSettings(host="10.0.0.1", limits=LIMITS)
CYCLE_NS = 8_000_000
POSE = (-0.5, -0.1, 0.45, 0.0, math.pi, 0.0)


class FakeArm:
    """A wrist that follows speeds, a controller with modes, and a list of everything that was called."""

    def __init__(self) -> None:
        self.calls: list[str] = []
        self.reading = dataclasses.replace(AT_REST, runtime_state=1)
        self.target, self.acceleration = 0.0, 4.0
        self.takes = True
        self.unlockable = True
        self.stale_command = False

    def cycle(self) -> None:
        wrist, speed = self.reading.q_rad[5], self.reading.qd_rad_per_s[5]
        step = self.acceleration * CYCLE_NS / 1e9
        now = speed + min(max(self.target - speed, -step), step)
        wrist += 0.5 * (now + speed) * CYCLE_NS / 1e9
        self.reading = dataclasses.replace(
            self.reading,
            t_mono_ns=self.reading.t_mono_ns + CYCLE_NS,
            q_rad=(*self.reading.q_rad[:5], wrist),
            qd_rad_per_s=(0.0, 0.0, 0.0, 0.0, 0.0, now),
        )

    def be(self, **changes: object) -> None:
        self.reading = dataclasses.replace(self.reading, **changes)  # type: ignore[arg-type]

    def end_program(self) -> None:
        self.target = 0.0
        self.be(runtime_state=1, moving_linearly=False)

    def wrist(self, command: WristSpeed) -> bool:
        self.calls.append("wrist")
        if self.takes:
            self.target, self.acceleration = command.rad_per_s, command.acceleration_rad_per_s2
            self.stale_command = True
        return self.takes

    def end_speed(self, deceleration_rad_per_s2: float) -> bool:
        self.calls.append("end_speed")
        self.target, self.acceleration = 0.0, deceleration_rad_per_s2
        return True

    def move(self, _command: MoveLinear) -> bool:
        self.calls.append("move")
        self.be(moving_linearly=self.takes)
        return self.takes

    def stop_move(self, _deceleration_rad_per_s2: float) -> None:
        self.calls.append("stop_move")
        self.be(moving_linearly=False)

    def kick(self) -> bool:
        self.calls.append("kick")
        return True

    def clear_command(self) -> None:
        self.calls.append("clear_command")
        self.stale_command = False

    def zero_wrench(self) -> bool:
        self.calls.append("zero_wrench")
        return True

    def unlock(self) -> None:
        self.calls.append("unlock")
        if not self.unlockable:
            raise DriverError("not in the first 5 s")
        self.be(safety_mode=1)

    def close_popups(self) -> None:
        self.calls.append("close_popups")

    def power_on(self) -> None:
        self.calls.append("power_on")
        self.be(robot_mode=5)

    def release_brakes(self) -> None:
        self.calls.append("release_brakes")
        self.be(robot_mode=7)

    def stop_program(self) -> None:
        self.calls.append("stop_program")
        self.end_program()

    def upload(self) -> bool:
        self.calls.append("upload")
        if self.stale_command:
            self.target = 0.8
        self.be(runtime_state=2)
        return True

    def arm_watchdog(self) -> bool:
        self.calls.append("arm_watchdog")
        return True


class Flight:
    """A pilot, its arm and the time."""

    def __init__(self, settings: UrSettings = SETTINGS) -> None:
        self.arm = FakeArm()
        self.now_ns = 10**12
        self.number = 0
        self.decided: dict[int, Reply] = {}
        self.pilot = Pilot(settings, self.arm, self.now_ns)

    def ask(self, command: Command) -> Reply:
        """Send a command and return its reply, letting cycles pass until it comes."""
        self.number += 1
        reply = self.pilot.request(self.number, command, self.arm.reading, self.now_ns)
        for _ in range(6000):
            if reply is not None or self.number in self.decided:
                break
            self.fly(1)
        return reply or self.decided[self.number]

    def fly(self, cycles: int, *, daemon_alive: bool = True) -> None:
        for _ in range(cycles):
            if daemon_alive:
                self.pilot.heard(self.now_ns)
            decided = self.pilot.tick(self.arm.reading, self.now_ns)
            if decided is not None:
                assert decided[0] not in self.decided
                self.decided[decided[0]] = decided[1]
            self.arm.cycle()
            self.now_ns += CYCLE_NS

    def fly_until(self, condition: Callable[[RobotState], bool], cycles: int = 1000) -> RobotState:
        for _ in range(cycles):
            if condition(self.state):
                return self.state
            self.fly(1)
        raise AssertionError(f"never came about; now {self.state}")

    @property
    def state(self) -> RobotState:
        return self.pilot.state(self.arm.reading)

    @property
    def wrist_speed(self) -> float:
        return self.arm.reading.qd_rad_per_s[5]


def flying() -> Flight:
    flight = Flight()
    flight.fly(5)
    assert flight.ask(Enable()).accepted
    flight.arm.calls.clear()
    return flight


def turning(speed: float = 0.5) -> Flight:
    flight = flying()
    assert flight.ask(WristSpeed(speed, 4.0)).accepted
    flight.fly(30)
    assert flight.wrist_speed == pytest.approx(speed)
    return flight


def test_start_clears_the_last_command_uploads_and_arms_the_watchdog_in_this_order() -> None:
    flight = Flight()
    flight.fly(5)
    assert flight.arm.calls == ["clear_command", "upload", "arm_watchdog", "kick", "kick"]


def test_nothing_moves_before_it_is_enabled() -> None:
    flight = Flight()
    assert "made ready" in flight.ask(WristSpeed(0.1, 1.0)).refused
    flight.fly(5)
    assert "not been enabled" in flight.ask(WristSpeed(0.1, 1.0)).refused
    assert "not been enabled" in flight.ask(MoveLinear(POSE, 0.1, 0.1)).refused
    assert flight.state.blocked
    assert {"wrist", "move"}.isdisjoint(flight.arm.calls)
    assert flight.ask(Enable()).accepted
    assert not flight.state.blocked
    flight.fly(100)
    assert {"wrist", "move"}.isdisjoint(flight.arm.calls)


def test_what_was_sent_after_clipping_is_returned_and_reported() -> None:
    flight = flying()
    reply = flight.ask(WristSpeed(3.0, 2.0))
    assert reply.sent == WristSpeed(0.8, 2.0)
    assert reply.clipped == ("wrist speed is limited to 0.8 rad/s",)
    assert (flight.state.sent, flight.state.clipped) == (reply.sent, reply.clipped)
    assert (flight.state.motion, flight.state.motion_id) == ("wrist", flight.number)


def test_wrist_speed_is_sent_every_cycle_and_ends_when_it_is_not_renewed() -> None:
    flight = turning(0.5)
    flight.fly(5)
    assert flight.arm.calls[-5:] == ["wrist"] * 5
    state = flight.fly_until(lambda state: state.motion == "idle")
    assert state.ended == "the wrist speed was not renewed within 0.3 s"
    assert flight.wrist_speed == 0
    # 0.3 s of turning, then 0.5/4 s of braking, then the speed thread is ended and the watchdog kicked.
    assert state.wrist_rad == pytest.approx(0.5 * 0.3, abs=0.03)
    assert flight.arm.calls[-1] == "end_speed"
    flight.fly(3)
    assert flight.arm.calls[-3:] == ["kick"] * 3


def test_silence_of_the_daemon_ends_whatever_moves() -> None:
    flight = flying()
    assert flight.ask(MoveLinear(POSE, 0.05, 0.1)).accepted
    flight.fly(30, daemon_alive=False)
    assert flight.state.motion == "linear"
    flight.fly(30, daemon_alive=False)
    assert flight.state.motion == "idle"
    assert "silent" in flight.state.ended
    assert "stop_move" in flight.arm.calls


def test_linear_move_is_kicked_along_and_its_arrival_told() -> None:
    flight = flying()
    reply = flight.ask(MoveLinear((-2.0, *POSE[1:]), 9.0, 0.1))
    assert reply.sent == MoveLinear((-0.78, *POSE[1:]), 0.1, 0.1)
    assert len(reply.clipped) == 2
    flight.fly(20)
    assert flight.arm.calls == ["move"] + ["kick"] * 20
    assert "linear move is under way" in flight.ask(WristSpeed(0.1, 1.0)).refused
    flight.arm.be(moving_linearly=False)
    flight.fly(1)
    assert (flight.state.motion, flight.state.ended) == ("idle", "arrived")


def test_linear_move_has_a_deadline_and_inner_limits() -> None:
    flight = flying()
    flight.ask(MoveLinear(POSE, 0.1, 0.5))
    state = flight.fly_until(lambda state: state.motion == "idle")
    assert "did not end within its time" in state.ended
    flight.ask(MoveLinear(POSE, 0.1, 0.5))
    flight.fly(3)
    flight.arm.be(wrench=(0.0, 0.0, 45.0, 0.0, 0.0, 0.0))
    flight.fly(2)
    assert "force of 45.00 N is above the inner limit" in flight.state.ended
    assert flight.arm.calls.count("stop_move") == 2


def test_stop_ends_turning_before_anything_else_may_begin() -> None:
    flight = turning(0.5)
    reply = flight.ask(Stop(2.0))
    assert reply.sent == Stop(2.0)
    flight.fly(1)
    assert flight.state.motion == "stopping"
    assert "still stopping" in flight.ask(WristSpeed(0.5, 1.0)).refused
    assert "stop it before" in flight.ask(MoveLinear(POSE, 0.1, 0.1)).refused
    state = flight.fly_until(lambda state: state.motion == "idle")
    assert state.ended == "stopped on command"
    assert flight.ask(MoveLinear(POSE, 0.1, 0.1)).accepted


def test_speed_thread_is_ended_before_a_linear_move() -> None:
    flight = flying()
    flight.ask(WristSpeed(0.0, 1.0))
    flight.fly(2)
    assert flight.ask(MoveLinear(POSE, 0.1, 0.1)).accepted
    assert flight.arm.calls[-2:] == ["end_speed", "move"]


@pytest.mark.parametrize(
    "command", [WristSpeed(0.1, 0.0), MoveLinear(POSE, 0.0, 0.1), MoveLinear(POSE, 0.1, -1.0), Stop(0.0)]
)
def test_senseless_numbers_are_refused_in_a_sentence(command: Command) -> None:
    flight = flying()
    assert "above 0" in flight.ask(command).refused
    assert not flight.arm.calls


def test_wrench_is_zeroed_at_rest_only() -> None:
    flight = turning()
    assert "only at rest" in flight.ask(ZeroForceTorque()).refused
    flight.fly_until(lambda state: state.motion == "idle")
    assert flight.ask(ZeroForceTorque()).accepted
    assert flight.arm.calls[-1] == "zero_wrench"


def test_robot_that_does_not_take_a_speed_is_stopped_and_said() -> None:
    flight = turning()
    flight.arm.takes = False
    assert "does not answer" in flight.ask(WristSpeed(0.1, 1.0)).refused
    assert flight.state.motion == "stopping"


def test_hard_limit_stops_and_holds_until_enabled_anew() -> None:
    flight = turning()
    flight.arm.be(wrench=(0.0, 0.0, 0.0, 0.0, 0.0, 6.5))
    flight.fly(1)
    assert flight.state.motion == "stopping"
    flight.fly_until(lambda state: state.motion == "idle")
    assert "Torque is 6.50 N m" in flight.ask(Enable()).refused
    flight.arm.be(wrench=(0.0,) * 6)
    flight.fly(50)
    assert "Torque is 6.50 N m" in flight.ask(WristSpeed(0.1, 1.0)).refused
    assert flight.ask(Enable()).accepted
    assert flight.ask(WristSpeed(0.1, 1.0)).accepted


def test_protective_stop_ends_motion_and_is_cured_on_the_operators_word() -> None:
    flight = turning()
    flight.arm.be(safety_mode=3, runtime_state=4)
    flight.arm.target = 0.0
    flight.arm.calls.clear()
    flight.fly(100)
    assert flight.state.protective_stop
    assert flight.state.blocked.startswith("Protective stop")
    assert flight.arm.calls == [], "nothing is sent, and above all nothing is unlocked"
    assert "Protective stop" in flight.ask(Enable()).refused

    flight.arm.unlockable = False
    assert "first 5 s" in flight.ask(Unlock()).refused
    flight.arm.unlockable = True
    flight.arm.calls.clear()
    assert flight.ask(Unlock()).accepted
    assert flight.arm.calls == ["unlock", "close_popups", "stop_program", "clear_command", "upload", "arm_watchdog"]
    flight.fly(100)
    assert flight.wrist_speed == 0, "the speed from before the stop is not taken up again"
    assert flight.ask(WristSpeed(0.1, 1.0)).accepted


def test_emergency_stop_is_cured_after_the_button_is_released() -> None:
    flight = turning()
    flight.arm.end_program()
    flight.arm.be(safety_mode=7, robot_mode=3)
    flight.fly(10)
    assert flight.state.emergency_stop
    assert "still pressed" in flight.ask(Unlock()).refused
    flight.arm.be(safety_mode=1)
    flight.fly(10)
    assert "not powered" in flight.state.blocked
    flight.arm.calls.clear()
    assert flight.ask(Unlock()).accepted
    assert flight.arm.calls == [
        "close_popups", "power_on", "release_brakes", "clear_command", "upload", "arm_watchdog",
    ]  # fmt: skip


def test_connecting_to_a_robot_in_a_protective_stop_waits_for_the_operator() -> None:
    flight = Flight()
    flight.arm.be(safety_mode=3)
    flight.fly(100)
    assert flight.arm.calls == []
    assert flight.ask(Unlock()).accepted
    assert flight.ask(WristSpeed(0.1, 1.0)).accepted


def test_program_that_ended_is_said_and_started_again_on_the_operators_word() -> None:
    flight = turning()
    flight.arm.end_program()
    flight.fly(50)
    assert "does not run" in flight.state.blocked
    assert "does not run" in flight.ask(WristSpeed(0.1, 1.0)).refused
    assert flight.ask(Unlock()).accepted


def test_recovery_gives_up_in_time_and_says_where_it_stands() -> None:
    flight = flying()
    flight.arm.end_program()
    flight.arm.upload = lambda: True  # type: ignore[method-assign]  # an upload that never takes
    begun_ns = flight.now_ns
    reply = flight.ask(Unlock())
    assert "within 30 s" in reply.refused
    assert "program state 1" in reply.refused
    assert flight.now_ns - begun_ns == pytest.approx(30e9, rel=0.01)


def test_old_data_is_not_believed() -> None:
    flight = turning()
    flight.arm.be(age_ns=300_000_000)
    flight.arm.calls.clear()
    flight.fly(10)
    assert flight.arm.calls == [], "without a kick the robot's watchdog stops it"
    assert "nothing new for 0.30 s" in flight.ask(WristSpeed(0.1, 1.0)).refused
    flight.arm.be(age_ns=0)
    flight.fly(10)
    assert flight.state.blocked, "what came back is not trusted by itself"


def test_disconnecting_stops_first() -> None:
    flight = turning()
    assert flight.ask(Disconnect()).accepted
    assert not flight.pilot.at_rest
    flight.fly_until(lambda _state: flight.pilot.at_rest)
    assert flight.wrist_speed == 0


class AnyFlight(RuleBasedStateMachine):
    """Whatever happens in whatever order: commands within the limits, and no motion that was not asked for just now."""

    def __init__(self) -> None:
        super().__init__()
        self.flight = Flight()
        self.allowed_until_ns = 0

    @initialize()
    def start(self) -> None:
        self.fly(5)

    @rule(speed=st.floats(-5, 5), acceleration=st.floats(1e-3, 100))
    def turn(self, speed: float, acceleration: float) -> None:
        if self.flight.ask(WristSpeed(speed, acceleration)).accepted:
            self.allowed_until_ns = self.flight.now_ns + 700_000_000

    @rule()
    def enable(self) -> None:
        self.flight.ask(Enable())

    @rule()
    def stop(self) -> None:
        self.flight.ask(Stop(4.0))

    @rule()
    def unlock(self) -> None:
        if self.flight.arm.reading.safety_mode != 7:
            self.flight.ask(Unlock())

    @rule(cycles=st.integers(1, 120), daemon_alive=st.booleans())
    def fly(self, cycles: int, daemon_alive: bool = True) -> None:
        for _ in range(cycles):
            self.flight.fly(1, daemon_alive=daemon_alive)
            self.moves_only_as_asked()

    @rule()
    def protective_stop(self) -> None:
        arm = self.flight.arm
        arm.target, arm.acceleration = 0.0, 20.0
        arm.be(safety_mode=3, runtime_state=4 if arm.reading.runtime_state == 2 else 1)

    @rule()
    def program_ends(self) -> None:
        self.flight.arm.end_program()

    @precondition(lambda self: not self.flight.arm.reading.wrench[0])
    @rule(force_n=st.floats(0, 100))
    def push(self, force_n: float) -> None:
        self.flight.arm.be(wrench=(force_n, 0.0, 0.0, 0.0, 0.0, 0.0))

    @rule()
    def let_go(self) -> None:
        self.flight.arm.be(wrench=(0.0,) * 6)

    @invariant()
    def moves_only_as_asked(self) -> None:
        arm = self.flight.arm
        assert abs(arm.target) <= LIMITS.wrist_speed_rad_per_s.inner
        assert abs(arm.reading.wrist_rad) <= 1.9 + 1e-6
        if self.flight.now_ns > self.allowed_until_ns:
            assert arm.reading.qd_rad_per_s[5] == 0, "it moves, and nobody asked"


AnyFlight.TestCase.settings = hypothesis_settings(max_examples=60, stateful_step_count=25, deadline=None)
TestAnyFlight = AnyFlight.TestCase


def test_reading_is_part_of_the_state() -> None:
    flight = flying()
    for field in dataclasses.fields(Reading):
        assert getattr(flight.state, field.name) == getattr(flight.arm.reading, field.name)
