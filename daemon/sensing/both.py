"""The task of two fingertips on one tool: their frames are paired as they come, and each pair gives an estimate.

It is what drives the loop, so it comes before that of the fingertip whose frame completed the pair.
"""

import asyncio
from collections.abc import Mapping

from shearloop.bank.estimation.pairing import Pairing
from shearloop.daemon.messaging.messages import Scalar
from shearloop.daemon.sensing.estimation import Backlog, EstimatorTask, Taken
from shearloop.drivers.eit_kit import Frame

COMBINED = "combined"
# Pairs that may wait for the estimator before the fingertips' boards are read no further.
LARGEST_BACKLOG = 8


class CombinedFingertipTask:
    """Ties several fingertips to one estimator."""

    def __init__(self, estimation: EstimatorTask, sides: tuple[str, ...], period_s: float) -> None:
        """Take the sides in the order of the calibration, and their frame period."""
        self.estimation = estimation
        self.sides = sides
        self._period_s = period_s
        self._pairing: Pairing[Frame] = Pairing(sides, round(period_s * 1e9))
        self._backlog = Backlog()
        self._room = asyncio.Event()
        self._room.set()

    def take(self, side: str, frame: Frame) -> None:
        """Take in a frame that one of the fingertips has sent, when it comes, and estimate from the pair it completes.

        Not later: which frames make a pair follows from the order in which they came, whatever was waited for since.
        So a replay finds the same pairs. An estimate that takes long, or has others before it, is left to `estimate`.
        """
        pair = self._pairing.take(side, frame.t_mid_ns, frame)
        if pair is None:
            return
        taken = Taken(pair[1])
        if self._backlog.idle:
            self.estimation.try_at_once(taken)
        if taken.reading is None:
            self._backlog.put_nowait(taken)
            if self._backlog.qsize() >= LARGEST_BACKLOG:
                self._room.clear()

    async def room(self) -> None:
        """Wait until the estimator has caught up: before more is read from the boards."""
        await self._room.wait()

    async def estimate(self) -> None:
        """Estimate from every pair that was not at once, in order, until cancelled."""
        while True:
            taken = await self._backlog.get()
            if self._backlog.qsize() < LARGEST_BACKLOG:
                self._room.set()
            await self.estimation.finish(taken)

    def diagnostics(self) -> Mapping[str, Scalar | Mapping[str, int]]:
        """Return what health tells of the estimates."""
        return {
            "expected_hz": 1.0 / self._period_s,
            "estimates": self.estimation.count,
            "backlog": self._backlog.qsize(),
        }
