"""`shearloop chart stability`: estimators under faults, checks of slices, the rim of the bank, the loop on the skin."""

from collections.abc import Sequence
from dataclasses import asdict
from itertools import product
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from shearloop.bank.eit.bank_file import Bank
from shearloop.bank.eit.mesh import Mesh
from shearloop.bank.estimation import Physics
from shearloop.bank.estimators import EstimatorName
from shearloop.daemon.analysis.charts import skin_loop, slice_stability
from shearloop.daemon.analysis.charts.drawing import SHADES, figure, look, save, slug
from shearloop.daemon.analysis.charts.fault_sweeps import BROKEN_SHARE, FaultCurve, fitted, misaligned, sweeps
from shearloop.daemon.analysis.charts.slice_stability import FOREIGN_SHARES, STEPS
from shearloop.daemon.analysis.charts.sources import Split, splits
from shearloop.daemon.errors import UserError
from shearloop.daemon.workers import Executor

SLICE_NAMES: tuple[EstimatorName, ...] = ("paper", "bank", "regression", "reconstruction", "motion_regression")
STREAM_NAMES: tuple[EstimatorName, ...] = ("bank", "regression", "motion_regression")
SHIFTS_S = (-0.54, -0.27, -0.13, 0.0, 0.13, 0.27, 0.54, 1.08)


def chart(parts: Sequence[Split], bank: Bank, mesh: Mesh, scratch: Path, out: Path, executor: Executor) -> list[Path]:
    """Measure, draw and write a chart per recording, the checks of slices, the bank's rim, and the loop on the skin."""
    physics, written = Physics(bank, mesh), []
    names = {"raw": STREAM_NAMES, "difference": SLICE_NAMES}
    for split in parts:
        curves = sweeps(split, names[split.past.kind], physics, bank, executor)
        if split.past.kind == "raw":
            curves += misaligned(split, STREAM_NAMES, physics, SHIFTS_S)
        if not curves:
            raise UserError(
                f"{split.title}: no estimator can be calibrated on it (see above); chart a longer recording"
            )
        written += _written(f"stability-{slug(split.title)}", split.title, curves, out)
        if split.past.kind == "difference":
            written += _of_slices(split, bank, mesh, out, executor)
    synthetic = next(one for one in splits([], 0.6, scratch) if one.past.kind == "difference")
    curves = list(slice_stability.sweep_rims(fitted(synthetic, SLICE_NAMES, physics), bank, scratch))
    written += _written("stability-rims", "the rim of the bank, on synthetic slices", curves, out)
    return written + skin_loop.chart(out, executor)


def _of_slices(split: Split, bank: Bank, mesh: Mesh, out: Path, executor: Executor) -> list[Path]:
    """Write the charts of slices: continuity, torques beyond the calibrated ones, foreign frames."""
    name, physics = slug(split.title), Physics(bank, mesh)
    found = slice_stability.walks(split, bank, fitted(split, ("regression", "motion_regression"), physics))
    rows = [asdict(one) | {"largest_hop_nm": one.largest_hop_nm, "hops": one.hops} for one in found]
    written = save(continuity_figure(split.title, found), {"steps": STEPS, "walks": rows}, out, f"continuity-{name}")
    beyond = slice_stability.extrapolate(split, SLICE_NAMES, bank, mesh, executor)
    content = {
        "broken_share": BROKEN_SHARE,
        "title": split.title,
        "extrapolations": [asdict(one) | {"times_good": one.times_good} for one in beyond],
    }
    written += save(extrapolation_figure(split.title, beyond), content, out, f"extrapolation-{name}")
    seen = slice_stability.detect_mixtures(split.whole)
    return written + save(
        detectability_figure(split.title.split(",", maxsplit=1)[0], seen),
        {"mixtures": [asdict(one) for one in seen]}, out, f"detectability-{name}",
    )  # fmt: skip


def _written(name: str, title: str, curves: Sequence[FaultCurve], out: Path) -> list[Path]:
    content = {"broken_share": BROKEN_SHARE, "title": title, "curves": [asdict(one) for one in curves]}
    return save(sweeps_figure(title, curves), content, out, name)


def sweeps_figure(title: str, curves: Sequence[FaultCurve]) -> Figure:
    """Draw bias, valid and false-valid share of every estimator, one row per fault."""
    faults = list(dict.fromkeys((one.fault, one.unit) for one in curves))
    made = figure(15, 2.75 * len(faults) + 1.0)
    axes = made.subplots(len(faults), 3, squeeze=False)
    for row, fault in zip(axes, faults, strict=True):
        _draw_fault(row, *fault, curves)
    axes[0, 2].legend(fontsize=8, loc="upper left", handlelength=3.5)
    made.suptitle(
        f"Estimators under faults: {title}\n× breaks silently: more than {BROKEN_SHARE:.0%} of the frames are "
        "called valid and miss their 95 % interval",
        fontsize=12,
    )  # fmt: skip
    return made


