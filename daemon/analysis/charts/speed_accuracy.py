"""`shearloop chart speed-accuracy`: latency against torque error, time per cell against model error, and the loop."""

import platform
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from matplotlib.axes import Axes

from shearloop.bank.eit.bank_file import Bank
from shearloop.bank.eit.mesh import Mesh
from shearloop.bank.estimation import Name, Physics
from shearloop.daemon.analysis.charts.forwards import CELLS, Solved, forwards
from shearloop.daemon.analysis.charts.methods import Measured, estimators, fewer_channels, matchers, measure
from shearloop.daemon.analysis.charts.picture import (
    LINES,
    MARKS,
    SHADES,
    draw_frontier,
    figure,
    lay_out,
    plain_log,
    save,
    write_names,
)
from shearloop.daemon.analysis.charts.sources import Split
from shearloop.daemon.analysis.charts.windows import GAIN, LOOPS, Followed, followed

Fill = Literal["none", "left", "full"]
# Noise that the loop's identification copes with; a sensor worse than that never closes the loop.
_LARGEST_LOOP_NOISE_NM = 0.02
_SLICE_ESTIMATORS: tuple[Name, ...] = ("bank", "regression", "reconstruction", "fused")
# An error is that of the frames called valid: of fewer than this share of what others call valid it is told beside the
# name, and not compared with theirs.
_OFTEN_VALID = 0.9
# How the mark of a single window is filled, from the smallest noise to the largest.
_FILLS: tuple[Fill, ...] = ("none", "left", "full")
# Families whose points are one thing at several settings are joined by a line.
_JOINED = {"zero lag, bank of rank r": "rank", "regression on the best n channels": "channels"}


@dataclass(frozen=True, slots=True, eq=False)
class Compared:
    """All methods on one split, in `rmse_nm` and `latency_ms`."""

    split: Split
    methods: list[Measured]


def measured(split: Split, bank: Bank, mesh: Mesh, rounds: int) -> Compared:
    """Return every method's time and error on a split."""
    physics, sides = Physics(bank, mesh), split.past.sides
    if split.past.kind == "difference":
        methods = [
            *matchers(split, bank), *fewer_channels(split), *estimators(split, physics, _SLICE_ESTIMATORS, sides[:1]),
        ]  # fmt: skip
    else:
        methods = [
            method
            for some in dict.fromkeys((sides[:1], sides))
            for method in estimators(split, physics, _SLICE_ESTIMATORS, some)
        ]
    return Compared(split, measure(methods, split.future.torque_at_frames(), rounds))


