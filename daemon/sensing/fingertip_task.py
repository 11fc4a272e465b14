"""The task of a fingertip's session: frames in, estimates out to the control loop and to subscribers."""

import asyncio
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import structlog

from shearloop.bank.errors import CalibrationError
from shearloop.daemon.clock import Clock
from shearloop.daemon.messaging.publisher import Publisher
from shearloop.daemon.sensing.fingertip_messages import (
    adapted_message,
    estimate_message,
    moved_as_bytes,
    tare_as_bytes,
    tool_as_bytes,
    torques_as_bytes,
)
from shearloop.daemon.sensing.snapshots import record_state
from shearloop.daemon.torques import LONGEST_TARE_S, SensorListener, TorqueSample
from shearloop.drivers.eit_kit import Frame
from shearloop.drivers.serial_sensor import InputKind, InputRecorder, RawEvent
from shearloop.errors import ActionError
from shearloop.estimation import Estimate, Measured, Session, TactileFrame, torque_at
from shearloop.timeouts import timeout
from shearloop.words import counted

# A correction of the gain begins with a frame.
_LONGEST_WAIT_S = 5.0


class DiameterListener(Protocol):
    """Takes the fingertips' diameters."""

    def update(self, source: str, estimate: Estimate, t_ns: int) -> None:
        """Take a source's estimate at t_ns."""


class ToolHolder(Protocol):
    """What presses the fingertips on the tool, where there is one: the gripper."""

    @property
    def diameters(self) -> DiameterListener:
        """Who takes the fingertips' diameters."""

    @property
    def is_holding(self) -> bool | None:
        """Whether something is between the fingers; None while that is not known."""

    def held_tool(self, t_ns: int) -> Measured | None:
        """Return the diameter of the held tool at t_ns, None if it is not known."""

    def moved_between(self, from_ns: int, to_ns: int) -> bool:
        """Return whether the fingers moved at any time of an interval, as far as is known."""


