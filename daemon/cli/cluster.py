"""The option of commands whose heavy work may run elsewhere."""

import argparse


def add_cluster(parser: argparse.ArgumentParser) -> None:
    """Add the option that moves heavy work to the workers of a Dask cluster."""
    parser.add_argument(
        "--cluster",
        nargs="?",
        const="local",
        metavar="ADDRESS",
        help="run on the Dask scheduler at this address, such as tcp://host:8786; alone: on a cluster of this machine",
    )
