"""Starts the configured experiment as soon as it can begin, unless the operator starts or stops one first."""

import asyncio
import os
from pathlib import Path

import structlog

from shearloop.daemon.control.experiment import ExperimentPhase
from shearloop.daemon.rig import Rig

# Interval between attempts to start.
START_RETRY_S = 0.5


class ConfiguredExperiment:
    """Starts one experiment automatically and waits for its end."""

    def __init__(self, path: Path, rig: Rig, daemon_end: asyncio.Event | None = None) -> None:
        """Take the experiment's file; its end sets `daemon_end`."""
        self.path = path
        self.done = False
        self._rig = rig
        self._daemon_end = daemon_end
        self.has_begun = asyncio.Event()
        self._crash_marker = CrashMarker()
        # Until any experiment has begun, or this one is called off. After a crash only the operator starts it.
        self._awaited = not self._crash_marker.left_behind

    @property
    def finished(self) -> bool:
        """Whether it is done, if the daemon ends with it."""
        return self.done or self._daemon_end is None

    async def run(self) -> None:
        """Start the experiment once, and return at its end.

        If only the operator may start it, return at once, or at its end where the daemon ends with it.
        """
        await self._start_once()
        if self.has_begun.is_set() or self._daemon_end is not None:
            await self.wait_for_end()
        if self._daemon_end is not None:
            self._daemon_end.set()

    async def _start_once(self) -> None:
        log, logged = structlog.get_logger().bind(experiment=str(self.path)), ""
        if self._crash_marker.left_behind and not self.has_begun.is_set():
            log.warning(
                "the previous daemon crashed after it had started an experiment: this one waits for "
                "`shearloop command start`"
            )
        while self._awaited:
            reason = await self._rig.start(self.path)
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
        self._crash_marker.set()
        self._awaited = False
        if path.resolve() == self.path.resolve():
            self.has_begun.set()

    def call_off(self) -> Path | None:
        """Cancel the automatic start; return the experiment, or None if it was not awaited."""
        awaited, self._awaited = self._awaited, False
        return self.path if awaited else None

    def close(self) -> None:
        """Note the daemon's normal end."""
        self._crash_marker.clear()


class CrashMarker:
    """A file in systemd's runtime folder that exists while an experiment may have moved something.

    systemd restarts a crashed daemon, and the operator's last command is lost with the crash: the marker keeps the new
    daemon from starting its experiment. Without a runtime folder, as at a terminal, there is no marker.
    """

    def __init__(self) -> None:
        # systemd separates several folders with colons; ours is one.
        folder = os.environ.get("RUNTIME_DIRECTORY", "").partition(":")[0]
        self._path = Path(folder) / "begun" if folder else None
        self.left_behind = self._path is not None and self._path.exists()

    def set(self) -> None:
        """Note that an experiment has begun."""
        if self._path is None:
            return
        try:
            self._path.touch()
        except OSError as error:
            structlog.get_logger().warning(
                "cannot write the crash marker: a daemon restarted after a crash would start its experiment again",
                path=str(self._path),
                reason=error.strerror,
            )

    def clear(self) -> None:
        """Note the daemon's normal end."""
        if self._path is not None:
            self._path.unlink(missing_ok=True)
