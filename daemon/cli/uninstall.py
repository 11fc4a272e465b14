"""`shearloop uninstall`: remove the service."""

import argparse

from shearloop.daemon.cli.install import add_common_arguments as configure
from shearloop.daemon.cli.install import run_steps, systemd_runs

__all__ = ["configure", "run"]


def run(args: argparse.Namespace) -> int:
    """Remove everything that `install` added and print each step; your own files stay."""
    from shearloop.daemon.service import uninstall_steps

    root = args.root.absolute()
    return run_steps(uninstall_steps(root, running=systemd_runs(root)), root, args)
