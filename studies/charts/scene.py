"""`shearloop chart scene`: how much model a recording needs, by its own noise, on each fingertip."""

import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from shearloop.bank.design import ALLOWED, Design, DesignChoice, design_bank, simulated_frames
from shearloop.studies.charts.chart_data import Split, own_fingertip
from shearloop.studies.slices.scene import scene_of_slices
from shearloop.studies.slices.series import SliceSeries
from shearloop.tools.bank_config import load_fingertip
from shearloop.tools.bank_design import doubts, scene_of
from shearloop.tools.banks import OWN_FINGERTIP
from shearloop.tools.drawing import SHADES, figure, save, slug
from shearloop.tools.parallel import Executor

_MESH_SIZE_CM = 0.07
_MIN_SHOWN, _MAX_TICKS = 1e-3, 12


def chart(parts: Sequence[Split], out: Path, executor: Executor) -> list[Path]:
    """Design for each recording on each fingertip, draw and write; print doubts on stderr, as `bank design` does.

    Recordings are of the paper's fingertip. On the others the same grip is simulated with the same fraction of noise.
    """
    titles = [split.title.split(",", maxsplit=1)[0] for split in parts]
    wholes = [split.whole for split in parts]
    scenes = [scene_of_slices(whole) if isinstance(whole, SliceSeries) else scene_of(whole) for whole in wholes]
    found = list(executor.map(design_bank, own_fingertip(_MESH_SIZE_CM), scenes))
    written = []
    for title, design in zip(titles, found, strict=True):
        for sentence in doubts(design):
            print(f"shearloop chart: {title}: {sentence}", file=sys.stderr)
        written += write(title, design, out)
    for path in sorted(OWN_FINGERTIP.parent.glob("*.yaml")):
        if path == OWN_FINGERTIP:
            continue
        fingertip = load_fingertip(path)
        simulated = [simulated_frames(design, fingertip) for design in found]
        for title, design in zip(titles, executor.map(design_bank, fingertip, simulated), strict=True):
            written += write(f"{title} {path.stem}, simulated", design, out)
    return written


def write(title: str, design: Design, out: Path) -> list[Path]:
    """Draw and write a design."""
    made = figure(17, 12)
    grid = made.add_gridspec(3, 3, height_ratios=[1, 1, 0.9])
    for number, choice in enumerate(design.choices):
        _draw_choice(made.add_subplot(grid[divmod(number, 3)]), choice)
    _draw_models(made.add_subplot(grid[2, 0]), design)
    _draw_table(made.add_subplot(grid[2, 1:]), design.choices)
    made.suptitle(
        f"How much model {title} needs: its noise is {design.relative_noise:.1%} of a difference frame; "
        "ring: the coarsest that adds less than a third of it",
        fontsize=13,
    )  # fmt: skip
    content = asdict(design) | {
        "allowed": ALLOWED,
        "chosen": {choice.name: asdict(choice.chosen) | {"enough": choice.enough} for choice in design.choices},
    }
    return save(made, content, out, f"scene-{slug(title)}")


def _draw_choice(axes: Axes, choice: DesignChoice) -> None:
    settings, added = ([getattr(step, name) for step in choice.steps] for name in ("setting", "added"))
    # A logarithmic axis cannot show the zero of an exact choice.
    shown = np.maximum(added, _MIN_SHOWN)
    axes.plot(settings, shown, "-o", color=SHADES[1], markersize=5)
    scale = "linear" if len(settings) > _MAX_TICKS else "log"
    axes.set(xscale=scale, yscale="log", xlabel=f"{choice.name}, {choice.unit}", ylabel="added error / noise")
    axes.axhline(ALLOWED, color="black", linestyle="--", linewidth=1)
    # Errors fall to the right, so the corner above the line is free there.
    axes.annotate(
        "a third of the noise", (0.98, ALLOWED), xycoords=("axes fraction", "data"), xytext=(0, 3),
        textcoords="offset points", fontsize=8, ha="right",
    )  # fmt: skip
    chosen = choice.chosen
    ring = max(chosen.added, _MIN_SHOWN)
    axes.plot(chosen.setting, ring, "o", markersize=15, markerfacecolor="none", color="black")
    if settings[0] > settings[-1]:
        axes.invert_xaxis()
    if scale == "log":
        ticks = settings[:: max(1, len(settings) // _MAX_TICKS)]
        axes.set_xticks(ticks, [f"{value:g}" for value in ticks], fontsize=8, rotation=60)
        axes.minorticks_off()
    axes.set_ylim(0.5 * min(shown), 3.0 * max(*shown, ALLOWED))
    axes.grid(alpha=0.25)
    cost = chosen.cost.split(";", maxsplit=1)[0]
    axes.set_title(f"{chosen.setting:g} {choice.unit}: {cost}", fontsize=9.5)


def _draw_models(axes: Axes, design: Design) -> None:
    ranked = sorted(design.models, key=lambda fit: fit.penalised)
    for i, fit in enumerate(ranked):
        axes.barh(i, fit.penalised, xerr=fit.standard_error, color="#d9d9d9", edgecolor="black", capsize=3,
                  hatch="//" if fit.model == design.model else None)  # fmt: skip
        axes.plot(fit.error, i, "|", color="black", markersize=16, markeredgewidth=2)
    axes.axvline(design.relative_noise, color="black", linestyle=":", linewidth=1.2)
    axes.set_yticks(range(len(ranked)), [f"{fit.model}\n({fit.parameters} parameters)" for fit in ranked], fontsize=8.5)
    axes.invert_yaxis()
    axes.set(
        xlabel="unexplained on other injections, share of a frame\n(bar: penalised; tick: not; dotted: the noise)",
        title="model that the data supports (hatched)",
    )  # fmt: skip


def _draw_table(axes: Axes, choices: Sequence[DesignChoice]) -> None:
    rows = []
    for choice in choices:
        step, after = choice.chosen, choice.next_step
        row = [choice.name, f"{step.setting:g}", f"{step.added:.2f}", "–", "–", "–"]
        if after is not None:
            buys = np.sqrt(1 + step.added**2) - np.sqrt(1 + after.added**2)
            row[3:] = f"{after.setting:g}", f"{buys:.1%} less error", after.cost.split(";", maxsplit=1)[0]
        rows.append(row)
    axes.set_axis_off()
    table = axes.table(
        rows, colLabels=["", "chosen", "adds (noise = 1)", "next step", "benefit", "cost"],
        loc="center", cellLoc="left", colWidths=[0.17, 0.09, 0.14, 0.1, 0.16, 0.36],
    )  # fmt: skip
    table.auto_set_font_size(False)
    table.set_fontsize(9)
    table.scale(1, 1.9)
    axes.set_title("Benefit of each further step")
