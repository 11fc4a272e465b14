"""The task of a fingertip's session: frames in, estimates out to the control loop and to subscribers."""

import asyncio
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple, Protocol

import numpy as np
import structlog

from shearloop.bank.errors import CalibrationError
from shearloop.daemon.clock import Clock
from shearloop.daemon.messaging.publisher import Publisher
from shearloop.daemon.sensing.fingertip_messages import adapted_message, estimate_message
from shearloop.daemon.sensing.zero_request import ZeroRequest, ZeroState
from shearloop.daemon.torques import LONGEST_TARE_S, SensorListener, TorqueSample
from shearloop.drivers.eit_kit import Frame
from shearloop.drivers.serial_sensor import InputRecorder
from shearloop.errors import ActionError
from shearloop.estimation import (
    Adaptation,
    BeforeFrame,
    Estimate,
    HeldTool,
    KnownTorques,
    Measured,
    Session,
    TactileFrame,
    torque_at,
)
from shearloop.timeouts import timeout
from shearloop.words import CountedReasons, counted

# A correction of the gain begins with a frame.
_LONGEST_WAIT_S = 5.0


class SessionRecorder(InputRecorder, Protocol):
    """Keeps the inputs of one session."""

    def record_before(self, frame: int, before: BeforeFrame, t_ns: int) -> None:
        """Keep what comes before a frame, by the number of the frame."""


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


class _AdaptingStep(NamedTuple):
    """A step that corrects the gain by the torque of a source, and waits for the end."""

    reference: str
    ended: asyncio.Future[None]


