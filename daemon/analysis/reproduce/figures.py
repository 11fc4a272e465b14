"""Figures 5, 7, 8 and 9 of Trehan et al. 2025, drawn from what was found here."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.figure import Figure
from matplotlib.gridspec import SubplotSpec

from shearloop.bank.arrays import FloatArray
from shearloop.bank.eit.bank_file import Bank
from shearloop.bank.eit.channels import N_CHANNELS
from shearloop.bank.eit.matching import Match
from shearloop.bank.eit.models import MODELS
from shearloop.bank.eit.polynomial import Polynomial
from shearloop.daemon.analysis.reproduce.analysis import DiameterResult, ModelScores, TorqueResult
from shearloop.daemon.analysis.reproduce.report import PAPER_MODEL_SCORES, Reproduction

_GREY, _BLACK, _PINK, _BLUE, _TEAL, _ORANGE = "#8c8c8c", "#222222", "#d6338a", "#1f5f99", "#2a9d8f", "#d9822b"
_HEAT = "viridis"
_HEATMAPS_SHOWN = 4


def draw_all(found: Reproduction, banks: dict[str, Bank], folder: Path) -> list[Path]:
    """Draw every figure that there are numbers for, as PNG and SVG, and return the paths; raises OSError."""
    figures: dict[str, Figure] = {}
    if found.models:
        figures["figure_5_models"] = model_figure(found.models)
    if found.torque:
        figures["figure_7_heatmap"] = heatmap_figure(found.torque, banks["wide"])
        figures["figure_8_torque"] = torque_figure(found.torque, banks["focused"])
    if found.diameter:
        figures["figure_9_diameter"] = diameter_figure(found.diameter, banks["wide"])
    written = []
    for name, figure in figures.items():
        # The layout is found once for both files: it takes longer than to draw them.
        figure.draw_without_rendering()
        figure.set_layout_engine("none")
        for path in (folder / f"{name}.png", folder / f"{name}.svg"):
            # Without the date, the same numbers make the same file.
            figure.savefig(path, dpi=150, metadata={"Date": None} if path.suffix == ".svg" else None)
            written.append(path)
    return written


def model_figure(models: ModelScores) -> Figure:
    """Draw the scores of the five models, best of the paper's first, beside the paper's."""
    names = sorted(PAPER_MODEL_SCORES, key=lambda name: -PAPER_MODEL_SCORES[name])
    bars: list[tuple[str, str, dict[str, float | None]]] = [("paper", _GREY, dict(PAPER_MODEL_SCORES))]
    if models.envelope is not None:
        bars.append(("envelope score, one raw frame (the paper's measure)", _BLUE, models.envelope))
    bars.append(("matching score, mean over the torque slices", _TEAL, models.matching))
    figure = _figure(9, 4.6)
    axes = figure.subplots()
    width = 0.8 / len(bars)
    for place, (label, colour, scores) in enumerate(bars):
        heights = [np.nan if scores[name] is None else float(scores[name] or 0.0) for name in names]
        at = np.arange(len(names)) + (place - (len(bars) - 1) / 2) * width
        drawn = axes.bar(at, heights, 0.92 * width, color=colour, label=label)
        axes.bar_label(drawn, fmt="%.3f", fontsize=7, padding=2)
    axes.set_xticks(np.arange(len(names)), [MODELS[name].title for name in names])
    axes.set(ylim=(0, 1.12), ylabel="score")
    axes.set_yticks(np.arange(0, 1.01, 0.2))
    axes.legend(frameon=False, ncols=len(bars), fontsize=8, loc="upper center")
    axes.set_title("Likeness of the five basis models to measured differences (figure 5)", loc="left", fontsize=11)
    _plain(axes)
    return figure


def heatmap_figure(torque: TorqueResult, bank: Bank) -> Figure:
    """Draw how one slice is matched: its difference, the bank's best signal, and the heatmap over the wide bank."""
    index = int(np.argmax(torque.wide.scores))
    match, number = torque.wide.best[index], int(torque.slices.numbers[index])
    figure = _figure(12, 5)
    halves = figure.add_gridspec(1, 2, width_ratios=[1.25, 1])
    measured, simulated = halves[0].subgridspec(2, 1).subplots(sharex=True, squeeze=False)[:, 0]
    measured.plot(torque.slices.differences[index] * 1e3, color=_BLACK, linewidth=0.6)
    measured.set(ylabel="|difference| (mV)", xlim=(0, N_CHANNELS))
    measured.set_title(f"Measured: slice {number} at {torque.slices.torque_nm[index]:.3f} N·m", loc="left", fontsize=10)
    simulated.plot(np.abs(bank.signals[match.cell]), color=_BLUE, linewidth=0.6)
    simulated.set(ylabel="|signal| (model's voltage)", xlabel="channel")
    simulated.set_title(
        f"Best of the bank: k = {match.k:.2f} cm, σ = {match.sigma:.2f} cm, score {match.score:.3f}",
        loc="left",
        fontsize=10,
    )
    for axes in (measured, simulated):
        _plain(axes)
    axes = figure.add_subplot(halves[1])
    image = _heatmap(axes, torque.wide.heatmaps[index], bank, match)
    axes.set_title("Heatmap: largest cross-correlation over all lags", loc="left", fontsize=10)
    figure.colorbar(image, ax=axes, label="score", shrink=0.9)
    figure.suptitle("From a measured difference to k and σ (figure 7); hatched cells are not valid", fontsize=11)
    return figure


