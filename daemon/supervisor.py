"""Restarts crashed tasks."""

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field

import structlog

from shearloop.drivers.errors import is_cancelled

FIRST_PAUSE_S = 0.5
LONGEST_PAUSE_S = 30.0
# After a run this long the next pause is the shortest again.
RECOVERED_AFTER_S = 60.0
# Length limit of errors in messages; the log has the full text.
LONGEST_ERROR = 300


def restart_pause_s(crashes_in_a_row: int) -> float:
    """Return the pause before the next start, which doubles with each crash."""
    return float(min(LONGEST_PAUSE_S, FIRST_PAUSE_S * 2.0 ** (crashes_in_a_row - 1)))


@dataclass(slots=True)
class TaskRecord:
    """One task's part of `health`."""

    name: str
    alive: bool = False
    # It has returned, as an experiment's task does.
    done: bool = False
    restarts: int = 0
    last_error: str = ""


@dataclass(slots=True)
class Supervisor:
    """Runs tasks and restarts crashed ones, so that no crash ends the daemon."""

    records: dict[str, TaskRecord] = field(default_factory=dict)

    def dead_tasks(self) -> dict[str, str]:
        """Return the error of each task that waits for its restart."""
        return {name: record.last_error for name, record in self.records.items() if not (record.alive or record.done)}

    async def keep_running(self, name: str, run: Callable[[], Awaitable[None]]) -> None:
        """Run `run()` until it returns; restart it after a crash."""
        record = self.records.setdefault(name, TaskRecord(name))
        log = structlog.get_logger().bind(task=name)
        loop = asyncio.get_running_loop()
        crashes = 0
        while True:
            record.alive, started_s = True, loop.time()
            try:
                await run()
            except Exception as error:  # any error of a task is its own
                if is_cancelled():
                    log.exception("the task crashed during its end")
                    raise asyncio.CancelledError from error
                crashes = 1 if loop.time() - started_s > RECOVERED_AFTER_S else crashes + 1
                pause_s = restart_pause_s(crashes)
                record.restarts += 1
                record.last_error = f"{type(error).__name__}: {error}"[:LONGEST_ERROR]
                log.exception("the task crashed and restarts", pause_s=pause_s)
            else:
                record.done = True
                return
            finally:
                record.alive = False
            await asyncio.sleep(pause_s)
