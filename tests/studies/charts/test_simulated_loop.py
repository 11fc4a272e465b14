"""The simulated plant, and the chart of the loop on it."""

import json

import numpy as np
import pytest

from shearloop.daemon.control.torque_controller import WristCommand
from shearloop.daemon.torques import TorqueSample
from shearloop.studies.charts.simulated_loop import (
    LOAD_CELL,
    PERIOD_S,
    Plant,
    SimulatedSensor,
    SimulatedTool,
    Trace,
    chart,
    nanoseconds,
    run,
)


class FixedSpeed:
    """Turns at one speed for a while, and keeps the measurements."""

    def __init__(self, speed: float, until_s: float) -> None:
        self.speed, self.until_ns = speed, nanoseconds(until_s)
        self.seen: list[tuple[float, int, int]] = []

    def measure(self, torque: TorqueSample) -> None:
        self.seen.append((torque.torque_nm, torque.t_mid_ns, torque.t_ns))

    def command(self, t_ns: int, wrist_angle_rad: float) -> WristCommand:  # noqa: ARG002
        return WristCommand(self.speed if t_ns < self.until_ns else 0.0)


def test_the_plant_measures_the_mean_of_its_window_and_reports_it_late():
    sensor = SimulatedSensor(period_s=0.5, transfer_s=0.1)
    tool = SimulatedTool(relaxing_share=0.0, actuation_s=0.0)
    loop = FixedSpeed(0.2, until_s=1e9)
    run(Plant(tool, sensor, np.random.default_rng(0)), loop, 6.0)
    assert len(loop.seen) >= 10
    for torque, mid_ns, now_ns in loop.seen:
        assert torque == pytest.approx(0.25 * 0.2 * mid_ns / 1e9, abs=1e-9)
        assert 0.35 <= (now_ns - mid_ns) / 1e9 <= 0.36


def test_the_plant_relaxes():
    tool = SimulatedTool(relaxing_share=0.1, relaxing_s=2.0)
    plant = Plant(tool, LOAD_CELL, np.random.default_rng(0))
    run(plant, FixedSpeed(0.5, until_s=0.8), 20.0)
    assert plant.torque_nm == pytest.approx(0.9 * 0.25 * plant.angle_rad, rel=1e-3)


@pytest.mark.parametrize(
    ("away", "held", "away_again", "held_again", "steps"),
    [(0, 130, 0, 0, 0), (10, 130, 0, 0, 10), (10, 120, 10, 130, 140), (0, 120, 10, 0, np.inf)],
)
def test_a_torque_is_back_when_it_stays_for_a_second(away, held, away_again, held_again, steps):
    torque_nm = np.repeat([0.0, 0.1, 0.0, 0.1], [away, held, away_again, held_again])
    trace = Trace(5.0 + PERIOD_S * np.arange(len(torque_nm)), torque_nm)
    assert trace.back_after_s(0.1) == pytest.approx(steps * PERIOD_S)


def test_the_chart_shows_that_the_torque_filter_brings_a_kicked_torque_back_sooner(tmp_path):
    paths = chart(tmp_path, seeds=3)
    assert [path.name for path in paths] == ["loop.json", "loop.svg", "loop.png"]
    found = json.loads(paths[0].read_text())
    assert list(found) == ["torque filter", "constant gain", "latest estimates alone"]
    with_filter, without, _ = (one["kick_back_s"] for one in found.values())
    # What is drawn before and after it is not counted.
    assert {tuple(one["time_in_band_of_s"]) for one in found.values()} == {(6.0, 15.0)}
    assert max(with_filter) <= 2.5
    assert max(with_filter) < min(without)
