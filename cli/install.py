"""`shearloop install` and `shearloop uninstall`: the daemon as a service of this computer."""

import argparse
import json
import os
from pathlib import Path

from shearloop.cli.options import add_json, add_option
from shearloop.errors import UserError


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `install`, or of `uninstall` to its parser."""
    installs = not parser.prog.endswith(" uninstall")
    parser.set_defaults(installs=installs)
    parser.add_argument("--dry-run", action="store_true", help="say what would be done, and do nothing")
    add_option(parser, "--root", Path, "DIR", "the root of another system, such as an image", default=Path("/"))
    add_json(parser)
    if installs:
        add_option(parser, "--program", Path, "PATH", "what the service runs; by default this program")
        text = "with or without the real-time options of docs/service.md (default: as it is)"
        parser.add_argument("--real-time", action=argparse.BooleanOptionalAction, help=text)
        parser.epilog = "Installs unit, user, udev rules, folders and an example configuration (docs/service.md)."


def run(args: argparse.Namespace) -> int:
    """Print and run each step, or only print it with --dry-run."""
    from shearloop.tools.service import find_program, in_system, install_steps, uninstall_steps

    root = args.root.absolute()
    if not root.is_dir():
        raise UserError(f"--root {args.root} is not a folder; give the folder with the other system's files")
    running = root == Path("/") and Path("/run/systemd/system").is_dir()
    steps = uninstall_steps(root, running=running)
    if args.installs:
        program = in_system(root, find_program() if args.program is None else args.program)
        steps = install_steps(root, program, real_time=args.real_time, running=running)
    if not args.dry_run and root == Path("/") and os.geteuid() != 0:
        raise UserError("this changes the system: run it with sudo, or see what it would do with --dry-run")
    done = []
    for step in steps:
        acts = step.run is not None
        done.append({"acts": acts, "says": step.sentence})
        if not args.json:
            print(f"{'would ' if args.dry_run and acts else ''}{step.sentence}", flush=True)
        if step.run is not None and not args.dry_run:
            try:
                step.run()
            except OSError as error:
                cure = "; run it with sudo" if isinstance(error, PermissionError) else ""
                raise UserError(f"{error.filename} cannot be changed: {error.strerror}{cure}") from error
    if args.json:
        print(json.dumps({"root": str(root), "dry_run": args.dry_run, "steps": done}, ensure_ascii=False))
    return 0
