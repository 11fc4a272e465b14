"""The tasks of one EIT fingertip: read its board, estimate in order, publish both."""

import asyncio
import contextlib
from collections.abc import Callable, Mapping

import numpy as np

from daemon.clock import Clock
from daemon.estimator import Estimator, Reading
from daemon.loop.senses import Torque
from daemon.messages import EitEstimate, EitFrame, EitHeatmap, Scalar
from daemon.publisher import Publisher
from drivers.eit_kit import EitKit, Frame
from drivers.raw_input import InputKind, RawInput, Tap, no_tap

# Frames that may wait for the estimator. When they are this many the port is read no further: the board's own
# buffer and then the board wait, and nothing is lost.
LARGEST_BACKLOG = 8


class FingertipTask:
    """Ties one board to one estimator."""

    def __init__(
        self,
        name: str,
        board: EitKit,
        estimator: Estimator,
        publisher: Publisher,
        clock: Clock,
        hear: Callable[[Torque], None] = lambda _: None,
        *,
        always_heatmap: bool = False,
        tap: Tap = no_tap,
    ) -> None:
        self._tap = tap
        self.name = name
        self._hear = hear
        self._board = board
        self._estimator = estimator
        self._publisher = publisher
        self._clock = clock
        self._always_heatmap = always_heatmap
        self._backlog: asyncio.Queue[Frame] = asyncio.Queue(LARGEST_BACKLOG)
        self._tare_wanted = False
        self._tared: list[asyncio.Future[str]] = []
        self._estimates = 0

    def tare(self) -> None:
        """Take a new homogeneous frame, beginning with the next frame to be estimated."""
        self._tare_wanted = True

    async def tare_to_the_end(self) -> str:
        """Take a new homogeneous frame and wait until it is complete; the text is empty, for nothing can go wrong."""
        self.tare()
        tared: asyncio.Future[str] = asyncio.get_running_loop().create_future()
        self._tared.append(tared)
        return await tared

    async def read(self) -> None:
        """Publish every frame that arrives and pass it on, until cancelled."""
        async with contextlib.aclosing(self._board.frames()) as frames:
            async for frame in frames:
                self._publisher.publish(frame_message(self.name, frame))
                await self._backlog.put(frame)

    async def estimate(self) -> None:
        """Estimate from every frame, in order, until cancelled."""
        while True:
            frame = await self._backlog.get()
            if self._tare_wanted:
                self._tare_wanted = False
                # A replay takes its zero before the same frame.
                self._tap(RawInput(InputKind.TARE, self._clock.now_ns(), str(frame.seq).encode()))
                self._estimator.tare()
            # Scoring every cell takes many milliseconds; the loop has commands and other devices to serve.
            reading = await asyncio.to_thread(self._estimator.update, frame)
            self._publish(frame, reading)
            self._estimates += 1
            if self._tared and not self._tare_wanted and self._estimator.baseline_complete:
                for waiting in self._tared:
                    # Who gave up waiting has cancelled it.
                    if not waiting.done():
                        waiting.set_result("")
                self._tared.clear()
            await self._publish_heatmap(frame, reading)

    def facts(self) -> Mapping[str, Scalar | Mapping[str, int]]:
        """Return what health tells of the board and the estimates."""
        facts = self._board.facts()
        return {
            **facts,
            "rate_hz": facts["measured_hz"],
            "expected_hz": EitFrame.rate_hz,
            "trouble": facts["last_refusal"] if facts["connected"] else facts["last_loss"],
            "estimates": self._estimates,
            "backlog": self._backlog.qsize(),
        }

    def _publish(self, frame: Frame, reading: Reading) -> None:
        torque = reading.torque_nm
        now_ns = self._clock.now_ns()
        self._hear(
            Torque(
                self.name,
                torque.value if torque is not None else None,
                "; ".join(reading.why),
                frame.t_mid_ns - reading.lag_ns,
                now_ns,
            )
        )
        self._publisher.publish(estimate_message(self.name, frame, reading, now_ns))

    async def _publish_heatmap(self, frame: Frame, reading: Reading) -> None:
        """Publish all scores where somebody looks at them, at their own price: no estimate waits for them."""
        if not (self._always_heatmap or self._publisher.wanted(EitHeatmap.topic)) or not self._backlog.empty():
            return
        heatmap = await asyncio.to_thread(self._estimator.heatmap, reading)
        if heatmap is not None:
            self._publisher.publish(self._heatmap_message(frame, heatmap))

    def _heatmap_message(self, frame: Frame, heatmap: np.ndarray) -> EitHeatmap:
        k_grid, sigma_grid = self._estimator.grids
        return EitHeatmap(
            source=self.name,
            t_mono_ns=frame.t_mid_ns,
            scores=heatmap,
            k_low=float(k_grid[0]),
            k_high=float(k_grid[-1]),
            sigma_low=float(sigma_grid[0]),
            sigma_high=float(sigma_grid[-1]),
            model=self._estimator.model,
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


def estimate_message(name: str, frame: Frame, reading: Reading, now_ns: int) -> EitEstimate:
    """Return what is published of a reading at now_ns."""
    match, torque, diameter = reading.match, reading.torque_nm, reading.diameter_mm
    return EitEstimate(
        source=name,
        t_mono_ns=frame.t_mid_ns,
        torque_nm=torque.value if torque else None,
        torque_low_nm=torque.low if torque else None,
        torque_high_nm=torque.high if torque else None,
        diameter_mm=diameter.value if diameter else None,
        k=match.k if match else None,
        sigma=match.sigma if match else None,
        score=match.score if match else None,
        runner_up=match.runner_up if match else None,
        valid=reading.valid,
        why="; ".join(reading.why),
        frame=frame.seq,
        latency_s=(now_ns - frame.t_arrival_ns) / 1e9,
    )
