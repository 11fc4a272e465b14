"""`shearloop completion`: print a shell's script that completes commands, options and file names."""

import argparse

EPILOG = """bash: shearloop completion bash | sudo tee /etc/bash_completion.d/shearloop
zsh:  shearloop completion zsh > ~/.zsh/completions/_shearloop   (a folder of your fpath)
tcsh: shearloop completion tcsh | sudo tee /etc/profile.d/shearloop.csh
"""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `completion`."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = EPILOG
    parser.add_argument("shell", choices=("bash", "zsh", "tcsh"), help="the shell that completes")


def run(args: argparse.Namespace) -> int:
    """Print the shell's script."""
    import shtab

    print(shtab.complete(full_parser(), args.shell))
    return 0


def full_parser() -> argparse.ArgumentParser:
    """Return one parser with every command and all its options."""
    from shearloop.cli.registry import COMMANDS, command_module

    parser = argparse.ArgumentParser(prog="shearloop")
    parser.add_argument("--version", action="store_true", help="show the version and exit")
    commands = parser.add_subparsers(dest="command")
    for name, command in COMMANDS.items():
        subparser = commands.add_parser(name, help=command.summary)
        command_module(name).configure(subparser)
        _mark_files(subparser)
    return parser


def arguments_of(parser: argparse.ArgumentParser) -> list[argparse.Action]:
    """Return the arguments of a parser but its parts; argparse has no public list of them."""
    return [action for action in parser._actions if not isinstance(action, argparse._SubParsersAction)]


def parts_of(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    """Return the parsers of a command's parts by name."""
    parts = [action.choices for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    return {name: below for choices in parts for name, below in choices.items()}


def _mark_files(parser: argparse.ArgumentParser) -> None:
    """Let the shell complete file names where an argument is a path."""
    import shtab

    from shearloop.cli.options import path_of
    from shearloop.cli.output_paths import output_path

    for subparser in parts_of(parser).values():
        _mark_files(subparser)
    for action in arguments_of(parser):
        if isinstance(action.choices, dict):
            # shtab would take a dictionary of choices for sub-commands.
            action.choices = list(action.choices)
        if action.type in (path_of, output_path):
            action.complete = shtab.DIR if action.metavar == "DIR" else shtab.FILE  # type: ignore[attr-defined]
