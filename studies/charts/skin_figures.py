"""Figures 4 to 8 of the shear skin's paper, redrawn from the models, and the slope within the deadband."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from shearloop.bank.arrays import FloatArray
from shearloop.estimation.skin.membrane import PAPER_SECTION, warming_change
from shearloop.studies.skin.characterisation import PAPER_LINEAR_N, WARM_K, Characterisation, ResponseCurve
from shearloop.tools.drawing import figure

ONE_D, TWO_D, GREY = "#c44e52", "#1f4e79", "#888888"
MARKERS = {0.5: "^", 1.0: "s", 1.5: "o", 2.0: "D"}
PAPER_PREDICTION_N, PAPER_SENSITIVITY_PER_N = 0.0802, 0.078


def draw(found: Characterisation, out: Path) -> list[Path]:
    """Write the figures as PNG and SVG into a folder and return their paths; raises OSError."""
    drawn_by_name = {
        "figure_4": _figure_4(found),
        "figure_5": _figure_5(found),
        "figure_6": _figure_6(found),
        "figure_7": _figure_7(found),
        "figure_8": _figure_8(found),
        "deadband": _deadband(found),
    }
    written = []
    for name, drawn in drawn_by_name.items():
        for suffix in ("png", "svg"):
            written.append(out / f"{name}.{suffix}")
            drawn.savefig(written[-1], dpi=150)
    return written


def _new(title: str, xlabel: str = "shear force, N", ylabel: str = "normalised response") -> tuple[Figure, Axes]:
    made = figure(7.0, 4.6)
    axes = made.add_subplot()
    axes.set(title=title, xlabel=xlabel, ylabel=ylabel)
    axes.grid(alpha=0.25)
    return made, axes


def _figure_4(found: Characterisation) -> Figure:
    made = figure(10.0, 4.4)
    panels = np.atleast_1d(made.subplots(1, len(found.strain_maps)))
    most = 100 * max(abs(strain).max() for _, strain in found.strain_maps.values())
    core = np.radians(np.linspace(0, 180, 181))
    for axes, (shear_n, (places, strain)) in zip(panels, found.strain_maps.items(), strict=True):
        for (x, y), value in zip(places.swapaxes(0, 1), 100 * strain, strict=True):
            painted = axes.pcolormesh(x, y, value, shading="gouraud", cmap="RdBu_r", vmin=-most, vmax=most)
            painted.set_rasterized(True)
        radius = PAPER_SECTION.inner_radius_mm
        axes.fill(-radius * np.cos(core), -radius * np.sin(core), facecolor="#eeeeee", edgecolor=GREY, lw=0.8)
        arrow = {"arrowstyle": "->", "lw": 1.6}
        below = -PAPER_SECTION.outer_radius_mm - 0.15
        axes.annotate("", xy=(2.4 * shear_n, below), xytext=(0, below), arrowprops=arrow)
        axes.annotate("", xy=(0, below), xytext=(0, below - 1.6), arrowprops=arrow)
        axes.set(title=f"Fn = 1 N, Ft = {shear_n:g} N", xlabel="x, mm", ylabel="y, mm", aspect="equal")
        axes.set(xlim=(-7.6, 7.6), ylim=(below - 1.9, 0.6))
    made.colorbar(painted, ax=list(panels), label="circumferential strain, %", shrink=0.8)
    made.suptitle("Figure 4: strain and bulging (2-D, finite strain)")
    return made


def _figure_5(found: Characterisation) -> Figure:
    made, axes = _new(
        "Figure 5: strain at mid-thickness, Fn = 1 N (2-D)",
        "angle from the bracket, degrees",
        "circumferential strain, %",
    )
    last = len(found.strain_profiles) - 1
    for i, profile in enumerate(found.strain_profiles):
        shade = 0.25 + 0.75 * i / last
        axes.plot(found.line_deg, 100 * profile, color=TWO_D, alpha=shade, lw=1.2)
    tip = 60, 100 * found.strain_profiles[last].max() * 0.75
    axes.annotate("", xy=tip, xytext=(60, 0.15), arrowprops={"arrowstyle": "->", "color": GREY})
    axes.text(47, 4.9, "Ft = 0, 0.1, … 1 N", color=GREY)
    begin, end = PAPER_SECTION.gauge_from_deg, PAPER_SECTION.gauge_to_deg
    for left, right, name in ((begin, end, "gauge 1"), (180 - end, 180 - begin, "gauge 2")):
        axes.axvspan(left, right, color=GREY, alpha=0.12, lw=0)
        axes.text((left + right) / 2, -0.9, name, ha="center", color=GREY)
    axes.set_xlim(0, 180)
    axes.set_xticks(range(0, 181, 15))
    return made


def _both_sides(curve: ResponseCurve, response: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return a loading and its mirror image: the skin is symmetrical."""
    shear = np.concatenate([-curve.shear_n[::-1], [0.0], curve.shear_n])
    return shear, np.concatenate([-response[::-1], [0.0], response])


