"""`shearloop bank design RECORDING`: the least bank that its noise asks for, as YAML for `bank build`."""

import argparse
import sys
from pathlib import Path


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument("recording", type=Path, metavar="RECORDING", help="a recording (.mcap) or a folder of slices")
    parser.add_argument(
        "--fingertip", type=Path, metavar="FILE", help="the fingertip's measures (default: the paper's)"
    )
    parser.add_argument("--side", metavar="SIDE", help="side of the recording to design for (default: its first)")
    parser.add_argument("--out", type=Path, metavar="FILE", help="write the YAML there (default: print it)")


def run(args: argparse.Namespace) -> int:
    """Design, and print or write what `bank build --config` takes."""
    from shearloop.daemon.cli.options import check_overwrite
    from shearloop.daemon.errors import UserError
    from shearloop.daemon.scene import design_yaml, designed_for, doubts

    if args.out is not None:
        check_overwrite(args.out, "a configuration")
    fingertip, design = designed_for(args.recording, args.fingertip, args.side)
    text = design_yaml(design, fingertip, args.recording)
    for sentence in doubts(design):
        print(f"shearloop bank: {sentence}", file=sys.stderr)
    if args.out is None:
        print(text, end="")
        return 0
    try:
        args.out.write_text(text, encoding="utf-8")
    except OSError as error:
        raise UserError(f"{args.out}: the design cannot be written: {error.strerror}") from error
    print(f"Build it: shearloop bank build --config {args.out} --out FILE", file=sys.stderr)
    return 0
