"""`shearloop schema`: print the JSON Schema of a configuration, an experiment or another file."""

import argparse

KINDS = ("configuration", "experiment", "robot", "bank", "fingertip")


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `schema`."""
    parser.add_argument("kind", choices=KINDS, help="the kind of file")
    parser.epilog = "Editors check and complete a YAML file that names its schema, such as the files of config/."


def run(args: argparse.Namespace) -> int:
    """Print the schema."""
    from shearloop.cli.config_schema import schema_text

    print(schema_text(args.kind), end="")
    return 0
