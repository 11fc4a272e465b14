"""Structured logs: readable lines on a console, JSON for a service manager."""

import logging
import os
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from typing import TextIO, cast

import structlog

from shearloop.daemon.nonblocking_writer import NonBlockingWriter


@contextmanager
def logging_to_stderr(*, json_lines: bool | None = None, level: int = logging.INFO) -> Iterator[NonBlockingWriter]:
    """Configure structlog for the context; logging never blocks on the reader of stderr.

    The default is JSON if stderr is systemd's journal, else readable lines.
    """
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
    with closing(NonBlockingWriter(sys.stderr)) as outlet:
        structlog.configure(
            processors=[*processors, renderer],
            wrapper_class=structlog.make_filtering_bound_logger(level),
            logger_factory=structlog.WriteLoggerFactory(cast(TextIO, outlet)),
            cache_logger_on_first_use=False,
        )
        try:
            yield outlet
        finally:
            # Later log lines are written directly.
            structlog.configure(logger_factory=structlog.WriteLoggerFactory(sys.stderr))
