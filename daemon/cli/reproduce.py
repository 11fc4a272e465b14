"""`shearloop reproduce`: compute the paper's numbers and figures from recorded slices."""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from shearloop.daemon.cli.options import PAPERS_RECORDINGS, add_json, add_option, checked_jobs, writing
from shearloop.daemon.cli.terminal import progress_bar
from shearloop.daemon.errors import missing

if TYPE_CHECKING:
    from shearloop.bank.eit.bank_file import Bank
    from shearloop.daemon.analysis.reproduce.banks import Grid
    from shearloop.daemon.analysis.reproduce.report import Reproduction


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    add_option(parser, "recordings", Path, "RECORDINGS", "folder with torque_slices, diameter_slices")
    add_option(parser, "--out", Path, "DIR", "folder for banks, figures and numbers", required=True)
    add_json(parser)
    default = "RECORDINGS/../reference/fingertip_mesh.npz, or a grid of our own if that file is missing"
    add_option(parser, "--mesh", Path, "FILE", f"mesh (.npz, EIDORS .mat) or fingertip (.yaml); by default {default}")
    add_option(parser, "--jobs", int, "N", "processors to use (default: all)")
    parser.epilog = PAPERS_RECORDINGS


def run(args: argparse.Namespace) -> int:
    """Compute the numbers, then write, print and draw them."""
    jobs = checked_jobs(args.jobs)
    try:
        from shearloop.daemon.analysis.reproduce.report import draw_all
    except ModuleNotFoundError as error:
        raise missing(error.name, "plot", "a figure") from error
    from shearloop.daemon.analysis.reproduce.report import json_text, table

    found, banks = _reproduce(args, jobs)
    numbers = args.out / "reproduce.json"
    with writing(args.out, "the results"):
        numbers.write_text(json_text(found) + "\n", encoding="utf-8")
        written = [numbers, *draw_all(found, banks, args.out)]
    if args.json:
        print(json_text(found))
    else:
        print(table(found))
        print(f"\nIn {args.out}: {', '.join(sorted(path.name for path in written))}.")
    return 0


def _reproduce(args: argparse.Namespace, jobs: int) -> "tuple[Reproduction, dict[str, Bank]]":
    from scipy import fft

    from shearloop.daemon.analysis.reproduce import analysis
    from shearloop.daemon.analysis.reproduce.banks import GRIDS, cached_bank, choose_mesh, focused_grid
    from shearloop.daemon.analysis.reproduce.dataset import read_twists, regress_on_channels
    from shearloop.daemon.analysis.reproduce.report import Reproduction

    inputs = analysis.read_inputs(args.recordings)
    mesh, origin = choose_mesh(args.recordings, args.mesh)
    print(f"mesh: {origin}", file=sys.stderr)
    notes = list(inputs.notes)

    def build(name: str, grid: "Grid") -> "Bank":
        with progress_bar(name, grid.k.size, "row") as show:
            return cached_bank(name, grid, mesh, args.out / "banks", jobs, show)

    with fft.set_workers(jobs):
        banks = {"wide": build("wide", GRIDS["wide"])}
        torque = diameter = models = None
        if inputs.torque is not None:
            slices = inputs.torque.differences
            with progress_bar("matching", len(slices), "slice") as show:
                on_wide = analysis.match_slices(slices, banks["wide"], show)
            focus = focused_grid(on_wide.k, on_wide.sigma)
            if focus is not GRIDS["focused"]:
                (k_low, *_, k_high), (sigma_low, *_, sigma_high) = focus.k, focus.sigma
                notes.append(
                    "Most slices match best outside of the paper's focused bank: this one lies around them, "
                    f"k {k_low:.2f} to {k_high:.2f} cm, sigma {sigma_low:.2f} to {sigma_high:.2f} cm."
                )
            banks["focused"] = build("focused", focus)
            with progress_bar("matching", len(slices), "slice") as show:
                on_focused = analysis.match_slices(slices, banks["focused"], show)
            torque = analysis.analyse_torque(inputs.torque, on_focused, on_wide)
            models = analysis.score_models(inputs.torque, inputs.raw_difference, mesh)
        if inputs.diameter is not None:
            with progress_bar("matching", len(inputs.diameter.differences), "slice") as show:
                diameter = analysis.analyse_diameter(inputs.diameter, banks["wide"], show)
    regressions = regress_on_channels(torque.slices, torque.parts) if torque else ()
    twists = read_twists(args.recordings, notes) if torque else None
    found = Reproduction(mesh, origin, banks["wide"], torque, diameter, models, regressions, twists, tuple(notes))
    return found, banks
