"""Restarts crashed tasks after a growing pause, and counts and reports the crashes."""

import asyncio
from dataclasses import dataclass, field
from typing import Protocol

import structlog

FIRST_PAUSE_S = 0.5
LONGEST_PAUSE_S = 30.0
# After a run of this length, the next pause is short again.
RECOVERED_AFTER_S = 60.0
# Characters of an error in messages; the log has the whole text.
MAX_ERROR_LENGTH = 300


def restart_pause_s(deaths_in_a_row: int) -> float:
    """Return the pause before the next start: it doubles from 0.5 s to 30 s."""
    return float(min(LONGEST_PAUSE_S, FIRST_PAUSE_S * 2.0 ** (deaths_in_a_row - 1)))


class Task(Protocol):
    """A part of the daemon that runs until it is cancelled, or until its work is done."""

    async def run(self) -> None:
        """Do the task's work."""


@dataclass(slots=True)
class TaskRecord:
    """The state of one task, for health."""

    alive: bool = False
    # Returned normally, as an experiment does.
    done: bool = False
    restarts: int = 0
    last_error: str = ""


@dataclass(slots=True)
class Supervisor:
    """Runs coroutines, so that no crash ends the daemon."""

    records: dict[str, TaskRecord] = field(default_factory=dict)
    # Crashed tasks that wait for their restart, with their errors.
    dead: dict[str, str] = field(default_factory=dict)

    async def keep_running(self, name: str, task: Task) -> None:
        """Run a task until it returns; if it raises, log the error and restart it."""
        record = self.records.setdefault(name, TaskRecord())
        log = structlog.get_logger().bind(task=name)
        loop = asyncio.get_running_loop()
        deaths = 0
        while True:
            record.alive, started_s = True, loop.time()
            self.dead.pop(name, None)
            try:
                await task.run()
            except Exception as error:  # an error of one task must not end the others
                # Before Python 3.13 a task group that fails while it is cancelled raises only the failure.
                own = asyncio.current_task()
                if own is not None and own.cancelling():
                    log.exception("the task crashed while it was cancelled")
                    raise asyncio.CancelledError from error
                deaths = 1 if loop.time() - started_s > RECOVERED_AFTER_S else deaths + 1
                pause_s = restart_pause_s(deaths)
                record.restarts += 1
                record.last_error = self.dead[name] = f"{type(error).__name__}: {error}"[:MAX_ERROR_LENGTH]
                log.exception("the task crashed and restarts", pause_s=pause_s)
            else:
                record.done = True
                return
            finally:
                record.alive = False
            await asyncio.sleep(pause_s)
