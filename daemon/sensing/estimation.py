"""One estimator at work in the daemon: readings are published and told to the loop, zeros are taken when asked for."""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass

from shearloop.bank.estimation import Measured
from shearloop.daemon.clock import Clock
from shearloop.daemon.control.loop_inputs import TorqueSample
from shearloop.daemon.messaging.messages import EitEstimate
from shearloop.daemon.messaging.publisher import Publisher
from shearloop.daemon.sensing.estimator import Reading
from shearloop.daemon.sensing.opening import AnyEstimator
from shearloop.daemon.sensing.tool_diameter import HearDiameter, as_text, unheard, unknown
from shearloop.daemon.waiters import Waiters
from shearloop.drivers.eit_kit import Frame
from shearloop.drivers.serial_sensor import InputKind, OnRaw, RawEvent, ignore_raw


@dataclass(slots=True)
class Taken:
    """The frames of one moment on their way to an estimating task, and what came of estimating them at once."""

    frames: tuple[Frame, ...]
    reading: Reading | None = None
    takes_long: bool = False
    error: Exception | None = None


class Backlog(asyncio.Queue[Taken]):
    """Frames on their way to an estimating task."""

    _awaited = False

    @property
    def idle(self) -> bool:
        """Whether the estimating task has nothing to do: then frames may be estimated before they go there."""
        return self._awaited and self.empty()

    async def get(self) -> Taken:
        """Return what has waited longest; whoever waits for it is idle meanwhile."""
        self._awaited = True
        try:
            return await super().get()
        finally:
            self._awaited = False


class EstimatorTask:
    """Publishes what an estimator says of each frame, or of each pair."""

    def __init__(
        self,
        name: str,
        estimator: AnyEstimator,
        publisher: Publisher,
        clock: Clock,
        period_s: Callable[[], float],
        hear: Callable[[TorqueSample], None],
        hear_diameter: HearDiameter = unheard,
        tap: OnRaw = ignore_raw,
    ) -> None:
        """Take what is tied together; `period_s` says how long the acquisition of a frame takes."""
        self._period_s = period_s
        self._tap = tap
        self.name = name
        self.estimator = estimator
        self.count = 0
        self._publisher = publisher
        self._clock = clock
        self._hear = hear
        self._hear_diameter = hear_diameter
        # Who knows the diameter of the tool that is held, and what the estimator was told of it last.
        self.held_tool: Callable[[int], Measured | None] = unknown
        self._tool: Measured | None = None
        # Since when a new homogeneous frame is wanted, until it is begun.
        self._tare_since_ns: int | None = None
        self._waiting = Waiters()

    def tare(self) -> None:
        """Take a new homogeneous frame, beginning with the first frame that is measured from now on.

        What is on its way is of the time before, when something may have been gripped.
        """
        self._tare_since_ns = self._clock.now_ns()

    async def tare_to_the_end(self) -> str:
        """Take a new homogeneous frame and wait until it is complete; the text is empty, for nothing can go wrong."""
        self.tare()
        return await self._waiting.wait(None)

    def try_at_once(self, taken: Taken) -> None:
        """Estimate where the frames were read; what that dies of is raised by `finish`, in the estimating task."""
        try:
            taken.reading = self.at_once(*taken.frames)
        except Exception as error:  # noqa: BLE001 - the estimating task dies of it, and not the one that reads a board
            taken.error = error
        taken.takes_long = taken.reading is None

    async def finish(self, taken: Taken) -> Reading:
        """Return what the frames say, estimating whatever has not been yet."""
        if taken.error is not None:
            raise taken.error
        if taken.reading is not None:
            return taken.reading
        return await (self.slowly(*taken.frames) if taken.takes_long else self.of(*taken.frames))

    async def of(self, *frames: Frame) -> Reading:
        """Estimate from the frames of one moment, one a side, publish it, and return what they said."""
        reading = self.at_once(*frames)
        return await self.slowly(*frames) if reading is None else reading

    def at_once(self, *frames: Frame) -> Reading | None:
        """Do the same where it takes no more than some milliseconds; where it does, return None: then call `slowly`.

        Most frames take less than it costs to hand them to a thread.
        """
        if self._tare_since_ns is not None and self._began_ns(frames) >= self._tare_since_ns:
            self._tare_since_ns = None
            # A replay takes its zero before the same frame.
            self._tap(RawEvent(InputKind.TARE, self._clock.now_ns(), str(frames[0].seq).encode()))
            self.estimator.tare()
        self._take_note_of_the_tool(frames[0].seq)
        reading: Reading | None = self.estimator.quickly(*frames)
        if reading is not None:
            self._finish(frames, reading)
        return reading

    def _began_ns(self, frames: tuple[Frame, ...]) -> int:
        """Return when the first of these frames was begun to be measured."""
        return min(frame.t_mid_ns for frame in frames) - round(0.5e9 * self._period_s())

    def _take_note_of_the_tool(self, frame: int) -> None:
        now_ns = self._clock.now_ns()
        tool = self.held_tool(now_ns)
        if tool != self._tool:
            self._tool = tool
            self._tap(RawEvent(InputKind.TOOL, now_ns, as_text(frame, tool)))
            self.estimator.hold(tool)

    async def slowly(self, *frames: Frame) -> Reading:
        """Estimate in a thread, so that commands and devices are not kept waiting."""
        reading = await asyncio.to_thread(self.estimator.update, *frames)  # type: ignore[arg-type]  # one a side
        self._finish(frames, reading)
        return reading

    def _finish(self, frames: tuple[Frame, ...], reading: Reading) -> None:
        self._publish(frames, reading)
        self.count += 1
        if self._waiting and self._tare_since_ns is None and self.estimator.baseline_complete:
            self._waiting.notify("")

    def _publish(self, frames: tuple[Frame, ...], reading: Reading) -> None:
        torque, now_ns = reading.torque_nm, self._clock.now_ns()
        message = estimate_message(self.name, frames, reading, now_ns)
        self._hear(
            TorqueSample(
                self.name,
                torque.value if torque is not None else None,
                message.reason,
                message.t_mono_ns - reading.lag_ns,
                now_ns,
            )
        )
        self._hear_diameter(self.name, reading.diameter_mm, now_ns)
        self._publisher.publish(message)


def estimate_message(name: str, frames: tuple[Frame, ...], reading: Reading, now_ns: int) -> EitEstimate:
    """Return what is published at now_ns of a reading of the frames of one moment."""
    match, torque, diameter = reading.match, reading.torque_nm, reading.diameter_mm
    return EitEstimate(
        source=name,
        t_mono_ns=sum(frame.t_mid_ns for frame in frames) // len(frames),
        torque_nm=torque.value if torque else None,
        torque_low_nm=torque.low if torque else None,
        torque_high_nm=torque.high if torque else None,
        diameter_mm=diameter.value if diameter else None,
        diameter_low_mm=diameter.low if diameter else None,
        diameter_high_mm=diameter.high if diameter else None,
        k=match.k if match else None,
        sigma=match.sigma if match else None,
        score=match.score if match else None,
        runner_up=match.runner_up if match else None,
        valid=reading.valid,
        reason="; ".join(reading.why),
        frame=frames[0].seq,
        latency_s=(now_ns - max(frame.t_arrival_ns for frame in frames)) / 1e9,
    )
