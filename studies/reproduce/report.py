"""The numbers and figures of a reproduction, next to the paper's."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.figure import Figure
from matplotlib.gridspec import SubplotSpec
from numpy.polynomial import Polynomial

from shearloop.bank.arrays import FloatArray
from shearloop.bank.bank_file import Bank
from shearloop.bank.channels import PAPER_TABLE
from shearloop.bank.matching import Match
from shearloop.bank.mesh import Mesh
from shearloop.bank.models import MODELS
from shearloop.studies.charts.bank_figures import evenly_spread, models_figure, signal_figure
from shearloop.studies.reproduce.analysis import DiameterResult, Matches, ModelScores, TorqueResult
from shearloop.studies.reproduce.dataset import (
    PAPER_CHANNELS,
    PAPER_FRACTION,
    ChannelRegression,
    Twists,
    dataset_figure,
)
from shearloop.tools.drawing import figure, lay_out
from shearloop.words import counted

PAPER = "Trehan, Hardman and Iida 2025, Sensors 25, 5159"
# As published, without signs: sigma falls with rising torque, and k with rising diameter.
PAPER_TORQUE_R, PAPER_TORQUE_CLUSTERED_R, PAPER_DIAMETER_R = 0.6552, 0.9588, 0.9746
# "The model correlates with experimental data for k > 3.5, σ > 0.6", in cm (its section 4).
PAPER_REGION_CM = (3.5, 0.6)
_NONE = "none"
# The bars of figure 5.
PAPER_MODEL_SCORES = {
    "step": 0.65126,
    "linear": 0.60932,
    "cut_linear": 0.6258,
    "gaussian_derivative": 0.70668,
    "modulated_gaussian": 0.58045,
}


@dataclass(frozen=True, slots=True, eq=False)
class Reproduction:
    """The results on a mesh; None where the recordings are missing."""

    mesh: Mesh
    mesh_origin: str
    banks: dict[str, Bank]
    torque: TorqueResult | None
    diameter: DiameterResult | None
    models: ModelScores | None
    regressions: Sequence[ChannelRegression]
    twists: Twists | None
    notes: tuple[str, ...]

    def region_agreement(self) -> dict[str, float]:
        """Return the fraction of the wide bank's cells whose validity agrees with the paper's region, by reading."""
        wide = self.banks["wide"]
        in_k, in_sigma = (wide.k_grid > PAPER_REGION_CM[0])[:, None], wide.sigma_grid > PAPER_REGION_CM[1]
        return {
            "or": float((wide.valid == (in_k | in_sigma)).mean()),
            "and": float((wide.valid == (in_k & in_sigma)).mean()),
        }


def json_text(found: Reproduction) -> str:
    """Return the numbers by name as JSON text; null where the recordings do not determine them."""
    torque, diameter, models = found.torque, found.diameter, found.models
    regression = next(iter(found.regressions), None)
    numbers = {
        "torque_sigma_r_focused": torque and torque.r_focused,
        "torque_sigma_r_wide": torque and torque.r_wide,
        "torque_sigma_r_clustered": torque and torque.r_clustered,
        "diameter_k_r_single": diameter and diameter.r_single,
        "diameter_k_r_accumulated": diameter and diameter.r_accumulated,
        "diameter_k_r_running_sum": diameter and diameter.r_running_sum,
        "model_scores": models.chosen if models else dict.fromkeys(MODELS),
        "torque_rmse_nm_cross_validated": torque and torque.rmse_nm,
        "torque_regression_r_share": regression and regression.r_share_at(PAPER_CHANNELS),
        "torque_regression_channels_for_80_percent_of_r2": regression and regression.counts_reaching(PAPER_FRACTION),
        "bank_valid_cells": int(found.banks["wide"].valid.sum()),
        "paper_region_agreement": found.region_agreement(),
    }
    return json.dumps(numbers, indent=2, allow_nan=False)


def table(found: Reproduction) -> str:
    """Return the comparison with the paper, and the explanations."""
    rows = [("", "paper", "here")]
    if torque := found.torque:
        rows += [
            ("torque and sigma, r, single slices, focused bank", f"{PAPER_TORQUE_R:.4f}", _number(torque.r_focused)),
            ("torque and sigma, r, single slices, wide bank", "", _number(torque.r_wide)),
            ("torque and sigma, r, groups of slices", f"{PAPER_TORQUE_CLUSTERED_R:.4f}", _number(torque.r_clustered)),
            ("torque of a single slice, RMSE cross-validated, N·m", "", _number(torque.rmse_nm)),
            ("   beside the torques' standard deviation, N·m", "", _number(float(torque.slices.torque_nm.std()))),
        ]
    for regression in found.regressions[:1]:
        share = _number(regression.r_share_at(PAPER_CHANNELS))
        needed = _count_range(regression.counts_reaching(PAPER_FRACTION))
        rows += [
            (f"linear regression: r of {PAPER_CHANNELS} channels over r of all", f"{PAPER_FRACTION:.4f}", share),
            ("linear regression: channels for 80 % of R²", str(PAPER_CHANNELS), needed),
        ]
    if diameter := found.diameter:
        paper = f"{PAPER_DIAMETER_R:.4f}"
        rows += [
            ("diameter and k, r, single slices", "", _number(diameter.r_single)),
            ("diameter and k, r, one point per cylinder", paper, _number(diameter.r_accumulated)),
            ("diameter and k, r, running sums, one per slice", paper, _number(diameter.r_running_sum)),
        ]
    if models := found.models:
        what = "matching" if models.envelope is None else "envelope"
        rows += [
            (f"{MODELS[name].title}: {what} score", f"{PAPER_MODEL_SCORES[name]:.4f}", _number(score))
            for name, score in models.chosen.items()
        ]
        if models.envelope is not None:
            rows += [
                (f"{MODELS[name].title}: matching score, mean over slices", "", _number(score))
                for name, score in models.matching.items()
            ]
    rows.append(("cells of the wide bank that are valid", "", str(found.banks["wide"].valid.sum())))
    rows += [
        (f"cells where that is the paper's region, k > 3.5 {word} σ > 0.6", "", f"{share:.1%}")
        for word, share in found.region_agreement().items()
    ]
    width = max(len(name) for name, *_ in rows)
    lines = [f"{name:<{width}}  {paper:>8}  {here:>9}".rstrip() for name, paper, here in rows]
    if any(here == _NONE for *_, here in rows):
        lines += ["", f"{_NONE}: slices are too few, or their matches too alike, for this number"]
    return "\n".join([*lines, "", *explanations(found)])


def explanations(found: Reproduction) -> list[str]:
    """Return sentences about the origin of the numbers, and about missing ones."""
    sentences = [f"Paper: {PAPER}; it gives magnitudes, and torque from 99 slices.", f"Mesh: {found.mesh_origin}."]
    if found.torque:
        sentences += [
            f"Torque: {counted(len(found.torque.slices.torque_nm), 'slice')}, grouped {found.torque.grouping}.",
            f"RMSE: a parabola for single slices, {found.torque.held_out}; no other recording is tried.",
        ]
    if found.regressions:
        sentences.append(_regression_explanation(found.regressions))
    if found.diameter:
        n_slices, n_diameters = len(found.diameter.slices.diameter_mm), len(found.diameter.diameters_mm)
        sentences.append(
            f"Diameter: {counted(n_slices, 'slice')} of {counted(n_diameters, 'diameter')}, smoothed along channels. "
            "The heatmaps of a cylinder are added up to one point, or up to each slice in turn (running sums)."
        )
    if found.models:
        sentences += _model_explanations(found.models)
    absent = [name for name, result in (("torque", found.torque), ("diameter", found.diameter)) if result is None]
    return [*sentences, *(f"There are no {name} slices: nothing about {name}." for name in absent), *found.notes]


def _regression_explanation(regressions: Sequence[ChannelRegression]) -> str:
    by_all, by_fitted = (_count_range(regression.counts_reaching(PAPER_FRACTION)) for regression in regressions)
    return (
        "Linear regression: least squares on the best channels, each part of the recording left out and predicted. "
        "R² first has 80 % of all channels' at the smaller number and keeps it from the larger one: "
        f"{by_all} with channels ranked by all slices, {by_fitted} ranked without the part. "
        "Between them the fit has about as many channels as slices and follows the noise."
    )


def _model_explanations(models: ModelScores) -> list[str]:
    ranked = sorted((score for score in models.matching.values() if score is not None), reverse=True)
    matching = (
        "Matching score: the largest normalised cross-correlation over lags and settings, averaged over the slices; "
        f"first is {_first(models.matching)} by {ranked[0] - ranked[1]:.4f}, and it matches best in "
        f"{max(models.n_slices.values())} of {sum(models.n_slices.values())} slices."
    )
    if models.envelope is None:
        return [f"{matching} The paper's own measure needs TorqueSlice.mat and TorqueSliceHom.mat in torque_slices."]
    first = ", ".join(f"{MODELS[name].title} {count}×" for name, count in models.n_envelopes.items() if count)
    gaps = [abs(score - PAPER_MODEL_SCORES[name]) for name, score in models.envelope.items() if score is not None]
    return [
        "Envelope score: the paper's measure, Spearman's correlation of the envelopes of one raw difference and the "
        "simulated signal at the best circular shift, averaged over settings of a centred model; first is "
        f"{_first(models.envelope)}, and the largest difference from the paper's is {max(gaps, default=0.0):.3f}.",
        f"The ranking depends on the envelope's settings: by {sum(models.n_envelopes.values())} pairs of peak distance "
        f"and moving average around the paper's, first is {first}.",
        matching,
    ]


def _count_range(counts: tuple[int, int] | None) -> str:
    return _NONE if counts is None else f"{counts[0]} to {counts[1]}" if counts[0] < counts[1] else str(counts[0])


def _first(scores: dict[str, float | None]) -> str:
    known = {name: score for name, score in scores.items() if score is not None}
    return MODELS[max(known, key=lambda name: known[name])].title if known else "none"


def _number(value: float | None, digits: int = 5) -> str:
    return _NONE if value is None else f"{value:.{digits}f}"


_GREY, _BLACK, _PINK, _BLUE, _TEAL, _ORANGE = "#8c8c8c", "#222222", "#d6338a", "#1f5f99", "#2a9d8f", "#d9822b"
_SLICES: dict[str, Any] = {"color": _GREY, "alpha": 0.6, "markeredgewidth": 0, "label": "slices"}
_HEATMAPS_SHOWN = 4


def draw_all(found: Reproduction, folder: Path) -> list[Path]:
    """Draw the figures of all existing results as PNG and SVG, and return the paths; raises OSError."""
    figures = {"figure_4_models": models_figure(found.mesh), "figure_6_bank": signal_figure(found.banks["wide"])}
    if found.models:
        figures["figure_5_models"] = model_figure(found.models)
    if torque := found.torque:
        dataset = dataset_figure(torque.slices, torque.parts, found.regressions, found.twists)
        figures |= {"figure_3_dataset": dataset, "figure_7_heatmap": heatmap_figure(torque, found.banks["wide"])}
        figures["figure_8_torque"] = torque_figure(torque, found.banks["focused"])
    if found.diameter:
        figures["figure_9_diameter"] = diameter_figure(found.diameter, found.banks["wide"])
    written = []
    for name, made in figures.items():
        lay_out(made)
        for path in (folder / f"{name}.png", folder / f"{name}.svg"):
            # Without a date, the same numbers make the same file.
            made.savefig(path, dpi=150, metadata={"Date": None} if path.suffix == ".svg" else None)
            written.append(path)
    return written


def model_figure(models: ModelScores) -> Figure:
    """Draw the five models' scores next to the paper's, the paper's best first."""
    names = sorted(PAPER_MODEL_SCORES, key=lambda name: -PAPER_MODEL_SCORES[name])
    bars: list[tuple[str, str, dict[str, float | None]]] = [("paper", _GREY, dict(PAPER_MODEL_SCORES))]
    if models.envelope is not None:
        bars.append(("envelope score, one raw frame (the paper's measure)", _BLUE, models.envelope))
    bars.append(("matching score, mean over the torque slices", _TEAL, models.matching))
    made = figure(9, 4.6)
    axes = made.subplots()
    width = 0.8 / len(bars)
    for place, (label, colour, scores) in enumerate(bars):
        heights = np.array([scores[name] for name in names], dtype=float)
        at = np.arange(len(names)) + (place - (len(bars) - 1) / 2) * width
        drawn = axes.bar(at, heights, 0.92 * width, color=colour, label=label)
        axes.bar_label(drawn, fmt="%.3f", fontsize=7, padding=2)
    axes.set_xticks(np.arange(len(names)), [MODELS[name].title for name in names])
    axes.set(ylim=(0, 1.12), ylabel="score")
    axes.set_yticks(np.arange(0, 1.01, 0.2))
    axes.legend(frameon=False, ncols=len(bars), fontsize=8, loc="upper center")
    axes.set_title("Likeness of the five basis models to measured differences (figure 5)", loc="left", fontsize=11)
    _plain(axes)
    return made


