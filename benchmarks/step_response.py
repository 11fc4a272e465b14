"""How fast, how exact and how safe: a step to 0.10 N·m, judged on the plant's true torque, over many seeds.

    python -m benchmarks.step_response --out DIR [--seeds 200]

For each seed a tool of another stiffness is gripped, identified with the torque that drives the loop, and brought to
0.10 N·m, with the controller that follows from the identification. Writes step_response.json and .png.
"""

import argparse
import copy
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.alternatives import HeldSpeed, LateCorrection, LatestPredicted
from benchmarks.closed_loop import Loop, Trace, identify_on, nanoseconds, run
from benchmarks.control_charts import draw_steps
from benchmarks.plant import EIT, LOAD_CELL, Plant, Sensor, Tool
from shearloop.daemon.control.controller import TwistController
from shearloop.daemon.control.identification import ExciteSettings, ToolModel
from shearloop.daemon.control.margins import gain_for_noise, integral_gain, margin_refusal
from shearloop.daemon.control.settings import ControllerSettings, LoopConfig

TARGET_NM = 0.10
PERIOD_S = 0.008
BLOCKED_S = 8.0
BAND = 0.10
# The torque's standard deviation that noise may cause, of which the gain follows.
ALLOWED_NM = 0.0018
DISTURBANCE_NM = -0.03


@dataclass(frozen=True, slots=True)
class Source:
    """A torque that can drive the loop, and what is asked of it."""

    name: str
    sensor: Sensor
    settled_s: float
    ramp_nm_per_s: float
    wrist_bandwidth_per_s: float
    excite: ExciteSettings
    hold_s: float


def _excite(sensor: Sensor, dwell_s: float, share: float) -> ExciteSettings:
    return ExciteSettings(
        amplitude_rad=0.35,
        sample_period_s=sensor.period_s,
        window_s=sensor.window_s,
        torque_limit_nm=0.17,
        stiffness_share=share,
        speed_rad_per_s=0.5,
        acceleration_rad_per_s2=2.0,
        bandwidth_per_s=5.0,
        dwell_s=dwell_s,
    )


SOURCES = (
    Source("eit", EIT, 6.0, 0.035, 4.0, _excite(EIT, 2.5, 0.04), 40.0),
    Source("load_cell", LOAD_CELL, 2.0, 0.1, 6.0, _excite(LOAD_CELL, 0.8, 0.02), 15.0),
)


PlantOf = Callable[[Sensor, np.random.Generator], Plant]


def small_plant(sensor: Sensor, rng: np.random.Generator) -> Plant:
    """Return a spring that relaxes, of a stiffness that nobody knows beforehand."""
    return Plant(tool_of(rng), sensor, rng)


def tool_of(rng: np.random.Generator) -> Tool:
    """Return a tool whose stiffness nobody knows beforehand."""
    return Tool(stiffness_nm_per_rad=float(rng.uniform(0.2, 0.35)))


def settings_for(found: ToolModel, source: Source) -> ControllerSettings:
    """Return the controller that follows from what was identified."""
    kp = gain_for_noise(found.noise_nm, ALLOWED_NM)
    return ControllerSettings(
        stiffness_nm_per_rad=found.stiffness_nm_per_rad,
        sample_period_s=found.sample_period_s,
        window_s=source.sensor.window_s,
        lag_s=max(found.significant_lag_s, 0.0),
        kp=kp,
        ki=integral_gain(kp),
        wrist_bandwidth_per_s=source.wrist_bandwidth_per_s,
        ramp_nm_per_s=source.ramp_nm_per_s,
        noise_nm=found.noise_nm,
        deadband_nm=0.001,
        innovation_limit_nm=max(3.0 * found.noise_nm, 0.01),
        creep_limit_nm_per_s=0.005,
        offset_limit_nm=0.06,
        torque_limit_nm=0.2,
        speed_limit_rad_per_s=0.8,
        acceleration_limit_rad_per_s2=3.0,
        travel_limit_rad=1.5,
    )


