"""Figure 3 of Trehan et al. 2025: the torques, the channels that a linear regression needs, the voltage in a twist."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from shearloop.bank.arrays import FloatArray, IntArray
from shearloop.bank.errors import CalibrationError
from shearloop.errors import UserError
from shearloop.estimation.grips import segment_grip
from shearloop.studies.slices.curve import ranked_channels
from shearloop.tools.drawing import figure
from shearloop.tools.frame_series import series_of
from shearloop.tools.recordings.frames import read_recording
from shearloop.tools.recordings.matlab_import import Slices, find_streams, import_mat

# "Using 272 of the 896 channels achieves 80% accuracy", relative to all channels.
PAPER_CHANNELS, PAPER_FRACTION = 272, 0.8
# Every number up to here, then evenly spaced logarithms.
_EVERY_COUNT, _N_COUNTS = 64, 30
_SIDE = "right"
# More than this fraction of the largest torque is a twist.
_TWISTED = 0.1
PHASES = ("no action", "gripped", "twisted")
_SHADES = ("#8c8c8c", "#1f5f99", "#d6338a")


@dataclass(frozen=True, slots=True, eq=False)
class ChannelRegression:
    """How well least squares on the n best channels predicts the torques of parts left out, for each n of counts (m,).

    r (m,) and r2 (m,) are the correlation and the explained fraction of the variance; the last is of all channels.
    """

    ranking: str
    counts: IntArray
    r: FloatArray
    r2: FloatArray

    def r_share_at(self, count: int) -> float:
        """Return the correlation with the nearest number of channels, as a fraction of all channels' correlation."""
        return float(self.r[np.abs(self.counts - count).argmin()] / self.r[-1])

    def counts_reaching(self, share: float) -> tuple[int, int] | None:
        """Return the least number of channels with this fraction of all channels' R², and the least that keeps it.

        None if all channels explain nothing.
        """
        if self.r2[-1] <= 0:
            return None
        enough = self.r2 >= share * self.r2[-1]
        short = np.flatnonzero(~enough)
        return int(self.counts[enough.argmax()]), int(self.counts[short[-1] + 1 if len(short) else 0])


@dataclass(frozen=True, slots=True, eq=False)
class Twists:
    """A recording's frames at t_s (n,): mean magnitude of the channels in V, torque in N·m, and number in PHASES.

    phase (n,) is −1 for frames while the gripper closes or opens. All other arrays are (n,), too.
    """

    name: str
    t_s: FloatArray
    mean_v: FloatArray
    torque_nm: FloatArray
    phase: IntArray


def regress_on_channels(slices: Slices, parts: IntArray) -> list[ChannelRegression]:
    """Return the regressions with channels ranked by all slices, as the paper does, and by the fitted ones only.

    The rank of a channel is its correlation with torque; parts (n,) of the slices are left out in turn.
    """
    torque, n_channels = slices.torque_nm, slices.differences.shape[1]
    counts = np.unique(
        [*range(1, _EVERY_COUNT), PAPER_CHANNELS, *np.geomspace(_EVERY_COUNT, n_channels, _N_COUNTS).astype(int)]
    )
    found = []
    for ranking, by_all in (("ranked by all slices (paper)", True), ("ranked by the fitted slices", False)):
        predicted = np.empty((len(counts), len(parts)))
        for part in np.unique(parts):
            out = parts == part
            ranked = by_all | ~out
            x = slices.differences[:, ranked_channels(slices.differences[ranked], torque[ranked])]
            x, mean = x - x[~out].mean(axis=0), torque[~out].mean()
            for i, count in enumerate(counts):
                weights = np.linalg.lstsq(x[~out, :count], torque[~out] - mean, rcond=None)[0]
                predicted[i, out] = x[out, :count] @ weights + mean
        r = np.array([np.corrcoef(prediction, torque)[0, 1] for prediction in predicted])
        r2 = 1.0 - ((predicted - torque) ** 2).mean(axis=1) / torque.var()
        found.append(ChannelRegression(ranking, counts, r, r2))
    return found


def read_twists(recordings: Path, notes: list[str]) -> Twists | None:
    """Return the twists of the first of the folder's streams with a fingertip and a load cell; else None and a note."""
    folders = sorted(path for path in (recordings / "streams").glob("*") if path.is_dir())
    for folder in folders:
        try:
            if {_SIDE, "load"} <= {stream for path in folder.glob("*.mat") for stream in find_streams(path)}:
                return _twists(folder)
        except (UserError, CalibrationError) as error:
            notes.append(f"{folder} is not drawn: {error}.")
    notes.append(f"{recordings / 'streams'} has no recording of twists: figure 3c is not drawn.")
    return None


