"""The figure of an evaluation: truth and estimates over time, with intervals."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from shearloop.bank.arrays import FloatArray
from shearloop.tools.estimate_tracks import EstimateTrack
from shearloop.tools.figures import Frames, figures_by_load

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def draw_tracks(
    tracks: Sequence[EstimateTrack],
    names: Sequence[str],
    title: str,
    path: Path,
    draw: "Callable[[Axes, EstimateTrack, str], None]",
) -> None:
    """Write a figure with a named row per series, which `draw` draws."""
    from shearloop.tools.drawing import figure

    made = figure(11, 3.2 * len(tracks))
    rows = np.ravel(made.subplots(len(tracks), 1, squeeze=False))
    for axes, track, row_name in zip(rows, tracks, names, strict=True):
        draw(axes, track, row_name)
    labelled = {label: handle for axes in rows for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    made.legend(labelled.values(), labelled, loc="outside lower left", ncols=3, frameon=False, fontsize="small")
    made.suptitle(title)
    made.savefig(path, dpi=110)


def draw_stream(axes: "Axes", track: EstimateTrack, name: str) -> None:
    """Draw truth and estimates of a stream over time, with intervals, and where none is valid."""
    frames, t_s = Frames.of(track, "torque"), track.series.t_s
    axes.plot(t_s, frames.truth, "k-", linewidth=1.0, markersize=5, label="load cell")
    _draw_intervals(axes, t_s, frames)
    emulated = "EMULATED: " if track.series.emulated else ""
    axes.set_title(emulated + name + loaded_text(track), loc="left", fontsize="medium")
    axes.set_xlabel("time in s")
    axes.set_ylabel("torque in N·m")


def _draw_intervals(axes: "Axes", t_s: FloatArray, frames: Frames) -> None:
    """Draw a stream's estimates and intervals, hatched where a load cell is not pushed."""
    value, low, high = frames.value, frames.low, frames.high
    axes.plot(t_s, value, linewidth=1.2, label="estimate")
    axes.fill_between(t_s, low, high, alpha=0.25, linewidth=0, label="95 % interval of the estimate")
    axes.fill_between(
        t_s, 0, 1, where=np.isnan(value), transform=axes.get_xaxis_transform(), color="0.92", linewidth=0,
        label="no valid estimate",
    )  # fmt: skip
    hanging = (value == 0) & ~np.isclose(low, -high)
    if hanging.any():
        label = "no load on a load cell that is pushed from one side: the tool may be twisted this far the other way"
        axes.fill_between(
            t_s, low, high, where=hanging, facecolor="none", edgecolor="0.6", hatch="///", linewidth=0, label=label
        )


def loaded_text(track: EstimateTrack) -> str:
    """Return the errors of a track's loaded frames as the end of a title, empty without any."""
    loaded = figures_by_load([track])["loaded"]
    error, zero = loaded["rmse_nm"], loaded["baseline_zero_rmse_nm"]
    if error is None or zero is None:
        return ""
    return f"; {loaded['n']} loaded frames: RMSE {error:.2g} N·m (always saying 0: {zero:.2g})"
