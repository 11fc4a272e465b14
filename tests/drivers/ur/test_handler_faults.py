"""Stops, faults, a robot that does not follow, and recovery."""

import pytest

from shearloop.drivers.ur.messages import Disconnect, Enable, RobotLostError, Stop, Unlock, WristSpeed
from tests.drivers.ur.flight import SETTINGS, Flight, flying, moving, turning


@pytest.mark.parametrize("command", [WristSpeed(0.1, 1.0), Stop(4.0)])
def test_robot_that_rejects_a_command_is_left_to_its_watchdog(command):
    flight = turning()
    flight.arm.accepts = False
    assert "does not answer" in flight.ask(command).refusal
    flight.arm.calls.clear()
    flight.fly(50)
    assert flight.arm.calls == []
    assert (flight.wrist_speed, flight.arm.reading.program_running) == (0, False)
    flight.arm.accepts = True
    assert "unlock" in flight.ask(Enable()).refusal.lower()
    assert flight.ask(Unlock()).accepted
    assert flight.ask(WristSpeed(0.1, 1.0)).accepted


def test_linear_move_that_does_not_stop_is_left_to_the_watchdog():
    flight = moving(3)
    flight.arm.stops_moves = False
    assert flight.ask(Stop(4.0)).accepted
    flight.fly_until(lambda state: "did not come to rest" in state.blocked, 200)
    flight.fly(20)
    assert not flight.arm.reading.program_running


def test_linear_move_that_rejects_its_stop_is_left_to_the_watchdog():
    flight = moving(3)
    flight.arm.accepts = False
    flight.arm.stops_moves = False
    flight.fly(60, daemon_alive=False)
    assert not flight.arm.reading.program_running
    assert "silent" in flight.state.end_reason


def test_noise_of_a_standing_arm_is_rest_and_one_slow_sample_is_not():
    flight = turning()
    assert flight.ask(Stop(4.0)).accepted
    flight.fly_until(lambda state: abs(state.qd_rad_per_s[5]) < 0.2)
    turning_on = flight.wrist_speed
    flight.arm.be(qd_rad_per_s=(0.0,) * 6)
    flight.handler.tick(flight.arm.reading, flight.now_ns)
    assert flight.state.motion == "stopping", "one sample decides nothing"
    flight.arm.be(qd_rad_per_s=(0.0, 0.0, 0.0, 0.0, 0.0, turning_on))
    flight.fly_until(lambda state: state.rests)
    # As a real arm reports it at rest.
    for joint in (0.003, -0.003) * 3:
        flight.arm.be(qd_rad_per_s=(joint,) * 6)
        flight.handler.tick(flight.arm.reading, flight.now_ns)
    assert flight.state.motion == "idle"


def test_arm_that_moves_without_a_command_is_left_to_the_watchdog():
    flight = flying()
    flight.arm.target = 0.1
    flight.fly(20)
    assert flight.state.motion == "idle"
    state = flight.fly_until(lambda state: bool(state.blocked), 30)
    assert "without a command" in state.blocked
    flight.fly(30)
    assert flight.wrist_speed == 0
    assert "unlock" in flight.ask(WristSpeed(0.1, 1.0)).refusal.lower()


def test_resumed_program_does_not_move_and_gets_no_heartbeats():
    flight = turning()
    flight.arm.protective_stop()
    flight.fly(1)
    flight.arm.be_resumed_at_the_pendant()
    assert flight.arm.target == 0
    flight.arm.calls.clear()
    flight.fly(1)
    assert flight.state.blocked.startswith("A program runs on the robot that someone else started or resumed")
    assert "someone else" in flight.ask(Enable()).refusal
    flight.fly(40)
    assert flight.arm.calls == []
    assert flight.wrist_speed == 0
    assert not flight.arm.reading.program_running
    assert flight.ask(Unlock()).accepted


def test_program_left_behind_ends_before_ours_starts():
    flight = Flight()
    flight.arm.be(runtime_state=2)
    flight.fly(60)
    flight.arm.end_program()
    flight.fly(5)
    assert flight.arm.calls[:3] == ["clear_command", "upload", "arm_watchdog"]
    assert flight.ask(Enable()).accepted


def test_foreign_program_is_stopped_only_on_unlock():
    """A program of a lost worker would have ended by its watchdog."""
    flight = Flight()
    flight.arm.be(runtime_state=2)
    flight.fly(500)
    for command in (WristSpeed(0.1, 1.0), Enable()):
        assert "someone else" in flight.ask(command).refusal
    flight.arm.be(runtime_state=4)
    flight.fly(50)
    assert flight.arm.calls == []
    assert flight.ask(Unlock()).accepted
    assert flight.arm.calls[:4] == ["close popup", "stop", "clear_command", "upload"]