@dataclass(slots=True)
class FingertipTask:
    """The I/O of one session: frames of one fingertip or of several together in, estimates out.

    Estimates go to the control loop and to subscribers. The gripper gives the held tool, and receives the diameters.
    `inputs` keeps what comes before each frame, for a replay.
    """

    name: str
    session: Session
    publisher: Publisher
    clock: Clock
    loop: SensorListener | None = None
    gripper: ToolHolder | None = None
    inputs: SessionRecorder | None = None
    # The longest time of a tare that no step of an experiment waits for.
    longest_tare_s: float = LONGEST_TARE_S
    count: int = 0
    # The latest request for an idle frame.
    _zero: ZeroRequest | None = None
    # Why the frames of the present tare gave no estimate.
    _refused: CountedReasons = field(default_factory=CountedReasons)
    _held: HeldTool = field(default_factory=lambda: HeldTool(None))
    # What the torque rests on that nothing checks about the held tool.
    _tool_note: str = field(init=False)
    # Whether an idle frame was taken without a request, before the gripper has reported that it held nothing.
    _unconfirmed: bool = field(init=False)
    # The step that waits for a correction of the gain, which the next frame makes.
    _adapting: _AdaptingStep | None = None

    def __post_init__(self) -> None:
        """Begin: a session of the paper's method takes an idle frame without a request."""
        self._unconfirmed = self.session.taring
        self._tool_note = self._note_of(self._held)

    async def process(self, *frames: Frame) -> None:
        """Estimate from the frames of one time, hand the estimate to the control loop, and publish it."""
        now_ns = self.clock.now_ns()
        before = self._before(frames, now_ns)
        self.session.prepare(before)
        corrected = self._correct_gain()
        if corrected is not None:
            known, correction = corrected
            before = replace(before, known_torques=known)
            self.publisher.publish(adapted_message(self.name, frames, known.reference, correction))
        if self.inputs is not None:
            self.inputs.record_before(frames[0].seq, before, now_ns)
        estimate = await estimate_frames(self.session, frames, fingers_moved=before.fingers_moved)
        now_ns = self.clock.now_ns()
        message = estimate_message(self.name, frames, estimate, now_ns)
        if self.loop is not None:
            t_mid_ns = message.t_mono_ns - round(1e9 * estimate.lag_s)
            # An estimate is valid also with a diameter alone.
            reason = message.reason or self.session.why_no_torque
            note = "" if estimate.torque_nm is None else self._tool_note
            self.loop.on_torque(TorqueSample(self.name, estimate.torque_nm, reason, t_mid_ns, now_ns, note=note))
        if self.gripper is not None:
            self.gripper.diameters.update(self.name, estimate, now_ns)
        self.publisher.publish(message)
        self.count += 1
        if self._zero is not None and self._zero.state is ZeroState.COLLECTING:
            self._refused.add(message.reason)
            if not self.session.taring:
                self._zero.take()

    def tare(self, *, confirmed: bool = False) -> None:  # noqa: ARG002 - a fingertip judges by itself whether it is idle
        """Take a new idle frame from frames acquired entirely after now, within `longest_tare_s`."""
        self._request_zero(self.longest_tare_s)

    @property
    def taring(self) -> bool:
        """Whether the next frames belong to an idle frame that was asked for."""
        return self._zero is not None and self._zero.is_under_way(self.clock.now_ns())

    def _request_zero(self, within_s: float) -> ZeroRequest:
        now_ns = self.clock.now_ns()
        self._zero, self._refused = ZeroRequest(now_ns, now_ns + round(within_s * 1e9), self._zero), CountedReasons()
        return self._zero

    def _before(self, frames: tuple[Frame, ...], now_ns: int) -> BeforeFrame:
        """Return what the session has to know before frames, and bring the request for an idle frame up to them."""
        begins, gives_up = self._follow_request(min(frame.t_begin_ns for frame in frames))
        gives_up |= self._refuse_held_tool(taring=begins or (self.session.taring and not gives_up))
        return BeforeFrame(
            begins_tare=begins,
            gives_up_tare=gives_up,
            tool=self._changed_tool(now_ns),
            fingers_moved=self._fingers_moved(frames),
        )

    def _follow_request(self, began_ns: int) -> tuple[bool, bool]:
        """Bring the request for an idle frame up to a frame that began then.

        Return whether the session's tare begins before the frame, and whether it is given up.
        """
        zero = self._zero
        if zero is None:
            return False, False
        self.expire_zero(began_ns)
        begins = zero.state is ZeroState.REQUESTED and began_ns >= zero.from_ns
        if begins:
            zero.collect()
            self._unconfirmed = False
        # Later frames could be of any load.
        return begins, zero.state is ZeroState.EXPIRED and self.session.taring

    def expire_zero(self, t_ns: int) -> None:
        """End a request for an idle frame for which this time is too late."""
        if self._zero is not None:
            why = self._refused_frames or "no frame came in time"
            self._zero.expire_if_late(t_ns, lambda: f"the idle frame of {self.name} was not taken: {why}")

    @property
    def why_no_zero(self) -> str:
        """Why the latest request got no idle frame, or an empty text."""
        return self._zero.reason if self._zero is not None else ""

    def _refuse_held_tool(self, *, taring: bool) -> bool:
        """Return whether the idle frame, which is being taken or unconfirmed, is one of a held tool; fail its request.

        The gripper may not say yet.
        """
        holding = self.gripper.is_holding if self.gripper is not None else None
        if holding is None:
            return False
        refused = holding and (taring or self._unconfirmed)
        self._unconfirmed = False
        if refused:
            reason = f"{self.name} has no idle frame: the gripper holds something"
            structlog.get_logger().warning(reason)
            if self._zero is not None:
                self._zero.fail(reason)
        return refused

    def _changed_tool(self, now_ns: int) -> HeldTool | None:
        """Return the known diameter of the tool, None if it has not changed since the last frame."""
        before = self._held
        measured = self.gripper.held_tool(now_ns) if self.gripper is not None else None
        self._held = HeldTool(measured, self.loop.stated_tool_mm if self.loop is not None else None)
        if self._held == before:
            return None
        self._tool_note = self._note_of(self._held)
        return self._held

    def _note_of(self, tool: HeldTool) -> str:
        return self.session.calibration.tool_note(self.name, tool_known=tool.diameter is not None)

    def _fingers_moved(self, frames: tuple[Frame, ...]) -> bool:
        """Return whether the fingers moved during any part of the frames' acquisition."""
        if self.gripper is None:
            return False
        # The middle of an acquisition is as far from its end as from its beginning.
        ended_ns = max(2 * frame.t_mid_ns - frame.t_begin_ns for frame in frames)
        return self.gripper.moved_between(min(frame.t_begin_ns for frame in frames), ended_ns)

    def _correct_gain(self) -> tuple[KnownTorques, Adaptation] | None:
        """Correct the gain for the step that waits for it, and give it the result.

        Return the known torques and the correction. None without such a step, and where it fails: the gain is then as
        before, for a replay too.
        """
        step = self._adapting
        if step is None or step.ended.done():
            return None
        try:
            times_ns, torques_nm = self.loop.torques_of(step.reference) if self.loop is not None else ([], [])
            of_grip = torque_at(self.session.grip_t_s, np.array(times_ns) / 1e9, np.array(torques_nm))
            correction = self.session.adapt(of_grip)
        except Exception as error:  # noqa: BLE001 - it fails the step that waits, and the frames go on
            step.ended.set_exception(error)
            return None
        step.ended.set_result(None)
        return KnownTorques(step.reference, of_grip), correction

    @property
    def _refused_frames(self) -> str:
        """Why the frames of the present tare gave no estimate, the most frequent reason first; empty without one."""
        reasons = self._refused.most_frequent_first
        return ", ".join(f"{counted(count, 'frame')}: {reason}" for count, reason in reasons)

    async def tare_and_wait(self, within_s: float) -> str | None:
        """Take a new idle frame and wait until it is complete; return None, or why it is not."""
        what = f"the idle frame of {self.name} could not be taken within {within_s:.3g} s"
        zero = self._request_zero(within_s)
        return await zero.wait(within_s, lambda: f"{what}: {self._refused_frames or 'no frame came'}")

    async def adapt(self, reference: str) -> None:
        """Correct the gain by this source's torque during this grip; raises ActionError."""
        ended: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._adapting = _AdaptingStep(reference, ended)
        try:
            async with timeout(_LONGEST_WAIT_S):
                await ended
        except TimeoutError:
            raise ActionError(f"{self.name} sent no frame within {_LONGEST_WAIT_S:g} s; check its board") from None
        except CalibrationError as error:
            raise ActionError(f"{self.name} against {reference}: {error}") from error
        finally:
            self._adapting = None

    @property
    def wants_state(self) -> bool:
        """Whether a recording needs the state."""
        return self.inputs is not None and self.inputs.wants_state

    def record_state(self, others: Mapping[str, object]) -> None:
        """Keep the state of the session, and of the others that belong to it."""
        if self.inputs is not None:
            state = {**others, "session": self.session}
            self.inputs.record_state(state, self.session.fixed, self.clock.now_ns())