def _draw_fault(row: Sequence[Axes], fault: str, unit: str, curves: Sequence[FaultCurve]) -> None:
    """Draw one fault's curves into three panels: bias, valid and false-valid share."""
    for panel, heading in zip(row, ("bias, and spread as bars, mN·m", "valid share", "FALSE-VALID share"), strict=True):
        _label(panel, unit, heading)
    row[0].set_title(fault, fontsize=10.5, loc="left", fontweight="bold")
    row[0].axhline(0, color="#999999", linewidth=0.8)
    names = list(dict.fromkeys(one.estimator for one in curves))
    for number, name in enumerate(names):
        for one in curves:
            if one.fault == fault and one.estimator == name:
                _draw_curve(row, one, number, len(names))
    row[2].axhline(BROKEN_SHARE, color="#999999", linewidth=1.2, linestyle=(0, (1, 2)))
    for panel in row[1:]:
        panel.set_ylim(-0.04, 1.04)


def _label(panel: Axes, unit: str, heading: str) -> None:
    panel.set_ylabel(heading, fontsize=9)
    panel.set_xlabel(unit, fontsize=9)
    panel.grid(alpha=0.25)


def _offset_places(count: int, number: int, of: int) -> NDArray[np.float64]:
    """Return the x places of one curve's marks, offset so that curves do not cover each other."""
    return np.arange(float(count)) + 0.12 * (number - (of - 1) / 2)


def _draw_curve(row: Sequence[Axes], one: FaultCurve, number: int, count: int) -> None:
    style = look(number) | {"linewidth": 1.3, "markersize": 5}
    labels = [f"{level.level:g}" for level in one.levels]
    x = _offset_places(len(labels), number, count)
    # None becomes NaN.
    bias_nm, spread_nm = np.array([(level.bias_nm, level.spread_nm) for level in one.levels], dtype=float).T
    row[0].errorbar(x, 1e3 * bias_nm, yerr=1e3 * spread_nm, elinewidth=0.8, **style)
    row[1].plot(x, [level.valid for level in one.levels], **style)
    false = [level.false_valid for level in one.levels]
    row[2].plot(x, false, label=one.estimator, **style)
    for i, level in enumerate(one.levels):
        if level.level == one.breaks_at:
            row[2].plot(x[i], false[i], "x", color="black", markersize=13, markeredgewidth=2.5, zorder=5)
    for panel in row:
        panel.set_xticks(range(len(labels)), labels, fontsize=8)
        panel.set_xlim(-0.6, len(labels) - 0.4)


def extrapolation_figure(title: str, found: Sequence[slice_stability.Extrapolation]) -> Figure:
    """Draw the estimators beyond the torques they were calibrated on, and the width of their intervals."""
    faults = list(dict.fromkeys((one.curve.fault, one.curve.unit) for one in found))
    made = figure(19, 4.2 * len(faults) + 1.0)
    axes = made.subplots(len(faults), 4, squeeze=False)
    for row, (fault, unit) in zip(axes, faults, strict=True):
        here = [one for one in found if one.curve.fault == fault]
        _draw_fault(row[:3], fault, unit, [one.curve for one in here])
        _label(row[3], unit, "median width, times that of good later slices")
        row[3].axhline(1.0, color="#999999", linewidth=0.8)
        for number, one in enumerate(here):
            times = np.array(one.times_good, dtype=float)
            x = _offset_places(len(times), number, len(here))
            row[3].plot(x, times, linewidth=1.3, markersize=5, **look(number))
        row[3].set_ylim(bottom=0.0)
        labels = [f"{level.level:.3f}\n{n}" for level, n in zip(here[0].curve.levels, here[0].slices, strict=True)]
        for panel in row:
            panel.set_xticks(range(len(labels)), ["all\n" + labels[0].split("\n")[1], *labels[1:]], fontsize=8)
            panel.set_xlim(-0.6, len(labels) - 0.4)
    # This panel has room for the names.
    axes[0, 1].legend(*axes[0, 2].get_legend_handles_labels(), fontsize=8, handlelength=3.5)
    made.suptitle(
        f"Torques beyond the calibrated ones: {title}\nat “all”: calibrated on the earlier slices, judged on the later "
        "ones; else all other slices are judged; below each limit: number of calibrated slices\n× breaks "
        f"silently: more than {BROKEN_SHARE:.0%} of the slices are called valid and miss their 95 % interval",
        fontsize=12,
    )  # fmt: skip
    return made


