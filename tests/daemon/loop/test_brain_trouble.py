"""The brain when something is wrong: sensors, torques, the robot, a task; what holds the wrist and what stops it."""

from dataclasses import replace
from typing import Any

import pytest

from shearloop.daemon.control.experiment_schema import ExperimentFile
from shearloop.daemon.control.safety import FaultCode, Response
from shearloop.daemon.control.step_runner import ExperimentPhase
from tests.daemon.loop.rig import EIT, GRIP, TICK_S, Rig, new_loop, phase, started


def test_a_silent_board_holds_the_wrist_and_then_stops_it() -> None:
    rig = started(Rig(new_loop()), GRIP, {"do": "twist", "angles_rad": [0.5], "speed_rad_per_s": 0.01, "hold_s": 60})
    rig.run(5)
    assert rig.speed > 0
    rig.silent.add("right")
    rig.run(2.5 * EIT.period_s + 0.7)
    assert (rig.speed, rig.control_loop.status.phase) == (0.0, "held")
    assert "Check the sensor's cable" in rig.control_loop.status.decision.reasons[0]
    rig.run(6)
    assert phase(rig) is ExperimentPhase.STOPPED
    assert rig.orders.stop
    assert not rig.orders.release, "the grip is kept"


def test_a_board_that_speaks_again_in_time_lets_the_twist_go_on() -> None:
    rig = started(Rig(new_loop()), GRIP, {"do": "twist", "angles_rad": [0.1], "speed_rad_per_s": 0.02, "hold_s": 1})
    rig.run(4)
    rig.silent.add("right")
    rig.run(3)
    assert rig.control_loop.status.phase == "held"
    rig.silent.clear()
    rig.run(30)
    assert phase(rig) is ExperimentPhase.DONE


def test_the_torque_limit_stops_and_releases_once() -> None:
    rig = started(Rig(new_loop(), noise_nm=0.0), GRIP, {"do": "twist", "angles_rad": [1.0]}, limits={"torque_nm": 0.1})
    releases = 0
    for _ in range(2000):
        rig.step()
        releases += rig.orders.release
    assert releases == 1
    assert phase(rig) is ExperimentPhase.STOPPED
    assert rig.force_n == 0.0
    assert max(rig.true_nm) < 0.1 + 0.3 * 0.2 * 0.2, "no farther than one reading of the load cell"


def test_a_protective_stop_ends_the_experiment_until_it_is_acknowledged() -> None:
    rig = started(Rig(new_loop()), GRIP, {"do": "wait", "wait_s": 60})
    rig.run(2)
    rig.arm = replace(rig.arm, protective_stop=True)
    rig.step()
    assert phase(rig) is ExperimentPhase.STOPPED
    rig.arm = replace(rig.arm, protective_stop=False)
    rig.run(1)
    file = ExperimentFile.model_validate({"name": "again", "steps": [{"do": "wait", "wait_s": 1}]})
    refused = rig.control_loop.start(file, rig.t_ns)
    assert refused is not None
    assert "protective stop" in refused
    rig.control_loop.acknowledge()
    assert rig.control_loop.start(file, rig.t_ns) is None


@pytest.mark.parametrize(
    ("sense", "event"),
    [
        ({"protective_stop": True}, FaultCode.PROTECTIVE_STOP),
        ({"emergency_stop": True}, FaultCode.EMERGENCY_STOP),
        ({"blocked": "the robot's process was started again"}, FaultCode.ROBOT_BLOCKED),
    ],
)
def test_what_the_robot_reports_ends_a_running_experiment_at_once(sense: dict[str, Any], event: FaultCode) -> None:
    rig = started(Rig(new_loop()), GRIP, {"do": "twist", "angles_rad": [0.3]})
    rig.run(2)
    rig.arm = replace(rig.arm, **sense)
    rig.step()
    assert rig.orders.stop
    assert rig.speed == 0.0
    assert event in {trouble.code for trouble in rig.control_loop.status.decision.faults}


def test_a_supervising_sensor_that_is_gone_holds_the_wrist_at_once_and_says_which() -> None:
    rig = started(Rig(new_loop()), GRIP, {"do": "twist", "angles_rad": [0.5], "speed_rad_per_s": 0.01, "hold_s": 60})
    rig.run(5)
    rig.control_loop.inputs.lost["load_cell"] = "/dev/ttyUSB3 was unplugged."
    rig.step()
    assert rig.speed == 0.0
    assert "load_cell is gone: /dev/ttyUSB3 was unplugged." in rig.control_loop.status.decision.reasons[0]
    rig.control_loop.inputs.lost.clear()
    rig.run(1)
    assert rig.speed > 0.0, "it goes on by itself"


def test_a_task_that_died_stops_the_wrist_and_says_of_what() -> None:
    rig = started(Rig(new_loop()), GRIP, {"do": "twist", "angles_rad": [0.5], "speed_rad_per_s": 0.01, "hold_s": 60})
    rig.run(5)
    rig.control_loop.inputs.died = {"right.estimator": "ValueError: no number"}
    rig.step()
    assert phase(rig) is ExperimentPhase.STOPPED
    assert "right.estimator: ValueError: no number" in rig.control_loop.status.decision.reasons[0]


def test_a_single_torque_that_disagrees_holds_until_the_next_one_and_stops_nothing() -> None:
    """Of the slower sensor: what it says stands until it says something else."""
    rig = started(Rig(new_loop(), noise_nm=0.0), GRIP, {"do": "twist", "angles_rad": [0.5], "speed_rad_per_s": 0.01})
    rig.run(5)
    while (spiked := rig.control_loop.inputs.torques["right"]).t_ns != rig.t_ns:
        rig.step()
    assert spiked.torque_nm is not None
    spike = replace(spiked, torque_nm=spiked.torque_nm + 0.07, t_mid_ns=spiked.t_mid_ns + 1)
    rig.control_loop.on_torque(spike)
    held = 0
    for _ in range(300):
        rig.step()
        assert phase(rig) is ExperimentPhase.RUNNING
        if rig.control_loop.status.decision.response is Response.HOLD:
            held += 1
            assert rig.speed == 0.0
    assert held * TICK_S == pytest.approx(EIT.period_s, abs=2 * TICK_S)
    assert rig.speed > 0.0


def test_a_wrist_angle_that_is_not_a_number_turns_nothing() -> None:
    rig = started(Rig(new_loop()), GRIP, {"do": "twist", "angles_rad": [0.5], "speed_rad_per_s": 0.01, "hold_s": 60})
    rig.run(5)
    assert rig.speed > 0
    rig.wrist_rad = float("nan")
    rig._sense(0.0)