def chart(parts: Sequence[Split], bank: Bank, mesh: Mesh, own_mesh: Mesh | None, out: Path, rounds: int) -> list[Path]:
    """Measure, draw and write the chart; `own_mesh` is the user's, on which the forward methods are timed as well."""
    compared = [one for one in (measured(split, bank, mesh, rounds) for split in parts) if one.methods]
    best = [min(method.rmse_nm for method in one.methods) for one in compared]
    noises = sorted({round(min(rmse, _LARGEST_LOOP_NOISE_NM), 4) for rmse in [*best, _LARGEST_LOOP_NOISE_NM]})
    loop = followed(noises[:1] + noises[1:][-2:], max(rounds // 2, 1))
    return write(compared, forwards(rounds, own_mesh), loop, bank, out)


def write(
    compared: Sequence[Compared], solved: Sequence[Solved], loop: Sequence[Followed], bank: Bank, out: Path
) -> list[Path]:
    """Draw what was measured, and write it."""
    content = {
        "machine": f"{platform.machine()}, one thread",
        "bank": {"model": bank.model, "shape": list(bank.signals.shape), "identity": bank.identity},
        "methods": {one.split.title: _rows(one.methods) for one in compared},
        "forward": [asdict(one) for one in solved],
        "loop": {"gain": GAIN, "runs": [asdict(one) for one in loop]},
    }
    panels = len(compared) + 2
    rows = (panels + 1) // 2
    made = figure(15, 6.3 * rows)
    axes = made.subplots(rows, 2, squeeze=False).ravel()
    for one, panel in zip(compared, axes, strict=False):
        _draw_methods(panel, one)
    _draw_forward(axes[len(compared)], solved)
    _draw_loop(axes[len(compared) + 1], loop)
    for panel in axes[panels:]:
        panel.set_axis_off()
    made.suptitle("Speed against accuracy: below and to the left is better", fontsize=14)
    lay_out(made)
    for one, panel in zip(compared, axes, strict=False):
        often = often_valid(one.methods)
        names = [_short(method, i in often) for i, method in enumerate(one.methods)]
        points = zip(one.methods, names, strict=True)
        write_names(panel, [(method.latency_ms, method.rmse_nm, name) for method, name in points])
    named = [(one.cell_ms, one.error, f"{one.name}\n{one.triangles} triangles") for one in solved if one.error]
    write_names(axes[len(compared)], named)
    return save(made, content, out, "speed-accuracy")


def _rows(methods: Sequence[Measured]) -> list[dict[str, Any]]:
    """Return the methods' figures with their times as ratios to the first one's, the paper's where it was run."""
    first = methods[0].latency_ms
    return [asdict(one) | {"latency_ratio": one.latency_ms / first} for one in methods]


def _draw_methods(axes: Axes, compared: Compared) -> None:
    methods = compared.methods
    plain_log(axes)
    often = often_valid(methods)
    costs, errors = ([getattr(methods[i], name) for i in often] for name in ("latency_ms", "rmse_nm"))
    best = [often[i] for i in draw_frontier(axes, costs, errors, max(one.latency_ms for one in methods))]
    families = list(dict.fromkeys(one.family for one in methods))
    for number, family in enumerate(families):
        shade, mark = SHADES[number % len(SHADES)], MARKS[number % len(MARKS)]
        members = [i for i, one in enumerate(methods) if one.family == family]
        if family in _JOINED:
            axes.plot(
                [methods[i].latency_ms for i in members], [methods[i].rmse_nm for i in members],
                color=shade, linestyle=LINES[number % len(LINES)], linewidth=1, zorder=1,
            )  # fmt: skip
        for i in members:
            one = methods[i]
            spread = [[one.latency_ms - one.latency_low_ms], [one.latency_high_ms - one.latency_ms]]
            axes.errorbar(
                one.latency_ms, one.rmse_nm, xerr=spread, marker=mark, markersize=8, color=shade, elinewidth=1,
                markerfacecolor=shade if i in best else "white", linestyle="none", zorder=2 + (i in best),
                label=family if i == members[0] else None,
            )  # fmt: skip
    frames = len(compared.split.future.t_s)
    axes.set(
        title=f"{compared.split.title}; judged on the {frames} frames that follow",
        xlabel="latency of one frame, ms (one thread; bars: slowest and fastest round)",
        ylabel="torque error on later frames, RMS, N·m",
    )
    axes.grid(alpha=0.25, which="both")
    # Room below the frontier for the legend.
    low, high = min(one.rmse_nm for one in methods), max(one.rmse_nm for one in methods)
    axes.set_ylim(low * (low / high) ** 0.55, high * 1.25)
    axes.legend(fontsize=8, loc="lower right", title="filled: on the frontier", title_fontsize=8, ncols=2)


def often_valid(methods: Sequence[Measured]) -> list[int]:
    """Return the numbers of the methods that call about as many frames valid as the one that calls most so."""
    most = max(one.valid_fraction for one in methods)
    return [i for i, one in enumerate(methods) if one.valid_fraction >= _OFTEN_VALID * most]


def _short(one: Measured, is_often_valid: bool) -> str:
    """Return a label, with the valid share where that is clearly less than the others': the error is of those alone."""
    short = one.name.removeprefix("rank ").removesuffix(" channels").replace("zero lag, ", "").replace("all lags, ", "")
    short = short.replace("paper: reference", "paper").replace("fast and exact", "fast").replace(", right", "")
    return short if is_often_valid else f"{short} ({one.valid_fraction:.0%} valid)"


def _draw_forward(axes: Axes, solved: Sequence[Solved]) -> None:
    plain_log(axes)
    known = [(one.cell_ms, one.error) for one in solved if one.error is not None]
    costs = [cost for cost, _ in known]
    draw_frontier(axes, costs, [error for _, error in known], max(costs))
    families = list(dict.fromkeys(one.family for one in solved))
    axes.margins(x=0.12, y=0.12)
    for number, family in enumerate(families):
        shade = SHADES[number % len(SHADES)]
        members = [one for one in solved if one.family == family]
        placed = [(one.cell_ms, one.error) for one in members if one.error is not None]
        if placed:
            axes.plot(
                *zip(*sorted(placed), strict=True), marker=MARKS[number], color=shade,
                linestyle=LINES[number % len(LINES)], linewidth=1, markersize=8, label=family,
                markerfacecolor="white" if members[0].cited else shade,
            )  # fmt: skip
        for one in members:
            if one.error is None:
                axes.axvline(
                    one.cell_ms,
                    color=shade,
                    linestyle=LINES[number % len(LINES)],
                    label=f"{one.name}, {one.triangles} triangles",
                )
    axes.set(
        title=f"Forward methods, {len(CELLS)} cells of the Gaussian derivative",
        xlabel="time per cell, ms (one thread; cited ones from elsewhere)",
        ylabel="error of the difference signal to a converged mesh, relative L2",
    )
    axes.grid(alpha=0.25, which="both")
    axes.legend(fontsize=7.5, loc="upper right")


def _draw_loop(axes: Axes, loop: Sequence[Followed]) -> None:
    axes.set(yscale="log")
    noises = sorted({one.noise_nm for one in loop})
    for number, name in enumerate(LOOPS):
        for noise, line, fill in zip(noises, LINES, _FILLS, strict=False):
            runs = [one for one in loop if one.loop == name and one.noise_nm == noise]
            rms = [one.rms_nm for one in runs]
            bars = [[one.rms_nm - one.rms_low_nm for one in runs], [one.rms_high_nm - one.rms_nm for one in runs]]
            # What has no line to tell its noise by tells it by how its mark is filled.
            axes.errorbar(
                [one.delay_s for one in runs], rms, yerr=bars, marker=MARKS[number], color=SHADES[number],
                linestyle=line if len(runs) > 1 else "none", linewidth=1.2, elinewidth=0.7,
                markersize=6 if len(runs) > 1 else 8, fillstyle="full" if len(runs) > 1 else fill,
                markerfacecoloralt="white", zorder=3 if len(runs) == 1 else 2,
                label=f"{name}, noise {1e3 * noise:g} mN·m",
            )  # fmt: skip
            least = rms.index(min(rms))
            if len(runs) > 1:
                axes.plot(
                    runs[least].delay_s, rms[least], "o", markersize=14, markerfacecolor="none", color=SHADES[number],
                )  # fmt: skip
    axes.set_ylim(top=0.5)
    frames = {one.frames: one.delay_s for one in loop}
    top = axes.secondary_xaxis("top")
    top.set_xticks(list(frames.values()), [str(count) for count in frames], fontsize=8)
    top.set_xlabel("frames averaged")
    axes.set(
        title="The loop on a wandering set point (ring: the best window)",
        xlabel="delay of the averaged torque, s", ylabel="tracking error, RMS of torque − set point, N·m",
    )  # fmt: skip
    axes.grid(alpha=0.25, which="both")
    axes.legend(fontsize=7.5, handlelength=3.5, loc="upper left")
