"""Which signals end a process in order."""

import signal
from collections.abc import Iterator

import pytest

from daemon.ending_signals import ending_signals


@pytest.fixture
def as_it_was() -> Iterator[None]:
    """Put back what is done at SIGHUP."""
    before = signal.getsignal(signal.SIGHUP)
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.mark.usefixtures("as_it_was")
def test_a_closed_terminal_ends_what_was_not_told_to_outlive_it() -> None:
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    assert ending_signals() == (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    # As `nohup` leaves it.
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    assert ending_signals() == (signal.SIGINT, signal.SIGTERM)