def heatmap_figure(torque: TorqueResult, bank: Bank) -> Figure:
    """Draw one slice's match: its difference, the bank's best signal, and the heatmap over the wide bank."""
    index = int(np.argmax(torque.wide.scores))
    match, number = torque.wide.best[index], int(torque.slices.numbers[index])
    made = figure(12, 5)
    halves = made.add_gridspec(1, 2, width_ratios=[1.25, 1])
    measured, simulated = halves[0].subgridspec(2, 1).subplots(sharex=True, squeeze=False)[:, 0]
    measured.plot(torque.slices.differences[index] * 1e3, color=_BLACK, linewidth=0.6)
    measured.set(ylabel="|difference| (mV)", xlim=(0, PAPER_TABLE.n_channels))
    measured.set_title(f"Measured: slice {number} at {torque.slices.torque_nm[index]:.3f} N·m", loc="left", fontsize=10)
    simulated.plot(np.abs(bank.signals[match.cell]), color=_BLUE, linewidth=0.6)
    simulated.set(ylabel="|signal| (model's voltage)", xlabel="channel")
    best = f"Best of the bank: k = {match.k:.2f} cm, σ = {match.sigma:.2f} cm, score {match.score:.3f}"
    simulated.set_title(best, loc="left", fontsize=10)
    for axes in (measured, simulated):
        _plain(axes)
    axes = made.add_subplot(halves[1])
    image = _heatmap(axes, torque.wide.heatmaps[index], bank, match)
    axes.set_title("Heatmap: largest cross-correlation over all lags", loc="left", fontsize=10)
    made.colorbar(image, ax=axes, label="score", shrink=0.9)
    made.suptitle("From a measured difference to k and σ (figure 7); hatched cells are not valid", fontsize=11)
    return made