def torque_figure(torque: TorqueResult, bank: Bank) -> Figure:
    """Draw sigma against torque with four heatmaps, and the torque that follows from sigma."""
    measured, sigma = torque.slices.torque_nm, torque.focused.sigma
    shown = _spread_over(measured)
    figure = _figure(13, 8.2)
    halves = figure.add_gridspec(2, 1, height_ratios=[1.25, 1])
    scatter, predicted = halves[0].subgridspec(1, 2).subplots(squeeze=False)[0]
    scatter.plot(measured, sigma, "o", color=_GREY, alpha=0.6, markeredgewidth=0, label="slices")
    scatter.plot(measured[shown], sigma[shown], "o", color=_PINK, label="heatmaps below")
    scatter.plot(torque.group_torque_nm, torque.group_sigma, "x", color=_BLACK, markersize=9, label="group means")
    scatter.set(xlabel="torque (N·m)", ylabel="σ of the best match (cm)")
    scatter.set_title(
        f"a  r = {_r(torque.r_focused)} for slices, {_r(torque.r_clustered)} for groups", loc="left", fontsize=10
    )
    _predictions(predicted, torque.fit, (sigma, measured), (torque.group_sigma, torque.group_torque_nm))
    predicted.set(xlabel="measured torque (N·m)", ylabel="predicted torque (N·m)")
    predicted.set_title("b  second-order polynomial of σ, fitted to the group means", loc="left", fontsize=10)
    for axes in (scatter, predicted):
        axes.legend(frameon=False, fontsize=8)
        _plain(axes)
    _heatmap_row(
        figure,
        halves[1],
        [torque.focused.heatmaps[index] for index in shown],
        [torque.focused.best[index] for index in shown],
        [f"{measured[index]:.3f} N·m, σ = {sigma[index]:.2f} cm" for index in shown],
        bank,
    )
    figure.suptitle(f"Torque from σ (figure 8): {len(measured)} slices, {torque.grouping}, focused bank", fontsize=11)
    return figure


def diameter_figure(diameter: DiameterResult, bank: Bank) -> Figure:
    """Draw k against diameter with the accumulated heatmaps, and the diameter that follows from k."""
    measured, k = diameter.slices.diameter_mm, diameter.single.k
    figure = _figure(13, 8.2)
    halves = figure.add_gridspec(2, 1, height_ratios=[1.25, 1])
    scatter, predicted = halves[0].subgridspec(1, 2).subplots(squeeze=False)[0]
    scatter.plot(k, measured, "o", color=_GREY, alpha=0.6, markeredgewidth=0, label="slices")
    scatter.plot(
        diameter.accumulated_k, diameter.diameters_mm, "x", color=_BLACK, markersize=9, label="heatmaps accumulated"
    )
    scatter.set(xlabel="k of the best match (cm)", ylabel="diameter (mm)")
    scatter.set_title(
        f"a  r = {_r(diameter.r_single)} for slices, {_r(diameter.r_accumulated)} accumulated", loc="left", fontsize=10
    )
    _predictions(predicted, diameter.fit, (k, measured), (diameter.accumulated_k, diameter.diameters_mm))
    predicted.set(xlabel="measured diameter (mm)", ylabel="predicted diameter (mm)")
    predicted.set_title("b  first-order polynomial of k, fitted to the accumulated matches", loc="left", fontsize=10)
    for axes in (scatter, predicted):
        axes.legend(frameon=False, fontsize=8)
        _plain(axes)
    few = _spread_over(diameter.diameters_mm)
    _heatmap_row(
        figure,
        halves[1],
        [diameter.heatmaps[index] for index in few],
        [diameter.accumulated[index] for index in few],
        [f"{diameter.diameters_mm[index]:g} mm, k = {diameter.accumulated_k[index]:.2f} cm" for index in few],
        bank,
    )
    figure.suptitle(
        f"Diameter from k (figure 9): {len(measured)} slices of {len(diameter.diameters_mm)} diameters, wide bank",
        fontsize=11,
    )
    return figure


