"""`shearloop demo`: run the emulated rig in closed loop, and show it."""

import argparse
import json
import shlex
import socket
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from types import ModuleType
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from shearloop.cli import bank, init
from shearloop.cli import run as run_command
from shearloop.cli.emulator_processes import SHEARLOOP, running
from shearloop.cli.free_ports import free_loopback, is_free, plays_no_robot
from shearloop.cli.options import PORT, add_option, path_of
from shearloop.cli.other_daemon import refuse_second_daemon
from shearloop.cli.temporary_folders import run_folder
from shearloop.cli.view import PAGE_PORT
from shearloop.daemon.messaging.addresses import stop_name
from shearloop.daemon.process import interrupt_status
from shearloop.errors import UserError
from shearloop.extras import missing
from shearloop.tools.outputs import writing

if TYPE_CHECKING:
    from shearloop.daemon.config import DaemonConfig

HOST = "127.0.0.1"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `demo`."""
    text = "folder for configuration, bank and calibrations, kept for later runs (default: %(default)s)"
    add_option(parser, "--folder", Path, "DIR", text, default=Path("shearloop-demo"))
    text = f"the page's port on 127.0.0.1; 0 for any free one (default: {PAGE_PORT}, or any if that is taken)"
    add_option(parser, "--port", PORT, "PORT", text)
    parser.add_argument("--prepare", action="store_true", help="only write the files; do not run")
    text = "play this .mat recording on one fingertip, without a robot: k, sigma and the heatmap"
    parser.add_argument("--play", "--recording", type=path_of, metavar="FILE", help=text)
    parser.epilog = (
        "Builds a bank and calibrations, emulates the whole rig, grips a tool, identifies it, holds 0.10 N·m on it and "
        "lets go. Prints the address of the live page, which needs the extra `view`."
    )


def run(args: argparse.Namespace) -> int:
    """Prepare the folder, then run the daemon and its page."""
    folder = args.folder / "config"
    if args.prepare:
        _write_missing(folder)
        try:
            _prepare(folder, args.folder / "run", calibrated=args.play is None)
        except KeyboardInterrupt as interrupt:
            # The demo that has started and ended this process says so.
            return interrupt_status(interrupt)
        return 0
    name = "demo.yaml" if args.play is None else "fingertip_demo.yaml"
    played = [] if args.play is None else ["--play", str(args.play)]
    # Mistakes, and another daemon, are found before anything is written, built and served.
    if args.play is not None:
        from shearloop.tools.recordings.matlab_import import read_lines

        read_lines(args.play)
    port = _page_port(args.port)
    if not (folder / name).exists():
        with TemporaryDirectory() as temporary:
            init.write_files(Path(temporary), init.packaged_files())
            _config_of_free_ports(Path(temporary) / name, folder / name)
    _write_missing(folder)
    config = _config_of_free_ports(folder / name)
    if args.play is None and not config.autostart:
        raise UserError(
            f"{folder / name} starts nothing by itself: it needs `emulated: true` and `autostart: true`; remove it, "
            "and `shearloop demo` writes it again"
        )
    with only_demo(config):
        print("The demo starts …", flush=True)
        # In a process of its own: the daemon would keep the memory of the fits.
        with running([*SHEARLOOP, "demo", "--prepare", "--folder", str(args.folder), *played]) as process:
            status = process.wait()
        if status:
            return status
        # Half a minute has passed.
        _config_of_free_ports(folder / name)
        with page(config, port), elsewhere(config) as moved:
            return _call(run_command, str(folder / name), "--show", *played, *moved)


@contextmanager
def only_demo(config: "DaemonConfig") -> Iterator[None]:
    """Hold the configuration's addresses for this demo until its end; raises UserError if another demo has them.

    A demo that has just started has no daemon yet that would answer.
    """
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as held:
        try:
            held.bind(demo_name(config.commands))
        except OSError as error:
            raise UserError(
                f"a demo has just started at {config.commands}, and it gets ready for half a minute: watch that one, "
                "or end it with Ctrl-C in its terminal; with another --folder, give its `config/demo.yaml` other "
                "`publish` and `commands`"
            ) from error
        yield


def demo_name(commands: str) -> bytes:
    """Return the abstract name that a demo with this command address holds."""
    return stop_name(commands).replace(b"-stop-", b"-demo-", 1)


def _write_missing(folder: Path) -> None:
    """Write the files of the demo that are not there yet."""
    files = init.packaged_files()
    init.write_files(folder, {path: content for path, content in files.items() if not (folder / path).exists()})


def _page_port(asked: int | None) -> int:
    """Return the page's port, 0 for any; raises UserError for one that was asked for and is taken."""
    if asked is None:
        return PAGE_PORT if is_free(HOST, PAGE_PORT) else 0
    if asked and not is_free(HOST, asked):
        raise UserError(f"the page cannot be served on {HOST}:{asked}, which is taken; give another --port")
    return asked


