"""What a reproduction found: as JSON, and as a table beside the paper's numbers."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from shearloop.bank.arrays import FloatArray
from shearloop.bank.eit.bank_file import Bank
from shearloop.bank.eit.models import MODELS
from shearloop.bank.errors import CalibrationError
from shearloop.bank.estimation import Calibration
from shearloop.daemon.analysis.reproduce.analysis import DiameterResult, ModelScores, TorqueResult, all_notes
from shearloop.daemon.analysis.reproduce.banks import Grid

PAPER = "Trehan, Hardman and Iida 2025, Sensors 25, 5159"
# As published, and without the signs: sigma falls as torque rises, and k as diameter does.
PAPER_TORQUE_R, PAPER_TORQUE_CLUSTERED_R, PAPER_DIAMETER_R = 0.6552, 0.9588, 0.9746
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
    """All that was found, and on which mesh; None where the recordings were not there."""

    mesh_origin: str
    bank_valid_cells: int
    torque: TorqueResult | None
    diameter: DiameterResult | None
    models: ModelScores | None
    notes: tuple[str, ...]


def moved_focus(grid: Grid) -> str:
    """Return the sentence for a focused bank that is not where the paper's is."""
    return (
        "Most slices match best beyond the paper's focused bank: this one lies around them, "
        f"k {grid.k[0]:.2f} to {grid.k[-1]:.2f} cm, sigma {grid.sigma[0]:.2f} to {grid.sigma[-1]:.2f} cm."
    )


def as_json(found: Reproduction) -> dict[str, Any]:
    """Return the numbers by name; None where the recordings do not determine one."""
    torque, diameter, models = found.torque, found.diameter, found.models
    return {
        "torque_sigma_r_focused": torque.r_focused if torque else None,
        "torque_sigma_r_wide": torque.r_wide if torque else None,
        "torque_sigma_r_clustered": torque.r_clustered if torque else None,
        "diameter_k_r_single": diameter.r_single if diameter else None,
        "diameter_k_r_accumulated": diameter.r_accumulated if diameter else None,
        "model_scores": models.chosen if models else dict.fromkeys(MODELS),
        "torque_rmse_nm_cross_validated": torque.rmse_nm if torque else None,
        "bank_valid_cells": found.bank_valid_cells,
    }


def json_text(found: Reproduction) -> str:
    """Return the JSON as it is printed and written."""
    return json.dumps(as_json(found), indent=2, allow_nan=False)


def table(found: Reproduction) -> str:
    """Return the comparison with the paper, and below it what there is to know about the numbers."""
    rows = [("", "paper", "here")]
    if found.torque:
        torque = found.torque
        rows += [
            ("torque and sigma, r, single slices, focused bank", _bare(PAPER_TORQUE_R), _number(torque.r_focused)),
            ("torque and sigma, r, single slices, wide bank", "", _number(torque.r_wide)),
            ("torque and sigma, r, groups of slices", _bare(PAPER_TORQUE_CLUSTERED_R), _number(torque.r_clustered)),
            ("torque of a single slice, RMSE cross-validated, N·m", "", _number(torque.rmse_nm)),
            ("   beside the torques' standard deviation, N·m", "", _number(float(torque.slices.torque_nm.std()))),
        ]
    if found.diameter:
        diameter = found.diameter
        rows += [
            ("diameter and k, r, single slices", "", _number(diameter.r_single)),
            ("diameter and k, r, heatmaps accumulated", _bare(PAPER_DIAMETER_R), _number(diameter.r_accumulated)),
        ]
    if found.models:
        what = "matching" if found.models.envelope is None else "envelope"
        rows += [
            (f"{MODELS[name].title}: {what} score", _bare(PAPER_MODEL_SCORES[name]), _number(score))
            for name, score in found.models.chosen.items()
        ]
        if found.models.envelope is not None:
            rows += [
                (f"{MODELS[name].title}: matching score, mean over slices", "", _number(score))
                for name, score in found.models.matching.items()
            ]
    rows.append(("cells of the wide bank that are valid", "", str(found.bank_valid_cells)))
    width = max(len(name) for name, *_ in rows)
    lines = [f"{name:<{width}}  {paper:>8}  {here:>9}".rstrip() for name, paper, here in rows]
    return "\n".join([*lines, "", *explanations(found)])