def torque_figure(torque: TorqueResult, bank: Bank) -> Figure:
    """Draw sigma against torque with four heatmaps, and the torque predicted from sigma."""
    measured, sigma = torque.slices.torque_nm, torque.focused.sigma
    means_nm, shown = torque.group_torque_nm, _spread_over(measured)
    made, scatter, lower = _relation_figure(
        torque.fit, (sigma, measured), (torque.group_sigma, means_nm), "torque (N·m)",
        "b  second-order polynomial of σ, fitted to the group means",
    )  # fmt: skip
    scatter.plot(measured, sigma, "o", **_SLICES)
    scatter.plot(measured[shown], sigma[shown], "o", color=_PINK, label="heatmaps below")
    scatter.plot(means_nm, torque.group_sigma, "x", color=_BLACK, markersize=9, label="group means")
    title = f"a  r = {_number(torque.r_focused, 3)} for slices, {_number(torque.r_clustered, 3)} for groups"
    _label(scatter, title, xlabel="torque (N·m)", ylabel="σ of the best match (cm)")
    titles = [f"{measured[index]:.3f} N·m, σ = {sigma[index]:.2f} cm" for index in shown]
    _heatmap_row(made, lower, torque.focused, shown, titles, bank)
    made.suptitle(f"Torque from σ (figure 8): {len(measured)} slices, {torque.grouping}, focused bank", fontsize=11)
    return made


