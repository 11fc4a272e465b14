import asyncio
from types import SimpleNamespace

import pytest
from structlog.testing import capture_logs

from shearloop.daemon import supervisor
from shearloop.daemon.supervisor import HealthReporter, Supervisor, restart_pause_s


def test_pauses_double_from_half_a_second_to_half_a_minute():
    assert [restart_pause_s(deaths) for deaths in (1, 2, 3, 7, 8, 500)] == [0.5, 1.0, 2.0, 30.0, 30.0, 30.0]


async def test_a_task_that_dies_is_restarted_and_its_error_is_recorded_and_logged(monkeypatch):
    monkeypatch.setattr(supervisor, "FIRST_PAUSE_S", 0.0)
    watched = Supervisor()
    starts = 0

    async def dies_twice() -> None:
        nonlocal starts
        starts += 1
        if starts < 3:
            raise RuntimeError(f"death {starts}")

    with capture_logs() as logs:
        await watched.keep_running("reader", SimpleNamespace(run=dies_twice))
    record = watched.records["reader"]
    assert (starts, record.restarts, record.alive) == (3, 2, False)
    assert record.last_error == "RuntimeError: death 2"
    assert [entry["task"] for entry in logs] == ["reader", "reader"]


async def test_a_cancelled_task_stays_cancelled():
    watched = Supervisor()
    started = asyncio.Event()

    async def waits() -> None:
        started.set()
        await asyncio.Event().wait()

    task = asyncio.create_task(watched.keep_running("waits", SimpleNamespace(run=waits)))
    await started.wait()
    assert watched.records["waits"].alive
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert not watched.records["waits"].alive
    assert watched.records["waits"].restarts == 0


async def test_a_task_that_dies_of_being_cancelled_is_not_started_again(monkeypatch):
    """As a task group does in which something fails meanwhile: nobody would cancel it once more."""
    monkeypatch.setattr(supervisor, "restart_pause_s", lambda _: pytest.fail("it is started again"))
    watched, started = Supervisor(), asyncio.Event()

    async def dies_of_it() -> None:
        started.set()
        try:
            await asyncio.Event().wait()
        except asyncio.CancelledError:
            raise RuntimeError("the last words") from None

    task = asyncio.create_task(watched.keep_running("stubborn", SimpleNamespace(run=dies_of_it)))
    await started.wait()
    task.cancel()
    with capture_logs() as logs, pytest.raises(asyncio.CancelledError):
        await task
    assert [entry["event"] for entry in logs] == ["the task crashed while it was cancelled"]


def test_a_part_that_cannot_report_hides_no_other():
    def fail() -> None:
        raise ZeroDivisionError("no rate yet")

    health = HealthReporter(None, Supervisor(), None)
    health.reporters.update(right=SimpleNamespace(diagnostics=fail), left=SimpleNamespace(diagnostics=lambda: {"n": 3}))
    assert health.tasks() == {
        "right": {"error": "its state is unknown: ZeroDivisionError: no rate yet"},
        "left": {"n": 3},
    }
