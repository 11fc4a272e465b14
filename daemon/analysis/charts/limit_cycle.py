"""What is left of an oscillation where friction lies within the loop: the shear skin's part of the stability chart."""

from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.held_shear import (
    AGES_S,
    CALIBRATION,
    GAINS,
    TICK_S,
    Case,
    Held,
    SkinLoop,
    judge,
    over_delays,
    over_gains,
    worst,
)
from shearloop.bank.skin.calibration_file import load_calibration
from shearloop.daemon.analysis.charts.picture import figure, look, save
from shearloop.daemon.workers import Executor


def chart(out: Path, pool: Executor, name: str, told: Callable[[Held], None] = lambda _: None) -> list[Path]:
    """Measure every case, draw and write; `told` hears of each as it is found."""
    calibration = load_calibration(CALIBRATION)
    gains, delays = over_gains(), over_delays()
    found: dict[int, Held] = {}
    for number, held in pool.map(worst, calibration, [*gains, *delays]):
        found[number] = held
        told(held)
    ordered = [found[number] for number in range(len(found))]
    shown = judge(Case(name="shown"), calibration)[1]
    made = limit_cycle_figure(ordered[: len(gains)], ordered[len(gains) :], shown)
    return save(made, {"held": [asdict(held) for held in ordered]}, out, name)


def limit_cycle_figure(gains: Sequence[Held], delays: Sequence[Held], loop: SkinLoop) -> Figure:
    """Draw the run of one case, width and offset of all over the gain, and the width over the delay."""
    made = figure(12.0, 7.5)
    grid = made.add_gridspec(2, 3, height_ratios=(1.0, 1.3))
    over = made.add_subplot(grid[0, :])
    width, offset, delay = (made.add_subplot(grid[1, i]) for i in range(3))
    _run(over, loop)
    bound = "2 μFn"
    _curves(width, gains, lambda case: case.kp, lambda held: held.width_n / held.bound_n)
    width.set(title="Limit cycle over the gain", xlabel="gain kp", ylabel=f"peak to peak / {bound}")
    _curves(offset, gains, lambda case: case.kp, lambda held: held.offset_n / held.bound_n)
    offset.set(title="Accuracy over the gain", xlabel="gain kp", ylabel=f"mean distance from the set point / {bound}")
    for axes in (width, offset):
        axes.set_xscale("log")
        axes.set_xticks(GAINS, [f"{kp:g}" for kp in GAINS])
        axes.minorticks_off()
    _curves(delay, delays, lambda case: case.age_s, lambda held: held.width_n / held.bound_n)
    delay.set_xticks(AGES_S, [f"{age_s:g}" for age_s in AGES_S])
    delay.set(title="Limit cycle over the delay", xlabel="age of a reading, s", ylabel=f"peak to peak / {bound}")
    for axes in (width, delay, offset):
        axes.set_ylim(-0.05, max(1.2, axes.get_ylim()[1]))
        axes.axhline(1.0, color="black", lw=1, ls=":")
    for axes in (width, delay):
        axes.axhspan(-0.05, 1.0, color="#55a868", alpha=0.08, lw=0)
        axes.annotate(f"allowed: up to {bound}", (0.02, 0.96), xycoords=("axes fraction", "data"), fontsize=8, va="top")
    handles, labels = width.get_legend_handles_labels()
    made.legend(handles, labels, loc="outside lower center", ncols=4, fontsize=8)
    delay.legend(fontsize=8)
    for axes in (over, width, offset, delay):
        axes.grid(alpha=0.25)
    return made


def _run(axes: Axes, loop: SkinLoop) -> None:
    time_s = np.arange(len(loop.truth_n)) * TICK_S
    estimate = np.array(loop.estimate_n[: len(time_s)])
    axes.plot(time_s, loop.truth_n, color="#1f4e79", lw=1.2, label="true shear force")
    axes.plot(time_s[: len(estimate)], estimate, color="#c44e52", lw=0.9, label="estimate")
    axes.plot(time_s, loop.set_point_n, color="#888888", lw=1, ls="--", label="set point")
    axes.set(
        title="Zero, identification, and three holds (Fn = 1 N, kp = 0.5)", xlabel="time, s", ylabel="shear force, N"
    )
    axes.legend(loc="upper left", fontsize=8)


def _curves(axes: Axes, found: Sequence[Held], over: Callable[[Case], float], value: Callable[[Held], float]) -> None:
    for number, name in enumerate(dict.fromkeys(held.case.name for held in found)):
        mine = [held for held in found if held.case.name == name]
        style = look(number) | {"markersize": 5, "linewidth": 1.2}
        axes.plot([over(held.case) for held in mine], [value(held) for held in mine], label=name, **style)
