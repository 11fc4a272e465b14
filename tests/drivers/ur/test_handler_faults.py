"""Stops, faults, a robot that does not follow, and recovery."""

from itertools import cycle

import pytest

from shearloop.drivers.ur.messages import Disconnect, Enable, RobotLostError, Stop, Unlock, WristSpeed
from tests.drivers.ur.handler_bench import SETTINGS, HandlerBench, enabled, moving, turning


@pytest.mark.parametrize("command", [WristSpeed(0.1, 1.0), Stop(4.0)])
def test_robot_that_rejects_a_command_is_left_to_its_watchdog(command):
    bench = turning()
    bench.arm.accepts = False
    assert "does not answer" in bench.ask(command).refusal
    bench.arm.calls.clear()
    bench.run(50)
    assert bench.arm.calls == []
    assert (bench.wrist_speed, bench.arm.reading.program_running) == (0, False)
    bench.arm.accepts = True
    assert "unlock" in bench.ask(Enable()).refusal.lower()
    assert bench.ask(Unlock()).accepted
    assert bench.ask(WristSpeed(0.1, 1.0)).accepted


def test_linear_move_that_does_not_stop_is_left_to_the_watchdog():
    bench = moving(3)
    bench.arm.stops_moves = False
    assert bench.ask(Stop(4.0)).accepted
    bench.run_until(lambda state: "did not come to rest" in state.blocked, 200)
    bench.run(20)
    assert not bench.arm.reading.program_running


def test_linear_move_that_rejects_its_stop_is_left_to_the_watchdog():
    bench = moving(3)
    bench.arm.accepts = False
    bench.arm.stops_moves = False
    bench.run(60, daemon_alive=False)
    assert not bench.arm.reading.program_running
    assert "silent" in bench.state.end_reason


def test_noise_of_a_standing_arm_is_rest_and_one_slow_sample_is_not():
    bench = turning()
    assert bench.ask(Stop(4.0)).accepted
    bench.run_until(lambda state: abs(state.qd_rad_per_s[5]) < 0.2)
    turning_on = bench.wrist_speed
    bench.arm.be(qd_rad_per_s=(0.0,) * 6)
    bench.tick()
    assert bench.state.motion == "stopping", "one sample decides nothing"
    bench.arm.be(qd_rad_per_s=(0.0, 0.0, 0.0, 0.0, 0.0, turning_on))
    bench.run_until(lambda state: state.rests)
    # As a real arm reports it at rest.
    for joint in (0.003, -0.003) * 3:
        bench.arm.be(qd_rad_per_s=(joint,) * 6)
        bench.tick()
    assert bench.state.motion == "idle"


def test_arm_that_moves_without_a_command_is_left_to_the_watchdog():
    bench = enabled()
    bench.arm.target = 0.1
    bench.run(20)
    assert bench.state.motion == "idle"
    state = bench.run_until(lambda state: bool(state.blocked), 30)
    assert "without a command" in state.blocked
    bench.run(30)
    assert bench.wrist_speed == 0
    assert "unlock" in bench.ask(WristSpeed(0.1, 1.0)).refusal.lower()


def test_resumed_program_does_not_move_and_gets_no_heartbeats():
    bench = turning()
    bench.arm.protective_stop()
    bench.run(1)
    bench.arm.be_resumed_at_the_pendant()
    assert bench.arm.target == 0
    bench.arm.calls.clear()
    bench.run(1)
    assert bench.state.blocked.startswith("A program runs on the robot that someone else started or resumed")
    assert "someone else" in bench.ask(Enable()).refusal
    bench.run(40)
    assert bench.arm.calls == []
    assert bench.wrist_speed == 0
    assert not bench.arm.reading.program_running
    assert bench.ask(Unlock()).accepted


def test_program_left_behind_ends_before_ours_starts():
    bench = HandlerBench()
    bench.arm.be(runtime_state=2)
    bench.run(60)
    bench.arm.end_program()
    bench.run(5)
    assert bench.arm.calls[:3] == ["clear_command", "upload", "arm_watchdog"]
    assert bench.ask(Enable()).accepted


