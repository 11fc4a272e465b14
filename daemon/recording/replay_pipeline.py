"""The daemon's own parsers and estimators, told again what a recording says that they were told."""

import asyncio
from dataclasses import replace

from shearloop.bank.eit.channels import ZERO_SLOTS
from shearloop.daemon.config import DaemonConfig
from shearloop.daemon.messaging.messages import EitEstimate, EitFrame, LoadTorque, SkinShear
from shearloop.daemon.messaging.publisher import Publisher
from shearloop.daemon.recording.recorded_run import ReplayEvents
from shearloop.daemon.rig import load_cell_calibration
from shearloop.daemon.sensing.estimators import COMBINED, LiveEstimator, open_combined, open_estimator
from shearloop.daemon.sensing.fingertip_task import FramePairing, estimate_message, frame_message
from shearloop.daemon.sensing.load_cell_task import LOAD_CELL, load_message
from shearloop.daemon.sensing.skin_setup import RecordedSkin
from shearloop.daemon.sensing.skin_task import SKIN
from shearloop.drivers.eit_line import Frame, FrameParser
from shearloop.drivers.hx711 import LoadParser
from shearloop.drivers.raw_event import RawEvent

# What is made anew; everything else of a recording is sent as it was recorded.
MADE_ANEW = (EitFrame.topic, EitEstimate.topic, LoadTorque.topic, SkinShear.topic)


class ReplayPipeline:
    """Parsers and estimators of one configuration, fed one input at a time, so that nothing depends on the pace."""

    def __init__(self, config: DaemonConfig, asides: ReplayEvents, publisher: Publisher) -> None:
        """Open every file that is needed; raises BankError or UserError. `asides` is what the estimators were told."""
        self._publisher = publisher
        self._asides = asides
        # By how much the numbers of a source's frames are higher than counted here, and up to which tools were told.
        self._before: dict[str, int] = {}
        self._told: dict[str, int] = {}
        self._estimators: dict[str, LiveEstimator] = {
            name: open_estimator(fingertip, name) for name, fingertip in config.fingertips.items()
        }
        self._pairing: FramePairing[Frame] | None = None
        if config.combined is not None:
            self._estimators[COMBINED] = combined = open_combined(config.combined, config.fingertips)
            sides = combined.calibration.sides
            self._pairing = FramePairing(sides, round(config.fingertips[sides[0]].frame_period_s * 1e9))
        self._lines = {
            name: FrameParser(ZERO_SLOTS, nominal_period_ns=round(fingertip.frame_period_s * 1e9))
            for name, fingertip in config.fingertips.items()
        }
        self._load: LoadParser | None = None
        if config.load_cell is not None:
            self._load = LoadParser(load_cell_calibration(config.load_cell), config.load_cell.rate_hz)
        self._skin = RecordedSkin(config.skin) if config.skin is not None else None

    @property
    def sources(self) -> tuple[str, ...]:
        """The sources whose inputs are taken."""
        load_cell = (LOAD_CELL,) if self._load is not None else ()
        return (*self._lines, *load_cell, *(self._skin.sources if self._skin is not None else ()))

    @property
    def publishes(self) -> tuple[str, ...]:
        """The sources of the messages that are made anew."""
        load_cell = (LOAD_CELL,) if self._load is not None else ()
        return (*self._estimators, *load_cell, *((SKIN,) if self._skin is not None else ()))

    async def take(self, source: str, told: RawEvent) -> None:
        """Publish all that an input leads to; an input of a source that is not configured leads to nothing."""
        if source in self._lines:
            for frame in self._as_numbered(source, self._lines[source].take(told)):
                self._publisher.publish(frame_message(source, frame))
                await self._estimate(source, frame)
                pair = self._pairing.add(source, frame.t_mid_ns, frame) if self._pairing is not None else None
                if pair is not None:
                    await self._estimate(COMBINED, *pair[1])
        elif source == LOAD_CELL and self._load is not None:
            for sample in self._load.take(told):
                self._publisher.publish(load_message(sample))
        elif self._skin is not None and source in self._skin.sources:
            for message in self._skin.take(source, told):
                self._publisher.publish(message)

    def _as_numbered(self, source: str, frames: list[Frame]) -> list[Frame]:
        """Return frames with the numbers that they were published with: a later file of a run goes on counting."""
        if frames and source not in self._before:
            # The last of them, for the first that came then may have begun in the file before.
            last, numbers = frames[-1], self._asides.numbers.get(source, {})
            self._before[source] = numbers.get(last.t_arrival_ns, last.seq) - last.seq
        before = self._before.get(source, 0)
        return [replace(frame, seq=frame.seq + before) for frame in frames] if before else frames

    async def _estimate(self, source: str, *frames: Frame) -> None:
        estimator, number = self._estimators[source], frames[0].seq
        if number in self._asides.tares.get(source, ()):
            estimator.tare()
        tools = self._asides.tools.get(source, {})
        due = [first for first in tools if self._told.get(source, -1) < first <= number]
        if due:
            estimator.set_tool(tools[max(due)])
        self._told[source] = number
        estimate = await asyncio.to_thread(estimator.estimate, *frames)
        # The recording's own time: how long it took then is in the recording, and here it took none of it.
        arrival_ns = max(frame.t_arrival_ns for frame in frames)
        self._publisher.publish(estimate_message(source, frames, estimate, arrival_ns))
