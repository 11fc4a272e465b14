"""Structured logs, and the writer that keeps the event loop from waiting for a terminal."""

import contextlib
import logging
import os
import queue
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TextIO, cast

import structlog

from shearloop.drivers.connection import LinkEvent
from shearloop.printable import own_stream, printable, silence

if TYPE_CHECKING:
    from shearloop.daemon.torques import SensorListener

# Texts beyond this number are dropped.
MAX_WAITING = 10_000
# Returns to the beginning of a terminal's line and empties it.
CLEAR_LINE = "\r\x1b[K"
# The end waits this long for the reader.
CLOSE_S = 1.0


class NonBlockingWriter:
    """Writes text in a thread of its own, because a terminal stopped with Ctrl-S blocks its writers.

    A line says where texts were dropped. After a broken pipe (`| head`) it stays silent.
    """

    def __init__(self, stream: TextIO, most_waiting: int = MAX_WAITING) -> None:
        # A terminal with another encoding may lack characters such as "…".
        self._stream = own_stream(stream)
        self._waiting: queue.Queue[str | None] = queue.Queue(most_waiting)
        self._dropped = False
        # A daemon thread: a blocked write must not keep the process alive.
        self.thread = threading.Thread(target=self._run, name="writer", daemon=True)
        self.thread.start()

    def write(self, text: str) -> int:
        """Queue a text; return its length, as a stream does."""
        try:
            self._waiting.put_nowait(text)
        except queue.Full:
            self._dropped = True
        return len(text)

    def flush(self) -> None:
        """Do nothing; the thread flushes."""

    def close(self, timeout_s: float = CLOSE_S) -> None:
        """Write the rest, as far as the reader takes it in time."""
        until_s = time.monotonic() + timeout_s
        with contextlib.suppress(queue.Full):
            self._waiting.put(None, timeout=timeout_s)
        self.thread.join(max(0.0, until_s - time.monotonic()))

    def _run(self) -> None:
        text: str | None = ""
        while text is not None:
            text = self._waiting.get()
            try:
                self._stream.write(text or "")
                if self._waiting.empty():
                    if self._dropped:
                        self._dropped = False
                        self._stream.write("… texts are missing above: the terminal did not read them\n")
                    self._stream.flush()
            except OSError as error:
                silence(self._stream)
                structlog.get_logger().warning("the output has no reader any more", reason=error.strerror)


@contextmanager
def logging_to_stderr(
    *, json_lines: bool | None = None, level: int = logging.INFO, before: str = ""
) -> Iterator[NonBlockingWriter]:
    """Configure structlog for the context: readable lines at a console, JSON under systemd or with `json_lines`.

    `before` precedes each line: CLEAR_LINE where a status line stands.
    """
    if json_lines is None:
        json_lines = "JOURNAL_STREAM" in os.environ
    processors: list[structlog.typing.Processor] = [
        structlog.contextvars.merge_contextvars,
        structlog.processors.add_log_level,
        structlog.processors.TimeStamper(fmt="iso" if json_lines else "%H:%M:%S.%f", utc=json_lines),
    ]
    if json_lines:
        processors += [structlog.processors.format_exc_info, structlog.processors.JSONRenderer(ensure_ascii=False)]
    else:
        plain = structlog.dev.plain_traceback
        processors += [
            structlog.processors.format_exc_info,
            _without_controls,
            structlog.dev.ConsoleRenderer(colors=sys.stderr.isatty(), exception_formatter=plain),
        ]
    if before:
        processors.append(lambda _logger, _name, text: f"{before}{text}")
    with closing(NonBlockingWriter(sys.stderr)) as writer:
        structlog.configure(
            processors=processors,
            wrapper_class=structlog.make_filtering_bound_logger(level),
            logger_factory=structlog.WriteLoggerFactory(cast(TextIO, writer)),
            cache_logger_on_first_use=False,
        )
        try:
            yield writer
        finally:
            structlog.configure(logger_factory=structlog.WriteLoggerFactory(sys.stderr))


def _without_controls(_logger: Any, _name: str, event: structlog.typing.EventDict) -> structlog.typing.EventDict:
    return {key: printable(value) if isinstance(value, str) else value for key, value in event.items()}


@dataclass(frozen=True, slots=True)
class LinkReporter:
    """Logs the losses and returns of one device, and hands them to what listens to the sensors."""

    device: str
    loop: "SensorListener | None" = None

    def on_link_event(self, event: LinkEvent) -> None:
        """Log a return as info, a loss as warning, a repeated loss as debug."""
        log = structlog.get_logger().bind(device=self.device)
        if event.up:
            log.info(event.sentence)
        elif event.repeated:
            log.debug(event.sentence)
        else:
            log.warning(event.sentence)
        if self.loop is not None:
            self.loop.on_link(self.device, event.sentence, up=event.up)

    def on_refusal(self, sentence: str) -> None:
        """Log refused data as a warning."""
        structlog.get_logger().bind(device=self.device).warning(sentence)
