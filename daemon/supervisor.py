"""Keeps tasks alive: one that dies is started again after a pause that grows, and the death is counted and told."""

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field

import structlog

from shearloop.drivers.errors import is_cancelled

FIRST_PAUSE_S = 0.5
LONGEST_PAUSE_S = 30.0
# A task that ran this long before it died had recovered: its next pause is short again.
RECOVERED_AFTER_S = 60.0
# Of what a task died of, so much is told on the wire and to the operator; the log has all of it.
LONGEST_ERROR = 300


def restart_pause_s(deaths_in_a_row: int) -> float:
    """Return how long to wait before the next start: doubling from half a second to half a minute."""
    return float(min(LONGEST_PAUSE_S, FIRST_PAUSE_S * 2.0 ** (deaths_in_a_row - 1)))


@dataclass(slots=True)
class TaskRecord:
    """What health tells of one task."""

    name: str
    alive: bool = False
    # It has returned by itself, as an experiment does: nothing is amiss.
    done: bool = False
    restarts: int = 0
    last_error: str = ""


@dataclass(slots=True)
class Supervisor:
    """Runs coroutines so that none of their deaths ends the daemon."""

    records: dict[str, TaskRecord] = field(default_factory=dict)

    @property
    def dead(self) -> tuple[str, ...]:
        """The tasks that should run and do not: between a death and the next start."""
        return tuple(self.deaths())

    def deaths(self) -> dict[str, str]:
        """Return what each of them died of; asked for at every state of the robot."""
        return {name: record.last_error for name, record in self.records.items() if not (record.alive or record.done)}

    async def keep_running(self, name: str, run: Callable[[], Awaitable[None]]) -> None:
        """Run `run()` until it returns; when it raises, tell it and start it again."""
        record = self.records.setdefault(name, TaskRecord(name))
        log = structlog.get_logger().bind(task=name)
        loop = asyncio.get_running_loop()
        deaths = 0
        while True:
            record.alive, started_s = True, loop.time()
            try:
                await run()
            except Exception as error:  # whatever kills one task must not kill the others
                if is_cancelled():
                    log.exception("the task died as it was ended")
                    raise asyncio.CancelledError from error
                deaths = 1 if loop.time() - started_s > RECOVERED_AFTER_S else deaths + 1
                pause_s = restart_pause_s(deaths)
                record.restarts += 1
                record.last_error = f"{type(error).__name__}: {error}"[:LONGEST_ERROR]
                log.exception("the task died and is started again", pause_s=pause_s)
            else:
                record.done = True
                return
            finally:
                record.alive = False
            await asyncio.sleep(pause_s)
