"""`shearloop run`: the daemon, in the foreground."""

import argparse
import asyncio
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager, nullcontext, suppress
from importlib import resources
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

if TYPE_CHECKING:
    from shearloop.daemon.cli.demonstration import Truth
    from shearloop.daemon.config import EmulatorConfig
    from shearloop.daemon.messaging.publisher import Listener
    from shearloop.daemon.nonblocking_writer import NonBlockingWriter
    from shearloop.daemon.recording.matlab_slices import SliceRecorder

# Long enough for an emulator to remove its port's link, short enough for a clean stop within a second.
EMULATOR_STOP_S = 0.5


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `run`."""
    parser.add_argument("config", type=Path, metavar="CONFIG", help="a YAML file such as config/demo.yaml")
    parser.add_argument(
        "--show", action="store_true", help="print the estimates as they come, and what happened at the end"
    )
    parser.add_argument(
        "--slices",
        type=Path,
        metavar="DIR",
        help="keep a slice of each held angle of a sweep, in torque_slices and diameter_slices for `reproduce`",
    )
    parser.add_argument(
        "--json-log", action="store_true", default=None, help="log JSON lines (the default under systemd)"
    )
    parser.add_argument(
        "--recording", type=Path, metavar="FILE", help="let the configuration's EIT emulators play this .mat recording"
    )
    parser.add_argument("--record", type=Path, metavar="DIR", help="record everything into files in this folder")
    parser.epilog = (
        "Ends at Ctrl-C, SIGTERM, the end of its terminal, `shearloop command stop`, or with the experiment where the "
        "configuration says stop_when_done. Exit status: 0 it ended as it was told to, 2 it could not run (and why), "
        "3 it was to end with its experiment, which was stopped before."
    )


def run(args: argparse.Namespace) -> int:
    """Run until a signal, `shearloop command stop`, or the end of the experiment (`stop_when_done`)."""
    from shearloop.daemon.ending_signals import ending_signals
    from shearloop.daemon.gc_control import kept_from_lasting_objects
    from shearloop.daemon.logs import logging_to_stderr
    from shearloop.daemon.nonblocking_writer import NonBlockingWriter

    # Until the event loop takes the signals over: a service that is stopped while it starts has not failed.
    for number in ending_signals():
        if number != signal.SIGINT:
            signal.signal(number, lambda *_: sys.exit(0))
    with (
        kept_from_lasting_objects() as collect_what_comes,
        logging_to_stderr(json_lines=args.json_log) as log,
        closing(NonBlockingWriter(sys.stdout)) as out,
    ):
        return _run(args, log, out, collect_what_comes)


def _run(
    args: argparse.Namespace, log: "NonBlockingWriter", out: "NonBlockingWriter", on_ready: Callable[[], None]
) -> int:
    from structlog import get_logger

    from shearloop.daemon.app import run_daemon
    from shearloop.daemon.cli import EXIT_OK, EXIT_UNFINISHED
    from shearloop.daemon.cli.demonstration import Deaths, Happenings, Truth
    from shearloop.daemon.config import RecordingConfig, load_daemon_config
    from shearloop.daemon.errors import UserError
    from shearloop.daemon.run_summary import RunSummary
    from shearloop.daemon.service.realtime import high_priority

    config = load_daemon_config(args.config)
    if args.recording is not None and not any(emulator.device == "eit-kit" for emulator in config.emulators):
        raise UserError(f"{args.config} has no eit-kit among its `emulators` to play --recording {args.recording}")
    if args.record is not None:
        config = config.model_copy(update={"recording": RecordingConfig(folder=args.record)})
    if config.lock_memory:
        from shearloop.daemon.service.realtime import lock_memory

        lock_memory()
    checked_emulators(config.emulators, args.config)
    if args.recording is not None:
        from shearloop.daemon.recording.matlab_streams import read_stream

        for emulator in config.emulators:
            if emulator.device == "eit-kit":
                # Here, and not in the emulator's process alone: without its frames the daemon would wait for ever.
                read_stream(args.recording, _side(emulator.arguments))
    slices = _slice_recorder(args.slices) if args.slices is not None else None
    listeners: tuple[Listener, ...] = () if slices is None else (slices,)
    truth = Truth(config.emulators)
    try:
        with (
            # Not an error where it is not allowed: late commands are seen, and hold the wrist by themselves.
            high_priority() if config.robot is not None else nullcontext(),
            _emulators(config.emulators, args.config.parent, args.recording, truth) as processes,
        ):
            happenings = Happenings(config.emulators, processes)
            if processes:
                # Before the daemon says what it does not find: it does not know that they are played.
                devices = [emulator.device for emulator in config.emulators]
                get_logger().info("emulated devices are starting; they are missed for a second", devices=devices)
            summary = RunSummary(
                lambda lines: out.write("\n".join(("", *lines, "", ""))), truth.torques, lambda: happenings.happened
            )
            listeners = (Deaths(config.emulators, processes), happenings, *listeners)
            facts = {"log": log.facts, "shown": out.facts, **({"slices": slices.facts} if slices is not None else {})}
            shown = (Show(out), summary) if args.show else ()
            finished = asyncio.run(run_daemon(config, (*listeners, *shown), facts, on_ready))
    finally:
        truth.close()
        if slices is not None:
            slices.close()
    if slices is not None:
        out.write(f"{args.slices}: {slices.summary}\n")
    return EXIT_OK if finished else EXIT_UNFINISHED


def checked_emulators(emulators: "tuple[EmulatorConfig, ...]", config: Path) -> None:
    """Raise UserError for an emulator of a device that there is none of, or with arguments that it does not take."""
    from shearloop.daemon.cli.emulate import DEVICES, checked_arguments
    from shearloop.daemon.errors import UserError

    for number, emulator in enumerate(emulators):
        if emulator.device not in DEVICES:
            raise UserError(
                f"{config}: `emulators[{number}].device` is {emulator.device!r}; there are {', '.join(DEVICES)}"
            )
        try:
            checked_arguments(emulator.device, (*emulator.arguments, *emulator.synthetic), config.parent)
        except UserError as error:
            raise UserError(f"{config}: `emulators[{number}].arguments`: {emulator.device}: {error}") from error


def _slice_recorder(folder: Path) -> "SliceRecorder":
    # Only where it is wanted: scipy.io takes long to import.
    from shearloop.daemon.recording.matlab_slices import SliceRecorder

    return SliceRecorder(folder)


def _side(arguments: tuple[str, ...]) -> str | None:
    """Return which fingertip of a recording an emulator is told to play; None where it is not told."""
    for argument, following in pairwise((*arguments, "")):
        if argument == "--side" and following in ("left", "right"):
            return following
    return None


class Show:
    """A listener that prints the estimates."""

    def __init__(self, out: "TextIO | NonBlockingWriter") -> None:
        self._out = out

    def __call__(self, topic: str, content: Mapping[str, Any]) -> None:
        """Print one message."""
        if topic in ("eit.estimate", "skin.shear"):
            from shearloop.daemon.cli.readable import as_line

            self._out.write(as_line(topic, content) + "\n")
            self._out.flush()


def _same_code() -> dict[str, str]:
    """Return an environment in which a child in another folder runs the code that runs here."""
    here = str(Path(str(resources.files("shearloop"))).parent)
    return {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, [here, os.environ.get("PYTHONPATH")]))}


@contextmanager
def _emulators(
    emulators: "tuple[EmulatorConfig, ...]", folder: Path, recording: Path | None, truth: "Truth"
) -> Iterator[list["subprocess.Popen[bytes]"]]:
    """Keep the configuration's emulated devices running, each as a process of its own."""
    processes: list[subprocess.Popen[bytes]] = []
    try:
        for emulator in emulators:
            played = emulator.synthetic
            if recording is not None and emulator.device == "eit-kit":
                played = ("--recording", str(recording.resolve()))
            if emulator.device == "rig":
                played = (*played, *truth.arguments)
            command = [sys.executable, "-m", "shearloop", "emulate", emulator.device, *emulator.arguments, *played]
            # Their standard input stays open and silent: a closed one would end them.
            processes.append(
                subprocess.Popen(
                    command, cwd=folder, env=_same_code(), stdin=subprocess.PIPE, stdout=subprocess.DEVNULL
                )
            )
        yield processes
    finally:
        for process in processes:
            process.terminate()
        for process in processes:
            try:
                process.wait(EMULATOR_STOP_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
            if process.stdin is not None:
                # What it was told and did not read any more goes with it.
                with suppress(BrokenPipeError):
                    process.stdin.close()
