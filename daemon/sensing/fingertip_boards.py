"""Fingertip tasks that read boards: one board each, and the pairs of several boards' frames."""

import asyncio
import contextlib
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import structlog

from shearloop.bank.arrays import BoolArray
from shearloop.bank.channels import ChannelTable
from shearloop.daemon.messaging.messages import EitHeatmap
from shearloop.daemon.sensing.fingertip_messages import frame_message, heatmap_message
from shearloop.daemon.sensing.fingertip_task import FingertipTask
from shearloop.daemon.sensing.frame_pairing import FramePairing
from shearloop.drivers.connection import Diagnostics
from shearloop.drivers.eit_kit import EitKit, Frame
from shearloop.words import counted


@dataclass(slots=True, kw_only=True)
class CombinedTask(FingertipTask):
    """Pairs the frames of several fingertips, which their boards' tasks add, and estimates from each pair.

    It is connected while all of its `boards` are.
    """

    period_s: float
    pairing: FramePairing[Frame]
    boards: Mapping[str, EitKit]
    _pairs: deque[tuple[Frame, ...]] = field(default_factory=deque)
    _in_order: asyncio.Lock = field(default_factory=asyncio.Lock)
    # The frames without a partner since the last pair.
    _unpaired: Counter[str] = field(default_factory=Counter)

    def add(self, side: str, frames: Sequence[Frame]) -> None:
        """Take the frames of one read; a side's frames come in order."""
        for frame in frames:
            before = self.pairing.unpaired.copy()
            pair = self.pairing.add(side, frame)
            self._name_unpaired(self.pairing.unpaired - before)
            if pair is not None:
                self._unpaired.clear()
                self._pairs.append(pair)

    def _name_unpaired(self, found: Counter[str]) -> None:
        """Log frames without a partner, once until the next pair; health counts them all."""
        is_first = bool(found) and not self._unpaired
        self._unpaired += found
        # Boards do not begin together.
        if is_first and self.count:
            structlog.get_logger().bind(device=self.name).warning(self._unpaired_sentence)

    @property
    def _unpaired_sentence(self) -> str:
        """Which frames since the last pair have no partner; empty without any."""
        if not self._unpaired:
            return ""
        frames = " and ".join(f"{counted(number, 'frame')} of {side}" for side, number in self._unpaired.items())
        return f"{frames}, without a frame of the other fingertip at that time: no combined estimate"

    async def process_pairs(self) -> None:
        """Estimate from the pairs that wait, in order.

        The newest counts for the control loop, and needs those before it: its estimate goes by how the frames changed.
        Seven that wait before it after a standstill of 4 s take 4 ms of processor time in all (rig of the demo). The
        search of their positions in a bank, which takes longer, is left out.
        """
        async with self._in_order:
            while self._pairs:
                await self.process(*self._pairs.popleft())
                self._record_own_state()

    def record_own_state(self) -> None:
        """Keep the state for a recording that begins here, once it has the boards' states and no estimate is made."""
        if not self._in_order.locked():
            self._record_own_state()

    def _record_own_state(self) -> None:
        # A pair has frames of several boards: the replay of all of them must have begun.
        sides = [board.inputs for board in self.boards.values()]
        if self.wants_state and not any(side is not None and side.wants_state for side in sides):
            self.record_state({"pairing": self.pairing, "pairs": self._pairs})

    def diagnostics(self) -> Diagnostics:
        """Return the values for the health message."""
        # Also where no pair comes.
        self.expire_zero(self.clock.now_ns())
        lost = [side for side, board in self.boards.items() if not board.diagnostics()["connected"]]
        loss = f"without {' and '.join(lost)} there is no combined estimate" if lost else ""
        errors = (self.why_no_zero, loss or self._unpaired_sentence)
        return {
            "connected": not lost,
            "expected_hz": 1.0 / self.period_s,
            "estimates": self.count,
            "unpaired": dict(self.pairing.unpaired),
            "error": "; ".join(filter(None, errors)),
        }


class DeadElectrodes:
    """What the dead channels of the latest frame have in common; each electrode is logged once."""

    def __init__(self) -> None:
        # Of the latest frame; empty without a dead electrode.
        self.sentence = ""
        self._logged: set[str] = set()

    def update(self, source: str, table: ChannelTable, dead: BoolArray) -> None:
        """Take the (c,) dead channels of a frame."""
        names = table.name_dead(dead) if dead.any() else []
        self.sentence = f"dead channels: {', '.join(names)}; press its connector on, and wet the gel" if names else ""
        if not self._logged.issuperset(names):
            self._logged.update(names)
            structlog.get_logger().bind(device=source).warning(self.sentence)


@dataclass(slots=True, kw_only=True)
class BoardTask(FingertipTask):
    """Reads one board, estimates from each frame, and publishes both; `combined` also needs the frames."""

    board: EitKit
    combined: CombinedTask | None = None
    always_heatmap: bool = False
    dead_electrodes: DeadElectrodes = field(default_factory=DeadElectrodes)

    async def run(self) -> None:
        """Process every frame until cancelled."""
        async with contextlib.aclosing(self.board.batches()) as batches:
            async for frames in batches:
                if not frames:
                    self._record_states()
                    continue
                if self.combined is not None:
                    self.combined.add(self.name, frames)
                for frame in frames:
                    await self.process_frame(frame)

    def _record_states(self) -> None:
        """Keep the states for a recording that begins here: no frame of this board is being processed."""
        if self.wants_state:
            self.record_state({"parser": self.board.parser})
        if self.combined is not None:
            self.combined.record_own_state()

    async def process_frame(self, frame: Frame) -> None:
        """Estimate from a frame and from the pairs that wait; publish the estimates, then the frame."""
        await self.process(frame)
        if self.combined is not None:
            await self.combined.process_pairs()
        self.publisher.publish(frame_message(self.name, frame))
        self.dead_electrodes.update(self.name, self.session.calibration.table, frame.dead)
        if self.always_heatmap or self.publisher.has_subscriber(EitHeatmap.topic):
            heatmap = await heatmap_message(self.name, frame, self.session)
            if heatmap is not None:
                self.publisher.publish(heatmap)

    def diagnostics(self) -> Diagnostics:
        """Return the values for the health message."""
        # Also where no frame comes.
        self.expire_zero(self.clock.now_ns())
        board = self.board.diagnostics()
        errors = [self.why_no_zero]
        if board["connected"]:
            errors += [self.dead_electrodes.sentence, str(board["last_refusal"])]
        else:
            errors.append(str(board["last_loss"]))
        return {
            **board,
            "rate_hz": board["measured_hz"],
            "error": "; ".join(filter(None, errors)),
            "estimates": self.count,
        }
