import asyncio
import signal
import sys
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import structlog
import yaml
import zmq

from shearloop.bank.eit.bank_file import Bank, BankDefinition, write_bank
from shearloop.bank.estimation import Calibration

# Guards against a test that hangs; none waits for so long.
DEADLINE_S = 60


@pytest.fixture(scope="session")
def tiny_bank(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bank of 8 × 8 random signals: scored in a millisecond."""
    path = tmp_path_factory.mktemp("bank") / "tiny.bank"
    random = np.random.default_rng(1)
    grid = np.linspace(1.0, 2.0, 8)
    write_bank(
        path,
        BankDefinition("ab" * 32, "gaussian_derivative", grid, grid),
        random.normal(0.0, 0.3, 896),
        np.ones((8, 8)),
        np.ones((8, 8), bool),
        random.normal(0.0, 0.05, (8, 8, 896)).astype(np.float32),
    )
    return path


@pytest.fixture(scope="session")
def tiny_calibration(tiny_bank: Path) -> Path:
    """A calibration of the whole tiny bank."""
    grid = np.linspace(0.9, 2.1, 30)
    path = tiny_bank.with_name("tiny.cal")
    identity = Bank.open(tiny_bank).identity
    Calibration.from_matches(identity, "synthetic", torque=(grid, 0.3 - 0.1 * grid), diameter=(grid, 20.0 * grid)).save(
        path
    )
    return path


@pytest.fixture
def config(tmp_path: Path, tiny_bank: Path, tiny_calibration: Path) -> Callable[..., Path]:
    """Write a configuration of one fingertip, with changes to it, and return its path."""

    def write(**changes: Any) -> Path:
        content = {
            "publish": f"ipc://{tmp_path}/publish",
            "commands": f"ipc://{tmp_path}/commands",
            "fingertips": {
                "right": {
                    "device": {"path": "eit-right"},
                    "bank": str(tiny_bank),
                    "calibration": str(tiny_calibration),
                    "matching": "zero_lag",
                }
            },
        }
        path = tmp_path / "config.yaml"
        path.write_text(yaml.safe_dump({**content, **changes}))
        return path

    return write


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
async def shearloop(*arguments: str, stdin: int | None = None) -> AsyncIterator[asyncio.subprocess.Process]:
    """Run a command as a process of its own; it is ended at the end, whatever becomes of the test."""
    process = await asyncio.create_subprocess_exec(
        sys.executable,
        *("-m", "shearloop", *arguments),
        stdin=stdin,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
    )
    try:
        async with asyncio.timeout(DEADLINE_S):
            yield process
    finally:
        if process.returncode is None:
            process.kill()
        await process.communicate()
        # The transport closes its pipes one step later.
        await asyncio.sleep(0)


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
def hears_of_terminal() -> Iterator[None]:
    """Processes that are started hear of a terminal that is closed, even where the tests do not (`nohup`)."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)
