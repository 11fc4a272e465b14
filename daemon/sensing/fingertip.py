"""The tasks of one EIT fingertip: read its board, estimate in order, publish both."""

import asyncio
import contextlib
from collections.abc import Awaitable, Callable, Mapping

import numpy as np

from shearloop.daemon.messaging.messages import EitFrame, EitHeatmap, Scalar
from shearloop.daemon.messaging.publisher import Publisher
from shearloop.daemon.sensing.estimation import Backlog, EstimatorTask, Taken
from shearloop.daemon.sensing.estimator import Reading
from shearloop.drivers.eit_kit import EitKit, Frame

# Frames that may wait for the estimator. When they are this many the port is read no further: the board's own
# buffer and then the board wait, and nothing is lost.
LARGEST_BACKLOG = 8
# So much later than its estimate a frame is published, where frames come slowly enough to have the time.
FRAME_LATER_S, LONG_PERIOD_S = 0.001, 0.02


async def _at_once() -> None:
    """Wait for nothing."""


class FingertipTask:
    """Ties one board to one estimator; `room` waits until whoever else gets its frames can bear more."""

    def __init__(
        self,
        board: EitKit,
        estimation: EstimatorTask,
        publisher: Publisher,
        room: Callable[[], Awaitable[None]] = _at_once,
        *,
        always_heatmap: bool = False,
    ) -> None:
        self.name = estimation.name
        self.estimation = estimation
        self._board = board
        self._publisher = publisher
        self._room = room
        self.always_heatmap = always_heatmap
        self._backlog = Backlog(LARGEST_BACKLOG)

    async def read(self) -> None:
        """Estimate and publish every frame that arrives, until cancelled.

        The estimate comes first, unless it takes long, and the frame itself after it: that can wait.
        """
        async with contextlib.aclosing(self._board.frames()) as frames:
            async for frame in frames:
                taken = Taken((frame,))
                if self._backlog.idle:
                    self.estimation.try_at_once(taken)
                try:
                    if taken.reading is not None and self._board.period_s > LONG_PERIOD_S:
                        # The socket's own thread, which sends the estimate, may want the core that we are on.
                        await asyncio.sleep(FRAME_LATER_S)
                finally:
                    self._publisher.publish(frame_message(self.name, frame))
                await self._backlog.put(taken)
                await self._room()

    async def estimate(self) -> None:
        """Estimate from every frame that `read` has not, in order, and publish heatmaps, until cancelled."""
        while True:
            taken = await self._backlog.get()
            await self._publish_heatmap(taken.frames[0], await self.estimation.finish(taken))

    def diagnostics(self) -> Mapping[str, Scalar | Mapping[str, int]]:
        """Return what health tells of the board and the estimates."""
        facts = self._board.diagnostics()
        return {
            **facts,
            "rate_hz": facts["measured_hz"],
            "error": facts["last_frame_error"] if facts["connected"] else facts["last_loss"],
            "estimates": self.estimation.count,
            "backlog": self._backlog.qsize(),
        }

    async def _publish_heatmap(self, frame: Frame, reading: Reading) -> None:
        """Publish all scores where somebody looks at them, at their own price: no estimate waits for them."""
        if not (self.always_heatmap or self._publisher.has_subscriber(EitHeatmap.topic)) or not self._backlog.empty():
            return
        estimator = self.estimation.estimator
        heatmap = await asyncio.to_thread(estimator.heatmap, reading)
        if heatmap is not None and estimator.grids is not None:
            self._publisher.publish(self._heatmap_message(frame, heatmap, estimator.grids))

    def _heatmap_message(self, frame: Frame, heatmap: np.ndarray, grids: tuple[np.ndarray, np.ndarray]) -> EitHeatmap:
        k_grid, sigma_grid = grids
        return EitHeatmap(
            source=self.name,
            t_mono_ns=frame.t_mid_ns,
            scores=heatmap,
            k_low=float(k_grid[0]),
            k_high=float(k_grid[-1]),
            sigma_low=float(sigma_grid[0]),
            sigma_high=float(sigma_grid[-1]),
            model=self.estimation.estimator.model,
            frame=frame.seq,
        )


def frame_message(name: str, frame: Frame) -> EitFrame:
    """Return what is published of a frame."""
    return EitFrame(
        source=name,
        t_mono_ns=frame.t_mid_ns,
        channels=frame.channels,
        line=frame.raw,
        frame=frame.seq,
        age_s=(frame.t_arrival_ns - frame.t_mid_ns) / 1e9,
        saturated=int(np.count_nonzero(frame.saturated)),
        dead=int(np.count_nonzero(frame.dead)),
        repeated=frame.repeated,
    )
