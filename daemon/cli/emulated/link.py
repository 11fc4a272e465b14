"""The name that an emulated port can be given."""

import argparse
from pathlib import Path


def add_link(parser: argparse.ArgumentParser) -> None:
    """Add `--link`."""
    parser.add_argument("--link", type=Path, metavar="PATH", help="a name for the port that outlives its replugging")


def checked_link(link: Path | None) -> Path | None:
    """Return the path for the link; UserError when none can be made there."""
    from daemon.errors import UserError

    if link is not None and (not link.parent.is_dir() or (link.exists() and not link.is_symlink())):
        raise UserError(f"--link {link} cannot be made: it needs a folder, and a name that no file has")
    return link
