"""The stability chart: curves through every fault, beyond the torques calibrated on, and from frame to frame."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from shearloop.bank.arrays import FloatArray
from shearloop.daemon.analysis.charts.continuity import STEPS, Walk
from shearloop.daemon.analysis.charts.extrapolation import Extrapolation
from shearloop.daemon.analysis.charts.picture import figure, look
from shearloop.daemon.analysis.charts.stability import BROKEN_SHARE, Curve


def sweeps_figure(title: str, curves: Sequence[Curve]) -> Figure:
    """Draw error, valid and false-valid share of every estimator, a row for each fault."""
    faults = list(dict.fromkeys((one.fault, one.unit) for one in curves))
    made = figure(15, 2.75 * len(faults) + 1.0)
    axes = made.subplots(len(faults), 3, squeeze=False)
    for row, fault in zip(axes, faults, strict=True):
        _draw_fault(row, *fault, curves)
    axes[0, 2].legend(fontsize=8, loc="upper left", handlelength=3.5)
    made.suptitle(
        f"Estimators where methods fail: {title}\n× breaks silently: more than {BROKEN_SHARE:.0%} of the frames are "
        "called valid and miss their 95 % interval",
        fontsize=12,
    )  # fmt: skip
    return made


def _draw_fault(row: Sequence[Axes], fault: str, unit: str, curves: Sequence[Curve]) -> None:
    """Draw the curves of one fault into three panels: bias, valid and false-valid share."""
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


def _beside(count: int, number: int, of: int) -> FloatArray:
    """Return where the marks of a curve of this number stand: beside those of the other curves, not upon them."""
    return np.arange(float(count)) + 0.12 * (number - (of - 1) / 2)


def _draw_curve(row: Sequence[Axes], one: Curve, number: int, count: int) -> None:
    style = look(number) | {"linewidth": 1.3, "markersize": 5}
    labels = [f"{level.level:g}" for level in one.levels]
    x = _beside(len(labels), number, count)
    bias = np.array([np.nan if level.bias_nm is None else 1e3 * level.bias_nm for level in one.levels])
    spread = np.array([np.nan if level.spread_nm is None else 1e3 * level.spread_nm for level in one.levels])
    row[0].errorbar(x, bias, yerr=spread, elinewidth=0.8, **style)
    row[1].plot(x, [level.valid for level in one.levels], **style)
    false = [level.false_valid for level in one.levels]
    row[2].plot(x, false, label=one.estimator, **style)
    for i, level in enumerate(one.levels):
        if level.level == one.breaks_at:
            row[2].plot(x[i], false[i], "x", color="black", markersize=13, markeredgewidth=2.5, zorder=5)
    for panel in row:
        panel.set_xticks(range(len(labels)), labels, fontsize=8)
        panel.set_xlim(-0.6, len(labels) - 0.4)


def extrapolation_figure(title: str, found: Sequence[Extrapolation]) -> Figure:
    """Draw what the estimators say beyond the torques calibrated on, and how wide their intervals are there."""
    faults = list(dict.fromkeys((one.curve.fault, one.curve.unit) for one in found))
    made = figure(19, 4.2 * len(faults) + 1.0)
    axes = made.subplots(len(faults), 4, squeeze=False)
    for row, (fault, unit) in zip(axes, faults, strict=True):
        here = [one for one in found if one.curve.fault == fault]
        _draw_fault(row[:3], fault, unit, [one.curve for one in here])
        _label(row[3], unit, "median width, times that of good later slices")
        row[3].axhline(1.0, color="#999999", linewidth=0.8)
        for number, one in enumerate(here):
            times = [np.nan if width is None else width for width in one.times_good]
            row[3].plot(_beside(len(times), number, len(here)), times, linewidth=1.3, markersize=5, **look(number))
        row[3].set_ylim(bottom=0.0)
        labels = [f"{level.level:.3f}\n{n}" for level, n in zip(here[0].curve.levels, here[0].slices, strict=True)]
        for panel in row:
            panel.set_xticks(range(len(labels)), ["all\n" + labels[0].split("\n")[1], *labels[1:]], fontsize=8)
            panel.set_xlim(-0.6, len(labels) - 0.4)
    # Where most slices are valid there is room for the names.
    axes[0, 1].legend(*axes[0, 2].get_legend_handles_labels(), fontsize=8, handlelength=3.5)
    made.suptitle(
        f"Torques beyond those calibrated on: {title}\nall other slices are judged; at “all” the earlier slices are "
        "calibrated on, and the later ones judged; below each limit, how many slices were calibrated on\n× breaks "
        f"silently: more than {BROKEN_SHARE:.0%} of the slices are called valid and miss their 95 % interval",
        fontsize=12,
    )  # fmt: skip
    return made


def continuity_figure(title: str, walks: Sequence[Walk]) -> Figure:
    """Draw the estimates along a way through the frames, and the largest hop of each within one small step."""
    made = figure(15, 6.2)
    way, bars = made.subplots(1, 2, gridspec_kw={"width_ratios": [2.3, 1]})
    for number, walk in enumerate(walks):
        style = look(number) | {"linewidth": 1.4, "markersize": 4}
        at = np.arange(len(walk.torque_nm)) / STEPS
        way.plot(at, walk.torque_nm, markevery=(2 * number, 40), label=walk.name, **style)
        bars.barh(
            number,
            1e3 * walk.largest_hop_nm,
            color="#d9d9d9",
            edgecolor="black",
            hatch=("/", "\\", "x", ".", "o")[number % 5],
        )
        bars.text(
            1e3 * walk.largest_hop_nm,
            number,
            f"  {1e3 * walk.largest_hop_nm:.2f} ({walk.hops} hops)",
            va="center",
            fontsize=9,
        )
    bars.set_yticks(range(len(walks)), [walk.name.replace(": ", ":\n") for walk in walks], fontsize=8.5)
    bars.invert_yaxis()
    bars.margins(x=0.45)
    bars.axvline(1e3 * walks[0].share_nm, color="black", linestyle=":", linewidth=1)
    bars.set(
        xlabel="largest move of the torque in one step, mN·m\n(dotted: a step's fair share of the way)",
        title=f"in {STEPS} steps from one frame to the next",
    )  # fmt: skip
    way.set(
        xlabel="frames of the later part by rising torque, joined by straight lines", ylabel="torque, N·m",
        title="what each says along the way",
    )  # fmt: skip
    way.grid(alpha=0.25)
    way.legend(fontsize=8.5)
    made.suptitle(f"Continuity: how far the estimate jumps for a small change of the frame, {title}")
    return made