def test_foreign_program_is_stopped_only_on_unlock():
    """A program of a lost worker would have ended by its watchdog."""
    bench = HandlerBench()
    bench.arm.be(runtime_state=2)
    bench.run(500)
    for command in (WristSpeed(0.1, 1.0), Enable()):
        assert "someone else" in bench.ask(command).refusal
    bench.arm.be(runtime_state=4)
    bench.run(50)
    assert bench.arm.calls == []
    assert bench.ask(Unlock()).accepted
    assert bench.arm.calls[:4] == ["close popup", "stop", "clear_command", "upload"]


@pytest.mark.parametrize("begin", [HandlerBench, turning], ids=["found", "ours"])
def test_paused_program_is_reported_and_stopped_only_on_unlock(begin):
    bench = begin()
    bench.arm.be(safety_mode=3, runtime_state=4)
    bench.arm.target = 0.0
    bench.run(300)
    assert "Protective stop" in bench.state.blocked
    assert not bench.state.awaits_enable
    # Cleared at the pendant.
    bench.arm.be(safety_mode=1)
    bench.arm.calls.clear()
    bench.run(300)
    assert "is paused" in bench.state.blocked
    assert "unlock, which stops it" in bench.state.blocked
    assert not bench.ask(Enable()).accepted
    assert bench.arm.calls == []
    assert bench.ask(Unlock()).accepted
    assert "stop" in bench.arm.calls
    assert not bench.state.blocked


def test_hard_limit_stops_until_enabled_again():
    bench = turning()
    bench.arm.be(wrench=(0.0, 0.0, 0.0, 0.0, 0.0, 6.5))
    bench.run(1)
    assert bench.state.motion == "stopping"
    bench.run_until(lambda state: state.motion == "idle")
    assert "Torque is 6.50 N m" in bench.ask(Enable()).refusal
    bench.arm.be(wrench=(0.0,) * 6)
    bench.run(50)
    assert "Torque is 6.50 N m" in bench.ask(WristSpeed(0.1, 1.0)).refusal
    assert bench.ask(Enable()).accepted
    assert bench.ask(WristSpeed(0.1, 1.0)).accepted


@pytest.mark.parametrize(
    ("changes", "late"),
    [
        ({"age_ns": 300_000_000}, True),
        ({"connected": False}, True),
        ({"runtime_state": 1}, True),
        ({"wrench": (0.0, 0.0, 0.0, 0.0, 0.0, 6.5)}, False),
        ({"speed_slider": 0.5}, False),
        ({"safety_mode": 3}, False),
        ({"safety_mode": 5, "runtime_state": 1}, False),
        ({"robot_mode": 3, "runtime_state": 1}, False),
        ({"runtime_state": 4}, False),
    ],
)
def test_only_what_late_messages_can_block_is_said_to_be_late(changes, late):
    bench = turning()
    bench.arm.be(**changes)
    bench.run(10)
    assert (bench.state.blocked != "", bench.state.late) == (True, late)


def test_a_limit_stays_a_limit_after_the_arm_has_come_back_within_it():
    bench = turning()
    for changes, late in (({"wrench": (0.0, 0.0, 0.0, 0.0, 0.0, 6.5)}, False), ({"age_ns": 300_000_000}, True)):
        bench.arm.be(**changes)
        bench.run(10)
        bench.arm.be(wrench=(0.0,) * 6, age_ns=0)
        bench.run(2)
        assert (bench.state.blocked != "", bench.state.late) == (True, late)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"speed_slider": 0.5}, "The speed slider is at 50 %"),
        ({"limiter_scaling": 0.8}, "The controller slows every motion to 80 %"),
    ],
)
def test_factor_on_speeds_prevents_and_ends_motion(changes, said):
    """It is a factor on the control loop's gain."""
    bench = turning()
    bench.arm.be(**changes)
    bench.run(1)
    assert bench.state.motion == "stopping"
    assert said in bench.state.end_reason
    bench.run_until(lambda state: state.motion == "idle")
    assert said in bench.ask(Enable()).refusal
    bench.arm.be(speed_slider=1.0, limiter_scaling=1.0)
    bench.run(1)
    assert said in bench.ask(WristSpeed(0.1, 1.0)).refusal, "a stop stays a stop"
    assert bench.ask(Enable()).accepted
    assert bench.ask(WristSpeed(0.1, 1.0)).accepted


