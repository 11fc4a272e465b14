"""Text for a terminal, a pipe or a journal, written in a thread of its own.

A terminal that was stopped with Ctrl-S takes nothing until Ctrl-Q, and whoever writes to it waits: that must not be the
loop that drives a robot.
"""

import contextlib
import io
import os
import queue
import threading
import time
from collections.abc import Mapping
from typing import TextIO

import structlog

from shearloop.daemon.messaging.messages import Scalar

# Of texts that nobody takes so many are kept; later ones are counted.
MOST_WAITING = 10_000
# How long the end waits for what nobody has taken yet.
CLOSE_S = 1.0


def silence(stream: TextIO) -> None:
    """Let a stream whose reader has gone lead nowhere, so that what Python still holds of it does not fail again."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, stream.fileno())
    os.close(nowhere)


class NonBlockingWriter:
    """Takes text without ever waiting, and writes it in order; `close` writes what is left.

    `lost` counts texts that were not kept because nobody read; a line says so in their place. Where the reader has gone
    (`| head`) it goes quiet: what the text tells of goes on.
    """

    def __init__(self, stream: TextIO, most_waiting: int = MOST_WAITING) -> None:
        self.lost = 0
        if isinstance(stream, io.TextIOWrapper):
            # A terminal of another encoding has no "…": as standard error does it, and not an end of everything shown.
            stream.reconfigure(errors="backslashreplace")
        self._stream = stream
        self._waiting: queue.Queue[str | None] = queue.Queue(most_waiting)
        self._told = 0
        # Several threads log.
        self._lock = threading.Lock()
        # A write that never ends must not keep the process from ending.
        self._thread = threading.Thread(target=self._run, name="outlet", daemon=True)
        self._thread.start()

    def write(self, text: str) -> int:
        """Have a text written soon; return its length, as a stream does."""
        with self._lock:
            try:
                self._tell_of_lost()
                self._waiting.put_nowait(text)
            except queue.Full:
                self.lost += 1
        return len(text)

    def flush(self) -> None:
        """Nothing: what was written is on its way."""

    def close(self, timeout_s: float = CLOSE_S) -> None:
        """Write what is left, as far as it is taken in time."""
        until_s = time.monotonic() + timeout_s
        with contextlib.suppress(queue.Full):
            with self._lock:
                self._tell_of_lost(timeout_s)
            self._waiting.put(None, timeout=max(0.0, until_s - time.monotonic()))
        self._thread.join(max(0.0, until_s - time.monotonic()))

    def facts(self) -> Mapping[str, Scalar | Mapping[str, int]]:
        """Return what health tells of it."""
        if not self.lost:
            return {"errors": {}, "error": ""}
        return {
            "errors": {"unread": self.lost},
            "error": f"{self.lost} texts are lost that nobody read; a terminal that was stopped with Ctrl-S goes on "
            "with Ctrl-Q",
        }

    def _tell_of_lost(self, timeout_s: float = 0.0) -> None:
        """Write how much is missing here; raises queue.Full where there is no room for it in time."""
        missing = self.lost - self._told
        if missing:
            note = f"… {missing} texts are missing here: nobody read for a while\n"
            self._waiting.put(note, block=timeout_s > 0, timeout=timeout_s)
            self._told = self.lost

    def _run(self) -> None:
        while (text := self._waiting.get()) is not None:
            try:
                self._stream.write(text)
                if self._waiting.empty():
                    self._stream.flush()
            except OSError as error:
                silence(self._stream)
                structlog.get_logger().warning("nobody reads any more what is shown", why=error.strerror)
