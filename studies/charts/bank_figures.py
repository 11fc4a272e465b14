"""Figures of a bank: its signals over the grid, and conductivity and signals of the five basis models."""

import numpy as np
from matplotlib.colors import TwoSlopeNorm
from matplotlib.figure import Figure

from shearloop.bank.arrays import IntArray
from shearloop.bank.bank_file import Bank
from shearloop.bank.channels import PAPER_TABLE
from shearloop.bank.forward import ForwardModel
from shearloop.bank.mesh import Mesh
from shearloop.bank.models import MODELS, conductivity
from shearloop.tools.drawing import figure

_PANELS = 10
_BLUE, _GREY = "#1f5f99", "#8a8a8a"


def evenly_spread(count: int, most: int) -> IntArray:
    """Return up to `most` places, evenly spread over `count`, first and last included."""
    return np.unique(np.rint(np.linspace(0, count - 1, min(most, count))).astype(np.int64))


def signal_figure(bank: Bank) -> Figure:
    """Draw up to ten rows and columns of a bank's signals, as figure 6 of Trehan et al. 2025 does.

    Signals differ a hundredfold in size, so every panel is scaled to its peak and shows it.
    """
    model = MODELS[bank.model]
    of_k, of_sigma = (evenly_spread(len(grid), _PANELS) for grid in (bank.k_grid, bank.sigma_grid))
    rows, columns = len(of_sigma), len(of_k)
    made = figure(1.35 * columns + 1.2, 0.85 * rows + 1.4)
    axes = made.subplots(rows, columns, squeeze=False, gridspec_kw={"wspace": 0.08, "hspace": 0.12})
    for row, s in enumerate(reversed(of_sigma)):
        for column, k in enumerate(of_k):
            panel = axes[row, column]
            panel.set(xticks=[], yticks=[])
            if bank.valid[k, s]:
                signal = bank.signals[k, s]
                peak = float(np.abs(signal).max())
                panel.plot(signal / peak, color=_BLUE, linewidth=0.35)
                panel.set_ylim(-1.15, 1.6)
                panel.text(0.97, 0.95, f"{peak:.2g}", transform=panel.transAxes, ha="right", va="top", fontsize=6)
            else:
                panel.set_facecolor("#eeeeee")
                panel.text(0.5, 0.5, "not valid", transform=panel.transAxes, ha="center", va="center", fontsize=6)
            if row == rows - 1:
                panel.set_xlabel(f"{bank.k_grid[k]:.3g}", fontsize=8)
            if column == 0:
                panel.set_ylabel(f"{bank.sigma_grid[s]:.3g}", fontsize=8, rotation=0, ha="right", va="center")
    made.supxlabel(f"k ({model.k_unit})", fontsize=10)
    made.supylabel(f"σ ({model.sigma_unit})", fontsize=10)
    made.suptitle(
        f"Signals of the model “{model.title}”: v(k, σ) − v(homogeneous) over 896 channels, each panel scaled to "
        "its peak (model's voltage, upper right)",
        fontsize=10,
    )
    return made


def models_figure(mesh: Mesh) -> Figure:
    """Draw basis function, conductivity and signal of the five models, as figure 4 of Trehan et al. 2025 does."""
    forward = ForwardModel(mesh)
    homogeneous = forward.homogeneous()
    low, high = mesh.nodes.min(axis=0), mesh.nodes.max(axis=0)
    y = np.linspace(low[1], high[1], 400)
    centre = float(low[1] + high[1]) / 2
    height = mesh.height_cm
    # k and σ that show each model with a positive conductivity, for any height.
    examples = {
        "step": (height / 2, height),
        "linear": (height / 2, 1.1 * height),
        "cut_linear": (0.65 * height, 0.7 * height),
        # Its steepest fall, e^(-1/2)/σ with σ in cm, limits σ.
        "gaussian_derivative": (height / 2, max(0.9, 0.2 * height)),
        "modulated_gaussian": (3.0, 0.25 * height),
    }
    made = figure(13.5, 2.25 * len(examples) + 0.9)
    axes = made.subplots(len(examples), 3, gridspec_kw={"width_ratios": [1.1, 1.5, 3]})
    norm = TwoSlopeNorm(1.0, 0.0, 2.0)
    for (curve, plane, signal), (name, (k, sigma)) in zip(axes, examples.items(), strict=True):
        basis = MODELS[name]
        values = conductivity(mesh, name, k, sigma)
        curve.plot(basis.function(y, k, sigma, centre), y, color=_BLUE)
        curve.axvline(0, color=_GREY, linewidth=0.6)
        curve.set(xlim=(-1.1, 1.1), ylim=(low[1], high[1]), ylabel="y (cm)")
        parameters = [f"k = {k:.3g} {basis.k_unit}"]
        if basis.uses_sigma:
            parameters.append(f"σ = {sigma:.3g} {basis.sigma_unit}")
        curve.set_title(f"{basis.title}: {', '.join(parameters)}", fontsize=9, loc="left")
        drawn = plane.tripcolor(
            *mesh.nodes.T, mesh.triangles, facecolors=values, cmap="RdBu_r", norm=norm, rasterized=True
        )
        for edge in mesh.electrode_edges:
            plane.plot(*mesh.nodes[edge].T, color="black", linewidth=2.5, solid_capstyle="butt", clip_on=False)
        plane.set(aspect="equal", xlim=(low[0], high[0]), ylim=(low[1], high[1]), ylabel="y (cm)")
        made.colorbar(drawn, ax=plane, label="conductivity\n(homogeneous = 1)", ticks=[0, 0.5, 1, 1.5, 2])
        signal.plot(forward.voltages(values) - homogeneous, color=_BLUE, linewidth=0.5)
        signal.set(xlim=(0, PAPER_TABLE.n_channels), ylabel="v − v(homog.)\n(model's voltage)")
    axes[-1, 0].set_xlabel("basis function f")
    axes[-1, 1].set_xlabel("x (cm)")
    axes[-1, 2].set_xlabel("channel")
    made.suptitle(
        "The five basis models: f, conductivity 1 + f with the electrodes, and the signal it makes", fontsize=11
    )
    return made
