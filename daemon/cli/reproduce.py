"""`shearloop reproduce`: compute the paper's numbers and figures anew from recorded slices."""

import argparse
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn, Self

from shearloop.daemon.errors import UserError

if TYPE_CHECKING:
    from tqdm import tqdm

    from shearloop.bank.eit.bank_file import Bank
    from shearloop.daemon.analysis.reproduce.banks import Grid
    from shearloop.daemon.analysis.reproduce.report import Reproduction


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument(
        "recordings", type=Path, metavar="RECORDINGS", help="folder with torque_slices, diameter_slices"
    )
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for banks, figures and numbers")
    parser.add_argument("--json", action="store_true", help="print the numbers as JSON, and nothing else, on stdout")
    geometry = parser.add_mutually_exclusive_group()
    geometry.add_argument(
        "--mesh",
        type=Path,
        metavar="FILE",
        help="mesh (.npz, EIDORS .mat) or fingertip (.yaml); by default RECORDINGS/../reference/fingertip_mesh.npz, "
        "or our own grid where that is not there",
    )
    geometry.add_argument("--bank-config", type=Path, metavar="FILE", help="a bank's configuration, for its geometry")
    parser.add_argument("--jobs", type=int, metavar="N", help="processors to use (default: all)")


def run(args: argparse.Namespace) -> int:
    """Reproduce, then write, print and draw."""
    jobs = len(os.sched_getaffinity(0)) if args.jobs is None else args.jobs
    if jobs < 1:
        raise UserError(f"--jobs must be 1 or more, not {jobs}")
    try:
        from shearloop.daemon.analysis.reproduce.figures import draw_all
    except ModuleNotFoundError as error:
        raise UserError(f"the figures need {error.name}; install it with `pip install 'shearloop[plot]'`") from error
    from shearloop.daemon.analysis.reproduce.report import json_text, save_calibrations, table, write_json

    found, banks = _reproduce(args, jobs)
    try:
        written = [write_json(found, args.out), *draw_all(found, banks, args.out)]
    except OSError as error:
        raise UserError(f"{args.out}: the results cannot be written: {error.strerror}") from error
    written += save_calibrations(found, banks, args.recordings, args.out)
    if args.json:
        print(json_text(found))
    else:
        print(table(found))
        print(f"\nIn {args.out}: {', '.join(sorted(path.name for path in written))}.")
    return 0


def _reproduce(args: argparse.Namespace, jobs: int) -> "tuple[Reproduction, dict[str, Bank]]":
    from scipy import fft

    from shearloop.daemon.analysis.reproduce.analysis import (
        analyse_diameter,
        analyse_torque,
        match_slices,
        score_models,
    )
    from shearloop.daemon.analysis.reproduce.banks import GRIDS, cached_bank, choose_mesh, focused_grid
    from shearloop.daemon.analysis.reproduce.inputs import read_inputs
    from shearloop.daemon.analysis.reproduce.report import Reproduction, moved_focus

    inputs = read_inputs(args.recordings)
    chosen = choose_mesh(args.recordings, args.mesh, args.bank_config)
    print(f"mesh: {chosen.origin}", file=sys.stderr)
    notes = list(inputs.notes)
    with _Progress() as progress, fft.set_workers(jobs):

        def built(name: str, grid: "Grid") -> "Bank":
            return cached_bank(name, grid, chosen.mesh, args.out / "banks", jobs, progress.rows)

        banks = {"wide": built("wide", GRIDS["wide"])}
        torque = diameter = models = None
        if inputs.torque is not None:
            slices = inputs.torque.differences
            progress.begin("matching", len(slices), "slice")
            on_wide = match_slices(slices, banks["wide"], progress.advance)
            focus = focused_grid(on_wide.k, on_wide.sigma)
            if focus is not GRIDS["focused"]:
                notes.append(moved_focus(focus))
            banks["focused"] = built("focused", focus)
            progress.begin("matching", len(slices), "slice")
            on_focused = match_slices(slices, banks["focused"], progress.advance)
            torque = analyse_torque(inputs.torque, on_focused, on_wide)
            models = score_models(inputs.torque, inputs.raw_difference, chosen.mesh)
        if inputs.diameter is not None:
            progress.begin("matching", len(inputs.diameter.differences), "slice")
            diameter = analyse_diameter(inputs.diameter, banks["wide"], progress.advance)
    valid_cells = int(banks["wide"].valid.sum())
    return Reproduction(chosen.origin, valid_cells, torque, diameter, models, tuple(notes)), banks


class _Progress:
    """One bar after the other on stderr, where that is a terminal."""

    def __init__(self) -> None:
        """Show nothing yet."""
        self._bar: tqdm[NoReturn] | None = None
        self._name = ""

    def __enter__(self) -> Self:
        """Begin without a bar."""
        return self

    def begin(self, name: str, total: int, unit: str, done: int = 0) -> None:
        """End the bar that is shown and show one for another piece of work."""
        from tqdm import tqdm

        self._close()
        # tqdm's own watch on slow bars is a thread that outlives them.
        tqdm.monitor_interval = 0
        self._name = name
        self._bar = tqdm(total=total, initial=done, unit=unit, desc=name, disable=None)

    def advance(self, count: int) -> None:
        """Count work that is done."""
        if self._bar is not None:
            self._bar.update(count)

    def rows(self, name: str, done: int, total: int) -> None:
        """Show that `done` of a bank's `total` rows are solved."""
        if self._bar is None or self._name != name:
            self.begin(name, total, "row", done)
        elif self._bar is not None:
            self._bar.update(done - self._bar.n)

    def _close(self) -> None:
        if self._bar is not None:
            self._bar.close()

    def __exit__(self, *_: object) -> None:
        """End the last bar."""
        self._close()