def _twists(folder: Path) -> Twists:
    with TemporaryDirectory() as scratch:
        import_mat([folder], Path(scratch) / "twists.mcap")
        series = series_of(read_recording(Path(scratch) / "twists.mcap"), (_SIDE,))
    idle, gripped, _ = segment_grip(series)
    torque = series.torque_at_frames()
    phase = np.full(len(series.t_s), -1)
    phase[idle] = 0
    phase[gripped] = np.where(np.abs(torque[gripped]) > _TWISTED * np.nanmax(np.abs(torque)), 2, 1)
    return Twists(folder.name, series.t_s, np.abs(series.channels[:, 0]).mean(axis=1), torque, phase)


def dataset_figure(
    slices: Slices, parts: IntArray, regressions: Sequence[ChannelRegression], twists: Twists | None
) -> Figure:
    """Draw figure 3: torques and responses in order of time, accuracy over channels, and the voltage in a twist."""
    made = figure(14, 8)
    grid = made.add_gridspec(2, 2, width_ratios=[1.1, 1])
    _draw_torques(made.add_subplot(grid[0, 0]), slices, parts)
    responses = made.add_subplot(grid[1, 0])
    n_channels = slices.differences.shape[1]
    image = responses.imshow(
        slices.differences.T * 1e3, aspect="auto", origin="lower", interpolation="nearest",
        vmax=float(np.quantile(slices.differences, 0.99)) * 1e3, extent=(0.5, len(parts) + 0.5, 0, n_channels),
    )  # fmt: skip
    responses.set(xlabel="slice, in order of time", ylabel="channel")
    made.colorbar(image, ax=responses, label="|difference| (mV)", extend="max")
    _draw_regressions(made.add_subplot(grid[0, 1]), regressions)
    if twists is not None:
        _draw_twists(made.add_subplot(grid[1, 1]), twists)
    made.suptitle("The torque dataset (figure 3)", fontsize=12)
    return made


def _draw_torques(axes: Axes, slices: Slices, parts: IntArray) -> None:
    at = np.arange(1, len(parts) + 1)
    for part in np.unique(parts):
        axes.plot(at[parts == part], slices.torque_nm[parts == part], "o-", color=_SHADES[part % 2], markersize=4)
    axes.set(xlabel="slice, in order of time", ylabel="torque (N·m)", xlim=(0.5, len(parts) + 0.5), ylim=(0, None))
    axes.set_title(f"a  {len(parts)} torques of the load cell, and the responses below", loc="left", fontsize=10)


def _draw_regressions(axes: Axes, regressions: Sequence[ChannelRegression]) -> None:
    for regression, line in zip(regressions, ("-", "--"), strict=True):
        axes.plot(
            regression.counts,
            regression.r / regression.r[-1],
            line,
            color=_SHADES[1],
            label=f"correlation, {regression.ranking}",
        )
        if regression.r2[-1] > 0:
            axes.plot(
                regression.counts,
                regression.r2 / regression.r2[-1],
                line,
                color=_SHADES[2],
                label=f"R², {regression.ranking}",
            )
    axes.axhline(PAPER_FRACTION, color="black", linewidth=0.8, linestyle=":")
    axes.plot(PAPER_CHANNELS, PAPER_FRACTION, "D", color="black", label=f"paper: {PAPER_CHANNELS} channels, 80 %")
    axes.set(
        xscale="log",
        ylim=(0, 1.15),
        xlabel="best channels of a linear regression",
        ylabel="share of all channels' accuracy",
    )
    axes.set_xticks([1, 3, 10, 30, 100, 272, 896], ["1", "3", "10", "30", "100", "272", "896"])
    axes.minorticks_off()
    axes.legend(frameon=False, fontsize=8, loc="lower left")
    axes.set_title("b  torques of left-out series, by least squares", loc="left", fontsize=10)


def _draw_twists(axes: Axes, twists: Twists) -> None:
    axes.plot(twists.t_s, twists.mean_v * 1e3, color="#c8c8c8", linewidth=0.8)
    for number, (name, shade) in enumerate(zip(PHASES, _SHADES, strict=True)):
        inside = twists.phase == number
        if inside.any():
            mean = float(twists.mean_v[inside].mean()) * 1e3
            label = f"{name}: {mean:.2f} mV"
            axes.plot(twists.t_s[inside], twists.mean_v[inside] * 1e3, ".", color=shade, markersize=4, label=label)
    shown = twists.mean_v[twists.phase >= 0] * 1e3
    axes.set_ylim(shown.min() - 0.3 * np.ptp(shown), shown.max() + 0.1 * np.ptp(shown))
    axes.set(xlabel=f"time (s) in {twists.name}", ylabel="mean |voltage| of all channels (mV)")
    axes.legend(frameon=False, fontsize=8, loc="lower left")
    axes.set_title("c  mean voltage without action, gripped, and twisted", loc="left", fontsize=10)
