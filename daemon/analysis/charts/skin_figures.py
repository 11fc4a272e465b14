"""Figures 5, 6 and 7 of the shear skin's paper, redrawn from the models."""

from pathlib import Path

import numpy as np

from shearloop.bank.arrays import FloatArray
from shearloop.bank.skin.characterisation import Characterisation, ResponseCurve
from shearloop.bank.skin.membrane import PAPER_SECTION
from shearloop.daemon.errors import UserError

try:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from shearloop.daemon.analysis.charts.drawing import figure
except ImportError as error:
    raise UserError("Drawing needs matplotlib: install the extra `plot`, or leave out --out.") from error

ONE_D, TWO_D, GREY = "#c44e52", "#1f4e79", "#888888"
MARKERS = {0.5: "^", 1.0: "s", 1.5: "o", 2.0: "D"}
PAPER_PREDICTION_N, PAPER_SENSITIVITY_PER_N, PAPER_LINEAR_N = 0.0802, 0.078, 1.2


def draw(found: Characterisation, out: Path) -> list[Path]:
    """Write the three figures as PNG and SVG into a folder and return their paths."""
    written = []
    try:
        out.mkdir(parents=True, exist_ok=True)
        for number, drawn in enumerate((_figure_5(found), _figure_6(found), _figure_7(found)), start=5):
            for suffix in ("png", "svg"):
                written.append(out / f"figure_{number}.{suffix}")
                drawn.savefig(written[-1], dpi=150)
    except OSError as error:
        raise UserError(f"{out}: the figures cannot be written: {error}.") from error
    return written


def _new(title: str, xlabel: str, ylabel: str) -> tuple[Figure, Axes]:
    made = figure(7.0, 4.6)
    axes = made.add_subplot()
    axes.set(title=title, xlabel=xlabel, ylabel=ylabel)
    axes.grid(alpha=0.25)
    return made, axes


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
    made, axes = _new("Figure 6: response to shear, Fn = 1 N", "shear force, N", "normalised response")
    axes.plot(*_both_sides(found.wide, found.wide.two_d), color=TWO_D, label="2-D")
    axes.plot(*_both_sides(found.wide, found.wide.membrane), color=ONE_D, ls="--", label="1-D")
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
    made, axes = _new("Figure 7: response under different normal forces", "shear force, N", "normalised response")
    for normal_n, curve in found.wide_by_normal.items():
        (marks,) = axes.plot(*_both_sides(curve, curve.two_d), MARKERS[normal_n], label=f"2-D, Fn = {normal_n} N")
        marks.set(mfc="none", color=TWO_D, ms=5)
        axes.plot(*_both_sides(curve, curve.membrane), color=ONE_D, lw=0.8, label="1-D" if normal_n == 2.0 else None)
    for end in (-PAPER_LINEAR_N, PAPER_LINEAR_N):
        axes.axvline(end, color=GREY, ls=":", lw=1)
    note = "beyond 1.2 N the paper's skin\nturns up; the models do not"
    axes.text(PAPER_LINEAR_N - 0.03, -0.13, note, color=GREY, ha="right")
    axes.legend(loc="upper left", fontsize=8)
    return made
