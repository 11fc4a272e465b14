"""`shearloop reproduce`: compute the paper's numbers and figures from recorded slices."""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from shearloop.cli.options import PAPERS_RECORDINGS, add_json, add_option, positive
from shearloop.cli.output_paths import output_path
from shearloop.cli.plots import require_matplotlib
from shearloop.tools.outputs import progress_bar, writing
from shearloop.tools.parallel import processors

if TYPE_CHECKING:
    from shearloop.bank.arrays import FloatArray
    from shearloop.bank.bank_file import Bank
    from shearloop.studies.reproduce.analysis import Matches
    from shearloop.studies.reproduce.report import Reproduction


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    add_option(parser, "recordings", Path, "RECORDINGS", "folder with torque_slices, diameter_slices")
    add_option(parser, "--out", output_path, "DIR", "folder for banks, figures and numbers", required=True)
    add_json(parser)
    default = "RECORDINGS/../reference/fingertip_mesh.npz, or a grid of our own if that file is missing"
    add_option(parser, "--mesh", Path, "FILE", f"mesh (.npz, EIDORS .mat) or fingertip (.yaml); by default {default}")
    add_option(parser, "--jobs", positive(int), "N", "processors to use (default: all)")
    parser.epilog = PAPERS_RECORDINGS


def run(args: argparse.Namespace) -> int:
    """Compute the numbers, then write, print and draw them."""
    # Before anything is computed.
    require_matplotlib("a figure")
    from shearloop.studies.reproduce.report import draw_all, json_text, table

    found = _reproduce(args, args.jobs or processors())
    numbers = args.out / "reproduce.json"
    with writing(args.out, "the results"):
        numbers.write_text(json_text(found) + "\n", encoding="utf-8")
        written = [numbers, *draw_all(found, args.out)]
    if args.json:
        print(json_text(found))
    else:
        print(table(found))
        print(f"\nIn {args.out}: {', '.join(sorted(path.name for path in written))}.")
    return 0


def _reproduce(args: argparse.Namespace, jobs: int) -> "Reproduction":
    from scipy import fft

    from shearloop.bank.channels import smoothed_along_channels
    from shearloop.studies.reproduce import analysis
    from shearloop.studies.reproduce.dataset import read_twists, regress_on_channels
    from shearloop.studies.reproduce.report import Reproduction
    from shearloop.tools.banks import GRIDS, cached_bank, choose_mesh

    inputs = analysis.read_inputs(args.recordings)
    mesh, origin = choose_mesh(args.recordings, args.mesh)
    print(f"mesh: {origin}", file=sys.stderr)
    notes: list[str] = []

    def build(name: str) -> "Bank":
        with progress_bar(name, GRIDS[name].k.size, "row") as show:
            return cached_bank(name, GRIDS[name], mesh, args.out / "banks", jobs, show)

    def match(differences: "FloatArray", bank: "Bank") -> "Matches":
        with progress_bar("matching", len(differences), "slice") as show:
            return analysis.match_slices(differences, bank, show)

    with fft.set_workers(jobs):
        banks = {"wide": build("wide")}
        torque = diameter = models = None
        if inputs.torque is not None:
            banks["focused"] = build("focused")
            on_focused, on_wide = (match(inputs.torque.differences, banks[name]) for name in ("focused", "wide"))
            torque = analysis.analyse_torque(inputs.torque, on_focused, on_wide)
            models = analysis.score_models(inputs.torque, inputs.raw_difference, mesh)
        if inputs.diameter is not None:
            smooth = smoothed_along_channels(inputs.diameter.differences)
            diameter = analysis.analyse_diameter(inputs.diameter, match(smooth, banks["wide"]), banks["wide"])
    regressions = regress_on_channels(torque.slices, torque.parts) if torque else ()
    twists = read_twists(args.recordings, notes) if torque else None
    return Reproduction(mesh, origin, banks, torque, diameter, models, regressions, twists, tuple(notes))
