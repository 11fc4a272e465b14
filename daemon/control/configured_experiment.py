"""The experiment that a configuration names: begun once, as soon as it can be, unless somebody calls it off."""

import asyncio
import contextlib
from collections.abc import Awaitable, Callable
from pathlib import Path

import structlog

from shearloop.daemon.control.step_runner import Experiment, ExperimentPhase
from shearloop.daemon.crash_marker import CrashMarker

# How often a start that was refused is tried again.
START_RETRY_S = 0.5
# A daemon that ends waits no longer than this to be told of the experiment's end; where the loop is dead it is not.
TOLD_WITHIN_S = 0.2


class ConfiguredExperiment:
    """Begins the experiment by itself, and sees it to its end."""

    def __init__(
        self, path: Path, begin: Callable[[Path], Awaitable[str | None]], ended: Callable[[], Awaitable[Experiment]]
    ) -> None:
        """Take what begins an experiment or returns why not, and what returns the one that runs once it has ended."""
        self.path = path
        self.done = False
        self._begin = begin
        self._ended = ended
        self.begun = False
        # Whether it is the operator's to begin it, if anybody's.
        self.left_to_operator = False
        self._awaited = self._called_off = False
        self._begun_now = asyncio.Event()
        # Set unless an experiment is seen to its end, of which it has not been told yet.
        self._told = asyncio.Event()
        self._told.set()
        self._mark = CrashMarker()

    async def run(self) -> None:
        """Begin it as soon as it can be begun, and return when it has ended or does not begin by itself."""
        log, told = structlog.get_logger().bind(experiment=str(self.path)), ""
        if self._mark.left_behind and not self._called_off:
            log.warning(
                "the daemon before this one died after it had begun an experiment: this one waits for "
                "`shearloop command start`"
            )
            self._called_off = True
        # Begun once: by us or by hand, and whatever becomes of this task. What was called off stays so.
        self._awaited = not (self.begun or self._called_off)
        while self._awaited:
            why = await self._begin(self.path)
            if why is not None:
                if why != told:
                    log.info("waiting to start", why=why)
                    told = why
                await asyncio.sleep(START_RETRY_S)
        self.left_to_operator = not self.begun
        if self.left_to_operator:
            log.info("it begins by `shearloop command start` alone")
            return
        await self.begun_and_ended()

    async def begun_and_ended(self) -> None:
        """Wait until it is begun, by hand where it does not begin by itself, and return when it has ended."""
        await self._begun_now.wait()
        self._told.clear()
        try:
            experiment = await self._ended()
            self.done = experiment.phase is ExperimentPhase.DONE
            structlog.get_logger().info(
                "the experiment has ended",
                experiment=str(self.path),
                phase=experiment.phase.value,
                why=experiment.stop_reason,
            )
        finally:
            self._told.set()

    async def told(self) -> None:
        """Wait until the end of the experiment is told, where it has begun and has ended just now."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(TOLD_WITHIN_S):
                await self._told.wait()

    def has_begun(self, path: Path) -> None:
        """Take note that an experiment has begun: this one does no more by itself, whichever it was."""
        self._mark.set()
        self._awaited, self._called_off = False, True
        if path.resolve() == self.path.resolve():
            self.begun = True
            self._begun_now.set()

    def give_up(self) -> Path | None:
        """Begin it no more, and return it; None where it was not waited for."""
        awaited, self._awaited = self._awaited, False
        self._called_off |= awaited
        return self.path if awaited else None

    def end(self) -> None:
        """Take note that the daemon ends in good order."""
        self._mark.clear()
