"""`shearloop check`: check a configuration and the files it names."""

import argparse
from pathlib import Path

from shearloop.cli.options import add_option
from shearloop.cli.terminal import print_result
from shearloop.errors import UserError


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `check`."""
    add_option(parser, "config", Path, "CONFIG", "a YAML file such as config/demo.yaml")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")
    parser.epilog = "Opens no device; `shearloop doctor CONFIG` does."


def run(args: argparse.Namespace) -> int:
    """Load everything that `run` loads, without opening a device."""
    from shearloop.cli.emulator_processes import check_emulators
    from shearloop.daemon.config import load_daemon_config
    from shearloop.tools.check import Parts, check_parts

    parts = Parts()
    with parts.of("configuration"):
        parts = check_parts(load_daemon_config(args.config), args.config, check_emulators)
    if "configuration" in parts.mistakes:
        with parts.of("experiment"):
            _check_experiment_alone(args.config)
    if parts.mistakes:
        raise UserError("\n".join(dict.fromkeys(parts.mistakes.values())))
    sentences = [*(f"{name}: {text}" for name, text in parts.texts.items()), f"{args.config} is in order"]
    return print_result({"config": str(args.config), "parts": parts.texts}, sentences, as_json=args.json)


def _check_experiment_alone(path: Path) -> None:
    """Raise UserError for the mistakes of the experiment that an invalid configuration names."""
    from shearloop.daemon.experiment_files import read_experiment
    from shearloop.yaml_files import read_yaml

    content = read_yaml(path, UserError)
    named = content.get("experiment") if isinstance(content, dict) else None
    if named and isinstance(named, str):
        read_experiment(path.parent / named)
