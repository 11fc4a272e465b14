"""Requests to a daemon, each in a thread of its own, that nobody waits for longer than was said.

A request gives up by itself once its time is over. One was seen that did not: without keys, at a daemon that asks for
them, on a busy machine, for a minute and on. It was seen once, and not again in 44 000 tries; its cause is not known
(libzmq's issue 2733 tells of contexts that never end after a failed handshake, and may be another thing). So a request
that hangs is left behind: it keeps neither a later stop waiting nor the process from ending.
"""

import asyncio
import threading
import time
from collections.abc import Mapping
from concurrent.futures import Future
from typing import Any

from shearloop.daemon.errors import UserError
from shearloop.daemon.messaging.keys import ClientKeys
from shearloop.daemon.messaging.request import request

# So much later than its own end a request counts as hanging.
GRACE_S = 2.0


class Requests:
    """Asks a daemon, and knows which threads are on their way."""

    def __init__(self) -> None:
        self._threads: set[threading.Thread] = set()

    async def ask(
        self, address: str, content: Mapping[str, Any], timeout_s: float, keys: ClientKeys | None
    ) -> dict[str, Any]:
        """Return the reply; raises UserError where none comes in time."""
        answer: Future[dict[str, Any]] = Future()
        # Whoever asked may go away: what was asked, such as a stop, is still carried.
        answer.set_running_or_notify_cancel()

        def carry() -> None:
            try:
                answer.set_result(request(address, content, timeout_s, keys))
            except Exception as error:  # noqa: BLE001 - raised where it is awaited
                answer.set_exception(error)

        self._threads = {thread for thread in self._threads if thread.is_alive()}
        # Not an executor's: the interpreter would wait for those at its end.
        thread = threading.Thread(target=carry, name="request", daemon=True)
        self._threads.add(thread)
        thread.start()
        try:
            async with asyncio.timeout(timeout_s + GRACE_S):
                return await asyncio.wrap_future(answer)
        except TimeoutError as error:
            raise UserError(
                f"the request to {address} hangs, and is given up; see whether the daemon runs, and try again"
            ) from error

    def close(self) -> None:
        """Wait for what is on its way, though not for what hangs."""
        until_s = time.monotonic() + GRACE_S
        for thread in self._threads:
            thread.join(max(0.0, until_s - time.monotonic()))
