"""Truth against estimate over time, as a figure."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from shearloop.daemon.analysis.evaluation import EstimateTrack


def draw(tracks: Sequence[EstimateTrack], names: Sequence[str], title: str, path: Path) -> None:
    """Write a figure, one named row per series: truth, estimates with their intervals, and where none is valid."""
    figure = Figure(figsize=(11, 3.2 * len(tracks)), layout="constrained")
    FigureCanvasAgg(figure)
    rows = np.ravel(figure.subplots(len(tracks), 1, squeeze=False))
    for axes, track, row_name in zip(rows, tracks, names, strict=True):
        truth, name = track.series.torque_at_frames(), "torque_nm"
        label, bounds = "torque in N·m", ("torque_low_nm", "torque_high_nm")
        if np.isfinite(track.series.diameter_mm).any():
            truth, name = track.series.diameter_mm, "diameter_mm"
            label, bounds = "diameter in mm", ("diameter_low_mm", "diameter_high_mm")
        t_s = track.series.t_s
        value, low, high = (
            np.array([getattr(one, key) if getattr(one, key) is not None else np.nan for one in track.estimates])
            for key in (name, *bounds)
        )
        slices = track.series.kind == "difference"
        style = "o" if slices else "-"
        axes.plot(t_s, truth, f"k{style}", linewidth=1.0, markersize=5, label="truth")
        if slices:
            axes.errorbar(t_s, value, [value - low, high - value], fmt="s", markersize=4, label="estimate, 95 %")
        else:
            axes.fill_between(t_s, low, high, alpha=0.25, linewidth=0)
            axes.plot(t_s, value, linewidth=1.2, label="estimate, 95 %")
            axes.fill_between(
                t_s, 0, 1, where=np.isnan(value), transform=axes.get_xaxis_transform(), color="0.92", linewidth=0,
                label="no valid estimate",
            )  # fmt: skip
        if slices:
            axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.set_title(row_name, loc="left", fontsize="medium")
        axes.set_xlabel("slice" if slices else "time in s")
        axes.set_ylabel(label)
        axes.legend(loc="lower right", bbox_to_anchor=(1, 1), borderaxespad=0, ncols=3, frameon=False, fontsize="small")
    figure.suptitle(title)
    figure.savefig(path, dpi=110)
