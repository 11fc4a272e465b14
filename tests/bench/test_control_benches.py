"""The two benches of the controller on few cells: the whole chain, with the real controller on the small plant."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from benchmarks import stability_map, step_response, twin_step
from benchmarks.closed_loop import nanoseconds, run
from benchmarks.control_charts import draw_answers
from benchmarks.plant import LOAD_CELL, Plant, Sensor, Tool
from shearloop.daemon.control.controller import WristCommand


@pytest.fixture(autouse=True, scope="module")
def fonts(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Let matplotlib open its fonts, which it keeps open for good, before any test counts its files."""
    figure = Figure()
    figure.suptitle("·")
    figure.savefig(tmp_path_factory.mktemp("fonts") / "fonts.png")


class _Fixed:
    """A loop that turns at one speed for a while, and remembers what it measured."""

    def __init__(self, speed: float, until_s: float) -> None:
        self.speed, self.until_ns = speed, nanoseconds(until_s)
        self.seen: list[tuple[float, int, int]] = []

    def measure(self, torque_nm: float | None, t_mid_ns: int, t_ns: int) -> None:
        assert torque_nm is not None
        self.seen.append((torque_nm, t_mid_ns, t_ns))

    def command(self, t_ns: int, wrist_angle_rad: float) -> WristCommand:  # noqa: ARG002
        return WristCommand(self.speed if t_ns < self.until_ns else 0.0)


def test_the_plant_measures_the_mean_of_its_window_and_says_so_late() -> None:
    sensor = Sensor(period_s=0.5, window_s=0.5, transfer_s=0.1)
    tool = Tool(relaxing_share=0.0, actuation_s=0.0)
    loop = _Fixed(0.2, until_s=1e9)
    run(Plant(tool, sensor, np.random.default_rng(0)), loop, 6.0)
    assert len(loop.seen) >= 10
    for torque, mid_ns, now_ns in loop.seen:
        assert torque == pytest.approx(0.25 * 0.2 * mid_ns / 1e9, abs=1e-9)
        assert 0.35 <= (now_ns - mid_ns) / 1e9 <= 0.36


def test_the_plant_relaxes_and_slips_as_it_says() -> None:
    tool = Tool(relaxing_share=0.1, relaxing_s=2.0)
    plant = Plant(tool, LOAD_CELL, np.random.default_rng(0))
    run(plant, _Fixed(0.5, until_s=0.8), 20.0)
    assert plant.torque_nm == pytest.approx(0.9 * 0.25 * plant.angle_rad, rel=1e-3)
    slipping = Plant(Tool(slip_nm=0.05), LOAD_CELL, np.random.default_rng(0))
    run(slipping, _Fixed(0.5, until_s=2.0), 2.0)
    assert slipping.torque_nm == pytest.approx(0.05)
    run(slipping, _Fixed(-0.5, until_s=1e9), 0.1)
    assert slipping.torque_nm < 0.04


@pytest.mark.parametrize("case", stability_map.CASES, ids=lambda case: case.name.replace("\n", " "))
@pytest.mark.parametrize(("age_s", "lost"), [(1.1, 0), (stability_map.EIT_AGE_S, 3)])
def test_the_computed_boundary_is_the_simulated_one(case: stability_map.Case, age_s: float, lost: int) -> None:
    computed = stability_map.computed_boundary(case, age_s, lost)
    assert np.isfinite(computed)
    assert stability_map.simulated_boundary(case, age_s, lost) == pytest.approx(computed, rel=0.05)


def test_without_losses_the_monodromy_matrix_and_the_roots_say_the_same() -> None:
    for case in stability_map.CASES[1:]:
        limit = stability_map.computed_boundary(case, 0.9, 0)
        assert stability_map._radius(case, 0.9, 0, 0.998 * limit) < 1.0
        assert stability_map._radius(case, 0.9, 0, 1.002 * limit) > 1.0


@pytest.mark.parametrize("source", step_response.SOURCES, ids=lambda source: source.name)
def test_a_step_meets_what_is_asked_of_it(source: step_response.Source) -> None:
    _, figures = step_response.steps(source, 3)
    assert figures["in_band_at_settling_time_share"] == 1.0
    assert figures["time_in_band_worst_seed"] >= 0.95
    assert figures["overshoot_worst_seed"] <= 0.15
    assert abs(figures["mean_error"]) < 0.03
    assert figures["refused_by_margins"] == 0


def test_a_slipping_grip_ends_in_a_held_wrist() -> None:
    trace = step_response.slipping(0.06)
    assert trace.held[-1]
    assert np.ptp(trace.angle_rad) < (0.1 + 0.06 + 0.01) / 0.2


def test_the_step_bench_writes_numbers_and_a_chart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["step_response", "--out", str(tmp_path), "--seeds", "2"])
    shorter = tuple(replace(source, hold_s=12.0) for source in step_response.SOURCES)
    monkeypatch.setattr(step_response, "SOURCES", shorter)
    step_response.main()
    figures = json.loads((tmp_path / "step_response.json").read_text())
    assert set(figures["sources"]) == {"eit", "load_cell"}
    assert (tmp_path / "step_response.png").stat().st_size > 10_000


def test_the_map_bench_writes_numbers_and_a_chart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["stability_map", "--out", str(tmp_path)])
    monkeypatch.setattr(stability_map, "AGES_S", (0.5,))
    monkeypatch.setattr(stability_map, "LOST", (2,))
    stability_map.main()
    figures = json.loads((tmp_path / "stability_map.json").read_text())
    for worst in figures["worst_disagreement"].values():
        assert max(worst.values()) < 0.05
    assert (tmp_path / "stability_map.png").stat().st_size > 10_000


def test_the_step_on_the_rigs_own_physics_is_held_and_a_screw_ends_at_its_target() -> None:
    numbers, tables, beyond, allowed = twin_step.measure(2)
    assert numbers["eit"]["time_in_band_mean"] > 0.95
    assert numbers["load_cell"]["in_band_at_settling_time_share"] == 1.0
    assert abs(tables["load_cell"][:, -1] - 0.1).max() < 0.002
    assert (abs(beyond) <= allowed).all()
    creep = twin_step.calibrated_creep()
    assert (creep.share, creep.time_s) == (pytest.approx(0.08, abs=0.02), pytest.approx(20.0, rel=0.5))


@pytest.mark.parametrize("periods", [0.2, 1.2, 1.3, 2.3, 2.42, 2.5, 2.6, 4.0])
def test_no_label_lies_on_the_limits_line_or_beyond_the_frame(periods: float) -> None:
    figure = Figure(figsize=(11, 4), layout="constrained")
    left, _ = figure.subplots(1, 2)
    faults = [{"fault": name, "periods": p, "after_s": 10.0} for name, p in (("short", 0.1), ("the one", periods))]
    limit, _, label = draw_answers(left, faults)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    box = label.get_window_extent(canvas.get_renderer())  # type: ignore[no-untyped-call]
    line, end = (left.transData.transform((x, 0.0))[0] for x in (2.5, periods))
    assert limit.get_window_extent(canvas.get_renderer()).x1 < line  # type: ignore[no-untyped-call]
    in_the_bar = box.x1 < end
    assert in_the_bar or box.x1 < line, "the bar covers the line"
    assert left.bbox.x0 < box.x0
    assert box.x1 < left.bbox.x1
