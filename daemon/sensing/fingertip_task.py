"""Tasks of the EIT fingertips: read the boards, estimate from each frame or pair of frames, publish both."""

import asyncio
import contextlib
from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import Generic, TypeVar

import numpy as np

from shearloop.bank.estimation import Estimate, Measured
from shearloop.daemon.clock import Clock
from shearloop.daemon.control.loop_inputs import TorqueSample
from shearloop.daemon.messaging.messages import EitEstimate, EitFrame, EitHeatmap, Scalar
from shearloop.daemon.messaging.publisher import Publisher
from shearloop.daemon.sensing.estimators import LiveEstimator
from shearloop.daemon.sensing.tool_diameter import OnDiameter, tool_as_bytes
from shearloop.drivers.eit_kit import EitKit, Frame
from shearloop.drivers.serial_sensor import InputKind, OnRaw, RawEvent, ignore_raw

Item = TypeVar("Item")

# Frames that may wait for the estimator. With more the port is not read: the board waits, and no frame is lost.
MAX_BACKLOG = 8
# Largest distance in time of a pair of frames, as a share of the frame period.
_MAX_APART_PERIODS = 0.75


class FramePairing(Generic[Item]):
    """Makes sets of one frame per side, each used at most once, as soon as they are complete.

    The result depends only on the frames' own times and their order.
    """

    def __init__(self, sides: tuple[str, ...], period_ns: int) -> None:
        """Take the sides in the order of a set, and the frame period."""
        self._sides = sides
        self._apart_ns = round(_MAX_APART_PERIODS * period_ns)
        self._latest: dict[str, tuple[int, Item]] = {}

    def add(self, side: str, t_ns: int, item: Item) -> tuple[Item, ...] | None:
        """Return the frames of the set that this one completes, or None."""
        if side not in self._sides:
            return None
        self._latest[side] = (t_ns, item)
        # Frames too old for this one are too old for all later ones.
        self._latest = {name: kept for name, kept in self._latest.items() if t_ns - kept[0] <= self._apart_ns}
        # A frame that was delayed is too old for those already here.
        if any(kept_ns - t_ns > self._apart_ns for kept_ns, _ in self._latest.values()):
            del self._latest[side]
            return None
        if len(self._latest) < len(self._sides):
            return None
        found = tuple(self._latest[name][1] for name in self._sides)
        self._latest.clear()
        return found


class EstimatorTask:
    """Estimates from queued frames in order, publishes the estimates, and passes them on."""

    def __init__(
        self,
        name: str,
        estimator: LiveEstimator,
        publisher: Publisher,
        clock: Clock,
        *,
        period_s: Callable[[], float],
        on_torque: Callable[[TorqueSample], None],
        on_diameter: OnDiameter | None = None,
        held_tool: Callable[[int], Measured | None] = lambda _: None,
        on_raw: OnRaw = ignore_raw,
    ) -> None:
        """Take the estimator and its consumers; `period_s` gives the present frame period.

        `held_tool` gives the diameter of the held tool at a time.
        """
        self.name = name
        self.estimator = estimator
        self.count = 0
        self._publisher = publisher
        self._clock = clock
        self._period_s = period_s
        self._on_torque = on_torque
        self._on_diameter = on_diameter
        self._held_tool = held_tool
        self._on_raw = on_raw
        self._tool: Measured | None = None
        self._queue: asyncio.Queue[tuple[Frame, ...]] = asyncio.Queue()
        self._has_room = asyncio.Event()
        self._has_room.set()
        self._tare_from_ns: int | None = None
        self._tared = asyncio.Event()

    @property
    def backlog(self) -> int:
        """Number of frames that wait."""
        return self._queue.qsize()

    def submit(self, *frames: Frame) -> None:
        """Queue the frames of one time, one for each side."""
        self._queue.put_nowait(frames)
        if self.backlog >= MAX_BACKLOG:
            self._has_room.clear()

    async def room(self) -> None:
        """Wait until the queue has room, before reading more from the boards."""
        await self._has_room.wait()

    async def next(self) -> tuple[tuple[Frame, ...], Estimate]:
        """Estimate from the frames that have waited longest, publish the estimate, and return both."""
        frames = await self._queue.get()
        if self.backlog < MAX_BACKLOG:
            self._has_room.set()
        return frames, await self.estimate(*frames)

    async def run(self) -> None:
        """Estimate from all frames in order, until cancelled."""
        while True:
            await self.next()

    def tare(self) -> None:
        """Take a new homogeneous frame from frames acquired entirely after now."""
        self._tare_from_ns = self._clock.now_ns()
        self._tared.clear()

    async def tare_and_wait(self) -> str:
        """Take a new homogeneous frame and wait until it is complete; return an empty error."""
        self.tare()
        await self._tared.wait()
        return ""

    async def estimate(self, *frames: Frame) -> Estimate:
        """Estimate from the frames of one time, publish the estimate, and pass it on.

        The estimator runs in a thread, because a search of the bank would delay the loop.
        """
        self._apply_tare(frames)
        self._apply_tool(frames[0].seq)
        estimate = await asyncio.to_thread(self.estimator.estimate, *frames)
        now_ns = self._clock.now_ns()
        message = estimate_message(self.name, frames, estimate, now_ns)
        lag_ns = round(1e9 * estimate.lag_s)
        self._on_torque(TorqueSample(self.name, estimate.torque_nm, message.reason, message.t_mono_ns - lag_ns, now_ns))
        if self._on_diameter is not None:
            self._on_diameter(self.name, _diameter(estimate), now_ns)
        self._publisher.publish(message)
        self.count += 1
        if self._tare_from_ns is None and not self.estimator.taring:
            self._tared.set()
        return estimate

    def _apply_tare(self, frames: tuple[Frame, ...]) -> None:
        begin_ns = min(frame.t_mid_ns for frame in frames) - round(0.5e9 * self._period_s())
        if self._tare_from_ns is not None and begin_ns >= self._tare_from_ns:
            self._tare_from_ns = None
            # A replay tares before the same frame.
            self._on_raw(RawEvent(InputKind.TARE, self._clock.now_ns(), str(frames[0].seq).encode()))
            self.estimator.tare()

    def _apply_tool(self, frame: int) -> None:
        now_ns = self._clock.now_ns()
        tool = self._held_tool(now_ns)
        if tool != self._tool:
            self._tool = tool
            self._on_raw(RawEvent(InputKind.TOOL, now_ns, tool_as_bytes(frame, tool)))
            self.estimator.set_tool(tool)


