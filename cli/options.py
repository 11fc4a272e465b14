"""Options that several commands share, and their checks."""

import argparse
import math
import os
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from shearloop.files import expanded_path, is_possible
from shearloop.words import shown

if TYPE_CHECKING:
    from shearloop.bank.fingertip import Fingertip

Expanded = TypeVar("Expanded", str, Path)

PAPERS_RECORDINGS = (
    "The paper's recordings: https://github.com/DhruvTrehan03/Soft-Tactile-Sensing-For-Robotic-Manipulation "
    "(see docs/recording.md)"
)


def number(low: float, high: float, kind: Callable[[str], float] = float, *, unit: str = "") -> Callable[[str], float]:
    """Return the type of an option that takes a number from `low` to `high`; a refusal names the unit."""
    return _number(kind, lambda value: low <= value <= high, f" from {low:g} to {high:g} {unit}".rstrip())


def positive(kind: Callable[[str], float] = float, high: float = math.inf) -> Callable[[str], float]:
    """Return the type of an option that takes a finite number above 0, `high` at the most."""
    limit = "" if math.isinf(high) else f" and up to {high:g}"
    return _number(kind, lambda value: 0 < value <= high and value < math.inf, f" above 0{limit}")


def _number(kind: Callable[[str], float], accepts: Callable[[float], bool], where: str) -> Callable[[str], float]:
    def value_of(text: str) -> float:
        try:
            value = kind(text)
        except ValueError:
            value = math.nan
        if not accepts(value):
            raise argparse.ArgumentTypeError(f"{text} is not a {'whole ' if kind is int else ''}number{where}")
        return value

    return value_of


def path_of(text: str) -> Path:
    """Return the path of an option: shells leave `~` in `--out=~/a` as it is, and service files `$HOME`."""
    path: Path = expanded(expanded_path, text)
    if not is_possible(path):
        raise argparse.ArgumentTypeError(f"{shown(text)} is the name of no file: too long, or with a wrong character")
    return path


def expanded(expand: Callable[[str], Expanded], text: str) -> Expanded:
    """Return what `expand` makes of an option's text; its ValueError becomes a refusal of the option."""
    try:
        return expand(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text} {error}") from error


TIMEOUT_S = positive(high=86_400.0)
# What fits between the gripper's fingers.
TOOL_MM = number(1.0, 140.0, unit="mm")
PORT = number(0, 65535, int)


def add_option(
    parser: argparse._ActionsContainer,
    name: str,
    kind: Callable[[str], Any],
    metavar: str | tuple[str, ...],
    text: str,
    **more: Any,
) -> None:
    """Add an option with a value, or a positional argument, to a parser or a group; a Path is read as `path_of`."""
    parser.add_argument(name, type=path_of if kind is Path else kind, metavar=metavar, help=text, **more)


def add_action(
    actions: "argparse._SubParsersAction[Any]", name: str, summary: str, run: Callable[[argparse.Namespace], int]
) -> argparse.ArgumentParser:
    """Return the parser of a new action, which `run_action` runs."""
    parser: argparse.ArgumentParser = actions.add_parser(name, help=summary, description=summary)
    parser.set_defaults(run_action=run)
    return parser


def run_action(args: argparse.Namespace) -> int:
    """Run the given action and return the exit status."""
    status: int = args.run_action(args)
    return status


def add_json(parser: argparse._ActionsContainer) -> None:
    """Add `--json` to a parser or a group."""
    parser.add_argument("--json", action="store_true", help="print the result as JSON, and nothing else, on stdout")


def add_cluster(parser: argparse.ArgumentParser) -> None:
    """Add `--cluster`, which runs heavy work on other processes or computers."""
    text = "run on the Dask scheduler at this address, such as tcp://host:8786; without one on processes here"
    parser.add_argument("--cluster", type=_address, nargs="?", const="local", metavar="ADDRESS", help=text)


def _address(text: str) -> str:
    if text != "local" and os.path.exists(text):
        raise argparse.ArgumentTypeError(f"{text} is a file and no address; write `--cluster local`")
    return text


def add_fingertip(parser: argparse.ArgumentParser) -> None:
    """Add `--fingertip`, which `load_fingertip` reads."""
    add_option(parser, "--fingertip", Path, "FILE", "the fingertip's dimensions; by default the paper's fingertip")


def load_fingertip(path: Path | None) -> "Fingertip":
    """Return the fingertip of a file, or the paper's; raises UserError for a file that cannot be used."""
    from shearloop.daemon.config_file import load_yaml_model
    from shearloop.tools.bank_config import FingertipGeometryConfig

    with resources.as_file(resources.files("shearloop.daemon.web") / "assets" / "fingertip.yaml") as paper:
        return load_yaml_model(path or paper, FingertipGeometryConfig).fingertip()