def _predictions(
    axes: Axes, fit: Polynomial | None, slices: tuple[FloatArray, FloatArray], means: tuple[FloatArray, FloatArray]
) -> None:
    """Draw predicted against measured, each pair being (places of the matches, measured values)."""
    everything = np.concatenate([slices[1], means[1]])
    ends = np.array([everything.min(), everything.max()])
    axes.plot(ends, ends, color=_ORANGE, linewidth=1, label="predicted = measured")
    if fit is None:
        return
    x, y = slices
    predicted = np.array([fit(value) for value in x])
    inside = (x >= fit.x_low) & (x <= fit.x_high)
    axes.plot(y[inside], predicted[inside], "o", color=_GREY, alpha=0.6, markeredgewidth=0, label="slices")
    if not inside.all():
        axes.plot(
            y[~inside], predicted[~inside], "o", color=_GREY, markerfacecolor="none", label="slices beyond the fit"
        )
    axes.plot(means[1], [fit(value) for value in means[0]], "x", color=_BLACK, markersize=9, label="fitted points")


def _heatmap_row(
    figure: Figure,
    place: SubplotSpec,
    heatmaps: list[FloatArray],
    matches: list[Match],
    titles: list[str],
    bank: Bank,
) -> None:
    """Draw heatmaps side by side, each relative to its own maximum: where that stands is what they are for."""
    row = place.subgridspec(1, len(heatmaps)).subplots(sharey=True, squeeze=False)[0]
    below = [heatmap - match.score for heatmap, match in zip(heatmaps, matches, strict=True)]
    # The worst half of the cells would take most of the colours.
    lowest = float(np.median([np.nanmedian(heatmap) for heatmap in below]))
    for axes, heatmap, match, title in zip(row, below, matches, titles, strict=True):
        image = _heatmap(axes, heatmap, bank, match, (min(lowest, -1e-6), 0.0))
        axes.set_title(f"{title}, score {match.score:.3f}", fontsize=9)
        axes.label_outer()
    figure.colorbar(image, ax=list(row), label="score − the map's maximum", extend="min")


def _heatmap(
    axes: Axes, heatmap: FloatArray, bank: Bank, match: Match, limits: tuple[float, float] | None = None
) -> QuadMesh:
    """Draw scores over σ and k with the maximum marked; cells that are not valid stay hatched."""
    axes.patch.set(hatch="////", edgecolor="#c8c8c8", facecolor="white")
    low, high = limits or (None, None)
    image = axes.pcolormesh(
        bank.sigma_grid, bank.k_grid, heatmap, cmap=_HEAT, vmin=low, vmax=high, shading="nearest", rasterized=True
    )
    axes.plot(match.sigma, match.k, "o", markersize=8, markerfacecolor="none", markeredgecolor=_PINK, markeredgewidth=2)
    axes.set(xlabel="σ (cm)", ylabel="k (cm)")
    return image


def _spread_over(values: FloatArray) -> list[int]:
    """Return the places of up to four values, evenly spread from the smallest to the largest."""
    order = np.argsort(values, kind="stable")
    places = np.rint(np.linspace(0, len(values) - 1, min(_HEATMAPS_SHOWN, len(values)))).astype(int)
    return [int(order[place]) for place in places]


def _r(value: float | None) -> str:
    return "none" if value is None else f"{value:.3f}"


def _plain(axes: Axes) -> None:
    axes.spines[["top", "right"]].set_visible(False)


def _figure(width: float, height: float) -> Figure:
    """Return an empty figure in inches, drawn without any window or global state."""
    return Figure(figsize=(width, height), layout="constrained")
