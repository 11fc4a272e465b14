"""The charts of the controller's benches; drawn to be read in grey as well."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Text

from benchmarks.closed_loop import Trace
from shearloop.bank.arrays import FloatArray
from shearloop.daemon.messaging.topics import STALE_AFTER_PERIODS

mpl.use("Agg")
mpl.rcParams.update({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False, "savefig.dpi": 130})

_PERIOD_S = 0.008
_TOP = 2.4
_INK, _MIDDLE, _PALE = "0.05", "0.55", "0.85"
_STYLES = ("-", "--", ":")


def draw_stability(path: Path, cases: Mapping[str, Mapping[str, Sequence[Sequence[float]]]], eit_age_s: float) -> None:
    """Draw, for each case, the stable region under its computed boundary, with the simulated one laid over."""
    figure = Figure(figsize=(11.5, 5.6), layout="constrained")
    axes = figure.subplots(2, len(cases), sharey=True, sharex="row")
    for column, (name, rows) in enumerate(cases.items()):
        ages, losses = np.array(rows["age_s"]), np.array(rows["lost_of_8"])
        _draw_region(axes[0, column], ages)
        _draw_region(axes[1, column], losses)
        axes[0, column].set_title(name.replace(", ", ",\n", 1), fontsize=10)
        axes[0, column].axvline(eit_age_s, color=_INK, linewidth=0.8, linestyle=":")
        axes[0, column].set_xlabel("age of a torque when it is used / s")
        axes[1, column].set_xlabel("frames lost in a row, of every 8")
    axes[0, 0].annotate("EIT", (eit_age_s, 0.03), xytext=(3, 0), textcoords="offset points")
    for axis in axes[:, 0]:
        axis.set_ylabel("gain kp per frame")
        axis.set_ylim(0.0, _TOP)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False)
    figure.suptitle("Where the twist loop becomes unstable (1.85 frames a second)", fontsize=11)
    figure.savefig(path)


def _draw_region(axis: Axes, rows: FloatArray) -> None:
    where, computed, simulated = np.minimum(rows, 10.0).T
    axis.fill_between(where, 0.0, computed, color=_PALE, linewidth=0.0, label="stable")
    axis.plot(where, computed, color=_INK, linewidth=1.4, label="boundary, computed")
    axis.plot(where, simulated, "o", color=_INK, markerfacecolor="white", markersize=5.5, label="boundary, simulated")


def draw_steps(
    path: Path,
    tables: Mapping[str, FloatArray],
    wrong: Mapping[str, Trace],
    slip: Trace,
    disturbances: Mapping[str, Trace],
) -> None:
    """Draw the spread of the steps by source, and single traces of what can go wrong."""
    figure = Figure(figsize=(10.5, 7.2), layout="constrained")
    axes = figure.subplots(2, 3)
    _draw_fan(axes[0, 0], tables["eit"], 6.0, "driven by the EIT estimate")
    _draw_fan(axes[0, 1], tables["load_cell"], 2.0, "driven by the load cell")
    _draw_traces(axes[0, 2], disturbances, "0.03 N·m taken away for good after 15 s")
    _draw_traces(axes[1, 0], wrong, "EIT; stiffness believed / true", top_nm=0.16)
    _draw_traces(axes[1, 1], {"torque": slip}, "EIT; the grip slips at 0.07 N·m")
    _draw_angle(axes[1, 2], slip, "the same: the wrist is held")
    for axis in axes.flat:
        axis.set_xlabel("time since the set point / s")
    for axis in axes.flat[:-1]:
        axis.legend(loc="lower right", frameon=False)
    figure.savefig(path)


def _draw_angle(axis: Axes, trace: Trace, title: str) -> None:
    time_s = trace.t_s - trace.t_s[0]
    axis.plot(time_s, trace.angle_rad, color=_INK)
    if trace.held[-1]:
        axis.axvspan(time_s[~trace.held][-1], time_s[-1], color=_PALE, linewidth=0.0)
        axis.annotate("held", (time_s[-1], trace.angle_rad.min()), ha="right")
    axis.set_ylabel("wrist angle / rad")
    axis.set_title(title, fontsize=10)


def _draw_band(axis: Axes, top_nm: float = 0.125) -> None:
    for edge in (0.09, 0.11):
        axis.axhline(edge, color=_MIDDLE, linewidth=0.8, linestyle="--")
    axis.axhline(0.115, color=_MIDDLE, linewidth=0.8, linestyle=":")
    axis.set_ylabel("true torque / N·m")
    axis.set_ylim(0.0, top_nm)


def _draw_fan(axis: Axes, table: FloatArray, settled_s: float, title: str) -> None:
    time_s = np.arange(table.shape[1]) * _PERIOD_S
    axis.fill_between(time_s, table.min(axis=0), table.max(axis=0), color=_PALE, linewidth=0.0, label="all seeds")
    low, high = np.quantile(table, [0.05, 0.95], axis=0)
    axis.fill_between(time_s, low, high, color=_MIDDLE, linewidth=0.0, label="90 % of the seeds")
    axis.plot(time_s, np.median(table, axis=0), color=_INK, linewidth=1.2, label="median")
    axis.axvline(settled_s, color=_INK, linewidth=0.8, linestyle=":")
    _draw_band(axis)
    axis.set_title(f"{title} ({len(table)} seeds)", fontsize=10)


def _draw_traces(axis: Axes, traces: Mapping[str, Trace], title: str, top_nm: float = 0.125) -> None:
    for (name, trace), style in zip(traces.items(), _STYLES, strict=False):
        axis.plot(trace.t_s - trace.t_s[0], trace.torque_nm, style, color=_INK, linewidth=1.2, label=name)
    _draw_band(axis, top_nm)
    axis.set_title(title, fontsize=10)


def draw_rig_faults(path: Path, faults: Sequence[Mapping[str, Any]], gaps_ms: Mapping[str, Sequence[float]]) -> None:
    """Draw how soon each fault was told, and how regularly the robot's states come (each sorted)."""
    figure = Figure(figsize=(11, 4), layout="constrained")
    left, right = figure.subplots(1, 2)
    draw_answers(left, faults)
    for (name, gaps), style, ink in zip(gaps_ms.items(), _STYLES, (_INK, _MIDDLE, _INK), strict=False):
        longer = 1.0 - np.arange(len(gaps)) / len(gaps)
        right.plot(gaps, longer, style, color=ink, linewidth=1.4, label=name, drawstyle="steps-post")
    right.set_xlim(0.0)
    right.set_yscale("log")
    right.set_xlabel("time between two states of the resting robot / ms (16 and 24 are meant)")
    right.set_ylabel("share that is longer")
    right.legend(fontsize=7, frameon=False)
    figure.savefig(path)