def identified(plant: Plant, source: Source) -> ToolModel:
    """Return what the identification step finds on this plant; raises RuntimeError where it fails."""
    step = identify_on(plant, source.excite)
    if step.result is None:
        raise RuntimeError(step.failure)
    return step.result


def started(plant: Plant, found: ToolModel, settings: ControllerSettings) -> TwistController:
    """Return a controller that has its set point, at the first measurement after its start."""
    controller = TwistController(settings)
    angle = found.torque_nm + found.stiffness_nm_per_rad * (plant.angle_rad - found.angle_rad)
    controller.start(nanoseconds(plant.t_s), plant.angle_rad, angle, found.known_measurements)
    while controller.state.innovation_nm is None:
        run(plant, controller, plant.period_s)
    controller.set_point(TARGET_NM)
    return controller


def judged(torque_nm: NDArray[np.float64], period_s: float, settled_s: float) -> dict[str, float]:
    """Return the figures of merit of true torques (seed, time) after the step at time 0."""
    error = torque_nm / TARGET_NM - 1.0
    late = error[:, round(settled_s / period_s) :]
    inside = np.abs(late) <= BAND
    return {
        "seeds": float(len(error)),
        "in_band_at_settling_time_share": float(inside[:, 0].mean()),
        "time_in_band_worst_seed": float(inside.mean(axis=1).min()),
        "seeds_in_band_for_95_percent_share": float((inside.mean(axis=1) >= 0.95).mean()),
        "time_in_band_mean": float(inside.mean()),
        "overshoot_worst_seed": float(error.max()),
        "overshoot_median": float(np.median(error.max(axis=1))),
        "mean_error": float(late.mean()),
        "mean_error_worst_seed": float(np.abs(late.mean(axis=1)).max()),
        "mean_absolute_error": float(np.abs(late).mean()),
        "torque_std_nm": float(late.std(axis=1).mean() * TARGET_NM),
    }


def steps(source: Source, seeds: int, plant_of: PlantOf = small_plant) -> tuple[NDArray[np.float64], dict[str, Any]]:
    """Return the true torques (seed, time) after the step, and the figures of a source."""
    torques, found_all, refused = [], [], []
    for seed in range(seeds):
        rng = np.random.default_rng((20, seed))
        plant = plant_of(source.sensor, rng)
        found = identified(plant, source)
        settings = settings_for(found, source)
        refused.append(margin_refusal(settings, found, LoopConfig()))
        controller = started(plant, found, settings)
        torques.append(run(plant, controller, source.hold_s).torque_nm)
        found_all.append(
            (found.stiffness_nm_per_rad / plant.stiffness_nm_per_rad, found, settings, plant.t_s - source.hold_s)
        )
    table = _table(torques)
    ratios = np.array([row[0] for row in found_all])
    figures: dict[str, Any] = judged(table, PERIOD_S, source.settled_s)
    figures["identified"] = {
        "stiffness_over_true_mean": float(ratios.mean()),
        "stiffness_over_true_std": float(ratios.std()),
        "noise_nm_mean": float(np.mean([row[1].noise_nm for row in found_all])),
        "age_s_mean": float(np.mean([row[1].age_s for row in found_all])),
        "lag_s_std": float(np.std([row[1].lag_s for row in found_all])),
        "duration_s_median": float(np.median([row[3] for row in found_all])),
    }
    figures["kp_mean"] = float(np.mean([row[2].kp for row in found_all]))
    figures["refused_by_margins"] = sum(sentence is not None for sentence in refused)
    return table, figures


