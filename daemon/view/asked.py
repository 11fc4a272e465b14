"""Requests to a daemon, each in a thread of its own, that nobody waits for longer than was said.

libzmq may hang for ever while a connection fails in its handshake, in a send or at the context's end, whatever the
timeouts (its issues 2329 and 2733): a thread that does so is left behind, and keeps neither a later stop waiting nor
the process from ending.
"""

import asyncio
import contextlib
import threading
import time
from collections.abc import Mapping
from typing import Any

from daemon.errors import UserError
from daemon.keys import ClientKeys
from daemon.request import request

# A request gives up by itself in time; so much later it hangs.
GRACE_S = 2.0


class Requests:
    """Asks a daemon, and knows which threads are on their way."""

    def __init__(self) -> None:
        self._threads: set[threading.Thread] = set()

    async def ask(
        self, address: str, content: Mapping[str, Any], timeout_s: float, keys: ClientKeys | None
    ) -> dict[str, Any]:
        """Return the reply; raises UserError where none comes in time."""
        loop = asyncio.get_running_loop()
        answered: asyncio.Future[dict[str, Any]] = loop.create_future()

        def settle(reply: dict[str, Any] | None, error: BaseException | None) -> None:
            if answered.done():
                return
            if error is not None:
                answered.set_exception(error)
            elif reply is not None:
                answered.set_result(reply)

        def carry() -> None:
            reply, failure = None, None
            try:
                reply = request(address, content, timeout_s, keys)
            except Exception as error:  # noqa: BLE001 - raised where it is awaited
                failure = error
            # The loop may have ended meanwhile.
            with contextlib.suppress(RuntimeError):
                loop.call_soon_threadsafe(settle, reply, failure)

        self._threads = {thread for thread in self._threads if thread.is_alive()}
        thread = threading.Thread(target=carry, name="request", daemon=True)
        self._threads.add(thread)
        thread.start()
        try:
            async with asyncio.timeout(timeout_s + GRACE_S):
                return await answered
        except TimeoutError as error:
            raise UserError(
                f"the request to {address} hangs, and is given up; see whether the daemon runs, and try again"
            ) from error

    def close(self) -> None:
        """Wait for what is on its way, though not for what hangs."""
        until_s = time.monotonic() + GRACE_S
        for thread in self._threads:
            thread.join(max(0.0, until_s - time.monotonic()))
