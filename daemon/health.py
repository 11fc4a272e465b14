"""Publishes `health` once a second: the state of the process and of each task."""

import asyncio
import os
import resource
import time
from collections.abc import Callable, Mapping
from pathlib import Path

from shearloop.daemon.clock import Clock
from shearloop.daemon.messaging.messages import Health, Scalar
from shearloop.daemon.messaging.publisher import Publisher
from shearloop.daemon.service import notify
from shearloop.daemon.supervisor import Supervisor

HEALTH_PERIOD_S = 1.0
Diagnostics = Mapping[str, Scalar | Mapping[str, int]]


class HealthReporter:
    """Collects the diagnostics of all tasks and publishes them."""

    def __init__(self, publisher: Publisher, supervisor: Supervisor, clock: Clock) -> None:
        self._publisher = publisher
        self._supervisor = supervisor
        self._clock = clock
        self._diagnostics: dict[str, Callable[[], Diagnostics]] = {}

    def add(self, name: str, diagnostics: Callable[[], Diagnostics]) -> None:
        """Add the diagnostics of a task (frames, errors by kind, rates) to every message."""
        self._diagnostics[name] = diagnostics

    def tasks(self) -> dict[str, Diagnostics]:
        """Return the present diagnostics of each task."""
        gathered: dict[str, Diagnostics] = {
            name: {
                "alive": record.alive,
                "done": record.done,
                "restarts": record.restarts,
                "last_error": record.last_error,
            }
            for name, record in self._supervisor.records.items()
        }
        for name, diagnostics in self._diagnostics.items():
            gathered[name] = {**gathered.get(name, {}), **diagnostics()}
        return gathered

    async def run(self) -> None:
        """Publish once a second until cancelled."""
        cpu_s, at_s = time.process_time(), time.monotonic()
        loop = asyncio.get_running_loop()
        due_s = loop.time()
        while True:
            due_s += HEALTH_PERIOD_S
            await asyncio.sleep(max(0.0, due_s - loop.time()))
            lag_s = loop.time() - due_s
            if lag_s > HEALTH_PERIOD_S:
                # One late message after a long stall, not a burst.
                due_s = loop.time()
            self._clock.synchronise()
            self._notify_systemd()
            (cpu_before_s, before_s), (cpu_s, at_s) = (cpu_s, at_s), (time.process_time(), time.monotonic())
            self._publisher.publish(
                Health(
                    source="daemon",
                    t_mono_ns=self._clock.now_ns(),
                    tasks=self.tasks(),
                    loop_lag_s=lag_s,
                    memory_mb=resident_memory_mb(),
                    cpu_percent=100.0 * (cpu_s - cpu_before_s) / max(at_s - before_s, 1e-9),
                )
            )

    def _notify_systemd(self) -> None:
        """Feed systemd's watchdog unless a task is dead."""
        if dead := self._supervisor.dead_tasks():
            notify(f"STATUS=dead, restarting: {', '.join(dead)}")
        else:
            notify("WATCHDOG=1", f"STATUS={len(self._supervisor.records)} tasks are alive")


def resident_memory_mb() -> float:
    """Return the resident memory of this process in megabytes (the peak on systems without /proc)."""
    statistics = Path("/proc/self/statm")
    if statistics.exists():
        return int(statistics.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
