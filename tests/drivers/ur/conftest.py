"""An emulated controller in its own process, one for each module; the daemon's ends of a worker's pipes."""

import asyncio
from collections.abc import Callable, Iterator
from functools import partial

import pytest

from tests.drivers.ur.process import Daemon, Timed
from tests.emulator_process import EmulatorProcess as ControllerProcess
from tests.running import LinkEvents


@pytest.fixture(scope="module")
def controller_process() -> Iterator[ControllerProcess]:
    """A controller that unlocks after one second instead of five."""
    options = ("--rate-hz", "250", "--unlock-wait-s", "1.0", "--power-on-s", "0.1")
    process = ControllerProcess("ur", *options, module=1, ready="listening")
    yield process
    process.close()


@pytest.fixture
def controller(controller_process) -> Iterator[ControllerProcess]:
    """The module's controller without faults, before the test and after it."""
    yield controller_process
    asyncio.run(controller_process.fault("normal"))


@pytest.fixture
def link() -> LinkEvents:
    """The events of a robot's link."""
    return LinkEvents()


@pytest.fixture
def daemon(monkeypatch) -> Iterator[Daemon]:
    """The daemon of a worker that neither exits nor sets alarms."""
    daemon = Daemon(monkeypatch)
    yield daemon
    daemon.close()


@pytest.fixture
def timed(daemon, monkeypatch) -> Callable[..., Timed]:
    """Run a worker in its own time."""
    return partial(Timed, daemon, monkeypatch)
