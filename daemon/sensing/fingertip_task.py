"""Tasks of the EIT fingertips: read the boards, estimate from each frame or pair of frames, publish both."""

import asyncio
import contextlib
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from operator import attrgetter

import numpy as np
import structlog

from shearloop.bank.arrays import BoolArray, FloatArray
from shearloop.bank.channels import ChannelTable
from shearloop.bank.errors import CalibrationError
from shearloop.daemon.clock import Clock
from shearloop.daemon.control.control_loop import ControlLoop
from shearloop.daemon.control.fingertip_diameters import tool_as_bytes
from shearloop.daemon.control.gripper_task import GripperTask
from shearloop.daemon.control.samples import TorqueSample
from shearloop.daemon.messaging.messages import EitAdapted, EitEstimate, EitFrame, EitHeatmap
from shearloop.daemon.messaging.publisher import Publisher
from shearloop.daemon.sensing.frame_estimator import FrameEstimator
from shearloop.daemon.sensing.snapshots import record_state
from shearloop.daemon.supervisor import TaskFacts
from shearloop.drivers.eit_kit import EitKit, Frame
from shearloop.drivers.serial_sensor import InputKind, InputRecorder, RawEvent
from shearloop.errors import ActionError
from shearloop.estimation import Adaptation, Estimate, Measured, torque_at
from shearloop.words import counted

# Largest distance in time of a pair of frames, as a share of the frame period.
_MAX_APART_PERIODS = 0.75
# A correction of the gain begins with a frame.
_LONGEST_WAIT_S = 5.0


class FramePairing:
    """Makes sets of one frame per side, each used at most once, as soon as they are complete.

    The result depends only on the frames' own times and their order.
    """

    def __init__(self, sides: tuple[str, ...], period_s: float) -> None:
        """Take the sides in the order of a set, and the frame period."""
        self._sides = sides
        self._apart_ns = round(_MAX_APART_PERIODS * period_s * 1e9)
        self._latest: dict[str, Frame] = {}

    def add(self, side: str, frame: Frame) -> tuple[Frame, ...] | None:
        """Return the frames of the set that this one completes, or None."""
        if side not in self._sides:
            return None
        self._latest[side] = frame
        oldest_ns, newest_ns = frame.t_mid_ns - self._apart_ns, frame.t_mid_ns + self._apart_ns
        # Frames too old for this one are too old for all later ones.
        self._latest = {name: kept for name, kept in self._latest.items() if kept.t_mid_ns >= oldest_ns}
        # A frame that was delayed is too old for those already here.
        if any(kept.t_mid_ns > newest_ns for kept in self._latest.values()):
            del self._latest[side]
            return None
        if len(self._latest) < len(self._sides):
            return None
        found = tuple(self._latest[name] for name in self._sides)
        self._latest.clear()
        return found


class _Tare:
    """A tare of one estimator: when it begins, whether it is done, and why its frames were refused."""

    def __init__(self) -> None:
        # The tare begins with the first frame acquired after this.
        self._from_ns: int | None = None
        self.done = asyncio.Event()
        self.done.set()
        # By the reason without its numbers: the count, and the latest reason.
        self._refused: dict[str, tuple[int, str]] = {}

    def begin(self, now_ns: int) -> None:
        """Begin, also during another tare."""
        self._from_ns = now_ns
        self.done.clear()
        self._refused.clear()

    def is_due(self, t_begin_ns: int) -> bool:
        """Return, once, whether a frame that began then is the tare's first."""
        due = self._from_ns is not None and t_begin_ns >= self._from_ns
        self._from_ns = None if due else self._from_ns
        return due

    def give_up(self) -> None:
        """Forget a tare that no frame has begun."""
        self._from_ns = None

    def add(self, reason: str, *, taring: bool) -> None:
        """Take the reason of an estimate, and whether more frames are needed."""
        if self.done.is_set() or self._from_ns is not None:
            return
        if not taring:
            self.done.set()
        kind = "".join(letter for letter in reason if not letter.isdigit())
        self._refused[kind] = self._refused.get(kind, (0, ""))[0] + 1, reason

    @property
    def reasons(self) -> str:
        """The reasons with their counts, the most frequent first."""
        often = sorted(self._refused.values(), reverse=True)
        return ", ".join(f"{counted(count, 'frame')}: {reason}" for count, reason in often)


