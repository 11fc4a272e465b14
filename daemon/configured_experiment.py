"""The experiment that a configuration names: begun once, as soon as it can be, unless somebody calls it off."""

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path

import structlog

from daemon.begun_mark import BegunMark
from daemon.experiment.machine import Experiment, Phase

# How often a start that was refused is tried again.
START_RETRY_S = 0.5


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
        self._awaited = False
        self._mark = BegunMark()

    @property
    def awaited(self) -> bool:
        """Whether it is still to begin by itself."""
        return self._awaited

    async def run(self) -> None:
        """Begin it as soon as it can be begun, and return when it has ended or does not begin."""
        log, told = structlog.get_logger().bind(experiment=str(self.path)), ""
        if self._mark.left_behind:
            log.warning(
                "the daemon before this one died after it had begun an experiment: this one waits for "
                "`shearloop command start`"
            )
            return
        self._awaited = not self.begun
        # Begun once: by us or by hand, and whatever becomes of this task.
        while not self.begun:
            if not self._awaited:
                log.info("the operator said stop, or started another: it is not started")
                return
            why = await self._begin(self.path)
            if why is not None:
                if why != told:
                    log.info("waiting to start", why=why)
                    told = why
                await asyncio.sleep(START_RETRY_S)
        experiment = await self._ended()
        self.done = experiment.phase is Phase.DONE
        log.info("the experiment has ended", phase=experiment.phase.value, why=experiment.why)

    def has_begun(self, path: Path) -> None:
        """Take note that an experiment has begun: this one does no more by itself, whichever it was."""
        self._mark.set()
        self._awaited = False
        self.begun |= path.resolve() == self.path.resolve()

    def give_up(self) -> Path | None:
        """Begin it no more, and return it; None where it was not waited for."""
        awaited, self._awaited = self._awaited, False
        return self.path if awaited else None

    def end(self) -> None:
        """Take note that the daemon ends in good order."""
        self._mark.clear()
