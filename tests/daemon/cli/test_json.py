"""Every command that a script would want to read has `--json`, and what it prints with it is JSON and nothing else."""

import argparse
import importlib
from collections.abc import Iterator

from shearloop.daemon.cli import COMMANDS

# What needs none, and why.
WITHOUT = {
    "run": "it logs JSON lines with --json-log, and publishes",
    "emulate": "its events are JSON lines as they are",
    "completion": "it prints what a shell reads",
    "demo": "it prints what `run` prints",
    "init": "it prints the next steps",
    "schema": "it prints JSON as it is",
    "bank design": "it prints the YAML that `bank build` takes",
    "chart": "it prints the files drawn, one a line; its numbers are a JSON file among them",
}


def parsers(name: str, parser: argparse.ArgumentParser) -> Iterator[tuple[str, argparse.ArgumentParser]]:
    """Yield the parsers of a command's parts, or its own where it has none."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for part, its_own in action.choices.items():
                yield from parsers(f"{name} {part}", its_own)
            return
    yield name, parser


def every_parser() -> Iterator[tuple[str, argparse.ArgumentParser]]:
    for name, command in COMMANDS.items():
        parser = argparse.ArgumentParser()
        importlib.import_module(command.module).configure(parser)
        yield from parsers(name, parser)


def test_every_command_has_a_json_option_or_a_reason_for_none():
    having = {name: "--json" in parser._option_string_actions for name, parser in every_parser()}
    lacking = {name for name, has_it in having.items() if not has_it}
    assert {next((known for known in WITHOUT if name.startswith(known)), name) for name in lacking} == set(WITHOUT)
