"""Sentences on arguments of the command line that are unknown or missing."""

import argparse
from collections.abc import Iterable, Sequence
from difflib import get_close_matches
from typing import Any

from shearloop.cli.registry import COMMANDS, MOVING

# Commands of the daemon that are named, and not carried out, without the word `command`.
_OF_COMMAND = (MOVING - COMMANDS.keys()) | {"tare"}


def unknown_arguments(extras: Sequence[str], options: Iterable[str]) -> str:
    """Return a sentence on unknown arguments, with the option that is nearest to the first."""
    near = get_close_matches(extras[0].partition("=")[0], options, 1)
    meant = f"; did you mean {near[0]}?" if near else ""
    return f"unrecognized arguments: {' '.join(extras)}{meant}"


def missing_arguments(message: str, actions: Sequence[argparse.Action]) -> str:
    """Return argparse's sentence with the choices of each missing argument that it names."""
    words = message.replace(",", " ").split()
    lists = [
        f"; {action.metavar or action.dest} is one of {', '.join(map(str, action.choices))}"
        for action in actions
        if action.required and action.choices and (action.metavar or action.dest) in words
    ]
    return message + "".join(lists)


def unknown_choice(action: argparse.Action, value: Any) -> str:
    """Return a sentence on a value that is not among an argument's choices, with the nearest one."""
    known = list(map(str, action.choices or ()))
    if value in _OF_COMMAND and "command" in known:
        return f"there is no {value!r}; it is `shearloop command {value}`"
    of = f" of {action.option_strings[-1]}" if action.option_strings else ""
    # A mistyped word must not become a motion.
    near = get_close_matches(str(value), [choice for choice in known if choice not in MOVING], 1)
    there_are = f"there {'is' if len(known) == 1 else 'are'} {', '.join(known)}"
    return f"there is no {value!r}{of}; {f'did you mean {near[0]}?' if near else there_are}"