@pytest.mark.parametrize("begin", [Flight, turning], ids=["found", "ours"])
def test_paused_program_is_reported_and_stopped_only_on_unlock(begin):
    flight = begin()
    flight.arm.be(safety_mode=3, runtime_state=4)
    flight.arm.target = 0.0
    flight.fly(300)
    assert "Protective stop" in flight.state.blocked
    assert not flight.state.awaits_enable
    # Cleared at the pendant.
    flight.arm.be(safety_mode=1)
    flight.arm.calls.clear()
    flight.fly(300)
    assert "is paused" in flight.state.blocked
    assert "unlock, which stops it" in flight.state.blocked
    assert not flight.ask(Enable()).accepted
    assert flight.arm.calls == []
    assert flight.ask(Unlock()).accepted
    assert "stop" in flight.arm.calls
    assert not flight.state.blocked


def test_hard_limit_stops_until_enabled_again():
    flight = turning()
    flight.arm.be(wrench=(0.0, 0.0, 0.0, 0.0, 0.0, 6.5))
    flight.fly(1)
    assert flight.state.motion == "stopping"
    flight.fly_until(lambda state: state.motion == "idle")
    assert "Torque is 6.50 N m" in flight.ask(Enable()).refusal
    flight.arm.be(wrench=(0.0,) * 6)
    flight.fly(50)
    assert "Torque is 6.50 N m" in flight.ask(WristSpeed(0.1, 1.0)).refusal
    assert flight.ask(Enable()).accepted
    assert flight.ask(WristSpeed(0.1, 1.0)).accepted


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"speed_slider": 0.5}, "The speed slider is at 50 %"),
        ({"limiter_scaling": 0.8}, "The controller slows every motion to 80 %"),
    ],
)
def test_factor_on_speeds_prevents_and_ends_motion(changes, said):
    """It is a factor on the control loop's gain."""
    flight = turning()
    flight.arm.be(**changes)
    flight.fly(1)
    assert flight.state.motion == "stopping"
    assert said in flight.state.end_reason
    flight.fly_until(lambda state: state.motion == "idle")
    assert said in flight.ask(Enable()).refusal
    flight.arm.be(speed_slider=1.0, limiter_scaling=1.0)
    flight.fly(1)
    assert said in flight.ask(WristSpeed(0.1, 1.0)).refusal, "a stop stays a stop"
    assert flight.ask(Enable()).accepted
    assert flight.ask(WristSpeed(0.1, 1.0)).accepted


def test_protective_stop_is_unlocked_only_by_the_operator():
    flight = turning()
    flight.arm.be(safety_mode=3, runtime_state=4)
    flight.arm.target = 0.0
    flight.arm.calls.clear()
    flight.fly(100)
    assert flight.state.protective_stop
    assert flight.state.blocked.startswith("Protective stop")
    assert flight.arm.calls == [], "nothing is unlocked"
    assert "Protective stop" in flight.ask(Enable()).refusal

    flight.arm.unlockable = False
    assert "first 5 s" in flight.ask(Unlock()).refusal
    flight.arm.unlockable = True
    flight.arm.calls.clear()
    assert flight.ask(Unlock()).accepted
    assert flight.arm.calls == [
        "unlock protective stop", "close popup", "stop", "clear_command", "upload", "arm_watchdog",
    ]  # fmt: skip
    flight.fly(100)
    assert flight.wrist_speed == 0, "the speed from before the stop is not taken up again"
    assert flight.ask(WristSpeed(0.1, 1.0)).accepted


def test_recovery_from_an_emergency_stop_needs_the_button_released():
    flight = turning()
    flight.arm.end_program()
    flight.arm.be(safety_mode=7, robot_mode=3)
    flight.fly(10)
    assert flight.state.emergency_stop
    assert "opens and closes its fingers" in flight.state.blocked
    assert "still pressed" in flight.ask(Unlock()).refusal
    flight.arm.be(safety_mode=1)
    flight.fly(10)
    assert "not powered" in flight.state.blocked
    flight.arm.calls.clear()
    assert flight.ask(Unlock()).accepted
    assert flight.arm.calls == [
        "close popup", "power on", "brake release", "clear_command", "upload", "arm_watchdog",
    ]  # fmt: skip


def test_connecting_to_a_robot_in_a_protective_stop_waits_for_the_operator():
    flight = Flight()
    flight.arm.be(safety_mode=3)
    flight.fly(100)
    assert flight.arm.calls == []
    assert flight.ask(Unlock()).accepted
    assert flight.ask(WristSpeed(0.1, 1.0)).accepted


