"""An emulator's console: runs until a signal or the end of its input, with commands on standard input."""

import argparse
import asyncio
import contextlib
import json
import secrets
import sys
import time
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import NamedTuple

from shearloop.cli.options import add_option, positive
from shearloop.cli.terminal import stdin_lines
from shearloop.daemon.process import ending_signals
from shearloop.errors import UserError


class Device(NamedTuple):
    """The command of one emulated device; `play` returns a coroutine that runs until the device ends."""

    summary: str
    configure: Callable[[argparse.ArgumentParser], None]
    play: Callable[[argparse.Namespace], Coroutine[None, None, None]]


def print_event(event: str, **fields: object) -> None:
    """Print an event as a JSON object on a line."""
    print(json.dumps({"t_mono_ns": time.monotonic_ns(), "event": event, **fields}), flush=True)


async def play(
    device: Coroutine[None, None, None], on_command: Callable[[str], None], **ports: "asyncio.Queue[str]"
) -> None:
    """Run `device` until it ends, SIGINT, SIGTERM or SIGHUP comes, or standard input is closed.

    Each line of standard input, if that is a pipe or a terminal, goes to `on_command`; a ValueError is printed. What
    the queues of `ports` get is printed, behind the name of the port if there are several.
    """
    task = asyncio.create_task(device)
    printing = [
        asyncio.create_task(_print_port(f"{name} " if len(ports) > 1 else "", queue)) for name, queue in ports.items()
    ]

    def obey(line: str | None) -> None:
        if line is None:
            task.cancel()
        elif line:
            try:
                on_command(line)
            except ValueError as error:
                print(error, file=sys.stderr, flush=True)

    for number in ending_signals():
        asyncio.get_running_loop().add_signal_handler(number, task.cancel)
    with contextlib.ExitStack() as reading:
        # A file or /dev/null cannot be watched, and gives no commands.
        with contextlib.suppress(PermissionError):
            reading.enter_context(stdin_lines(obey))
        with contextlib.suppress(asyncio.CancelledError):
            await task
    for printer in printing:
        printer.cancel()


async def _print_port(name: str, appearances: "asyncio.Queue[str]") -> None:
    while True:
        print(f"{name}{await appearances.get()}", flush=True)


def add_seed_and_speed(parser: argparse._ActionsContainer, pace: str) -> None:
    """Add `--seed` and `--speed`, which multiplies `pace`."""
    # The frames of two emulated rigs differ, as the frames of real ones do. So one recording can judge a fit on
    # another.
    text = "of all noise and garbage (default: another one at each start)"
    parser.add_argument("--seed", type=int, default=secrets.randbits(31), help=text)
    add_option(parser, "--speed", positive(), "N", f"times {pace} (default: 1)", default=1.0)


def add_sigma(parser: argparse._ActionsContainer) -> None:
    """Add `--sigma`; the default is the value of the paper's screwdriver."""
    text = "sigma at no torque and at 0.14 N·m (default: 1.85 1.25)"
    add_option(parser, "--sigma", float, ("REST", "LARGEST"), text, nargs=2, default=(1.85, 1.25))


def add_link(parser: argparse.ArgumentParser) -> None:
    """Add `--link`."""
    add_option(parser, "--link", Path, "PATH", "a name for the port that outlives its replugging")


def checked_link(link: Path | None) -> Path | None:
    """Return the path for the link, after making its folder; UserError if a file has this name."""
    if link is None:
        return None
    # Only one level: `run/` of a fresh checkout.
    link.parent.mkdir(exist_ok=True)
    if link.exists() and not link.is_symlink():
        raise UserError(f"--link {link} cannot be made: a file has this name; choose another")
    return link
