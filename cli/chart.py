"""`shearloop chart NAME [RECORDING…] --out DIR`: measure, and draw as JSON, SVG and PNG."""

import argparse
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryFile

from shearloop.cli.options import add_cluster, add_option, number, positive
from shearloop.cli.output_paths import output_path
from shearloop.cli.plots import require_matplotlib
from shearloop.errors import UserError

NAMES = {
    "speed-accuracy": "latency against torque error of every estimator, forward methods, and the loop's window",
    "stability": "every estimator as faults grow (bias, spread, valid, false-valid), continuity, the loop on the skin",
    "loop": "a torque that is held and kicked, with and without the torque filter; no recordings",
    "scene": "how much model, bank and board the recording's noise asks for",
}


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    listing = "; ".join(f"{name}: {content}" for name, content in NAMES.items())
    parser.add_argument("name", choices=NAMES, metavar="NAME", help=listing)
    text = "recordings (.mcap) or folders of slices (default: synthetic frames)"
    add_option(parser, "recordings", Path, "REC", text, nargs="*", default=[])
    add_option(parser, "--out", output_path, "DIR", "folder for the chart and its numbers", required=True)
    add_option(parser, "--bank", Path, "FILE", "bank to match with (default: a small one, built)")
    add_option(parser, "--mesh", Path, "FILE", "mesh or fingertip to reconstruct and solve on (default: our own)")
    add_option(parser, "--split", number(0.1, 0.9), "SHARE", "earlier part, for the fit (default: 0.6)", default=0.6)
    add_cluster(parser)
    add_option(
        parser, "--jobs", positive(int), "N", "processes or local workers (default: 1; --cluster alone: one per core)"
    )
    text = "rounds of timing of speed-accuracy (default: 5)"
    add_option(parser, "--rounds", positive(int), "N", text, default=5)
    parser.epilog = (
        "speed-accuracy measures times in one thread, without --cluster and --jobs. scene chooses mesh and bank "
        "itself, without --mesh and --bank."
    )


def run(args: argparse.Namespace) -> int:
    """Draw one chart and print its paths."""
    _check_arguments(args)
    require_matplotlib("a chart")
    from shearloop.tools.drawing import writing_charts
    from shearloop.tools.outputs import new_folder

    with ExitStack() as folder:
        with writing_charts(args.out):
            folder.enter_context(new_folder(args.out))
            TemporaryFile(dir=args.out).close()
        return _draw(args)


def _draw(args: argparse.Namespace) -> int:
    from shearloop.bank.bank_file import Bank
    from shearloop.studies.charts import scene, simulated_loop, speed_accuracy, stability
    from shearloop.studies.charts.chart_data import GRID, MESH_SIZE_CM, own_fingertip, splits
    from shearloop.tools.bank_config import load_geometry
    from shearloop.tools.banks import cached_bank
    from shearloop.tools.parallel import open_executor

    # A mistake in its name is said before anything is computed.
    given = Bank.open(args.bank) if args.bank else None
    if args.name == "loop":
        print(*simulated_loop.chart(args.out), sep="\n")
        return 0
    scratch = args.out / "banks"
    parts = splits(args.recordings, args.split, scratch)
    with open_executor(args.cluster, args.jobs) as executor:
        if args.name == "scene":
            # The synthetic stream's single frames are too noisy to design a bank by.
            paths = scene.chart(parts if args.recordings else parts[:1], args.out, executor)
        else:
            mesh = load_geometry(args.mesh).mesh if args.mesh else own_fingertip(MESH_SIZE_CM).mesh()
            bank = given or cached_bank("chart", GRID, mesh, scratch)
            if args.name == "stability":
                paths = stability.chart(parts, bank, mesh, scratch, args.out, executor)
            else:
                paths = speed_accuracy.chart(parts, bank, mesh, mesh if args.mesh else None, args.out, args.rounds)
    print(*paths, sep="\n")
    return 0


def _check_arguments(args: argparse.Namespace) -> None:
    if args.name == "speed-accuracy" and (args.cluster is not None or args.jobs not in (None, 1)):
        raise UserError("speed-accuracy measures times, one thread on this machine: leave out --cluster and --jobs")
    if args.name == "loop" and args.recordings:
        raise UserError(f"loop is a simulation: leave out {args.recordings[0]}")
    if args.name == "scene" and (args.bank is not None or args.mesh is not None):
        raise UserError("scene chooses mesh and bank itself, on the paper's fingertip: leave out --bank and --mesh")