class CombinedFingertipTask:
    """Pairs the frames of several fingertips and estimates from each pair."""

    def __init__(self, estimator_task: EstimatorTask, period_s: float) -> None:
        """Take the estimator of the pairs, and the frame period."""
        self.estimator_task = estimator_task
        self.sides = estimator_task.estimator.calibration.sides
        self._period_s = period_s
        self._pairing: FramePairing[Frame] = FramePairing(self.sides, round(period_s * 1e9))

    def on_frame(self, side: str, frame: Frame) -> None:
        """Queue the pair that a frame completes.

        Call this when the frame arrives: the order of arrival decides the pairs, and a replay finds the same ones.
        """
        if (pair := self._pairing.add(side, frame.t_mid_ns, frame)) is not None:
            self.estimator_task.submit(*pair)

    def diagnostics(self) -> Mapping[str, Scalar | Mapping[str, int]]:
        """Return the values for the health message."""
        task = self.estimator_task
        return {"expected_hz": 1.0 / self._period_s, "estimates": task.count, "backlog": task.backlog}


class FingertipTask:
    """Reads one board, publishes its frames, and estimates from each."""

    def __init__(
        self,
        board: EitKit,
        estimator_task: EstimatorTask,
        publisher: Publisher,
        combined: CombinedFingertipTask | None = None,
        *,
        always_heatmap: bool = False,
    ) -> None:
        """Take the board, its estimator, and the task that also needs its frames, if there is one."""
        self.name = estimator_task.name
        self.estimator_task = estimator_task
        self.always_heatmap = always_heatmap
        self._board = board
        self._publisher = publisher
        self._combined = combined

    async def read(self) -> None:
        """Publish and queue every frame until cancelled."""
        async with contextlib.aclosing(self._board.readings()) as frames:
            async for frame in frames:
                self._publisher.publish(frame_message(self.name, frame))
                self.estimator_task.submit(frame)
                await self.estimator_task.room()
                if self._combined is not None:
                    await self._combined.estimator_task.room()

    async def estimate(self) -> None:
        """Estimate from every frame in order, and publish heatmaps, until cancelled."""
        while True:
            (frame,), _ = await self.estimator_task.next()
            wanted = self.always_heatmap or self._publisher.has_subscriber(EitHeatmap.topic)
            if wanted and not self.estimator_task.backlog:
                await self._publish_heatmap(frame)

    def diagnostics(self) -> Mapping[str, Scalar | Mapping[str, int]]:
        """Return the values for the health message."""
        board = self._board.diagnostics()
        return {
            **board,
            "rate_hz": board["measured_hz"],
            "error": board["last_frame_error"] if board["connected"] else board["last_loss"],
            "estimates": self.estimator_task.count,
            "backlog": self.estimator_task.backlog,
        }

    async def _publish_heatmap(self, frame: Frame) -> None:
        estimator = self.estimator_task.estimator
        scores = await asyncio.to_thread(estimator.heatmap)
        if scores is None or estimator.grids is None:
            return
        k_grid, sigma_grid = estimator.grids
        self._publisher.publish(
            EitHeatmap(
                source=self.name,
                t_mono_ns=frame.t_mid_ns,
                scores=scores,
                k_low=float(k_grid[0]),
                k_high=float(k_grid[-1]),
                sigma_low=float(sigma_grid[0]),
                sigma_high=float(sigma_grid[-1]),
                model=estimator.model,
                frame=frame.seq,
            )
        )


def frame_message(name: str, frame: Frame) -> EitFrame:
    """Return the message of a frame."""
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


def estimate_message(name: str, frames: tuple[Frame, ...], estimate: Estimate, now_ns: int) -> EitEstimate:
    """Return the message of an estimate from frames of one time, as published at now_ns."""
    values = asdict(estimate)
    del values["reasons"], values["lag_s"]
    return EitEstimate(
        source=name,
        t_mono_ns=sum(frame.t_mid_ns for frame in frames) // len(frames),
        **values,
        reason="; ".join(estimate.reasons),
        frame=frames[0].seq,
        latency_s=(now_ns - max(frame.t_arrival_ns for frame in frames)) / 1e9,
    )


def _diameter(estimate: Estimate) -> Measured | None:
    low_mm, high_mm = estimate.diameter_low_mm, estimate.diameter_high_mm
    if estimate.diameter_mm is None or low_mm is None or high_mm is None:
        return None
    return Measured(estimate.diameter_mm, 0.5 * (high_mm - low_mm))
