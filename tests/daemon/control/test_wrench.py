"""The mean of the robot's wrench: what it is known to, and where it begins anew."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from shearloop.daemon.control.wrench import WrenchMean, publish_every, wrench_source
from shearloop.drivers.ur.poses import tool_axis
from shearloop.drivers.ur.settings import GENERATIONS, WRENCH_STATES
from shearloop.emulators.ur_robot import Robot

RATE_HZ = 125.0
PERIOD_NS = 8_000_000


def state(number: int, torque_nm: float) -> Any:
    """Return what a mean takes of a state; `number` counts periods of the controller's clock."""
    return SimpleNamespace(measured_ns=number * PERIOD_NS, wrist_torque_nm=torque_nm)


def test_a_mean_is_of_the_window_and_of_the_middle_of_its_times():
    mean = WrenchMean(RATE_HZ)
    for number in range(WRENCH_STATES):
        assert not mean.known
        mean.add(state(number, float(number)))
    assert mean.known
    assert (mean.torque_nm, mean.t_mid_ns) == (7.5, 7.5 * PERIOD_NS)
    for number in range(WRENCH_STATES, 100):
        mean.add(state(number, float(number)))
    # 24 states, the last of which is number 99.
    assert (mean.torque_nm, mean.t_mid_ns) == (87.5, 87.5 * PERIOD_NS)


def test_a_state_that_is_repeated_counts_once():
    mean = WrenchMean(RATE_HZ)
    for _ in range(2):
        mean.add(state(0, 1.0))
    mean.add(state(1, 0.0))
    assert mean.torque_nm == 0.5


def test_with_a_third_of_the_states_a_mean_is_known_and_with_half_of_them_it_is_not():
    for every, known in ((1, True), (1.5, True), (2, False)):
        mean = WrenchMean(RATE_HZ)
        for number in range(60):
            mean.add(state(round(number * every), 0.1))
        assert mean.known is known


@pytest.mark.parametrize("rate_hz", [50.0, 125.0, 250.0, 500.0])
def test_a_mean_is_over_the_same_time_and_published_as_often_at_any_rate_of_states(rate_hz):
    assert 20.0 <= rate_hz / publish_every(rate_hz) <= 30.0
    mean = WrenchMean(rate_hz)
    for number in range(round(rate_hz)):
        t_ns = round(number * 1e9 / rate_hz)
        mean.add(SimpleNamespace(measured_ns=t_ns, wrist_torque_nm=number / rate_hz))
    assert mean.known
    # Of a ramp of 1 N·m a second: half the window, which at 50 states a second is for 24 of them.
    window_s = max(0.192, 24 / rate_hz)
    assert 1.0 - mean.torque_nm == pytest.approx(0.5 * window_s, abs=1.0 / rate_hz)
    assert wrench_source(rate_hz).window_s == pytest.approx(window_s)


def test_states_before_a_gap_belong_to_no_mean_after_it():
    mean = WrenchMean(RATE_HZ)
    for number in range(40):
        mean.add(state(number, 1.0))
    mean.add(state(70, 0.0))
    assert not mean.known
    assert mean.torque_nm == 0.0


@pytest.mark.parametrize("states", [1, WRENCH_STATES])
def test_a_mean_of_a_sensor_with_the_data_sheets_errors_is_known_as_said(states):
    robot = Robot()
    axis = np.array(tool_axis(tuple(robot.arm.pose)))
    torques_nm = []
    for _ in range(10_000):
        robot.arm.feel(0.008, robot.wrench_error)
        torques_nm.append(axis @ robot.arm.wrench[3:])
    means_nm = np.convolve(torques_nm, np.full(states, 1 / states), "valid")
    print(f"figures: {states} states: {means_nm.std():.4f} N·m, largest {np.abs(means_nm).max():.3f} N·m")
    known_nm = GENERATIONS["e-series"].noise_nm / np.sqrt(states)
    # Within three standard deviations, and one state always.
    assert np.mean(np.abs(means_nm) > known_nm) < 0.003
    assert np.abs(means_nm).max() > 0.5 * known_nm
