"""Publishes the health of the process and of each task once a second."""

import asyncio
import os
import time
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Protocol, runtime_checkable

from shearloop.daemon.clock import Clock
from shearloop.daemon.messaging.messages import Health, Scalar
from shearloop.daemon.messaging.publisher import Publisher
from shearloop.daemon.service import notify
from shearloop.daemon.supervisor import Supervisor

HEALTH_PERIOD_S = 1.0
TaskFacts = Mapping[str, Scalar | Mapping[str, int]]


@runtime_checkable
class Reporter(Protocol):
    """A part of the daemon with values for `health`."""

    def diagnostics(self) -> TaskFacts:
        """Return the present counters: frames, errors by kind, rate."""


class HealthReporter:
    """Collects the supervisor's records and the tasks' own counters, and publishes them."""

    def __init__(self, publisher: Publisher, supervisor: Supervisor, clock: Clock) -> None:
        self._publisher = publisher
        self._supervisor = supervisor
        self._clock = clock
        self._reporters: dict[str, Reporter] = {}

    def add(self, name: str, reporter: Reporter) -> None:
        """Add a part of the daemon; it is asked for every message."""
        self._reporters[name] = reporter

    def tasks(self) -> dict[str, TaskFacts]:
        """Return the present state of each task."""
        gathered: dict[str, TaskFacts] = {name: asdict(record) for name, record in self._supervisor.records.items()}
        for name, reporter in self._reporters.items():
            gathered[name] = {**gathered.get(name, {}), **reporter.diagnostics()}
        return gathered

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
            self._clock.synchronise()
            self._notify_systemd()
            self._publisher.publish(
                Health(
                    source="daemon",
                    t_mono_ns=self._clock.now_ns(),
                    tasks=self.tasks(),
                    loop_lag_s=lag_s,
                    memory_mb=resident_memory_mb(),
                    cpu_percent=100.0 * used_s / passed_s,
                )
            )

    def _notify_systemd(self) -> None:
        """Feed systemd's watchdog unless a task is dead; a task that stays dead ends the service."""
        dead = self._supervisor.dead
        if dead:
            notify(f"STATUS=dead, restarting: {', '.join(dead)}")
        else:
            notify("WATCHDOG=1", f"STATUS={len(self._supervisor.records)} tasks are alive")


def resident_memory_mb() -> float:
    """Return the resident memory of this process in megabytes."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
