"""`shearloop chart NAME [RECORDING…] --out DIR`: measure, and draw as JSON, SVG and PNG."""

import argparse
from collections.abc import Callable
from pathlib import Path

from shearloop.daemon.cli.cluster import add_cluster

NAMES = {
    "speed-accuracy": "latency against torque error of every estimator, forward methods, and the loop's window",
    "stability": "every estimator as faults grow (bias, spread, valid, false-valid), continuity, the loop on the skin",
    "scene": "how much model, bank and board the recording's own noise asks for",
}


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    listing = "; ".join(f"{name}: {what}" for name, what in NAMES.items())
    parser.add_argument("name", choices=NAMES, metavar="NAME", help=listing)
    parser.add_argument(
        "recordings",
        nargs="*",
        default=[],
        type=Path,
        metavar="REC",
        help="recordings (.mcap) or folders of slices; synthetic frames where none is given",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the chart and its numbers")
    parser.add_argument("--bank", type=Path, metavar="FILE", help="bank to match with (default: a small one, built)")
    parser.add_argument(
        "--mesh", type=Path, metavar="FILE", help="mesh or fingertip to reconstruct and solve on (default: our own)"
    )
    parser.add_argument(
        "--split", type=float, default=0.6, metavar="SHARE", help="earlier part, which is fitted to (default: 0.6)"
    )
    add_cluster(parser)
    parser.add_argument(
        "--jobs", type=int, metavar="N", help="processes or local workers (default: 1; --cluster alone: one per core)"
    )
    parser.add_argument(
        "--rounds", type=int, default=5, metavar="N", help="how often everything is timed, by turns (default: 5)"
    )


def run(args: argparse.Namespace) -> int:
    """Draw one chart and say where it is."""
    from shearloop.daemon.errors import UserError

    if not 0.1 <= args.split <= 0.9:
        raise UserError(f"--split must be a share from 0.1 to 0.9, not {args.split:g}")
    if args.rounds < 1:
        raise UserError(f"--rounds must be 1 or more, not {args.rounds}")
    if args.jobs is not None and args.jobs < 1:
        raise UserError(f"--jobs must be 1 or more, not {args.jobs}")
    if args.name == "speed-accuracy" and (args.cluster is not None or args.jobs not in (None, 1)):
        raise UserError("speed-accuracy measures times, one thread on this machine: leave out --cluster and --jobs")
    if args.name == "scene" and (args.bank is not None or args.mesh is not None):
        raise UserError(
            "scene chooses mesh and bank by itself, on the fingertip of the paper: leave out --bank and --mesh"
        )
    try:
        import matplotlib as _  # noqa: F401 - so that its absence is told before anything is measured
    except ModuleNotFoundError as error:
        raise UserError("charts need matplotlib: `pip install 'shearloop[plot]'`") from error
    from shearloop.daemon.analysis.charts.picture import check_takes_pictures, empty_ones_removed

    check_takes_pictures(args.out)
    charts: dict[str, Callable[[argparse.Namespace], list[Path]]] = {
        "speed-accuracy": _speed_accuracy,
        "stability": _stability,
        "scene": _scene,
    }
    # One that is interrupted, or fails, may have made folders by then and nothing in them.
    with empty_ones_removed(args.out / "banks"):
        paths = charts[args.name](args)
    for path in paths:
        print(path)
    return 0


def _speed_accuracy(args: argparse.Namespace) -> list[Path]:
    from shearloop.daemon.analysis.charts.sources import bank_of, mesh_of, splits
    from shearloop.daemon.analysis.charts.speed_accuracy import chart

    scratch = args.out / "banks"
    mesh = mesh_of(args.mesh)
    return chart(
        splits(args.recordings, args.split, scratch),
        bank_of(args.bank, mesh, scratch),
        mesh,
        mesh if args.mesh else None,
        args.out,
        args.rounds,
    )


def _stability(args: argparse.Namespace) -> list[Path]:
    from shearloop.daemon.analysis.charts.sources import bank_of, mesh_of, splits
    from shearloop.daemon.analysis.charts.stability_chart import chart
    from shearloop.daemon.workers import open_executor

    scratch, mesh = args.out / "banks", mesh_of(args.mesh)
    # Before a bank is built there: what cannot be read leaves nothing behind.
    parts = splits(args.recordings, args.split, scratch)
    bank = bank_of(args.bank, mesh, scratch)
    with open_executor(args.cluster, args.jobs) as pool:
        return chart(parts, bank, mesh, scratch, args.out, pool)


def _scene(args: argparse.Namespace) -> list[Path]:
    from shearloop.daemon.analysis.charts.scene import chart
    from shearloop.daemon.analysis.charts.sources import splits
    from shearloop.daemon.workers import open_executor

    parts = splits(args.recordings, args.split, args.out / "banks")
    with open_executor(args.cluster, args.jobs) as pool:
        return chart(parts, args.out, pool)
