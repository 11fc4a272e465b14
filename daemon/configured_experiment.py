"""The configured experiment: the operator starts it, or `autostart` does on an emulated rig; followed to its end."""

import asyncio
from pathlib import Path

import structlog

from shearloop.daemon.control.experiment import ExperimentPhase
from shearloop.daemon.rig import Rig

# Interval between attempts to start.
START_RETRY_S = 0.5


class ConfiguredExperiment:
    """Waits for the start and the end of one experiment; starts it only where `autostart` says so."""

    def __init__(
        self, path: Path, rig: Rig, *, autostart: bool = False, daemon_end: asyncio.Event | None = None
    ) -> None:
        """Take the experiment's file; its end sets `daemon_end`."""
        self.path = path
        self.done = False
        self._rig = rig
        self._daemon_end = daemon_end
        self.has_begun = asyncio.Event()
        # Until any experiment has begun, or this one is called off.
        self._awaited = autostart

    @property
    def finished(self) -> bool:
        """Whether it is done, if the daemon ends with it."""
        return self.done or self._daemon_end is None

    async def run(self) -> None:
        """Start the experiment once, if it starts by itself, and return at its end, however it began."""
        await self._start_once()
        await self.wait_for_end()
        if self._daemon_end is not None:
            self._daemon_end.set()

    async def _start_once(self) -> None:
        log, logged = structlog.get_logger().bind(experiment=str(self.path)), ""
        while self._awaited:
            # It starts by itself on emulated rigs alone.
            reason = await self._rig.start(self.path, confirmed=True)
            if reason is None:
                self.on_begun(self.path)
            else:
                if reason != logged:
                    log.info("waiting to start", reason=reason)
                    logged = reason
                await asyncio.sleep(START_RETRY_S)
        if not self.has_begun.is_set():
            log.info("it starts by `shearloop command start` only")

    async def wait_for_end(self) -> None:
        """Wait until it has begun, automatically or by hand, and has ended."""
        await self.has_begun.wait()
        experiment = await self._rig.runner.experiment_ended()
        self.done = experiment.phase is ExperimentPhase.DONE
        phase, reason = experiment.phase.value, experiment.stop_reason
        structlog.get_logger().info("the experiment has ended", experiment=str(self.path), phase=phase, reason=reason)

    def on_begun(self, path: Path) -> None:
        """Note that an experiment has begun; no other starts automatically afterwards."""
        self._awaited = False
        if path.resolve() == self.path.resolve():
            self.has_begun.set()

    def call_off(self) -> Path | None:
        """Cancel the automatic start; return the experiment, or None if it was not awaited."""
        awaited, self._awaited = self._awaited, False
        return self.path if awaited else None
