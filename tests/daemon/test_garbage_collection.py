"""What Python's garbage collector looks through, before a daemon is ready, while it runs, and after it."""

import gc
import weakref
from collections.abc import Callable, Iterator

import pytest

from shearloop.daemon import app
from shearloop.daemon.cli import main
from shearloop.daemon.process import without_long_collections


class Cycle:
    """An object that only the collector can free."""

    def __init__(self) -> None:
        self.itself = self


@pytest.fixture(autouse=True)
def as_it_was() -> Iterator[None]:
    gc.unfreeze()
    yield
    gc.unfreeze()
    gc.enable()


def forgotten() -> weakref.ref[Cycle]:
    """Return a reference to an object that nobody else has one to."""
    return weakref.ref(Cycle())


def test_nothing_is_collected_until_all_that_lasts_is_there_and_then_only_what_comes():
    # A collection of Python 3.12 freezes what lives as long as the program.
    gc.collect()
    frozen = gc.get_freeze_count()
    with without_long_collections() as collect_what_comes:
        assert not gc.isenabled()
        before = forgotten()
        collect_what_comes()
        assert gc.isenabled()
        after = forgotten()
        gc.collect()
        assert before() is not None
        assert after() is None
    gc.collect()
    assert before() is None
    assert gc.isenabled()
    assert gc.get_freeze_count() == frozen


def test_what_ends_before_it_is_ready_leaves_the_collector_as_it_was():
    with pytest.raises(SystemExit), without_long_collections():
        raise SystemExit
    assert gc.isenabled()


def test_daemon_of_the_command_line_is_collected_from_when_it_is_ready(config, monkeypatch):
    collected = []

    async def run_daemon(_config: object, _listeners: object, on_ready: Callable[[], None], _summary: object) -> bool:
        collected.append(gc.isenabled())
        on_ready()
        collected.append(gc.isenabled() and gc.get_freeze_count() > 0)
        return True

    monkeypatch.setattr(app, "run_daemon", run_daemon)
    assert main(["run", str(config())]) == 0
    assert collected == [False, True]