def diameter_figure(diameter: DiameterResult, bank: Bank) -> Figure:
    """Draw k against diameter with the accumulated heatmaps, and the diameter predicted from k."""
    measured, k = diameter.slices.diameter_mm, diameter.single.k
    diameters_mm, means_k = diameter.diameters_mm, diameter.accumulated.k
    shown = _spread_over(diameters_mm)
    made, scatter, lower = _relation_figure(
        diameter.fit, (k, measured), (means_k, diameters_mm), "diameter (mm)",
        "b  first-order polynomial of k, fitted to the accumulated matches",
    )  # fmt: skip
    scatter.plot(k, measured, "o", **_SLICES)
    scatter.plot(means_k, diameters_mm, "x", color=_BLACK, markersize=9, label="heatmaps accumulated")
    title = f"a  r = {_number(diameter.r_single, 3)} for slices, {_number(diameter.r_accumulated, 3)} accumulated"
    _label(scatter, title, xlabel="k of the best match (cm)", ylabel="diameter (mm)")
    titles = [f"{diameters_mm[index]:g} mm, k = {means_k[index]:.2f} cm" for index in shown]
    _heatmap_row(made, lower, diameter.accumulated, shown, titles, bank)
    slices = f"{counted(len(measured), 'slice')} of {counted(len(diameters_mm), 'diameter')}"
    made.suptitle(f"Diameter from k (figure 9): {slices}, wide bank", fontsize=11)
    return made


