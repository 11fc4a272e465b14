"""`shearloop chart stability`: every fault on every recording, what is asked of slices, the bank's rims, the skin."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from shearloop.bank.eit.bank_file import Bank
from shearloop.bank.eit.mesh import Mesh
from shearloop.bank.estimation import Name, Physics
from shearloop.daemon.analysis.charts import limit_cycle
from shearloop.daemon.analysis.charts.continuity import STEPS, walks
from shearloop.daemon.analysis.charts.detectability import detectability_figure, detected
from shearloop.daemon.analysis.charts.extrapolation import extrapolated
from shearloop.daemon.analysis.charts.picture import save
from shearloop.daemon.analysis.charts.rims import at_rims
from shearloop.daemon.analysis.charts.sources import Split, splits
from shearloop.daemon.analysis.charts.stability import BROKEN_SHARE, Curve, fitted, misaligned, sweeps
from shearloop.daemon.analysis.charts.stability_picture import continuity_figure, extrapolation_figure, sweeps_figure
from shearloop.daemon.errors import UserError
from shearloop.daemon.workers import Executor

SLICE_NAMES: tuple[Name, ...] = ("paper", "bank", "regression", "reconstruction", "fused")
STREAM_NAMES: tuple[Name, ...] = ("bank", "regression", "fused")
SHIFTS_S = (-0.54, -0.27, -0.13, 0.0, 0.13, 0.27, 0.54, 1.08)


def chart(parts: Sequence[Split], bank: Bank, mesh: Mesh, scratch: Path, out: Path, pool: Executor) -> list[Path]:
    """Sweep, draw and write: a chart per recording, more of slices, and the bank's rims and the loop on the skin."""
    physics, written = Physics(bank, mesh), []
    made_for = {"raw": STREAM_NAMES, "difference": SLICE_NAMES}
    for split in parts:
        curves = sweeps(split, made_for[split.past.kind], physics, bank, pool)
        if split.past.kind == "raw":
            curves += misaligned(split, STREAM_NAMES, physics, SHIFTS_S)
        if not curves:
            raise UserError(f"{split.title}: no estimator can be calibrated on it, as told above; chart a longer one")
        written += _written(f"stability-{_slug(split.title)}", split.title, curves, out)
        if split.past.kind == "difference":
            written += _of_slices(split, bank, mesh, out, pool)
    synthetic = next(one for one in splits([], 0.6, scratch) if one.past.kind == "difference")
    curves = list(at_rims(fitted(synthetic, SLICE_NAMES, physics), bank, scratch))
    written += _written("stability-rims", "where the bank ends, on synthetic slices", curves, out)
    return written + limit_cycle.chart(out, pool, "stability-skin")


def _of_slices(split: Split, bank: Bank, mesh: Mesh, out: Path, pool: Executor) -> list[Path]:
    """Write what is asked of slices alone: continuity, torques beyond those calibrated on, foreign frames."""
    slug, physics = _slug(split.title), Physics(bank, mesh)
    found = walks(split, bank, fitted(split, ("regression", "fused"), physics))
    rows = [asdict(one) | {"largest_hop_nm": one.largest_hop_nm, "hops": one.hops} for one in found]
    written = save(
        continuity_figure(split.title, found), {"steps": STEPS, "walks": rows}, out, f"continuity-{slug}"
    )  # fmt: skip
    beyond = extrapolated(split, SLICE_NAMES, bank, mesh, pool)
    content = {
        "broken_share": BROKEN_SHARE,
        "title": split.title,
        "extrapolations": [asdict(one) | {"times_good": one.times_good} for one in beyond],
    }
    written += save(extrapolation_figure(split.title, beyond), content, out, f"extrapolation-{slug}")
    seen = detected(split.whole)
    return written + save(
        detectability_figure(split.title.split(",", maxsplit=1)[0], seen),
        {"mixtures": [asdict(one) for one in seen]}, out, f"detectability-{slug}",
    )  # fmt: skip


def _written(name: str, title: str, curves: Sequence[Curve], out: Path) -> list[Path]:
    content = {"broken_share": BROKEN_SHARE, "title": title, "curves": [asdict(one) for one in curves]}
    return save(sweeps_figure(title, curves), content, out, name)


def _slug(title: str) -> str:
    return "-".join(title.split(",", maxsplit=1)[0].replace(".", " ").replace("_", " ").split()).lower()