def draw_answers(axis: Axes, faults: Sequence[Mapping[str, Any]]) -> list[Text]:
    """Draw a bar for each fault, with its time, in it where it is long: no label on the limit or beyond the frame.

    Returns the labels: the limit's, then one a fault.
    """
    stale = STALE_AFTER_PERIODS
    longest = max(stale, *(fault["periods"] for fault in faults))
    axis.axvline(stale, color=_INK, linewidth=0.8, linestyle=":", zorder=0)
    axis.barh([fault["fault"] for fault in faults], [fault["periods"] for fault in faults], color=_MIDDLE)
    labels: list[Text] = [
        axis.annotate(
            f"stale: {stale:g} periods",
            (stale, 0.02),
            xycoords=axis.get_xaxis_transform(),
            xytext=(-3, 0),
            textcoords="offset points",
            ha="right",
            fontsize=7,
        )
    ]
    for place, fault in enumerate(faults):
        inside = fault["periods"] > 0.5 * stale
        labels.append(
            axis.annotate(
                f"{fault['after_s'] * 1e3:.0f} ms",
                (fault["periods"], place),
                xytext=(-3 if inside else 3, 0),
                textcoords="offset points",
                ha="right" if inside else "left",
                va="center",
                color="white" if inside else _INK,
                fontsize=7,
            )
        )
    axis.set_xlim(0.0, 1.04 * longest)
    axis.set_xlabel("periods of the topic from the fault to the response")
    axis.invert_yaxis()
    return labels
