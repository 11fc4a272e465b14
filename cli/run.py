"""`shearloop run`: run the daemon in the foreground."""

import argparse
import asyncio
import signal
import sys
from collections.abc import Callable
from contextlib import ExitStack, closing
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from shearloop.cli.options import add_option, path_of
from shearloop.daemon.running_rig import EMULATED
from shearloop.errors import UserError
from shearloop.printable import printable

if TYPE_CHECKING:
    from shearloop.daemon.config import DaemonConfig
    from shearloop.daemon.logs import NonBlockingWriter
    from shearloop.daemon.messaging.publisher import Listener


SUMMARY_HEADING = f"{EMULATED}: every device was emulated on this computer."


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `run`."""
    add_option(parser, "config", Path, "CONFIG", "a YAML file such as config/demo.yaml")
    text = "show the state (to a file: each estimate, or the load cell's readings), and a summary"
    parser.add_argument("--show", action="store_true", help=text)
    text = "log JSON lines (the default under systemd)"
    parser.add_argument("--json-log", action="store_true", default=None, help=text)
    choices = ("debug", "info", "warning", "error")
    text = "log this level and worse ones (default: info; on a terminal with --show: warning)"
    parser.add_argument("--log-level", choices=choices, metavar="LEVEL", help=f"{text}; one of {', '.join(choices)}")
    text = "replace a value of the configuration, e.g. loop.kp=0.5; repeatable"
    add_option(parser, "--set", _assignment, "KEY=VALUE", text, action="append", default=[])
    text = "let the configuration's EIT emulators play this .mat recording"
    parser.add_argument("--play", "--recording", type=path_of, metavar="FILE", help=text)
    text = "rehearse: emulate every device of this configuration, and run its experiment; no real device is opened"
    parser.add_argument("--emulate", action="store_true", help=text)
    add_option(parser, "--record", Path, "DIR", "record everything into files in this folder")
    parser.epilog = (
        "Ends at Ctrl-C, SIGTERM, a closed terminal, `shearloop command stop`, or with the experiment if the "
        "configuration says stop_when_done. Exit status: 0 it ended as requested, 2 it could not run (and why), "
        "3 a fault stopped the experiment of stop_when_done, 4 a person stopped it."
    )


def _assignment(text: str) -> tuple[str, str]:
    key, sign, value = text.partition("=")
    if not (key and sign):
        raise argparse.ArgumentTypeError(f"{text} is not of the form KEY=VALUE, such as loop.kp=0.5")
    return key, value


def run(args: argparse.Namespace) -> int:
    """Run until a signal, `shearloop command stop`, or the end of the experiment (`stop_when_done`)."""
    import logging

    from shearloop.daemon.logs import CLEAR_LINE, NonBlockingWriter, logging_to_stderr
    from shearloop.daemon.process import ending_signals, without_long_collections

    # Until the event loop handles the signals: stopping a service that is still starting is no failure.
    for number in ending_signals():
        if number != signal.SIGINT:
            signal.signal(number, lambda *_: sys.exit(0))
    # A terminal shows one line that changes, and only warnings between.
    terminal = args.show and not args.json_log and sys.stdout.isatty() and sys.stderr.isatty()
    level, before = (logging.WARNING, CLEAR_LINE) if terminal else (logging.INFO, "")
    if args.log_level is not None:
        level = getattr(logging, args.log_level.upper())
    with (
        without_long_collections() as on_ready,
        logging_to_stderr(json_lines=args.json_log, level=level, before=before),
        closing(NonBlockingWriter(sys.stdout)) as out,
    ):
        return _run(args, out, on_ready, terminal=terminal)


def _run(args: argparse.Namespace, out: "NonBlockingWriter", on_ready: Callable[[], None], *, terminal: bool) -> int:
    from shearloop.cli.other_daemon import refuse_second_daemon

    with ExitStack() as rehearsing:
        config = _config(args)
        # Before a rehearsal says what it plays.
        refuse_second_daemon(config.commands)
        if args.emulate:
            from shearloop.cli.rehearsal import rehearsal, sentences_of_run

            rehearsed = rehearsing.enter_context(rehearsal(config, args.config))
            config = rehearsed.config
            sentences = [*rehearsed.sentences, *sentences_of_run(config)]
            out.write("".join(f"{EMULATED}: {sentence}\n" for sentence in sentences))
        return _run_config(config, args, out, on_ready, terminal=terminal)


def _run_config(
    config: "DaemonConfig",
    args: argparse.Namespace,
    out: "NonBlockingWriter",
    on_ready: Callable[[], None],
    *,
    terminal: bool,
) -> int:
    import structlog

    from shearloop.cli import EXIT_OK, EXIT_STOPPED, EXIT_UNFINISHED
    from shearloop.cli.emulator_processes import EmulatedDevices
    from shearloop.cli.terminal import StatusLine, print_estimate, shown_topics
    from shearloop.daemon.app import run_daemon
    from shearloop.daemon.messaging.refusals import Refusals
    from shearloop.daemon.messaging.stop_socket import StopSocket
    from shearloop.daemon.process import lock_memory, raise_descriptor_limit, raise_priority
    from shearloop.daemon.run_summary import RunSummary

    raise_descriptor_limit()
    if config.lock_memory:
        lock_memory()
    if config.robot is not None:
        # Without permission the loop still detects late commands and holds the wrist.
        raise_priority()
    if config.emulators:
        # A daemon that does not answer is found before the emulators find their ports taken.
        StopSocket(config.commands, {}, Refusals()).close()
    label = f"{EMULATED} " if config.emulated else ""
    with ExitStack() as stack:
        if config.emulated:
            stack.enter_context(structlog.contextvars.bound_contextvars(rig=EMULATED))
        emulated = stack.enter_context(EmulatedDevices(config.emulators, args.config.parent, args.play))
        listeners: list[Listener] = [emulated]
        if args.show:
            topics = shown_topics(config)
            listeners.append(
                stack.enter_context(StatusLine(out, label, topics))
                if terminal
                else partial(print_estimate, out, label=label, topics=topics)
            )
        shown = out if args.show or args.emulate or config.recording is not None else None
        # If the daemon ends with its experiment, the summary comes after all that it logs.
        at_end = shown if config.stop_when_done else None
        summary = RunSummary(None if at_end else shown, emulated, heading=SUMMARY_HEADING if config.emulated else "")
        try:
            finished = asyncio.run(run_daemon(config, tuple(listeners), on_ready, summary))
        finally:
            if at_end and summary.text:
                at_end.write(f"\n{printable(summary.text)}\n\n")
    if finished:
        return EXIT_OK
    return EXIT_STOPPED if summary.ended_as_asked else EXIT_UNFINISHED


def _config(args: argparse.Namespace) -> "DaemonConfig":
    """Return the configuration with the arguments' changes, after checking its emulators."""
    from shearloop.cli.emulator_processes import check_emulators
    from shearloop.daemon.config import RecordingConfig, load_daemon_config

    config = load_daemon_config(args.config, dict(args.set))
    options = check_emulators(config.emulators, args.config)
    if args.play is not None:
        from shearloop.tools.recordings.matlab_import import read_lines

        boards = [given for given in options if given.device == "eit-kit"]
        if not boards:
            raise UserError(f"{args.config} has no eit-kit among its `emulators` that --play {args.play} could use")
        for given in boards:
            # Without its frames the daemon would wait forever.
            read_lines(args.play, given.side)
    if args.record is not None:
        config = config.model_copy(update={"recording": RecordingConfig(folder=args.record)})
    return config
