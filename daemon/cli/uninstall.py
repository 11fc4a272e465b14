"""`shearloop uninstall`: take the service away again."""

import argparse

from shearloop.daemon.cli.install import add_place, carry_out, systemd_runs


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `uninstall`."""
    add_place(parser)


def run(args: argparse.Namespace) -> int:
    """Take away what `install` put in place, saying each; your own files stay."""
    from shearloop.daemon.service.installation import uninstall_steps

    root = args.root.absolute()
    return carry_out(uninstall_steps(root, running=systemd_runs(root)), root, args)
