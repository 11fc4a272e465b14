"""`shearloop completion`: what a shell needs to complete commands, options and file names."""

import argparse

SHELLS = ("bash", "zsh", "tcsh")
EPILOG = """bash: shearloop completion bash | sudo tee /etc/bash_completion.d/shearloop
zsh:  shearloop completion zsh > ~/.zsh/completions/_shearloop   (a folder of your fpath)
tcsh: shearloop completion tcsh | sudo tee /etc/profile.d/shearloop.csh
"""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `completion`."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = EPILOG
    parser.add_argument("shell", choices=SHELLS, help="the shell that is to complete")


def run(args: argparse.Namespace) -> int:
    """Print the shell's script."""
    import shtab

    print(shtab.complete(whole_parser(), args.shell))
    return 0


def whole_parser() -> argparse.ArgumentParser:
    """Return one parser of every command with all its options, which tells the shell where a file is meant."""
    import importlib

    from shearloop.daemon.cli import COMMANDS

    parser = argparse.ArgumentParser(prog="shearloop")
    parser.add_argument("--version", action="store_true", help="show the version and exit")
    commands = parser.add_subparsers(dest="command")
    for name, command in COMMANDS.items():
        own = commands.add_parser(name, help=command.summary)
        importlib.import_module(command.module).configure(own)
        _name_files(own)
    return parser


def _name_files(parser: argparse.ArgumentParser) -> None:
    from pathlib import Path

    import shtab

    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for below in action.choices.values():
                _name_files(below)
            continue
        if isinstance(action.choices, dict):
            # shtab takes every table of choices for one of sub-commands.
            action.choices = list(action.choices)
        if action.type is Path:
            action.complete = shtab.DIR if action.metavar == "DIR" else shtab.FILE  # type: ignore[attr-defined]
