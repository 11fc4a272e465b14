"""`shearloop install`: make the daemon a service of this computer."""

import argparse
import os
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from shearloop.daemon.cli.result import add_json, tell

if TYPE_CHECKING:
    from shearloop.daemon.service.steps import Step


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `install`."""
    add_place(parser)
    parser.add_argument("--program", type=Path, metavar="PATH", help="what the service runs; by default this program")
    parser.add_argument("--real-time", action="store_true", help="with the real-time options of docs/service.md")
    parser.epilog = (
        "Puts unit, user, udev rules, folders and an example configuration in place, with sudo (docs/service.md)."
    )


def add_place(parser: argparse.ArgumentParser) -> None:
    """Add what `install` and `uninstall` have in common."""
    parser.add_argument("--dry-run", action="store_true", help="say what would be done, and do nothing")
    parser.add_argument(
        "--root", type=Path, default=Path("/"), metavar="DIR", help="the root of another system, such as an image"
    )
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Put unit, user, udev rules, folders and an example configuration in place, saying each."""
    from shearloop.daemon.errors import UserError
    from shearloop.daemon.service.installation import find_program, install_steps

    program = find_program() if args.program is None else args.program.absolute()
    if not program.is_file():
        raise UserError(f"--program {args.program} is not a file; give the path of the installed `shearloop`")
    root = args.root.absolute()
    steps = install_steps(root, program, real_time=args.real_time, running=systemd_runs(root))
    return carry_out(steps, root, args)


def systemd_runs(root: Path) -> bool:
    """Return whether this is the running system, with systemd to be told of changes."""
    return root == Path("/") and Path("/run/systemd/system").is_dir()


def carry_out(steps: "Iterable[Step]", root: Path, args: argparse.Namespace) -> int:
    """Say and do each step, or only say it; as JSON all of them at the end."""
    from shearloop.daemon.errors import UserError

    if not args.dry_run and root == Path("/") and os.geteuid() != 0:
        raise UserError("this changes the system: run it with sudo, or see what it would do with --dry-run")
    told: list[dict[str, object]] = []
    for step in steps:
        acts, sentence = step.acts, step.sentence()
        told.append({"acts": acts, "says": sentence})
        if not args.json:
            print(f"{'would ' if args.dry_run and acts else ''}{sentence}", flush=True)
        if not args.dry_run:
            step.carry_out()
    if args.json:
        tell({"root": str(root), "dry_run": args.dry_run, "steps": told}, (), as_json=True)
    return 0