class _Tare:
    """A tare of one estimator: when it begins, whether it is done, and why its frames were refused."""

    def __init__(self) -> None:
        # The tare begins with the first frame acquired after this, and ends before the first one acquired after that.
        self._from_ns: int | None = None
        self._until_ns = 0
        self.begun = self._expired = False
        self.done = asyncio.Event()
        self.done.set()
        # By the reason without its numbers: the count, and the latest reason.
        self._refused: dict[str, tuple[int, str]] = {}
        # Why it ended without an idle frame, if it did.
        self.failure: str | None = None

    def begin(self, now_ns: int, within_s: float) -> None:
        """Begin, also during another tare."""
        self._from_ns, self._until_ns = now_ns, now_ns + round(within_s * 1e9)
        self.begun = self._expired = False
        self.failure = None
        self.done.clear()
        self._refused.clear()

    def is_under_way(self, now_ns: int) -> bool:
        """Return whether the next frames belong to it."""
        return not (self.done.is_set() or self._expired) and now_ns <= self._until_ns

    def expires(self, t_begin_ns: int) -> bool:
        """Return, once, whether a frame that began then is too late for it."""
        late = not (self.done.is_set() or self._expired) and t_begin_ns > self._until_ns
        self._expired |= late
        return late

    def is_due(self, t_begin_ns: int) -> bool:
        """Return, once, whether a frame that began then is the tare's first."""
        due = not self._expired and self._from_ns is not None and t_begin_ns >= self._from_ns
        self._from_ns = None if due else self._from_ns
        self.begun |= due
        return due

    def give_up(self, now_ns: int) -> None:
        """Forget a tare that no frame has begun, and end one that is not complete."""
        self._from_ns = None
        self._until_ns = min(self._until_ns, now_ns)

    def fail(self, reason: str) -> None:
        """End it without an idle frame: no later frame completes it."""
        self._from_ns, self._expired, self.failure = None, True, reason
        self.done.set()

    def add(self, reason: str, *, taring: bool) -> None:
        """Take the reason of an estimate, and whether more frames are needed."""
        if self.done.is_set() or self._expired or not self.begun:
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
class FingertipTask:
    """The I/O of one session: frames of one fingertip or of several together in, estimates out.

    Estimates go to the control loop and to subscribers. The gripper gives the held tool, and receives the diameters.
    `inputs` keeps the moments of tares and of changes of the tool, and the frames during which the fingers moved.
    """

    name: str
    session: Session
    publisher: Publisher
    clock: Clock
    loop: SensorListener | None = None
    gripper: ToolHolder | None = None
    inputs: InputRecorder | None = None
    # The longest time of a tare that no step of an experiment waits for.
    longest_tare_s: float = LONGEST_TARE_S
    count: int = 0
    _tare: _Tare = field(default_factory=_Tare)
    _held: Measured | None = None
    # Whether the gripper has not said yet that nothing was held in the session's first idle frame; None at first.
    _unconfirmed: bool | None = None
    # The source of the known torque of a correction that waits for the next frame, and its result.
    _adapting: tuple[str, asyncio.Future[None]] | None = None

    async def process(self, *frames: Frame) -> None:
        """Estimate from the frames of one time, hand the estimate to the control loop, and publish it."""
        number, now_ns = frames[0].seq, self.clock.now_ns()
        # A replay tares, takes the held tool and the fingers' motion, and corrects the gain before the same frame.
        began_ns = min(frame.t_begin_ns for frame in frames)
        if self._tare.expires(began_ns):
            self._give_up_tare(number, now_ns)
        if self._tare.is_due(began_ns):
            self.session.tare()
            self._record(InputKind.TARE, now_ns, tare_as_bytes(number))
            self._unconfirmed = False
        if self._is_of_held_tool():
            reason = f"{self.name} has no idle frame: the gripper holds something"
            structlog.get_logger().warning(reason)
            self._end_tare(reason, number, now_ns)
        tool = self.gripper.held_tool(now_ns) if self.gripper is not None else None
        if tool != self._held:
            self._held = tool
            self.session.set_tool(tool)
            self._record(InputKind.TOOL, now_ns, tool_as_bytes(number, tool))
        moved = self._fingers_moved(frames)
        if moved:
            self._record(InputKind.MOVED, now_ns, moved_as_bytes(number))
        if self._adapting is not None:
            reference, ended = self._adapting
            if not ended.done():
                try:
                    self._adapt(reference, frames, now_ns)
                    ended.set_result(None)
                except Exception as error:  # noqa: BLE001 - it fails the step, and the frames go on
                    ended.set_exception(error)
        estimate = await estimate_frames(self.session, frames, fingers_moved=moved)
        now_ns = self.clock.now_ns()
        message = estimate_message(self.name, frames, estimate, now_ns)
        if self.loop is not None:
            t_mid_ns = message.t_mono_ns - round(1e9 * estimate.lag_s)
            # An estimate is valid also with a diameter alone.
            reason = message.reason or self.session.why_no_torque
            self.loop.on_torque(TorqueSample(self.name, estimate.torque_nm, reason, t_mid_ns, now_ns))
        if self.gripper is not None:
            self.gripper.diameters.update(self.name, estimate, now_ns)
        self.publisher.publish(message)
        self.count += 1
        self._tare.add(message.reason, taring=self.session.taring)

    def tare(self, *, confirmed: bool = False) -> None:  # noqa: ARG002 - a fingertip judges by itself whether it is idle
        """Take a new idle frame from frames acquired entirely after now, within `longest_tare_s`."""
        self._tare.begin(self.clock.now_ns(), self.longest_tare_s)

    @property
    def taring(self) -> bool:
        """Whether the next frames belong to a tare that was asked for."""
        return self._tare.is_under_way(self.clock.now_ns())

    def _fingers_moved(self, frames: tuple[Frame, ...]) -> bool:
        """Return whether the fingers moved during any part of the frames' acquisition."""
        if self.gripper is None:
            return False
        # The middle of an acquisition is as far from its end as from its beginning.
        ended_ns = max(2 * frame.t_mid_ns - frame.t_begin_ns for frame in frames)
        return self.gripper.moved_between(min(frame.t_begin_ns for frame in frames), ended_ns)

    def _give_up_tare(self, number: int, now_ns: int) -> None:
        """Leave a tare that no frame has completed in time: later frames could be of any load."""
        reason = f"the idle frame of {self.name} was not taken: {self._tare.reasons or 'no frame came in time'}"
        structlog.get_logger().warning(reason)
        if self._tare.begun and self.session.taring:
            self._end_tare(reason, number, now_ns)

    def _is_of_held_tool(self) -> bool:
        """Return whether the idle frame is one of a held tool, as far as the gripper says."""
        # A session of the paper's method begins with an idle frame, without a request.
        if self._unconfirmed is None:
            self._unconfirmed = self.session.taring
        holding = self.gripper.is_holding if self.gripper is not None else None
        if holding is None:
            return False
        found = holding and (self.session.taring or self._unconfirmed)
        self._unconfirmed = False
        return found

    def _end_tare(self, reason: str, number: int, now_ns: int) -> None:
        self._tare.fail(reason)
        self.session.give_up_tare()
        self._record(InputKind.TARE, now_ns, tare_as_bytes(number, given_up=True))

    async def tare_and_wait(self, within_s: float) -> str | None:
        """Take a new idle frame and wait until it is complete; return None, or why it is not."""
        self._tare.begin(self.clock.now_ns(), within_s)
        try:
            async with timeout(within_s):
                await self._tare.done.wait()
        except TimeoutError:
            what = f"the idle frame of {self.name} could not be taken within {within_s:.3g} s"
            return f"{what}: {self._tare.reasons or 'no frame came'}"
        finally:
            # Frames that come later could be of any load.
            self._tare.give_up(self.clock.now_ns())
        return self._tare.failure

    async def adapt(self, reference: str) -> None:
        """Correct the gain by this source's torque during this grip; raises ActionError."""
        ended: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._adapting = reference, ended
        try:
            async with timeout(_LONGEST_WAIT_S):
                await ended
        except TimeoutError:
            raise ActionError(f"{self.name} sent no frame within {_LONGEST_WAIT_S:g} s; check its board") from None
        except CalibrationError as error:
            raise ActionError(f"{self.name} against {reference}: {error}") from error
        finally:
            self._adapting = None

    def _adapt(self, reference: str, frames: tuple[Frame, ...], now_ns: int) -> None:
        times_ns, torques_nm = self.loop.torques_of(reference) if self.loop is not None else ([], [])
        torque_nm = torque_at(self.session.grip_t_s, np.array(times_ns) / 1e9, np.array(torques_nm))
        adaptation = self.session.adapt(torque_nm)
        self._record(InputKind.ADAPT, now_ns, torques_as_bytes(frames[0].seq, reference, torque_nm))
        self.publisher.publish(adapted_message(self.name, frames, reference, adaptation))

    @property
    def wants_state(self) -> bool:
        """Whether a recording needs the state."""
        return self.inputs is not None and self.inputs.wants_state

    def record_state(self, others: Mapping[str, object]) -> None:
        """Keep the state of the session, and of the others that belong to it."""
        if self.inputs is not None:
            state = {**others, "session": self.session}
            record_state(self.inputs, state, self.session.fixed, self.clock.now_ns())

    def _record(self, kind: InputKind, t_ns: int, data: bytes) -> None:
        if self.inputs is not None:
            self.inputs.record(RawEvent(kind, t_ns, data))


def tactile_frame(frames: tuple[Frame, ...], *, fingers_moved: bool = False) -> TactileFrame:
    """Return the boards' frames of one time, one for each side, without their saturated and dead channels."""
    repeated = any(frame.repeated and frame.channels.any() for frame in frames)
    t_s = sum(frame.t_mid_ns for frame in frames) / len(frames) / 1e9
    usable = [~(frame.saturated | frame.dead) for frame in frames]
    return TactileFrame(t_s, np.array([frame.channels for frame in frames]), np.array(usable), repeated, fingers_moved)


async def estimate_frames(session: Session, frames: tuple[Frame, ...], *, fingers_moved: bool = False) -> Estimate:
    """Return the estimate of the boards' frames of one time; `fingers_moved` while they were acquired.

    A search of the bank runs in a thread: it can take half a second.
    """
    frame = tactile_frame(frames, fingers_moved=fingers_moved)
    if session.search is None:
        return session.estimate(frame)
    return await asyncio.to_thread(session.estimate, frame)