def test_ended_program_is_reported_and_restarted_on_unlock():
    flight = turning()
    flight.arm.end_program()
    flight.fly(50)
    assert "does not run" in flight.state.blocked
    assert "does not run" in flight.ask(WristSpeed(0.1, 1.0)).refusal
    assert flight.ask(Unlock()).accepted


def test_recovery_times_out_and_reports_the_modes():
    flight = flying()
    flight.arm.end_program()
    flight.arm.be(robot_mode=3)
    flight.arm.ignores["power on"] = "The controller says nothing"
    begun_ns = flight.now_ns
    reply = flight.ask(Unlock())
    assert "within 30 s" in reply.refusal
    assert "program: stopped" in reply.refusal
    assert flight.now_ns - begun_ns == pytest.approx(30e9, rel=0.01)


def test_old_samples_block_motion():
    flight = turning()
    flight.arm.be(age_ns=300_000_000)
    flight.arm.calls.clear()
    flight.fly(10)
    assert flight.arm.calls == [], "without a send_heartbeat the robot's watchdog stops it"
    assert "is 0.30 s old" in flight.ask(WristSpeed(0.1, 1.0)).refusal
    flight.arm.be(age_ns=0)
    flight.fly(40)
    assert flight.state.blocked, "motion stays blocked after the samples return"
    assert flight.wrist_speed == 0, "the program must not be kept going"


@pytest.mark.parametrize("begin", [turning, lambda: moving(3)], ids=["wrist", "line"])
def test_stop_that_meets_an_old_sample_stops(begin):
    """The sample before it and the one after it are fit."""
    flight = begin()
    flight.arm.be(age_ns=260_000_000)
    assert "stops by itself" in flight.ask(Stop(4.0)).refusal
    flight.arm.be(age_ns=0)
    flight.arm.calls.clear()
    flight.fly(30)
    assert flight.arm.calls == []
    assert not flight.arm.reading.program_running


def test_old_samples_at_rest_need_only_an_enable():
    flight = flying()
    flight.arm.be(age_ns=300_000_000)
    flight.fly(10)
    flight.arm.be(age_ns=0)
    flight.fly(10)
    assert "old: check its cable" in flight.ask(WristSpeed(0.1, 1.0)).refusal
    assert flight.ask(Enable()).accepted
    assert flight.ask(WristSpeed(0.1, 1.0)).accepted


@pytest.mark.parametrize("command", [Disconnect(), Stop(4.0)])
def test_unlocking_is_ended_by_disconnecting_and_by_a_stop(command):
    flight = flying()
    flight.arm.be(robot_mode=3, runtime_state=1)
    flight.fly(1)
    flight.arm.calls.clear()
    assert flight.handler.request(98, Unlock(), flight.arm.reading, flight.now_ns) is None
    flight.handler.request(99, command, flight.arm.reading, flight.now_ns)
    flight.fly(300)
    assert flight.arm.calls == []
    assert not flight.handler.recovering
    assert not flight.decided[98].accepted


def test_unlocking_with_old_samples_times_out():
    flight = turning()
    flight.arm.protective_stop()
    flight.fly(10)
    # As of a network that has become slow for good: not so old that the connection counts as lost.
    flight.arm.be(age_ns=400_000_000)
    since_ns = flight.now_ns
    assert "did not get ready" in flight.ask(Unlock()).refusal
    assert flight.now_ns - since_ns < (SETTINGS.recover_timeout_s + 1.0) * 1e9
    flight.arm.be(age_ns=0)
    flight.arm.calls.clear()
    flight.fly(100)
    assert flight.arm.calls == [], "nothing is unlocked so long after the operator's word"


def test_worker_whose_uploads_start_nothing_is_replaced():
    """A new one has new connections. A lost upload is sent once more before."""
    flight = flying()
    flight.arm.end_program()
    flight.arm.calls.clear()
    flight.arm.upload = lambda **_: flight.arm.calls.append("upload")
    begun_ns = flight.now_ns
    with pytest.raises(RobotLostError, match="does not play it") as lost:
        flight.ask(Unlock())
    assert lost.value.kind == "script"
    assert flight.arm.calls.count("upload") == 2
    assert flight.now_ns - begun_ns == pytest.approx(2e9, rel=0.02)


def test_slowly_starting_program_gets_heartbeats(monkeypatch):
    """The program arms its watchdog when it starts."""
    flight = Flight()
    upload = flight.arm.upload
    monkeypatch.setattr(flight.arm, "upload", lambda **_: flight.arm.calls.append("upload"))
    flight.fly(50)
    assert flight.arm.calls == ["clear_command", "upload", *["clear_command"] * 48]
    monkeypatch.setattr(flight.arm, "upload", upload)
    flight.arm.be(runtime_state=2)
    flight.fly(1)
    assert flight.arm.calls[-1] == "arm_watchdog"