def explanations(found: Reproduction) -> list[str]:
    """Return sentences on how the numbers came about, and on what is missing."""
    said = [f"Paper: {PAPER}; it gives magnitudes, and torque from 99 slices.", f"Mesh: {found.mesh_origin}."]
    if found.torque:
        said += [
            f"Torque: {len(found.torque.slices.torque_nm)} slices, grouped {found.torque.grouping}.",
            f"RMSE: a parabola for single slices, {found.torque.held_out}; slices of no other recording are tried.",
        ]
    if found.diameter:
        n_slices, n_diameters = len(found.diameter.slices.diameter_mm), len(found.diameter.diameters_mm)
        said.append(f"Diameter: {n_slices} slices of {n_diameters} diameters, smoothed along the channels.")
    if found.models:
        said += model_explanations(found.models)
    return said + list(found.notes) + all_notes([found.torque, found.diameter])


def model_explanations(models: ModelScores) -> list[str]:
    """Return what the model scores are, how near they come to the paper's, and which model is first."""
    matching = (
        "Matching score: the largest normalised cross-correlation over lags and settings, averaged over the slices; "
        f"first is {_first(models.matching)}."
    )
    if models.envelope is None:
        return [f"{matching} The paper's own measure needs TorqueSlice.mat and TorqueSliceHom.mat in torque_slices."]
    gaps = [abs(score - PAPER_MODEL_SCORES[name]) for name, score in models.envelope.items() if score is not None]
    return [
        "Envelope score: the paper's measure, Spearman's correlation of the envelopes of one raw difference and the "
        "simulated signal at the best circular shift, averaged over settings of a centred model; first is "
        f"{_first(models.envelope)}, and the farthest from the paper's is {max(gaps, default=0.0):.3f} away.",
        matching,
    ]


def write_json(found: Reproduction, folder: Path) -> Path:
    """Write the JSON into a folder and return its path; raises OSError."""
    path = folder / "reproduce.json"
    path.write_text(json_text(found) + "\n", encoding="utf-8")
    return path


def save_calibrations(found: Reproduction, banks: dict[str, Bank], recordings: Path, folder: Path) -> list[Path]:
    """Write a calibration file for every fit that the slices determine, and return the paths.

    Torque is fitted to single slices, whose scatter a single frame has; diameters likewise. Raises CalibrationError
    where a file cannot be written.
    """
    fits: dict[str, tuple[str, dict[str, tuple[FloatArray, FloatArray]]]] = {}
    if found.torque:
        for bank, matches in (("focused", found.torque.focused), ("wide", found.torque.wide)):
            fits[f"torque_{bank}"] = (bank, {"torque": (matches.sigma, found.torque.slices.torque_nm)})
    if found.diameter:
        fits["diameter_wide"] = ("wide", {"diameter": (found.diameter.single.k, found.diameter.slices.diameter_mm)})
    written = []
    for name, (bank, points) in fits.items():
        source = f"{name.split('_')[0]} slices of {recordings.name}, on the {bank} bank"
        try:
            calibration = Calibration.from_matches(banks[bank].identity, source, **points)
        except CalibrationError:  # told in the notes already
            continue
        written.append(folder / f"calibration_{name}.cal")
        calibration.save(written[-1])
    return written


def _first(scores: dict[str, float | None]) -> str:
    known = {name: score for name, score in scores.items() if score is not None}
    return MODELS[max(known, key=lambda name: known[name])].title if known else "none"


def _bare(value: float) -> str:
    return f"{value:.4f}"


def _number(value: float | None) -> str:
    return "none" if value is None else f"{value:.5f}"