def _relation_figure(
    fit: Polynomial | None,
    slices: tuple[FloatArray, FloatArray],
    means: tuple[FloatArray, FloatArray],
    quantity: str,
    title: str,
) -> tuple[Figure, Axes, SubplotSpec]:
    """Return a figure with drawn predictions, its empty axes for a scatter, and its lower half for heatmaps.

    `slices` and `means` are places of the matches and measured values.
    """
    made = figure(13, 8.2)
    grid = made.add_gridspec(2, 1, height_ratios=[1.25, 1])
    scatter, axes = grid[0].subgridspec(1, 2).subplots(squeeze=False)[0]
    (x, y), ends = slices, [min(*slices[1], *means[1]), max(*slices[1], *means[1])]
    axes.plot(ends, ends, color=_ORANGE, linewidth=1, label="predicted = measured")
    if fit is not None:
        predicted, inside = fit(x), (x >= fit.domain[0]) & (x <= fit.domain[1])
        axes.plot(y[inside], predicted[inside], "o", **_SLICES)
        if not inside.all():
            beyond = "slices beyond the fit"
            axes.plot(y[~inside], predicted[~inside], "o", color=_GREY, markerfacecolor="none", label=beyond)
        axes.plot(means[1], fit(means[0]), "x", color=_BLACK, markersize=9, label="fitted points")
    _label(axes, title, xlabel=f"measured {quantity}", ylabel=f"predicted {quantity}")
    return made, scatter, grid[1]


def _label(axes: Axes, title: str, **labels: str) -> None:
    axes.set(**labels)
    axes.set_title(title, loc="left", fontsize=10)
    axes.legend(frameon=False, fontsize=8)
    _plain(axes)


def _heatmap_row(
    made: Figure, place: SubplotSpec, matches: Matches, shown: list[int], titles: list[str], bank: Bank
) -> None:
    """Draw some heatmaps side by side, each relative to its own maximum."""
    row = place.subgridspec(1, len(shown)).subplots(sharey=True, squeeze=False)[0]
    best = [matches.best[index] for index in shown]
    below = [matches.heatmaps[index] - matches.scores[index] for index in shown]
    # Skip the worst half of the cells, which would take most of the colours.
    lowest = float(np.median([np.nanmedian(heatmap) for heatmap in below]))
    for axes, heatmap, match, title in zip(row, below, best, titles, strict=True):
        image = _heatmap(axes, heatmap, bank, match, (min(lowest, -1e-6), 0.0))
        axes.set_title(f"{title}, score {match.score:.3f}", fontsize=9)
        axes.label_outer()
    made.colorbar(image, ax=list(row), label="score − the map's maximum", extend="min")


def _heatmap(
    axes: Axes, heatmap: FloatArray, bank: Bank, match: Match, limits: tuple[float, float] | None = None
) -> QuadMesh:
    """Draw scores over σ and k with the maximum marked; invalid cells stay hatched."""
    axes.patch.set(hatch="////", edgecolor="#c8c8c8", facecolor="white")
    low, high = limits or (None, None)
    image = axes.pcolormesh(
        bank.sigma_grid, bank.k_grid, heatmap, cmap="viridis", vmin=low, vmax=high, shading="nearest", rasterized=True
    )
    axes.plot(match.sigma, match.k, "o", markersize=8, markerfacecolor="none", markeredgecolor=_PINK, markeredgewidth=2)
    axes.set(xlabel="σ (cm)", ylabel="k (cm)")
    return image


def _spread_over(values: FloatArray) -> list[int]:
    """Return the indices of up to four values, evenly spread from the smallest to the largest."""
    shown: list[int] = np.argsort(values, kind="stable")[evenly_spread(len(values), _HEATMAPS_SHOWN)].tolist()
    return shown


def _plain(axes: Axes) -> None:
    axes.spines[["top", "right"]].set_visible(False)