def continuity_figure(title: str, walks: Sequence[slice_stability.ContinuityWalk]) -> Figure:
    """Draw the estimates along a path through the frames, and the largest change of each within one small step."""
    made = figure(15, 6.2)
    way, bars = made.subplots(1, 2, gridspec_kw={"width_ratios": [2.3, 1]})
    for number, walk in enumerate(walks):
        style = look(number) | {"linewidth": 1.4, "markersize": 4}
        at = np.arange(len(walk.torque_nm)) / STEPS
        way.plot(at, walk.torque_nm, markevery=(2 * number, 40), label=walk.name, **style)
        hop_mnm = 1e3 * walk.largest_hop_nm
        bars.barh(number, hop_mnm, color="#d9d9d9", edgecolor="black", hatch="/\\x.o"[number % 5])
        bars.text(hop_mnm, number, f"  {hop_mnm:.2f} ({walk.hops} hops)", va="center", fontsize=9)
    bars.set_yticks(range(len(walks)), [walk.name.replace(": ", ":\n") for walk in walks], fontsize=8.5)
    bars.invert_yaxis()
    bars.margins(x=0.45)
    bars.axvline(1e3 * walks[0].share_nm, color="black", linestyle=":", linewidth=1)
    bars.set(
        xlabel="largest change of the torque in one step, mN·m\n(dotted: a step's fair share of the path)",
        title=f"in {STEPS} steps from one frame to the next",
    )  # fmt: skip
    way.set(
        xlabel="frames of the later part by rising torque, joined by straight lines", ylabel="torque, N·m",
        title="estimates along the path",
    )  # fmt: skip
    way.grid(alpha=0.25)
    way.legend(fontsize=8.5)
    made.suptitle(f"Continuity: how far the estimate jumps for a small change of the frame, {title}")
    return made


def detectability_figure(title: str, found: Sequence[slice_stability.ForeignMixture]) -> Figure:
    """Draw the misfits of one origin, and the share that passes at all origins."""
    made = figure(15, 6)
    clouds, passing = made.subplots(1, 2, gridspec_kw={"width_ratios": [1, 1.15]})
    kinds = list(dict.fromkeys(one.kind for one in found))
    origins = list(dict.fromkeys(one.origin for one in found))
    shown = min(origins, key=lambda one: abs(one - 0.6))
    for one in found:
        if one.origin == shown and one.kind == kinds[0]:
            x = np.full(len(one.misfits), one.share) + np.linspace(-0.008, 0.008, len(one.misfits))
            clouds.plot(x, one.misfits, "o", color=SHADES[1], markersize=4, alpha=0.7)
    best = max(next(one.misfits for one in found if one.origin == shown and one.share == 0))
    clouds.axhline(1.0, color="black", linewidth=1.4, label="limit of the validity check, from earlier slices")
    clouds.axhline(best, color="black", linestyle=":", linewidth=1.4, label="best limit: the worst good slice")
    clouds.set(
        xlabel=f"share of a foreign frame ({kinds[0]})", ylabel="misfit of each later slice's reciprocal channels",
        title=f"calibrated on the first {shown:.0%}", yscale="log",
    )  # fmt: skip
    clouds.legend(fontsize=8.5, loc="upper left")
    labels = (("passing", "validity check"), ("passing_best", "best possible limit"))
    for number, (kind, (name, label)) in enumerate(product(kinds, labels)):
        of_kind = [one for one in found if one.kind == kind]
        rows = np.array([[getattr(one, name) for one in of_kind if one.share == share] for share in FOREIGN_SHARES])
        mean = rows.mean(axis=1)
        bars = mean - rows.min(axis=1), rows.max(axis=1) - mean
        x = np.array(FOREIGN_SHARES) + 0.003 * (number - 1.5)
        passing.errorbar(x, mean, yerr=bars, linewidth=1.4, elinewidth=0.8, label=f"{kind}: {label}", **look(number))
    passing.set(
        xlabel="share of the foreign frame", ylabel="share of the slices that passes",
        title=f"mean of {len(origins)} origins (bars: lowest and highest)", ylim=(-0.04, 1.04),
    )  # fmt: skip
    passing.legend(fontsize=8.5, loc="upper right")
    for panel in (clouds, passing):
        panel.grid(alpha=0.25)
    made.suptitle(f"Detectable share of a foreign frame: {title}")
    return made
