import asyncio
import json
import signal
import socket
import sys
from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest
import structlog
import yaml
import zmq
import zmq.asyncio
from scipy.io import savemat

from shearloop.bank.eit.bank_file import Bank
from shearloop.bank.eit.channels import PAPER_TABLE
from shearloop.daemon.app import Daemon
from shearloop.daemon.cli import main
from shearloop.daemon.config import load_daemon_config
from shearloop.daemon.messaging.client import send_command
from shearloop.drivers.defaults import FRAME_PERIOD_S
from shearloop.drivers.eit_kit import ADC_STEP_V
from tests.paper_curve import paper_curve

# Guards against a test that hangs; none waits for so long.
DEADLINE_S = 60


@pytest.fixture(scope="session")
def tiny_calibration(tiny_bank) -> Path:
    """A calibration of the whole tiny bank."""
    grid = np.linspace(0.9, 2.1, 30)
    path = tiny_bank.with_name("tiny.cal")
    identity = Bank.open(tiny_bank).identity
    paper_curve(identity, torque=(grid, 0.3 - 0.1 * grid), diameter=(grid, 20.0 * grid)).save(path)
    return path


@pytest.fixture(scope="session")
def ur_rtde() -> None:
    """Skip a test whose configuration needs the robot's library."""
    pytest.importorskip("rtde_control", reason="ur-rtde has wheels for CPython up to 3.12 on x86-64 only")


@pytest.fixture
def config(tmp_path, tiny_bank, tiny_calibration) -> Callable[..., Path]:
    """Write a configuration of one fingertip, with changes to it and to the fingertip, and return its path."""

    def write(*, right: Mapping[str, Any] = MappingProxyType({}), **changes: Any) -> Path:
        content = {
            "publish": f"ipc://{tmp_path}/publish",
            "commands": f"ipc://{tmp_path}/commands",
            "fingertips": {
                "right": {
                    "device": {"path": "eit-right"},
                    "bank": str(tiny_bank),
                    "calibration": str(tiny_calibration),
                    "matching": "zero_lag",
                    **right,
                }
            },
        }
        path = tmp_path / "config.yaml"
        path.write_text(yaml.safe_dump({**content, **changes}))
        return path

    return write


@pytest.fixture
def ran(capsys) -> Callable[..., "pytest.CaptureResult[str]"]:
    """Return a function that runs a command, which must end with a status, and returns all that was printed."""

    def run(*arguments: object, status: int = 0) -> "pytest.CaptureResult[str]":
        assert main([*map(str, arguments)]) == status
        return capsys.readouterr()

    return run


@pytest.fixture
def result_of(ran) -> Callable[..., Any]:
    """Return a function that runs a command with --json, and returns what was printed."""

    def run(*arguments: object, status: int = 0) -> Any:
        return json.loads(ran(*arguments, "--json", status=status).out)

    return run


@pytest.fixture
def keys(tmp_path, result_of) -> Path:
    """A server and one client who knows it, made as a script makes them."""
    server, client = tmp_path / "keys", tmp_path / "ada"
    assert result_of("keys", "server", "--dir", server)["secret_file"] == str(server / "server.key_secret")
    public = result_of("keys", "client", "--dir", client)["public_file"]
    assert result_of("keys", "allow", public, "--name", "ada", "--dir", server) == {"allowed": "ada"}
    return tmp_path


@pytest.fixture
def mistake(ran) -> Callable[..., str]:
    """Return a function that runs a command, which must end with status 2 and a line for each mistake."""

    def run(*arguments: object) -> str:
        out, err = ran(*arguments, status=2)
        assert out == ""
        # No traceback.
        assert all(": " in line and not line.startswith(" ") for line in err.splitlines()), err
        assert err.startswith(f"shearloop {arguments[0]}: ")
        return err

    return run


@asynccontextmanager
async def deadline(otherwise: str) -> AsyncIterator[None]:
    """Fail with a sentence of what has not happened where it takes longer than any test waits."""
    try:
        async with asyncio.timeout(DEADLINE_S):
            yield
    except TimeoutError:
        pytest.fail(f"{otherwise} within {DEADLINE_S} s")


class Log:
    """What the log says, as it says it, and a wait for a sentence of it."""

    def __init__(self) -> None:
        self.said: list[str] = []
        self._more = asyncio.Event()

    def __call__(self, _logger: Any, _level: str, event: structlog.typing.EventDict) -> structlog.typing.EventDict:
        """Take in one event, and pass it on, as a processor of structlog."""
        self.said.append(str(event["event"]))
        self._more.set()
        return event

    async def says(self, sentence: str) -> None:
        """Wait until it has said so."""
        async with deadline(f"the log did not say {sentence!r}"):
            while not any(sentence in one for one in self.said):
                self._more.clear()
                await self._more.wait()


@pytest.fixture
def log() -> Log:
    """Give what is logged in this process, in the event loop's thread."""
    heard = Log()
    # Every test begins with the defaults (tests/conftest.py).
    structlog.configure(processors=[heard, *structlog.get_config()["processors"]])
    return heard


