"""Options that several commands share, and their checks."""

import argparse
import math
import os
import re
import shlex
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from shearloop.daemon.messaging import addresses
from shearloop.errors import UserError
from shearloop.files import expanded_path

if TYPE_CHECKING:
    from shearloop.bank.fingertip import Fingertip
    from shearloop.daemon.messaging.keys import ClientKeys

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
    return _expanded(expanded_path, text)


def _daemon(text: str) -> str:
    return _expanded(addresses.expanded, text)


def _expanded(expand: Callable[[str], Expanded], text: str) -> Expanded:
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


def add_connection(parser: argparse.ArgumentParser, default: str, purpose: str) -> None:
    """Add `--connect`, `--key` and `--server-key`; `purpose` describes the address."""
    add_option(parser, "--connect", _daemon, "ADDRESS", f"{purpose} (default: %(default)s)", default=default)
    add_option(
        parser, "--key", Path, "FILE", "your .key_secret, for a daemon open to the network (default: in ~/.config)"
    )
    add_option(parser, "--server-key", Path, "FILE", "that daemon's .key (default: in ~/.config)")


def with_connection(text: str, args: argparse.Namespace, default: str) -> str:
    """Return a text in which each `shearloop command …` has this command's options of the connection."""
    connect = None if args.connect == default else args.connect
    given = {"--connect": connect, "--key": args.key, "--server-key": args.server_key}
    options = "".join(f" {name} {shlex.quote(str(value))}" for name, value in given.items() if value is not None)
    return re.sub(r"`(shearloop command [^`]+)`", lambda found: f"`{found[1]}{options}`", text)


def add_fingertip(parser: argparse.ArgumentParser) -> None:
    """Add `--fingertip`, which `load_fingertip` reads."""
    add_option(parser, "--fingertip", Path, "FILE", "the fingertip's dimensions; by default the paper's fingertip")


def load_fingertip(path: Path | None) -> "Fingertip":
    """Return the fingertip of a file, or the paper's; raises UserError for a file that cannot be used."""
    from shearloop.daemon.config_file import load_yaml_model
    from shearloop.tools.bank_config import FingertipGeometryConfig

    with resources.as_file(resources.files("shearloop.daemon.web") / "assets" / "fingertip.yaml") as paper:
        return load_yaml_model(path or paper, FingertipGeometryConfig).fingertip()


def user_key_folder() -> Path:
    """Return the folder of the user's keys."""
    home = os.environ.get("XDG_CONFIG_HOME")
    return (Path(home) if home else Path.home() / ".config") / "shearloop"


class MissingKeyError(UserError):
    """A file of the client's keys does not exist."""


def client_keys(args: argparse.Namespace, address: str | None = None) -> "ClientKeys | None":
    """Return the keys for an address, by default that of `--connect`; None where the daemon needs none.

    A daemon that is open to the network needs them on a loopback address too. Raises MissingKeyError for missing keys.
    """
    # The daemon itself needs no client.
    from shearloop.daemon.messaging import stop_client

    address = address or args.connect
    why = ""
    if addresses.needs_keys(address):
        why = f"{address} is not on this machine"
    elif stop_client.is_open_to_network(address):
        why = f"the daemon at {address} is open to the network and answers only with keys"
    if not why and args.key is None and args.server_key is None:
        return None
    from shearloop.daemon.messaging.keys import ClientKeys

    folder = user_key_folder()
    key = args.key or folder / "client.key_secret"
    server_key = args.server_key or folder / "server.key"
    for path, option, cure in (
        (key, "--key", "make one with `shearloop keys client`"),
        (server_key, "--server-key", "copy the daemon's server.key there"),
    ):
        if not path.exists():
            raise MissingKeyError(f"{f'{why}, and ' if why else ''}there is no key {path}: {cure}, or give {option}")
    return ClientKeys.load(key, server_key)