@dataclass(slots=True)
class FingertipPipeline:
    """Estimates from the frames of one fingertip, or of several together, for the control loop and for subscribers.

    The gripper gives the held tool, and receives the diameters. `inputs` keeps the moments of tares and of changes of
    the tool.
    """

    name: str
    estimator: FrameEstimator
    publisher: Publisher
    clock: Clock
    loop: ControlLoop | None = None
    gripper: GripperTask | None = None
    inputs: InputRecorder | None = None
    count: int = 0
    _tare: _Tare = field(default_factory=_Tare)
    _held: Measured | None = None
    # The source of the known torque of a correction that waits for the next frame, and its result.
    _adapting: tuple[str, asyncio.Future[None]] | None = None

    async def process(self, *frames: Frame) -> None:
        """Estimate from the frames of one time, hand the estimate to the control loop, and publish it."""
        number, now_ns = frames[0].seq, self.clock.now_ns()
        # A replay tares, takes the held tool, and corrects the gain before the same frame.
        if self._tare.is_due(min(frame.t_begin_ns for frame in frames)):
            self.estimator.session.tare()
            self._record(InputKind.TARE, now_ns, str(number).encode())
        tool = self.gripper.held_tool(now_ns) if self.gripper is not None else None
        if tool != self._held:
            self._held = tool
            self.estimator.session.set_tool(tool)
            self._record(InputKind.TOOL, now_ns, tool_as_bytes(number, tool))
        if self._adapting is not None:
            reference, ended = self._adapting
            if not ended.done():
                try:
                    self._adapt(reference, frames, now_ns)
                    ended.set_result(None)
                except Exception as error:  # noqa: BLE001 - it fails the step, and the frames go on
                    ended.set_exception(error)
        estimate = await self.estimator.estimate(*frames)
        now_ns = self.clock.now_ns()
        message = estimate_message(self.name, frames, estimate, now_ns)
        if self.loop is not None:
            t_mid_ns = message.t_mono_ns - round(1e9 * estimate.lag_s)
            # An estimate is valid also with a diameter alone.
            reason = message.reason or self.estimator.session.why_no_torque
            self.loop.on_torque(TorqueSample(self.name, estimate.torque_nm, reason, t_mid_ns, now_ns))
        if self.gripper is not None:
            self.gripper.diameters.update(self.name, estimate, now_ns)
        self.publisher.publish(message)
        self.count += 1
        self._tare.add(message.reason, taring=self.estimator.session.taring)

    def tare(self) -> None:
        """Take a new idle frame from frames acquired entirely after now."""
        self._tare.begin(self.clock.now_ns())

    async def tare_and_wait(self, within_s: float) -> str | None:
        """Take a new idle frame and wait until it is complete; return None, or why it is not."""
        self.tare()
        try:
            async with asyncio.timeout(within_s):
                await self._tare.done.wait()
        except TimeoutError:
            what = f"the idle frame of {self.name} could not be taken within {within_s:.3g} s"
            return f"{what}: {self._tare.reasons or 'no frame came'}"
        finally:
            # Frames that come later could be of any load.
            self._tare.give_up()
        return None

    async def adapt(self, reference: str) -> None:
        """Correct the gain by this source's torque during this grip; raises ActionError."""
        ended: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._adapting = reference, ended
        try:
            async with asyncio.timeout(_LONGEST_WAIT_S):
                await ended
        except TimeoutError:
            raise ActionError(f"{self.name} sent no frame within {_LONGEST_WAIT_S:g} s; check its board") from None
        except CalibrationError as error:
            raise ActionError(f"{self.name} against {reference}: {error}") from error
        finally:
            self._adapting = None

    def _adapt(self, reference: str, frames: tuple[Frame, ...], now_ns: int) -> None:
        times_ns, torques_nm = self.loop.inputs.history.get(reference, ([], [])) if self.loop else ([], [])
        torque_nm = torque_at(self.estimator.session.grip_t_s, np.array(times_ns) / 1e9, np.array(torques_nm))
        adaptation = self.estimator.session.adapt(torque_nm)
        self._record(InputKind.ADAPT, now_ns, torques_as_bytes(frames[0].seq, reference, torque_nm))
        self.publisher.publish(adapted_message(self.name, frames, reference, adaptation))

    @property
    def wants_state(self) -> bool:
        """Whether a recording needs the state."""
        return self.inputs is not None and self.inputs.wants_state

    def record_state(self, others: Mapping[str, object], now_ns: int) -> None:
        """Keep the state of the estimator, and of the others that belong to it."""
        session = self.estimator.session
        if self.inputs is not None:
            record_state(self.inputs, {**others, "session": session}, session.fixed, now_ns)

    def _record(self, kind: InputKind, t_ns: int, data: bytes) -> None:
        if self.inputs is not None:
            self.inputs.record(RawEvent(kind, t_ns, data))