def test_protective_stop_is_unlocked_only_by_the_operator():
    bench = turning()
    bench.arm.be(safety_mode=3, runtime_state=4)
    bench.arm.target = 0.0
    bench.arm.calls.clear()
    bench.run(100)
    assert bench.state.protective_stop
    assert bench.state.blocked.startswith("Protective stop")
    assert bench.arm.calls == [], "nothing is unlocked"
    assert "Protective stop" in bench.ask(Enable()).refusal

    bench.arm.unlockable = False
    assert "first 5 s" in bench.ask(Unlock()).refusal
    bench.arm.unlockable = True
    bench.arm.calls.clear()
    assert bench.ask(Unlock()).accepted
    assert bench.arm.calls == [
        "unlock protective stop", "close popup", "stop", "clear_command", "upload", "arm_watchdog",
    ]  # fmt: skip
    bench.run(100)
    assert bench.wrist_speed == 0, "the speed from before the stop is not taken up again"
    assert bench.ask(WristSpeed(0.1, 1.0)).accepted


def test_recovery_from_an_emergency_stop_needs_the_button_released():
    bench = turning()
    bench.arm.end_program()
    bench.arm.be(safety_mode=7, robot_mode=3)
    bench.run(10)
    assert bench.state.emergency_stop
    assert "the next release opens and closes its fingers once" in bench.state.blocked
    assert "still pressed" in bench.ask(Unlock()).refusal
    bench.arm.be(safety_mode=1)
    bench.run(10)
    assert "not powered" in bench.state.blocked
    bench.arm.calls.clear()
    assert bench.ask(Unlock()).accepted
    assert bench.arm.calls == [
        "close popup", "power on", "brake release", "clear_command", "upload", "arm_watchdog",
    ]  # fmt: skip


def test_connecting_to_a_robot_in_a_protective_stop_waits_for_the_operator():
    bench = HandlerBench()
    bench.arm.be(safety_mode=3)
    bench.run(100)
    assert bench.arm.calls == []
    assert bench.ask(Unlock()).accepted
    assert bench.ask(WristSpeed(0.1, 1.0)).accepted


def test_ended_program_is_reported_and_restarted_on_unlock():
    bench = turning()
    bench.arm.end_program()
    bench.run(50)
    assert "does not run" in bench.state.blocked
    assert "does not run" in bench.ask(WristSpeed(0.1, 1.0)).refusal
    assert bench.ask(Unlock()).accepted


def test_recovery_times_out_and_reports_the_modes():
    bench = enabled()
    bench.arm.end_program()
    bench.arm.be(robot_mode=3)
    bench.arm.ignores["power on"] = "The controller says nothing"
    begun_ns = bench.now_ns
    reply = bench.ask(Unlock())
    assert "within 30 s" in reply.refusal
    assert "program: stopped" in reply.refusal
    assert bench.now_ns - begun_ns == pytest.approx(30e9, rel=0.01)


def test_old_samples_block_motion():
    bench = turning()
    bench.arm.be(age_ns=300_000_000)
    bench.arm.calls.clear()
    bench.run(10)
    assert bench.arm.calls == [], "without a send_heartbeat the robot's watchdog stops it"
    assert "is 0.30 s old" in bench.ask(WristSpeed(0.1, 1.0)).refusal
    bench.arm.be(age_ns=0)
    bench.run(40)
    assert bench.state.blocked, "motion stays blocked after the samples return"
    assert bench.wrist_speed == 0, "the program must not be kept going"