def _config_of_free_ports(path: Path, kept: Path | None = None) -> "DaemonConfig":
    """Return the configuration of a file, which is kept at `kept`; raises UserError if its addresses are taken."""
    from shearloop.daemon.config import load_daemon_config
    from shearloop.daemon.rig import open_settings

    config = load_daemon_config(path)
    open_settings(config)
    check_ports(config, kept or path)
    return config


def check_ports(config: "DaemonConfig", path: Path) -> None:
    """Raise UserError if another daemon, or another program, has the sockets of the configuration in this file."""
    page = "" if is_free(HOST, PAGE_PORT) else f"http://{HOST}:{PAGE_PORT}/"
    prepare = shlex.join(["shearloop", "demo", "--prepare", "--folder", str(path.parents[1])])
    made = "" if path.exists() else f", which `{prepare}` writes"
    cure = f"give `publish` and `commands` other addresses in {path}{made}; --port is the page's port"
    refuse_second_daemon(config.commands, page, cure)
    ours = [urlsplit(address) for address in (config.publish, config.commands) if address.startswith("tcp://")]
    for url in ours:
        if url.port and not is_free(str(url.hostname), url.port):
            place = f"{url.hostname}:{url.port}"
            raise UserError(f"{place} is taken by another program; `ss -ltnp` names it: end it first, or {cure}")


@contextmanager
def elsewhere(config: "DaemonConfig") -> Iterator[list[str]]:
    """Yield the options of `run` that let robot and gripper be played at another address, if theirs is taken."""
    import yaml

    from shearloop.daemon.rig import configured_settings
    from shearloop.yaml_files import read_yaml

    settings = configured_settings(config)
    players = [number for number, emulator in enumerate(config.emulators) if emulator.device == "rig"]
    if settings is None or config.robot is None or not players or plays_no_robot(settings.host):
        yield []
        return
    host = free_loopback()
    print(f"{settings.host} plays another robot: this one is played at {host}.", flush=True)
    # The last `--host` counts.
    arguments = [*config.emulators[players[0]].arguments, "--host", host]
    with run_folder() as folder:
        robot = folder / config.robot.name
        robot.write_text(yaml.safe_dump({**read_yaml(config.robot, UserError), "host": host}), encoding="utf-8")
        values = {"robot": str(robot), f"emulators.{players[0]}.arguments": json.dumps(arguments)}
        if config.gripper is not None and config.gripper.socket is not None:
            values["gripper.socket.host"] = host
        yield [part for key, value in values.items() for part in ("--set", f"{key}={value}")]


def _prepare(config: Path, data: Path, *, calibrated: bool) -> None:
    """Make the bank and, if `calibrated`, the calibrations, where they are missing or outdated."""
    from shearloop.tools.bank_config import load_bank_plan
    from shearloop.tools.banks import is_built

    with writing(data, "the folder"):
        data.mkdir(exist_ok=True)
    definition, signals = config / "banks" / "demo.yaml", data / "demo.bank"
    if not is_built(signals, load_bank_plan(definition).definition):
        duration = "half a minute, or a few minutes on a busy computer"
        print(f"The first time, a bank and calibrations are made in {data}: {duration}.", flush=True)
        _call(bank, "build", "--config", str(definition), "--out", str(signals))
    if calibrated and not _is_calibrated(data, signals):
        from shearloop.studies.emulated_calibration import calibrate_rig

        calibrate_rig(signals, data)


def _is_calibrated(data: Path, signals: Path) -> bool:
    """Return whether the calibrations are there, newer than the bank, and of this version's format."""
    from shearloop.bank.errors import CalibrationError
    from shearloop.estimation import Calibration

    try:
        paths = [data / name for name in ("rig.cal", "rig-right.cal", "rig-left.cal")]
        return all(Calibration.load(path) and path.stat().st_mtime >= signals.stat().st_mtime for path in paths)
    except CalibrationError:
        return False


@contextmanager
def page(config: "DaemonConfig", port: int) -> Iterator[None]:
    """Serve the live page on this port in a process of its own."""
    if find_spec("aiohttp") is None:
        print(missing("aiohttp", "view", "the live page"), flush=True)
        yield
        return
    options = ("--connect", config.publish, "--commands", config.commands, "--port", str(port), "--json")
    with running([*SHEARLOOP, "view", *options], stdout=subprocess.PIPE) as process:
        # Empty where the page has ended; its own sentence says why.
        if process.stdout is not None and (line := process.stdout.readline()):
            print(f"The live page, for a browser of this computer: {json.loads(line)['url_with_token']}", flush=True)
        yield


def _call(command: ModuleType, *arguments: str) -> int:
    """Run another command in this process and return its exit status."""
    parser = argparse.ArgumentParser()
    command.configure(parser)
    status: int = command.run(parser.parse_args(arguments))
    return status
