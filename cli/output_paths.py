"""The type of options that name what a command writes."""

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path

from shearloop.cli.options import path_of
from shearloop.tools.outputs import check_apart, check_link


class OutputPath:
    """Takes the path of a file or folder to write; `check` refuses a link to nothing, and one that is an input."""

    def __call__(self, text: str) -> Path:
        """Return the path."""
        return path_of(text)

    def check(self, own: argparse.Action, every: Sequence[argparse.Action], found: argparse.Namespace) -> None:
        """Raise UserError where the path of `own` is a link to nothing, or that of another argument as it was found."""
        others = [
            (f"{_name_of(action)} {path}", path)
            for action in every
            if action is not own
            for path in _paths(getattr(found, action.dest, None))
        ]
        for out in _paths(getattr(found, own.dest)):
            check_link(_name_of(own), out)
            check_apart(_name_of(own), out, others)


output_path = OutputPath()


def written_to(out: Path, *, replaced: bool) -> str:
    """Return the sentence on a file that was written, in place of an earlier one or not."""
    return f"Written to {out}, in place of an earlier file." if replaced else f"Written to {out}."


def _name_of(action: argparse.Action) -> str:
    """Return an argument as a person types it."""
    return action.option_strings[-1] if action.option_strings else str(action.metavar)


def _paths(value: object) -> Iterator[Path]:
    """Yield the paths among an argument's values."""
    if isinstance(value, Path):
        yield value
    elif isinstance(value, list | tuple):
        for one in value:
            yield from _paths(one)
