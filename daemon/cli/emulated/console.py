"""How an emulator runs by itself: until it is told to stop, with commands on standard input."""

import asyncio
import contextlib
import os
import sys
from collections.abc import Callable, Coroutine

from shearloop.daemon.signals import ending_signals

STDIN = 0
READ_BYTES = 4096


def play(device: Coroutine[None, None, None], on_command: Callable[[str], None]) -> None:
    """Run `device` until it ends, SIGINT, SIGTERM or SIGHUP comes, or standard input is closed.

    Each line of standard input, where that is a pipe or a terminal, goes to `on_command`; a ValueError of its is told
    on stderr and changes nothing.
    """
    asyncio.run(_play(device, on_command))


async def _play(device: Coroutine[None, None, None], on_command: Callable[[str], None]) -> None:
    loop = asyncio.get_running_loop()
    task = asyncio.create_task(device)
    begun = bytearray()

    def read() -> None:
        data = os.read(STDIN, READ_BYTES)
        if not data:
            loop.remove_reader(STDIN)
            task.cancel()
        *lines, rest = (bytes(begun) + data).split(b"\n")
        # No command is as long as this: what is without a newline for so long is none.
        begun[:] = rest[:READ_BYTES]
        for line in filter(None, (line.decode(errors="replace").strip() for line in lines)):
            try:
                on_command(line)
            except ValueError as error:
                print(error, file=sys.stderr, flush=True)

    for number in ending_signals():
        loop.add_signal_handler(number, task.cancel)
    # A file or /dev/null cannot be waited for, and gives no commands.
    with contextlib.suppress(PermissionError):
        loop.add_reader(STDIN, read)
    try:
        with contextlib.suppress(asyncio.CancelledError):
            await task
    finally:
        loop.remove_reader(STDIN)
