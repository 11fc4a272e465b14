"""Runs the daemon's tasks: restarts crashed ones after a growing pause, and publishes the health of all."""

import asyncio
import os
import platform
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Protocol, runtime_checkable

import structlog

from shearloop.daemon.clock import Clock
from shearloop.daemon.messaging.messages import DaemonEnd, Health
from shearloop.daemon.messaging.publisher import Publisher
from shearloop.daemon.running_rig import RunningRig
from shearloop.daemon.sd_notify import notify
from shearloop.drivers.connection import Diagnostics
from shearloop.words import counted

FIRST_PAUSE_S = 0.5
LONGEST_PAUSE_S = 30.0
# After a run of this length, the next pause is short again.
RECOVERED_AFTER_S = 60.0
# Characters of an error in messages; the log has the whole text.
MAX_ERROR_LENGTH = 300
HEALTH_PERIOD_S = 1.0


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


@runtime_checkable
class Reporter(Protocol):
    """A part of the daemon with values for `health`."""

    def diagnostics(self) -> Diagnostics:
        """Return the present counters: frames, errors by kind, rate."""


@dataclass(slots=True)
class HealthReporter:
    """Collects the supervisor's records and the counters of the `reporters`, and publishes them."""

    publisher: Publisher
    supervisor: Supervisor
    clock: Clock
    running_rig: RunningRig = field(default_factory=RunningRig)
    # Why each of some commands is refused now, or None.
    refusals: dict[str, Callable[[], str | None]] = field(default_factory=dict)
    reporters: dict[str, Reporter] = field(default_factory=dict)
    # The cap on the robot's speeds and torque, in a sentence; empty where none holds.
    cap: Callable[[], str] = str

    def tasks(self) -> dict[str, Diagnostics]:
        """Return the present state of each task."""
        gathered: dict[str, Diagnostics] = {name: asdict(record) for name, record in self.supervisor.records.items()}
        for name, reporter in self.reporters.items():
            gathered[name] = {**gathered.get(name, {}), **_facts(reporter)}
        return gathered

    def _refusal(self, command: str) -> str:
        return (self.refusals[command]() or "") if command in self.refusals else ""

    def publish_end(self, *, finished: bool, summary: str) -> None:
        """Publish that the daemon ends, as its last message."""
        end = DaemonEnd(source="daemon", t_mono_ns=self.clock.now_ns(), finished=finished, summary=summary)
        self.publisher.publish(end)

    async def run(self) -> None:
        """Publish once a second until cancelled."""
        loop = asyncio.get_running_loop()
        due_s = measured_s = loop.time()
        cpu_s = time.process_time()
        while True:
            due_s += HEALTH_PERIOD_S
            await asyncio.sleep(max(0.0, due_s - loop.time()))
            lag_s = loop.time() - due_s
            if lag_s > HEALTH_PERIOD_S:
                # After a long stall, send one late message instead of a burst.
                due_s = loop.time()
            used_s, passed_s = time.process_time() - cpu_s, max(loop.time() - measured_s, 1e-9)
            cpu_s, measured_s = cpu_s + used_s, measured_s + passed_s
            if step := self.clock.synchronise():
                structlog.get_logger().warning(f"{step}; the control loop and recordings do not follow it")
            # A task that stays dead ends the service: systemd's watchdog is fed only while all are alive.
            if dead := self.supervisor.dead:
                notify(f"STATUS=dead, restarting: {', '.join(dead)}")
            else:
                notify("WATCHDOG=1", f"STATUS={counted(len(self.supervisor.records), 'task is', 'tasks are')} alive")
            health = Health(
                source="daemon",
                t_mono_ns=self.clock.now_ns(),
                tasks=self.tasks(),
                host=platform.node(),
                process=os.getpid(),
                instance=self.running_rig.instance,
                rig=self.running_rig.rig,
                emulated=self.running_rig.emulated,
                cap=self.cap(),
                tare_refusal=self._refusal("tare"),
                start_refusal=self._refusal("start"),
                release_refusal=self._refusal("release"),
                loop_lag_s=lag_s,
                memory_mb=resident_memory_mb(),
                cpu_percent=100.0 * used_s / passed_s,
            )
            self.publisher.publish(health)


def _facts(reporter: Reporter) -> Diagnostics:
    """Return the values of one part; an error in one hides no other, and the service stays alive."""
    try:
        return reporter.diagnostics()
    except Exception as error:  # noqa: BLE001 - the service stays alive
        structlog.get_logger().exception("a part of the daemon could not report its state")
        return {"error": f"its state is unknown: {error_text(error)}"}


def resident_memory_mb() -> float:
    """Return the resident memory of this process in megabytes."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def error_text(error: Exception) -> str:
    """Return an error's type and message, shortened for messages."""
    return f"{type(error).__name__}: {error}"[:MAX_ERROR_LENGTH]