def _figure_6(found: Characterisation) -> Figure:
    made, axes = _new("Figure 6: response to shear, Fn = 1 N")
    axes.plot(*_both_sides(found.wide, found.wide.two_d), color=TWO_D, label="2-D, 0.70 mm")
    axes.plot(*_both_sides(found.wide, found.wide.membrane), color=ONE_D, ls="--", label="1-D, 0.88 mm")
    ends = np.array([-1.0, 1.0])
    for sign, label in ((-1, None), (1, "paper: 0.078 /N ± 95 % prediction interval")):
        edge = PAPER_SENSITIVITY_PER_N * (ends + sign * PAPER_PREDICTION_N)
        axes.plot(ends, edge, color=GREY, ls=(0, (6, 4)), lw=1, label=label)
    inset = axes.inset_axes((0.60, 0.09, 0.38, 0.40))
    inset.plot(*_both_sides(found.near_zero, found.near_zero.two_d), color=TWO_D)
    inset.plot(*_both_sides(found.near_zero, found.near_zero.membrane), color=ONE_D, ls="--")
    inset.plot(
        *_both_sides(found.near_zero, found.near_zero.two_d_slippery), color=GREY, ls=":", label="2-D, no friction"
    )
    inset.legend(fontsize=7, loc="upper left", frameon=False)
    inset.tick_params(labelsize=7)
    inset.grid(alpha=0.25)
    axes.legend(loc="upper left", fontsize=8)
    return made


def _figure_7(found: Characterisation) -> Figure:
    made, axes = _new("Figure 7: response under different normal forces")
    for normal_n, curve in found.wide_by_normal.items():
        (marks,) = axes.plot(*_both_sides(curve, curve.two_d), MARKERS[normal_n], label=f"2-D, Fn = {normal_n} N")
        marks.set(mfc="none", color=TWO_D, ms=5)
        last = normal_n == max(found.wide_by_normal)
        axes.plot(*_both_sides(curve, curve.membrane), color=ONE_D, lw=0.8, label="1-D, 0.88 mm" if last else None)
    for end in (-PAPER_LINEAR_N, PAPER_LINEAR_N):
        axes.axvline(end, color=GREY, ls=":", lw=1)
    note = "beyond 1.2 N the paper's skin\nturns up more than any model"
    axes.text(PAPER_LINEAR_N - 0.03, -0.13, note, color=GREY, ha="right")
    axes.legend(loc="upper left", fontsize=8)
    return made


def _figure_8(found: Characterisation) -> Figure:
    made, axes = _new("Figure 8: response at 25 °C and 40 °C, Fn = 1 N")
    curve, change = found.wide, warming_change(WARM_K)
    shear_n, cold = _both_sides(curve, curve.two_d)
    # Equation (1): what changes both gauges' resistance by the same factor cancels against a zero at that temperature.
    warm = (1 + change) * cold
    axes.plot(shear_n[::5], cold[::5], "o", mfc="none", color=TWO_D, label="25 °C")
    axes.plot(shear_n[::5], (warm / (1 + change))[::5], "x", color=ONE_D, label="40 °C, with a zero at 40 °C")
    axes.plot(shear_n, warm, color=GREY, lw=1, label=f"40 °C, with the zero of 25 °C: {100 * change:+.2f} %")
    axes.legend(loc="upper left", fontsize=8)
    return made


def _deadband(found: Characterisation) -> Figure:
    made, axes = _new("Slope of the response within the deadband, Fn = 1 N", ylabel="slope, 1/N")
    near = found.near_zero
    shear_n = np.concatenate([[0.0], near.shear_n])
    for response, style, color, label in (
        (near.two_d, "-", TWO_D, "2-D"),
        (near.membrane, "--", ONE_D, "1-D"),
        (near.two_d_slippery, ":", GREY, "2-D, no friction"),
    ):
        slope = np.diff(np.concatenate([[0.0], response])) / np.diff(shear_n)
        axes.stairs(slope, shear_n, ls=style, color=color, baseline=None, label=label)
    axes.legend(loc="lower right", fontsize=8)
    return made
