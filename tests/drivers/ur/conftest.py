"""A controller in a process of its own, at an address of its own, shared by the tests of a module."""

import asyncio
from collections.abc import Iterator

import pytest

from tests.emulator_process import EmulatorProcess as ControllerProcess


@pytest.fixture(scope="module")
def controller_process() -> Iterator[ControllerProcess]:
    """A controller that unlocks after a second, not five."""
    options = ("--rate-hz", "250", "--unlock-wait-s", "1.0", "--power-on-s", "0.1")
    process = ControllerProcess("ur", *options, module=1, ready="listening")
    yield process
    process.close()


@pytest.fixture
def controller(controller_process: ControllerProcess) -> Iterator[ControllerProcess]:
    """The module's controller without faults, before the test and after it."""
    yield controller_process
    asyncio.run(controller_process.fault("normal"))