@asynccontextmanager
async def shearloop(*arguments: str, **streams: int) -> AsyncIterator[asyncio.subprocess.Process]:
    """Run a command as a process of its own; it is ended at the end, in success and in failure of the test."""
    streams = {"stdout": asyncio.subprocess.PIPE, "stderr": asyncio.subprocess.PIPE, **streams}
    process = await asyncio.create_subprocess_exec(sys.executable, "-m", "shearloop", *arguments, **streams)
    try:
        async with asyncio.timeout(DEADLINE_S):
            yield process
    finally:
        if process.returncode is None:
            process.kill()
        await process.communicate()
        # The transport closes its pipes one step later.
        await asyncio.sleep(0)


@asynccontextmanager
async def running_daemon(path: Path) -> AsyncIterator[Daemon]:
    """Run a daemon in this process, where its parts can be reached."""
    with zmq.asyncio.Context() as context:
        daemon = Daemon(load_daemon_config(path), context)
        # A daemon that dies ends the test at once.
        async with asyncio.timeout(DEADLINE_S), asyncio.TaskGroup() as group:
            group.create_task(daemon.run())
            try:
                yield daemon
            finally:
                daemon.stop()


async def ask(daemon: Daemon, command: str, **arguments: Any) -> dict[str, Any]:
    """Send a command to a daemon of this process, as a client does, and return the reply."""
    request = {"command": command, **arguments}
    return await asyncio.to_thread(send_command, daemon._tasks["commands"].address, request, DEADLINE_S)


def collector(daemon: Daemon, topic: str) -> "asyncio.Queue[dict[str, Any]]":
    """Return a queue of all messages of a topic."""
    queue: asyncio.Queue[dict[str, Any]] = asyncio.Queue()
    daemon.publisher.add_listener(lambda name, content: queue.put_nowait(content) if name == topic else None)
    return queue


def free_port() -> int:
    """Return a TCP port of this machine that nobody uses."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def robot_at(host: str, folder: Path) -> None:
    """Write `ur.yaml`: the settings of a robot at this address."""
    robot = yaml.safe_load(Path("config/ur.yaml").read_text())
    (folder / "ur.yaml").write_text(yaml.safe_dump({**robot, "host": host}))


def recording(folder: Path, n_frames: int) -> tuple[Path, np.ndarray]:
    """Write a recording with a touch in its second half, and return its path and its lines (n_frames, 1024)."""
    random = np.random.default_rng(2)
    idle = random.integers(20, 200, len(PAPER_TABLE.line_slots))
    steps = idle + random.integers(-1, 2, (n_frames, len(PAPER_TABLE.line_slots)))
    steps[n_frames // 2 :] += random.integers(-15, 16, len(PAPER_TABLE.line_slots))
    lines = np.round(PAPER_TABLE.line_of_channels(steps * ADC_STEP_V), 4)
    days = 739_588 + np.arange(n_frames) * FRAME_PERIOD_S / 86_400
    savemat(folder / "stream.mat", {"Right_Data": np.column_stack([days, lines])})
    return folder / "stream.mat", lines


def emulated_kit(folder: Path, frames: int, *options: str) -> AbstractAsyncContextManager[asyncio.subprocess.Process]:
    """Play a recording of so many frames to the fingertip of `config`, twenty times as fast."""
    play, _ = recording(folder, frames)
    words = ("--recording", str(play), "--speed", "20", "--link", str(folder / "eit-right"), *options)
    return shearloop("emulate", "eit-kit", *words, stdin=asyncio.subprocess.PIPE)


@pytest.fixture
def subscriber() -> Iterator[Callable[[str, str], "zmq.Socket[bytes]"]]:
    """Return a function that connects a SUB socket with a topic."""
    with zmq.Context() as context:
        sockets = []

        def connect(address: str, topic: str) -> "zmq.Socket[bytes]":
            socket: zmq.Socket[bytes] = context.socket(zmq.SUB)
            socket.setsockopt(zmq.RCVHWM, 0)
            socket.setsockopt(zmq.LINGER, 0)
            socket.setsockopt(zmq.RCVTIMEO, DEADLINE_S * 1000)
            socket.connect(address)
            socket.setsockopt(zmq.SUBSCRIBE, topic.encode())
            sockets.append(socket)
            return socket

        yield connect
        for socket in sockets:
            socket.close()


@pytest.fixture
def default_signals() -> Iterator[None]:
    """Signals do what they do in a new process: one that runs tests may ignore some (`nohup`)."""
    defaults = {
        signal.SIGINT: signal.default_int_handler,
        signal.SIGTERM: signal.SIG_DFL,
        signal.SIGHUP: signal.SIG_DFL,
    }
    before = {number: signal.signal(number, handler) for number, handler in defaults.items()}
    yield
    after = {number: signal.signal(number, handler) for number, handler in before.items()}
    assert after == defaults, "what a command does with signals is undone at its end"