def tactile_frame(frames: tuple[Frame, ...], *, fingers_moved: bool = False) -> TactileFrame:
    """Return the boards' frames of one time, one for each side, without their saturated and dead channels."""
    repeated = any(frame.repeated and frame.channels.any() for frame in frames)
    t_s = sum(frame.t_mid_ns for frame in frames) / len(frames) / 1e9
    usable = [~(frame.saturated | frame.dead) for frame in frames]
    period_s = 2e-9 * max(frame.t_mid_ns - frame.t_begin_ns for frame in frames)
    read_after_s = max(frame.t_arrival_ns for frame in frames) / 1e9 - t_s
    channels = np.array([frame.channels for frame in frames])
    return TactileFrame(t_s, channels, np.array(usable), repeated, fingers_moved, read_after_s / period_s)


async def estimate_frames(session: Session, frames: tuple[Frame, ...], *, fingers_moved: bool = False) -> Estimate:
    """Return the estimate of the boards' frames of one time; `fingers_moved` while they were acquired.

    A search of the bank runs in a thread: it can take half a second. An old frame has none.
    """
    frame = tactile_frame(frames, fingers_moved=fingers_moved)
    if session.search is None or session.is_old(frame):
        return session.estimate(frame)
    return await asyncio.to_thread(session.estimate, frame)
