"""The name that an emulated port can be given."""

import argparse
from pathlib import Path


def add_link(parser: argparse.ArgumentParser) -> None:
    """Add `--link`."""
    parser.add_argument("--link", type=Path, metavar="PATH", help="a name for the port that outlives its replugging")


def checked_link(link: Path | None) -> Path | None:
    """Return the path for the link, its folder made; UserError when none can be made there."""
    from shearloop.daemon.errors import UserError

    if link is None:
        return None
    try:
        # `run/` of a fresh checkout; a longer way that is not there is a mistake.
        link.parent.mkdir(exist_ok=True)
    except OSError as error:
        raise UserError(f"--link {link} cannot be made: {error.strerror}; choose another folder") from error
    if link.exists() and not link.is_symlink():
        raise UserError(f"--link {link} cannot be made: a file has this name; choose another")
    return link
