"""Structured logs: readable lines on a console, JSON where a service manager collects them."""

import logging
import os
import sys
from collections.abc import Callable
from functools import partial
from typing import TextIO, cast

import structlog


def silence(stream: TextIO) -> None:
    """Let a stream whose reader has gone lead nowhere, so that what Python still holds of it does not fail again."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, stream.fileno())
    os.close(nowhere)


class _Enduring:
    """A stream for the log that goes quiet once its reader has gone (`2>&1 | head`): what it tells of goes on."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self.flush = partial(self._try, stream.flush)

    def _try(self, do: Callable[[], object]) -> None:
        try:
            do()
        except OSError:
            silence(self._stream)

    def write(self, text: str) -> None:
        """Write a line, as far as anybody reads it."""
        self._try(partial(self._stream.write, text))


def set_up_logging(*, json_lines: bool | None = None, level: int = logging.INFO) -> None:
    """Configure structlog; JSON is chosen by itself when systemd has connected the log to its journal."""
    if json_lines is None:
        json_lines = "JOURNAL_STREAM" in os.environ
    renderer: structlog.typing.Processor = (
        structlog.processors.JSONRenderer(ensure_ascii=False)
        if json_lines
        else structlog.dev.ConsoleRenderer(
            colors=sys.stderr.isatty(), exception_formatter=structlog.dev.plain_traceback
        )
    )
    processors: list[structlog.typing.Processor] = [
        structlog.contextvars.merge_contextvars,
        structlog.processors.add_log_level,
        structlog.processors.TimeStamper(fmt="iso" if json_lines else "%H:%M:%S.%f", utc=json_lines),
    ]
    if json_lines:
        processors.append(structlog.processors.format_exc_info)
    structlog.configure(
        processors=[*processors, renderer],
        wrapper_class=structlog.make_filtering_bound_logger(level),
        logger_factory=structlog.WriteLoggerFactory(cast(TextIO, _Enduring(sys.stderr))),
        cache_logger_on_first_use=False,
    )
