"""The loop around the emulated skin, in virtual time: what the bench measures, held to what it has to be."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from shearloop.daemon.config import load_daemon_config
from shearloop.daemon.config_file import load_yaml_model
from shearloop.daemon.control.experiment import ExperimentPhase
from shearloop.daemon.control.experiment_schema import ExperimentFile, HoldTorqueStep
from shearloop.estimation.skin.calibration import SkinCalibration, load_calibration
from shearloop.studies.charts import skin_loop
from shearloop.studies.charts.skin_loop import CALIBRATION, SkinLoop, SkinLoopCase, judge
from shearloop.tools.parallel import SerialExecutor

CONFIG = Path(__file__).parents[3] / "config"
# The section's 0.04, at the outer radius.
FRICTION = 0.04 * 5.47 / 6.35


@pytest.fixture(scope="module")
def calibration() -> SkinCalibration:
    return load_calibration(CALIBRATION)


@pytest.mark.parametrize(
    "case",
    [
        SkinLoopCase(name="Fn = 1 N", hold_s=6.0),
        SkinLoopCase(name="Fn = 2 N", normal_n=2.0, deadband_nm=0.0, kp=0.15, hold_s=6.0),
    ],
)
def test_a_force_is_held_without_a_limit_cycle_wider_than_friction_s_band(case, calibration):
    held, _ = judge(case, calibration)
    assert held.phase == "done"
    assert held.bound_n == pytest.approx(2 * FRICTION * case.normal_n)
    assert held.width_n <= held.bound_n / 4
    assert held.offset_n <= 0.02


def test_without_the_band_the_limit_cycle_is_wide(calibration):
    held, _ = judge(SkinLoopCase(name="without the band", band=False, kp=0.5, hold_s=12.0), calibration)
    assert held.width_n > held.bound_n


def test_a_gauge_that_drifts_while_a_force_is_held_ends_in_a_hold_and_not_in_a_push(calibration):
    loop = SkinLoop(SkinLoopCase(name="drift"), calibration)
    begin = []
    measured = loop.skin.resistances_ohm

    def drifting() -> tuple[float, float]:
        r1, r2 = measured()
        controller = loop.control_loop.wrist.controller
        if controller is not None and not begin:
            begin.append(loop.t_ns)
        seconds = (loop.t_ns - begin[0]) / 1e9 - 8.0 if begin else 0.0
        return r1 * (1 - 0.01 * max(seconds, 0.0)), r2

    loop.skin.resistances_ohm = drifting
    said = loop.run(60.0)
    assert said.startswith(ExperimentPhase.STOPPED.value)
    assert max(loop.trace.truth_n) < 2.0, "half of what the drift would have had it push by then"


@pytest.mark.usefixtures("fonts")
def test_the_stability_chart_shows_the_limit_cycle(tmp_path, monkeypatch):
    case = SkinLoopCase(name="with the band", hold_s=4.0)
    monkeypatch.setattr(skin_loop, "over_gains", lambda: [case])
    monkeypatch.setattr(skin_loop, "over_delays", lambda: [replace(case, name="without the band", band=False)])
    monkeypatch.setattr(skin_loop, "SEEDS", 1)
    paths = skin_loop.chart(tmp_path, SerialExecutor())
    assert [path.name for path in paths] == ["stability-skin.json", "stability-skin.svg", "stability-skin.png"]
    with_band, without_band = json.loads(paths[0].read_text())["held"]
    assert with_band["width_n"] <= with_band["bound_n"] == pytest.approx(2 * FRICTION)
    assert without_band["case"]["band"] is False
    assert paths[2].stat().st_size > 20_000


def test_the_demo_holds_the_force_that_it_says():
    config = load_daemon_config(CONFIG / "skin_demo.yaml")
    assert config.skin.tool_radius_mm is not None
    file = load_yaml_model(config.experiment, ExperimentFile)
    (hold,) = [step for step in file.steps if isinstance(step, HoldTorqueStep)]
    assert file.torque_source == "skin"
    assert hold.torque_nm / config.skin.tool_radius_mm * 1e3 == pytest.approx(1.0)
    assert [step.do for step in file.steps] == ["tare", "identify", "hold_torque", "twist"]
    assert all(step.timeout_s for step in file.steps), "none may last for ever"