class CombinedFingertips:
    """Pairs the frames of several fingertips, and estimates from each pair."""

    def __init__(self, pipeline: FingertipPipeline, period_s: float) -> None:
        """Take the estimates of the pairs, and the frame period."""
        self.pipeline = pipeline
        self.sides = pipeline.estimator.calibration.sides
        self._period_s = period_s
        self._pairing = FramePairing(self.sides, period_s)
        self._pairs: deque[tuple[Frame, ...]] = deque()
        self._in_order = asyncio.Lock()

    def add(self, side: str, frames: Sequence[Frame]) -> None:
        """Take the frames of one read; call this at once, because the order of arrival decides the pairs."""
        for frame in frames:
            if (pair := self._pairing.add(side, frame)) is not None:
                self._pairs.append(pair)

    async def process_pairs(self) -> None:
        """Estimate from the pairs that wait, in order."""
        async with self._in_order:
            while self._pairs:
                await self.pipeline.process(*self._pairs.popleft())

    @property
    def is_waiting(self) -> bool:
        """Whether no pair waits for its estimate."""
        return not self._pairs

    def record_state(self, now_ns: int) -> None:
        """Keep the state of the pairing and of the pairs' estimator."""
        self.pipeline.record_state({"pairing": self._pairing}, now_ns)

    def diagnostics(self) -> TaskFacts:
        """Return the values for the health message."""
        return {"expected_hz": 1.0 / self._period_s, "estimates": self.pipeline.count}


class FingertipStates:
    """Keeps the states of all fingertips for a recording that begins in the middle of a run.

    They belong together, because a pair has frames of several boards. So they are taken between frames of all boards.
    """

    def __init__(self, clock: Clock, combined: CombinedFingertips | None = None) -> None:
        """Begin without a fingertip; the fingertips of a pair are in `combined`."""
        self._clock = clock
        self._combined = combined
        self._boards: list[tuple[EitKit, FingertipPipeline]] = []
        self._busy = 0

    def add(self, board: EitKit, pipeline: FingertipPipeline) -> None:
        """Take a board and its estimates."""
        self._boards.append((board, pipeline))

    @contextlib.contextmanager
    def processing(self) -> Iterator[None]:
        """Hold the states back while the block processes a board's frames."""
        self._busy += 1
        try:
            yield
        finally:
            self._busy -= 1
        if not self._busy:
            self._record()

    def _record(self) -> None:
        if not any(pipeline.wants_state for _, pipeline in self._boards):
            return
        if self._combined is not None and not self._combined.is_waiting:
            return
        now_ns = self._clock.now_ns()
        for board, pipeline in self._boards:
            pipeline.record_state({"parser": board.parser}, now_ns)
        if self._combined is not None:
            self._combined.record_state(now_ns)


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


