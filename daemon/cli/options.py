"""Options that several commands share, and the check of `--out`."""

import argparse
import codecs
from pathlib import Path

from shearloop.daemon.errors import UserError

# Longer than the 124 characters of text at the start of a MATLAB file.
_HEAD_BYTES = 512


def add_json(parser: argparse._ActionsContainer) -> None:
    """Add `--json` to a parser or a group."""
    parser.add_argument("--json", action="store_true", help="print the result as JSON, and nothing else, on stdout")


def add_cluster(parser: argparse.ArgumentParser) -> None:
    """Add `--cluster`, which runs heavy work on other processes or computers."""
    parser.add_argument(
        "--cluster",
        nargs="?",
        const="local",
        metavar="ADDRESS",
        help="run on the Dask scheduler at this address, such as tcp://host:8786; without an address: on processes of "
        "this computer",
    )


def check_overwrite(out: Path, kind: str, begins: bytes | None = None) -> None:
    """Raise UserError if `out` is a file of another kind: one that does not begin with `begins`, or is no text.

    A missing word in `calibrate --out recordings/*.mcap` would otherwise overwrite a recording. Errors of reading are
    left to the code that writes the file.
    """
    if not out.is_file():
        return
    try:
        with out.open("rb") as file:
            head = file.read(_HEAD_BYTES)
    except OSError:
        return
    if head and not (_is_text(head) if begins is None else head.startswith(begins)):
        raise UserError(f"{out} exists and is not {kind}: it was not changed; choose another --out")


def _is_text(head: bytes) -> bool:
    try:
        # The incremental decoder accepts a character that is cut off at the end.
        codecs.getincrementaldecoder("utf-8")().decode(head)
    except UnicodeDecodeError:
        return False
    return b"\0" not in head
