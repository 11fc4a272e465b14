"""The step to 0.10 N·m on the emulated rig's own physics, judged on its true torque, over many seeds; and `tighten`.

    python -m benchmarks.twin_step --out DIR [--seeds 200]

For each seed the rig's twin has a gel of another stiffness. It is identified with the torque that drives, and brought
to 0.10 N·m; a fingertip errs by 0.012 N·m a frame. Then a screw is tightened to 0.12 N·m on the load cell. Simulated
time, so the same numbers on every machine. Writes twin_step.json and twin_step.png.
"""

import argparse
import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.plant import EIT, LOAD_CELL, Plant, Sensor, Tool, TwinPlant
from benchmarks.step_response import BAND, PERIOD_S, SOURCES, TARGET_NM, steps
from shearloop.bank.arrays import FloatArray
from shearloop.daemon.control.creep import Creep, Stretch, fit_creep
from shearloop.drivers.emulators.twin import Joint, Twin, TwinSettings

# What a gel can have; 0.8 is the emulated rig's.
GEL_NM_PER_RAD = (0.5, 1.1)
# The gel is three times as stiff as the small plant's tools: so much less is turned to learn it.
AMPLITUDE_RAD = 0.12
# The recording from which the gel's creep is learnt: as long as ten twists of 40 s, and the rests between them.
CREEP_S = 600.0
CREEP_IS_CORRECTED = True
# As config/experiments/tighten.yaml.
TIGHTEN_NM, TIGHTEN_RAD_PER_S = 0.12, 0.05


@cache
def calibrated_creep() -> Creep:
    """Return the creep that ten held twists of one gel say, beside the load cell: a fingertip's calibration."""
    rng = np.random.default_rng(26)
    sees = [TwinPlant(Tool(), replace(each, relaxing_share=0.0, play_nm=0.0), rng) for each in (EIT, LOAD_CELL)]
    sees[1].sees_gel = False
    series: list[FloatArray] = []
    for plant in sees:
        rows: list[tuple[float, float]] = []
        while plant.t_s < CREEP_S:
            # Twisted for 40 s, back for 20 s.
            wanted_rad = 0.15 if plant.t_s % 60.0 < 40.0 else 0.0
            plant.step(5.0 * (wanted_rad - plant.angle_rad))
            rows += [(sample.t_mid_s, sample.torque_nm) for sample in plant.collect()]
        series.append(np.array(rows))
    (eit_s, shear_nm), (load_s, load_nm) = (table.T for table in series)
    return fit_creep([Stretch(eit_s, shear_nm, np.interp(eit_s, load_s, load_nm))], scale_is_right=True).creep


def rig_twin(sensor: Sensor, rng: np.random.Generator) -> Plant:
    """Return the rig's physics with a gel of some stiffness; gel and lever do what the small plant's sensor does."""
    eit = sensor is EIT
    creep = Creep(calibrated_creep().share, calibrated_creep().time_s) if eit and CREEP_IS_CORRECTED else None
    twin = Twin(TwinSettings(gel_stiffness_nm_per_rad=float(rng.uniform(*GEL_NM_PER_RAD))))
    plain = replace(sensor, relaxing_share=0.0, play_nm=0.0)
    return TwinPlant(Tool(), plain, rng, twin=twin, sees_gel=eit, creep=creep)


def tightened(seed: int) -> tuple[float, float]:
    """Return by how much a screw ends beyond its target in N·m, and what one sample of the load cell lets pass."""
    rng = np.random.default_rng((25, seed))
    settings = TwinSettings(
        gel_stiffness_nm_per_rad=float(rng.uniform(*GEL_NM_PER_RAD)), joint=Joint.TIGHTENING, tightening_nm_per_rad=0.15
    )
    plant = TwinPlant(Tool(), LOAD_CELL, rng, twin=Twin(settings), sees_gel=False)
    speed, latest_nm, travel_nm = TIGHTEN_RAD_PER_S, 0.0, 0.0
    while latest_nm < TIGHTEN_NM:
        plant.step(-speed)
        for sample in plant.collect():
            latest_nm = -sample.torque_nm
        travel_nm = plant.stiffness_nm_per_rad * speed * LOAD_CELL.period_s
    # What was sent before the stop is still carried out.
    for _ in range(round(1.0 / PERIOD_S)):
        plant.step(0.0)
    return -plant.torque_nm - TIGHTEN_NM, travel_nm