@dataclass(frozen=True, slots=True)
class FingertipTask:
    """Reads one board, estimates from each frame, and publishes both; `combined` also needs the frames.

    `states` keeps what a recording that begins later needs.
    """

    board: EitKit
    pipeline: FingertipPipeline
    publisher: Publisher
    states: FingertipStates
    combined: CombinedFingertips | None = None
    always_heatmap: bool = False
    dead_electrodes: DeadElectrodes = field(default_factory=DeadElectrodes)

    async def run(self) -> None:
        """Process every frame until cancelled."""
        async with contextlib.aclosing(self.board.batches()) as batches:
            async for frames in batches:
                with self.states.processing():
                    if self.combined is not None:
                        self.combined.add(self.pipeline.name, frames)
                    for frame in frames:
                        await self.process_frame(frame)

    async def process_frame(self, frame: Frame) -> None:
        """Estimate from a frame and from the pairs that wait; publish the estimates, then the frame."""
        await self.pipeline.process(frame)
        if self.combined is not None:
            await self.combined.process_pairs()
        self.publisher.publish(frame_message(self.pipeline.name, frame))
        self.dead_electrodes.update(self.pipeline.name, self.pipeline.estimator.table, frame.dead)
        if self.always_heatmap or self.publisher.has_subscriber(EitHeatmap.topic):
            await self._publish_heatmap(frame)

    def diagnostics(self) -> TaskFacts:
        """Return the values for the health message."""
        board = self.board.diagnostics()
        errors = (self.dead_electrodes.sentence, str(board["last_refusal"]))
        return {
            **board,
            "rate_hz": board["measured_hz"],
            "error": "; ".join(filter(None, errors)) if board["connected"] else board["last_loss"],
            "estimates": self.pipeline.count,
        }

    async def _publish_heatmap(self, frame: Frame) -> None:
        estimator = self.pipeline.estimator
        scores = await asyncio.to_thread(estimator.heatmap)
        if scores is None or estimator.grids is None:
            return
        k_grid, sigma_grid = estimator.grids
        self.publisher.publish(
            EitHeatmap(
                source=self.pipeline.name,
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


def torques_as_bytes(frame: int, reference: str, torque_nm: FloatArray) -> bytes:
    """Return the raw event's data: the known torques (n,) of the grip that correct the gain from a frame on."""
    return " ".join([str(frame), reference, *map(repr, torque_nm.tolist())]).encode()


def torques_from_bytes(data: bytes) -> tuple[int, str, FloatArray]:
    """Return the frame, the source and the torques (n,) of a raw event; raises ValueError for other data."""
    frame, reference, *torques = data.decode().split()
    return int(frame), reference, np.array(torques, dtype=np.float64)


def adapted_message(name: str, frames: tuple[Frame, ...], reference: str, adaptation: Adaptation) -> EitAdapted:
    """Return the message of a correction that begins with the frames of one time."""
    correction, before, after = adaptation.correction, adaptation.before, adaptation.after
    return EitAdapted(
        source=name,
        t_mono_ns=_mean_ns(frames),
        reference=reference,
        twists=correction.twists,
        factor=tuple(correction.factors.tolist()),
        factor_std=tuple(correction.errors.tolist()),
        offset_nm=correction.offset_nm,
        gain_before=before.gain,
        gain_after=after.gain,
        rmse_before_nm=before.rmse_nm,
        rmse_after_nm=after.rmse_nm,
        spread_before=before.spread,
        spread_after=after.spread,
        frame=frames[0].seq,
    )


def _mean_ns(frames: tuple[Frame, ...]) -> int:
    return sum(frame.t_mid_ns for frame in frames) // len(frames)


def estimate_message(name: str, frames: tuple[Frame, ...], estimate: Estimate, now_ns: int) -> EitEstimate:
    """Return the message of an estimate from frames of one time, as published at now_ns."""
    values = asdict(estimate)
    del values["reasons"], values["lag_s"]
    return EitEstimate(
        source=name,
        t_mono_ns=_mean_ns(frames),
        **values,
        reason="; ".join(estimate.reasons),
        frame=frames[0].seq,
        latency_s=(now_ns - max(map(attrgetter("t_arrival_ns"), frames))) / 1e9,
    )