def _table(rows: list[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Return the rows as one array; rounding of the time may have made some one longer."""
    return np.array([row[: min(map(len, rows))] for row in rows])


Maker = Callable[[Plant, ToolModel, ControllerSettings], Loop]


def _held_speed(_: Plant, found: ToolModel, settings: ControllerSettings) -> Loop:
    return HeldSpeed(
        stiffness_nm_per_rad=found.stiffness_nm_per_rad,
        sample_period_s=found.sample_period_s,
        kp=settings.kp,
        ki=settings.ki,
        set_point_nm=TARGET_NM,
        speed_limit_rad_per_s=settings.speed_limit_rad_per_s,
    )


def _late_correction(_: Plant, found: ToolModel, settings: ControllerSettings) -> Loop:
    return LateCorrection(
        stiffness_nm_per_rad=found.stiffness_nm_per_rad,
        kp=settings.kp,
        ki=settings.ki,
        wrist_bandwidth_per_s=settings.wrist_bandwidth_per_s,
        ramp_nm_per_s=settings.ramp_nm_per_s,
        speed_limit_rad_per_s=settings.speed_limit_rad_per_s,
        set_point_nm=TARGET_NM,
    )


def _latest_predicted(rate_of: Callable[[ControllerSettings], float]) -> Maker:
    def make(_: Plant, found: ToolModel, settings: ControllerSettings) -> Loop:
        return LatestPredicted(
            stiffness_nm_per_rad=found.stiffness_nm_per_rad,
            window_s=settings.window_s,
            rate_per_s=rate_of(settings),
            ramp_nm_per_s=settings.ramp_nm_per_s,
            speed_limit_rad_per_s=settings.speed_limit_rad_per_s,
            set_point_nm=TARGET_NM,
        )

    return make


def _slow_rate(settings: ControllerSettings) -> float:
    """Return the rate at which one period takes up the same share of a measurement as kp does."""
    return -float(np.log1p(-settings.kp)) / settings.sample_period_s


COMPARED: dict[str, Maker] = {
    "twist controller": started,
    "held speed, no compensator": _held_speed,
    "late correction, no compensator": _late_correction,
    "latest torque carried on, fast": _latest_predicted(lambda settings: settings.wrist_bandwidth_per_s),
    "latest torque carried on, same gain": _latest_predicted(_slow_rate),
}


def compared(source: Source, seeds: int) -> dict[str, dict[str, float]]:
    """Return the figures of all loops on the same tools, with the same identification and gain.

    Beside the step: the overshoot after the robot has not turned for the first 8 s, whatever it was sent.
    """
    steps_nm: dict[str, list[NDArray[np.float64]]] = {name: [] for name in COMPARED}
    freed_nm: dict[str, list[float]] = {name: [] for name in COMPARED}
    for seed in range(seeds):
        rng = np.random.default_rng((20, seed))
        gripped = Plant(tool_of(rng), source.sensor, rng)
        found = identified(gripped, source)
        settings = settings_for(found, source)
        for name, make in COMPARED.items():
            plant = copy.deepcopy(gripped)
            steps_nm[name].append(run(plant, make(plant, found, settings), source.hold_s).torque_nm)
            plant = copy.deepcopy(gripped)
            loop, plant.blocked = make(plant, found, settings), True
            run(plant, loop, BLOCKED_S)
            plant.blocked = False
            freed_nm[name].append(float(run(plant, loop, 10.0).torque_nm.max()))
    return {
        name: judged(_table(rows), PERIOD_S, source.settled_s)
        | {"overshoot_after_block_median": float(np.median(freed_nm[name])) / TARGET_NM - 1.0}
        for name, rows in steps_nm.items()
    }


def wrong_stiffness(ratios: tuple[float, ...]) -> dict[str, Trace]:
    """Return what a controller does that takes the tool for `ratio` times as stiff as it is, from the EIT's torque."""
    traces = {}
    for ratio in ratios:
        source, rng = SOURCES[0], np.random.default_rng(21)
        plant = Plant(Tool(), source.sensor, rng)
        found = identified(plant, source)
        settings = replace(settings_for(found, source), offset_limit_nm=np.inf)
        wrong = replace(settings, stiffness_nm_per_rad=ratio * plant.tool.stiffness_nm_per_rad)
        traces[f"×{ratio:g}"] = run(plant, started(plant, found, wrong), source.hold_s)
    return traces


def slipping(slip_nm: float) -> Trace:
    """Return what happens where the grip holds less torque than is asked for."""
    source, rng = SOURCES[0], np.random.default_rng(22)
    plant = Plant(Tool(), source.sensor, rng)
    found = identified(plant, source)
    plant.tool = replace(plant.tool, slip_nm=slip_nm)
    return run(plant, started(plant, found, settings_for(found, source)), source.hold_s)


def disturbed(source: Source) -> Trace:
    """Return what happens where, 15 s after the step, something takes 0.03 N·m off the tool for good."""
    rng = np.random.default_rng(23)
    plant = Plant(Tool(), source.sensor, rng)
    found = identified(plant, source)
    controller = started(plant, found, settings_for(found, source))
    first = run(plant, controller, 15.0)
    plant.disturbance_nm = DISTURBANCE_NM
    then = run(plant, controller, 25.0)
    joined = (np.concatenate([getattr(first, name), getattr(then, name)]) for name in Trace.__slots__)
    return Trace(*joined)


def recovered(seeds: int) -> dict[str, float]:
    """Return for how long, on average, the disturbance leaves the EIT's loop out of the band, in 25 s."""
    source, away = SOURCES[0], {"with_jump_detection_s": 0.0, "without_s": 0.0}
    for seed in range(seeds):
        rng = np.random.default_rng((24, seed))
        gripped = Plant(Tool(), source.sensor, rng)
        found = identified(gripped, source)
        settings = settings_for(found, source)
        for name, tried in zip(away, (settings, replace(settings, noise_nm=0.0)), strict=True):
            plant = copy.deepcopy(gripped)
            controller = started(plant, found, tried)
            run(plant, controller, 15.0)
            plant.disturbance_nm = DISTURBANCE_NM
            error = run(plant, controller, 25.0).torque_nm / TARGET_NM - 1.0
            away[name] += float(np.sum(np.abs(error) > BAND)) * PERIOD_S / seeds
    return away


def bounded(trace: Trace) -> dict[str, float | None]:
    """Return the extremes of a trace, and when the wrist was held for good (None: never)."""
    start_s = trace.t_s[0]
    held_from = float(trace.t_s[~trace.held][-1] - start_s) if trace.held[-1] else None
    return {
        "torque_max_nm": float(trace.torque_nm.max()),
        "torque_end_nm": float(trace.torque_nm[-1250:].mean()),
        "angle_turned_rad": float(np.ptp(trace.angle_rad)),
        "held_from_s": held_from,
    }


def main() -> None:
    """Measure, write the numbers, draw the chart."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--out", type=Path, required=True, help="folder for step_response.json and .png")
    parser.add_argument("--seeds", type=int, default=200)
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    began = time.process_time()
    tables, numbers = {}, {}
    for source in SOURCES:
        tables[source.name], numbers[source.name] = steps(source, args.seeds)
    wrong, slip = wrong_stiffness((1.0, 0.5, 2.0)), slipping(0.07)
    disturbances = {source.name.replace("_", " "): disturbed(source) for source in SOURCES}
    result = {
        "target_nm": TARGET_NM,
        "asked": {"band": BAND, "time_in_band": 0.95, "overshoot": 0.15, "mean_error": 0.03},
        "sources": numbers,
        "compared": {source.name: compared(source, max(args.seeds // 16, 2)) for source in SOURCES},
        "stiffness_assumed_over_true": {name: bounded(trace) for name, trace in wrong.items()},
        "out_of_band_after_disturbance": recovered(max(args.seeds // 10, 2)),
        "grip_slips_at_0.07_nm": bounded(slip),
        "cpu_s": time.process_time() - began,
    }
    (args.out / "step_response.json").write_text(json.dumps(result, indent=2) + "\n")

    draw_steps(args.out / "step_response.png", tables, wrong, slip, disturbances)
    print(json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
