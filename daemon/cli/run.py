"""`shearloop run`: run the daemon in the foreground."""

import argparse
import asyncio
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager, nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from shearloop.daemon.cli.demonstration import TruthFile
    from shearloop.daemon.config import EmulatorConfig
    from shearloop.daemon.logs import NonBlockingWriter
    from shearloop.daemon.messaging.publisher import Listener

# An emulator needs some of it to remove its port's link; a clean stop takes less than a second in all.
EMULATOR_STOP_S = 0.5


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `run`."""
    parser.add_argument("config", type=Path, metavar="CONFIG", help="a YAML file such as config/demo.yaml")
    parser.add_argument("--show", action="store_true", help="print the estimates, and a summary at the end")
    parser.add_argument(
        "--slices",
        type=Path,
        metavar="DIR",
        help="write a slice of each held angle of a sweep, in torque_slices and diameter_slices for `reproduce`",
    )
    parser.add_argument(
        "--json-log", action="store_true", default=None, help="log JSON lines (the default under systemd)"
    )
    parser.add_argument(
        "--recording", type=Path, metavar="FILE", help="let the configuration's EIT emulators play this .mat recording"
    )
    parser.add_argument("--record", type=Path, metavar="DIR", help="record everything into files in this folder")
    parser.epilog = (
        "Ends at Ctrl-C, SIGTERM, a closed terminal, `shearloop command stop`, or with the experiment if the "
        "configuration says stop_when_done. Exit status: 0 it ended as requested, 2 it could not run (and why), "
        "3 the experiment of stop_when_done was stopped before its end."
    )


def run(args: argparse.Namespace) -> int:
    """Run until a signal, `shearloop command stop`, or the end of the experiment (`stop_when_done`)."""
    from shearloop.daemon.gc_control import without_long_collections
    from shearloop.daemon.logs import NonBlockingWriter, logging_to_stderr
    from shearloop.daemon.signals import ending_signals

    # Until the event loop handles the signals: stopping a service that is still starting is no failure.
    for number in ending_signals():
        if number != signal.SIGINT:
            signal.signal(number, lambda *_: sys.exit(0))
    with (
        without_long_collections() as on_ready,
        logging_to_stderr(json_lines=args.json_log) as log,
        closing(NonBlockingWriter(sys.stdout)) as out,
    ):
        return _run(args, log, out, on_ready)


def _run(
    args: argparse.Namespace, log: "NonBlockingWriter", out: "NonBlockingWriter", on_ready: Callable[[], None]
) -> int:
    import structlog

    from shearloop.daemon.app import run_daemon
    from shearloop.daemon.cli import EXIT_OK, EXIT_UNFINISHED
    from shearloop.daemon.cli.demonstration import EmulatorMonitor, EventInjector, TruthFile
    from shearloop.daemon.cli.output import EstimatePrinter
    from shearloop.daemon.config import RecordingConfig, load_daemon_config
    from shearloop.daemon.errors import UserError
    from shearloop.daemon.health import Reporter
    from shearloop.daemon.realtime import high_priority, lock_memory
    from shearloop.daemon.run_summary import RunSummary

    config = load_daemon_config(args.config)
    emulators = config.emulators
    if args.recording is not None and not any(emulator.device == "eit-kit" for emulator in emulators):
        raise UserError(f"{args.config} has no eit-kit among its `emulators` to play --recording {args.recording}")
    if args.record is not None:
        config = config.model_copy(update={"recording": RecordingConfig(folder=args.record)})
    if config.lock_memory:
        lock_memory()
    options = check_emulators(emulators, args.config)
    if args.recording is not None:
        from shearloop.daemon.recording.matlab import read_stream

        for emulator, given in zip(emulators, options, strict=True):
            if emulator.device == "eit-kit":
                # Without its frames the daemon would wait forever.
                read_stream(args.recording, given.side)
    listeners: list[Listener] = []
    reporters: dict[str, Reporter] = {"log": log, "shown": out}
    with ExitStack() as stack:
        slices = None
        if args.slices is not None:
            # Imports scipy.io, which takes long.
            from shearloop.daemon.recording.matlab_slices import SliceRecorder

            slices = SliceRecorder(args.slices)
            stack.callback(slices.close)
            listeners.append(slices)
            reporters["slices"] = slices
        truth = stack.enter_context(closing(TruthFile(emulators)))
        # Without permission the loop still detects late commands and holds the wrist.
        stack.enter_context(high_priority() if config.robot is not None else nullcontext())
        processes = stack.enter_context(_run_emulators(emulators, args.config.parent, args.recording, truth))
        events = EventInjector(emulators, processes)
        listeners += [EmulatorMonitor(emulators, processes), events]
        if processes:
            # The daemon does not know about emulation and will report missing devices.
            structlog.get_logger().info(
                "emulated devices are starting; the daemon misses them for a second",
                devices=[emulator.device for emulator in emulators],
            )
        if args.show:
            listeners += [EstimatePrinter(out), RunSummary(out, truth, events)]
        finished = asyncio.run(run_daemon(config, tuple(listeners), reporters, on_ready))
    if slices is not None:
        out.write(f"{args.slices}: {slices.summary}\n")
    return EXIT_OK if finished else EXIT_UNFINISHED


def check_emulators(emulators: "tuple[EmulatorConfig, ...]", config: Path) -> list[argparse.Namespace]:
    """Return the parsed arguments of each emulator; raise UserError for an unknown device or invalid arguments."""
    from shearloop.daemon.cli.emulate import DEVICES, checked_arguments
    from shearloop.daemon.errors import UserError

    options = []
    for number, emulator in enumerate(emulators):
        if emulator.device not in DEVICES:
            raise UserError(
                f"{config}: `emulators[{number}].device` is {emulator.device!r}; there are {', '.join(DEVICES)}"
            )
        try:
            options.append(
                checked_arguments(emulator.device, (*emulator.arguments, *emulator.synthetic), config.parent)
            )
        except UserError as error:
            raise UserError(f"{config}: `emulators[{number}].arguments`: {emulator.device}: {error}") from error
    return options


@contextmanager
def _run_emulators(
    emulators: "tuple[EmulatorConfig, ...]", folder: Path, recording: Path | None, truth: "TruthFile"
) -> Iterator[list["subprocess.Popen[bytes]"]]:
    """Run the configuration's emulated devices, each in a process."""
    processes: list[subprocess.Popen[bytes]] = []
    try:
        for emulator in emulators:
            source = emulator.synthetic
            if recording is not None and emulator.device == "eit-kit":
                source = ("--recording", str(recording.resolve()))
            if emulator.device == "rig":
                source = (*source, *truth.arguments)
            command = [sys.executable, "-m", "shearloop", "emulate", emulator.device, *emulator.arguments, *source]
            # An emulator ends when its standard input is closed.
            processes.append(subprocess.Popen(command, cwd=folder, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL))
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
                # Closing flushes unread input to a process that has ended.
                with suppress(BrokenPipeError):
                    process.stdin.close()