@pytest.mark.parametrize("begin", [turning, lambda: moving(3)], ids=["wrist", "line"])
def test_stop_that_meets_an_old_sample_stops(begin):
    """The sample before it and the one after it are fit."""
    bench = begin()
    bench.arm.be(age_ns=260_000_000)
    assert "stops by itself" in bench.ask(Stop(4.0)).refusal
    bench.arm.be(age_ns=0)
    bench.arm.calls.clear()
    bench.run(30)
    assert bench.arm.calls == []
    assert not bench.arm.reading.program_running


def test_old_samples_at_rest_need_only_an_enable():
    bench = enabled()
    bench.arm.be(age_ns=300_000_000)
    bench.run(10)
    bench.arm.be(age_ns=0)
    bench.run(10)
    assert "old: check its cable" in bench.ask(WristSpeed(0.1, 1.0)).refusal
    assert bench.ask(Enable()).accepted
    assert bench.ask(WristSpeed(0.1, 1.0)).accepted


@pytest.mark.parametrize("command", [Disconnect(), Stop(4.0)])
def test_unlocking_is_ended_by_disconnecting_and_by_a_stop(command):
    bench = enabled()
    bench.arm.be(robot_mode=3, runtime_state=1)
    bench.run(1)
    bench.arm.calls.clear()
    assert bench.handler.request(98, Unlock(), bench.now_ns) is None
    bench.handler.request(99, command, bench.now_ns)
    bench.run(300)
    assert bench.arm.calls == []
    assert not bench.handler.recovering
    assert not bench.decided[98].accepted


def test_unlocking_with_old_samples_times_out():
    bench = turning()
    bench.arm.protective_stop()
    bench.run(10)
    # As of a network that has become slow for good: not so old that the connection counts as lost.
    bench.arm.be(age_ns=400_000_000)
    since_ns = bench.now_ns
    assert "did not get ready" in bench.ask(Unlock()).refusal
    assert bench.now_ns - since_ns < (SETTINGS.recover_timeout_s + 1.0) * 1e9
    bench.arm.be(age_ns=0)
    bench.arm.calls.clear()
    bench.run(100)
    assert bench.arm.calls == [], "nothing is unlocked so long after the operator's word"


def test_an_arm_that_goes_to_and_fro_between_two_modes_is_given_up():
    """Each further `power on` would go on without end."""
    bench = turning()
    bench.arm.be(robot_mode=3)
    bench.run(10)
    since_ns, modes = bench.now_ns, cycle((3, 4))

    def power_on(*_: str) -> str:
        bench.arm.be(robot_mode=next(modes))
        return ""

    bench.arm.ask_dashboard = power_on
    assert "did not get ready" in bench.ask(Unlock()).refusal
    assert bench.now_ns - since_ns < 3 * SETTINGS.recover_timeout_s * 1e9


def test_worker_whose_uploads_start_nothing_is_replaced():
    """A new one has new connections. A lost upload is sent once more before."""
    bench = enabled()
    bench.arm.end_program()
    bench.arm.calls.clear()
    bench.arm.upload = lambda **_: bench.arm.calls.append("upload")
    begun_ns = bench.now_ns
    with pytest.raises(RobotLostError, match="does not play it") as lost:
        bench.ask(Unlock())
    assert lost.value.kind == "script"
    assert bench.arm.calls.count("upload") == 2
    assert bench.now_ns - begun_ns == pytest.approx(6e9, rel=0.02)


def test_slowly_starting_program_gets_heartbeats(monkeypatch):
    """The program arms its watchdog when it starts."""
    bench = HandlerBench()
    upload = bench.arm.upload
    monkeypatch.setattr(bench.arm, "upload", lambda **_: bench.arm.calls.append("upload"))
    bench.run(50)
    assert bench.arm.calls == ["clear_command", "upload", *["clear_command"] * 48]
    monkeypatch.setattr(bench.arm, "upload", upload)
    bench.arm.be(runtime_state=2)
    bench.run(1)
    assert bench.arm.calls[-1] == "arm_watchdog"
