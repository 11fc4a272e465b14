"""Keeps daemons from starting while a desk command has their robot."""

import asyncio
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from threading import Thread

from shearloop.cli.other_daemon import refuse_second_daemon
from shearloop.daemon.messaging.command_server import STATUS, STOP, Reply, Request
from shearloop.daemon.messaging.refusals import Refusals
from shearloop.daemon.messaging.stop_socket import NameTakenError, StopSocket
from shearloop.errors import UserError


@contextmanager
def held_from_daemons(commands: str, holder: str) -> Iterator[None]:
    """Keep the daemons of every user of this computer away from an address of `commands`, as a daemon does.

    `holder` is the reply to each request there. Raises UserError if a daemon, or another holder, has it, or
    if it cannot be bound.
    """
    refuse_second_daemon(commands, cure="")

    async def refuse(_request: Request) -> Reply:
        return {"ok": False, "reason": holder}

    try:
        held = StopSocket(commands, {STOP: refuse, STATUS: refuse}, Refusals())
    except NameTakenError as error:
        raise UserError(
            f"the stop socket of `commands: {commands}` is taken: a daemon of this or another user has it and does not "
            "answer; `sudo ss -xlp` shows the process: end it first"
        ) from error
    with closing(held), closing(asyncio.new_event_loop()) as loop:
        serving = loop.create_task(held.run())
        answering = Thread(target=_run_until_cancelled, args=(loop, serving), name="address", daemon=True)
        answering.start()
        try:
            yield
        finally:
            loop.call_soon_threadsafe(serving.cancel)
            answering.join()


def _run_until_cancelled(loop: asyncio.AbstractEventLoop, task: "asyncio.Task[None]") -> None:
    with suppress(asyncio.CancelledError):
        loop.run_until_complete(task)