def draw(path: Path, tables: dict[str, FloatArray], beyond: FloatArray, allowed: FloatArray) -> None:
    """Draw every seed's true torque, and where the screws end."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 3.6), layout="constrained")
    axes = figure.subplots(1, 3)
    for axis, source in zip(axes, SOURCES, strict=False):
        table = tables[source.name]
        times = np.arange(table.shape[1]) * PERIOD_S
        for row in table[:: max(len(table) // 40, 1)]:
            axis.plot(times, row, color="tab:blue", linewidth=0.4, alpha=0.4)
        low, middle, high = np.quantile(table, [0.025, 0.5, 0.975], axis=0)
        axis.plot(times, middle, color="black", linewidth=1.2, label="median")
        axis.plot(times, low, color="black", linewidth=0.7, linestyle="--", label="95 % of the seeds")
        axis.plot(times, high, color="black", linewidth=0.7, linestyle="--")
        axis.axhspan(TARGET_NM * (1 - BAND), TARGET_NM * (1 + BAND), color="tab:green", alpha=0.15, label="± 10 %")
        axis.axvline(source.settled_s, color="tab:red", linewidth=0.8, label=f"{source.settled_s:g} s")
        axis.set_title(f"driven by {source.name.replace('_', ' ')}")
        axis.set_xlabel("time since the set point, s")
        axis.set_ylabel("true torque, N·m")
        axis.legend(fontsize=7, loc="lower right")
    axes[2].hist(1e3 * beyond, bins=20, color="tab:blue")
    axes[2].axvline(1e3 * float(allowed.min()), color="tab:red", linewidth=0.8, label="5 mN·m + one sample's travel")
    axes[2].set_title(f"tighten to {TIGHTEN_NM:g} N·m")
    axes[2].set_xlabel("true torque beyond the target, mN·m")
    axes[2].set_ylabel("seeds")
    axes[2].legend(fontsize=7)
    figure.savefig(path, dpi=120)


def measure(seeds: int) -> tuple[dict[str, Any], dict[str, FloatArray], FloatArray, FloatArray]:
    """Return the figures, the true torques (seed, time) by source, and what screws end beyond their target (seed,)."""
    tables: dict[str, FloatArray] = {}
    numbers: dict[str, Any] = {}
    for source in SOURCES:
        stiff = replace(source, excite=replace(source.excite, amplitude_rad=AMPLITUDE_RAD))
        tables[source.name], numbers[source.name] = steps(stiff, seeds, rig_twin)
    ends = np.array([tightened(seed) for seed in range(seeds)])
    beyond, allowed = ends[:, 0], 0.005 + ends[:, 1]
    numbers["tighten"] = {
        "seeds": seeds,
        "beyond_target_nm_mean": float(beyond.mean()),
        "beyond_target_nm_worst": float(np.abs(beyond).max()),
        "one_samples_travel_nm": [float(ends[:, 1].min()), float(ends[:, 1].max())],
        "within_share": float(np.mean(np.abs(beyond) <= allowed)),
    }
    return numbers, tables, beyond, allowed


def main() -> None:
    """Measure, write the numbers, draw the chart."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--out", type=Path, required=True, help="folder for twin_step.json and .png")
    parser.add_argument("--seeds", type=int, default=200)
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    numbers, tables, beyond, allowed = measure(args.seeds)
    (args.out / "twin_step.json").write_text(json.dumps(numbers, indent=2) + "\n")
    draw(args.out / "twin_step.png", tables, beyond, allowed)
    print(json.dumps(numbers, indent=2))


if __name__ == "__main__":
    main()
