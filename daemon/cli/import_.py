"""`shearloop import mat SRC… --out REC`: import recordings of other programs."""

import argparse
from dataclasses import asdict
from pathlib import Path

from shearloop.daemon.cli.options import add_option
from shearloop.daemon.cli.terminal import print_result


def configure(parser: argparse.ArgumentParser) -> None:
    """Add a sub-parser per format."""
    formats = parser.add_subparsers(dest="format", metavar="FORMAT", required=True)
    mat = formats.add_parser("mat", help="the paper's MATLAB streams", description="Import the paper's streams.")
    add_option(mat, "sources", Path, "SRC", ".mat files of one recording, or its folder", nargs="+")
    add_option(mat, "--out", Path, "REC", "recording to write, e.g. twist.mcap", required=True)
    mat.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Import and print the counts."""
    from mcap.writer import MCAP0_MAGIC

    from shearloop.daemon.cli.options import check_overwrite
    from shearloop.daemon.recording.matlab import import_mat

    check_overwrite(args.out, "a recording", MCAP0_MAGIC)
    imported = import_mat(args.sources, args.out)
    counts = [f"{count} frames of the {side} side" for side, count in imported.frames.items()]
    sentence = f"{args.out}: {', '.join(counts)}, {imported.torques} torques."
    return print_result({"path": str(args.out), **asdict(imported)}, [sentence, *imported.remarks], as_json=args.json)
