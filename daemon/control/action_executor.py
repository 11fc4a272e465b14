"""Carries out the actions of an experiment and of the operator: straight moves, grips, tares, adapting, unlocking."""

import asyncio
from collections.abc import Awaitable, Callable, Coroutine, Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import structlog

from shearloop.daemon.control.command_sender import CommandSender
from shearloop.daemon.control.control_loop import ControlLoop
from shearloop.daemon.control.experiment import Action
from shearloop.daemon.control.experiment_schema import (
    AdaptStep,
    ApproachStep,
    GripStep,
    IdentifyStep,
    Opening,
    TareStep,
)
from shearloop.daemon.control.gripper_task import GripperTask
from shearloop.daemon.control.safety import FaultCode
from shearloop.daemon.supervisor import error_text
from shearloop.daemon.torques import LONGEST_TARE_S, Adaptable, Tareable
from shearloop.drivers.errors import DriverError
from shearloop.drivers.ur.client import UrRobot
from shearloop.drivers.ur.messages import (
    ARRIVED,
    STOPPED_ON_COMMAND,
    CommandReply,
    MoveLinear,
    Unlock,
    ZeroForceTorque,
    tool_axis,
)
from shearloop.drivers.ur.settings import Six
from shearloop.errors import ActionError, NotBegunError
from shearloop.timeouts import timeout

# A release is tried for 5 s and takes up to 2 s; systemd kills a service 10 s after it asked for the end.
RELEASED_WITHIN_S = 7.0
LINEAR_ACCELERATION_M_PER_S2 = 0.3
# The arm rests within this time after a stop, unless something else moves it.
COMES_TO_REST_S = 2.0
# A tare gives up this much before its step is overdue, so that the sensors' reasons are reported.
GIVES_UP_BEFORE_S = 0.1
UNLOCKING = "robot and gripper are being unlocked, or the gripper opened; wait for the end"


# Writes the state that a later daemon finds; returns why it cannot be written, or None.
WriteState = Callable[[], Awaitable[str | None]]


async def no_state() -> None:
    """Write nothing: the state of a rig that ends with its daemon."""


@dataclass(slots=True)
class ActionExecutor:
    """Carries out one action at a time; a straight move that is interrupted continues to its end afterwards."""

    robot: UrRobot
    gripper: GripperTask | None
    sensors: Mapping[str, Tareable]
    sender: CommandSender
    control_loop: ControlLoop
    write_state: WriteState = no_state
    # The fingers may be on their way; cleared by a stop of the fingers.
    fingers_move: bool = False
    # Set while straight moves may go on.
    may_move: asyncio.Event = field(default_factory=asyncio.Event)
    _moving: bool = False
    _interrupted: bool = False
    _task: asyncio.Task[None] | None = None
    # The last action of a stop: to open the gripper, or to halt its fingers.
    _final_task: asyncio.Task[None] | None = None
    _unlocking: asyncio.Task[None] | None = None

    @property
    def unlocking(self) -> bool:
        """Whether robot and gripper are being unlocked, or the gripper is opened for the operator."""
        return self._unlocking is not None and not self._unlocking.done()

    @property
    def finishing(self) -> bool:
        """Whether the last release or halt of a stop is under way."""
        return self._final_task is not None and not self._final_task.done()

    def begin(self, action: Action) -> None:
        """Carry out an action, and report its end to the control loop."""
        self._start(action.do, partial(self._run, action), self.control_loop.on_action_ended)

    def release(self) -> None:
        """Open the gripper after a stop."""
        if self.gripper is not None:
            self._final_task = self._start("open", self.gripper.release, self.control_loop.tool.on_release_ended)

    def cancel(self) -> None:
        """Cancel the present action; moving fingers are halted."""
        fingers_move, self.fingers_move = self.fingers_move, False
        if fingers_move and self.gripper is not None:
            self._final_task = self._start("halt", self.gripper.halt, self._on_halted)
        elif self._task is not None:
            self._task.cancel()

    async def unlock(self, *, confirmed: bool = False) -> None:
        """Enable robot and gripper while no experiment runs; raises DriverError and ActionError.

        `confirmed`: the operator says that a tool may drop.
        """
        await self._by_operator("unlock", "unlocking", partial(self._unlock, confirmed=confirmed))

    async def open_by_operator(self) -> None:
        """Open the gripper, if there is one, while no experiment runs; raises DriverError and ActionError."""
        await self._by_operator("release", "the release", self._open)

    async def _by_operator(self, command: str, name: str, act: Callable[[], Coroutine[Any, Any, None]]) -> None:
        if self.unlocking:
            raise ActionError(UNLOCKING)
        task = self._unlocking = asyncio.create_task(act(), name=command)
        # After the caller is cancelled, a failure has no receiver.
        task.add_done_callback(lambda done: done.cancelled() or done.exception())
        await asyncio.wait([task])
        if task.cancelled():
            raise ActionError(f"{name} was stopped; send `{command}` again")
        task.result()

    async def _open(self) -> None:
        if self.gripper is None:
            return
        self.fingers_move = True
        await self.gripper.open_by_operator()
        self.fingers_move = False

    async def _unlock(self, *, confirmed: bool) -> None:
        _accepted(await self.robot.send(Unlock()))
        if self.gripper is not None:
            # An activation opens and closes the fingers; after a failure they may still move.
            self.fingers_move = True
            try:
                await self.gripper.unlock(confirmed=confirmed)
            except (ActionError, DriverError) as error:
                raise ActionError(
                    f"the robot is unlocked and may move again, and the gripper is not: {error}"
                ) from error
            self.fingers_move = False

    def stop_unlocking(self) -> str | None:
        """End the operator's `unlock` or `release`, and halt the fingers that it moves; return its name, or None."""
        if self._unlocking is None or not self._unlocking.cancel():
            return None
        if self.fingers_move:
            self.cancel()
        return self._unlocking.get_name()

    def abort(self) -> None:
        """Cancel the present action unless it is the last one of a stop.

        Before the stop: the action may be about to start a straight move.
        """
        if self._task is not self._final_task:
            self.cancel()

    async def wait_for_final_action(self) -> None:
        """Wait for the end of the last release or halt."""
        if self._final_task is not None:
            await asyncio.wait({self._final_task}, timeout=RELEASED_WITHIN_S)

    async def close(self) -> None:
        """Cancel the present action and wait for its end."""
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)

    def interrupt(self) -> bool:
        """Delay straight moves until `may_move` is set; return whether one is under way and must be stopped now."""
        self.may_move.clear()
        stop = self._moving and not self._interrupted
        self._interrupted = self._interrupted or stop
        return stop

    def _start(
        self, name: str, act: Callable[[], Awaitable[None]], on_ended: Callable[[str | None], None]
    ) -> asyncio.Task[None]:
        """Run an action in a task; `on_ended` receives None, or why it failed."""
        if self._task is not None:
            self._task.cancel()

        async def run_action() -> None:
            error = None
            try:
                await act()
            except (ActionError, DriverError) as refused:
                error = str(refused)
                structlog.get_logger().error("an action of the devices failed", action=name, reason=error)
            except Exception as exception:  # noqa: BLE001 - any error fails the step
                structlog.get_logger().exception("an action of the devices crashed", action=name)
                error = f"it crashed with {error_text(exception)}; the log has more"
            on_ended(error)

        self._task = asyncio.create_task(run_action(), name="action")
        return self._task

    def _on_halted(self, error: str | None) -> None:
        if error is not None:
            detail = f"the fingers did not stop, keep clear of them: {error}"
            self.control_loop.on_fault(FaultCode.COMMAND_REFUSED, detail)

    async def _run(self, action: Action) -> None:
        """Carry out an action; raises DriverError and ActionError."""
        match action:
            case ApproachStep():
                await self._move(action)
            case GripStep():
                if self.gripper is None:
                    raise ActionError("no gripper is configured; add a `gripper` section to the configuration")
                try:
                    if not isinstance(action, Opening):
                        await self._write_new_grip()
                    # After a failure, such as a lost connection, the fingers may still move.
                    self.fingers_move = True
                    await self.gripper.grip(action)
                except NotBegunError:
                    # A halt would only make the gripper forget that it holds something.
                    self.fingers_move = False
                    self.control_loop.tool.on_grip_refused()
                    raise
                self.fingers_move = False
            case TareStep():
                if reason := await self.write_state():
                    raise ActionError(f"no zero was taken: {reason}")
                loop, longest_s = asyncio.get_running_loop(), action.timeout_s or LONGEST_TARE_S
                until_s = loop.time() + longest_s - GIVES_UP_BEFORE_S
                await self._rest()
                _accepted(await self.robot.send(ZeroForceTorque()))
                await tare_all(self.sensors.values(), until_s - loop.time())
            case AdaptStep():
                sensor = self.sensors.get(action.fingertip)
                if not isinstance(sensor, Adaptable):
                    raise ActionError(f"{action.fingertip} is not a fingertip; name one calibrated on recordings")
                await sensor.adapt(action.reference)
            case IdentifyStep():
                raise TypeError("the control loop identifies by itself")

    async def _write_new_grip(self) -> None:
        """Write the grip that begins: a later daemon would go on with an earlier one; raises NotBegunError."""
        try:
            reason = await self.write_state()
        except asyncio.CancelledError:
            self.control_loop.tool.on_grip_refused()
            raise
        if reason:
            raise NotBegunError(f"the fingers were not closed: {reason}")

    async def _rest(self) -> None:
        """Wait until no motion is under way; raises ActionError.

        Resting joints are not enough: after a stop the worker is busy a little longer, and refuses a move.
        """
        sender = self.sender
        try:
            async with timeout(COMES_TO_REST_S):
                state = await self.robot.next_state()
                while sender.sent_rad_per_s or sender.unanswered or state.motion != "idle" or not state.rests:
                    state = await self.robot.next_state()
        except TimeoutError:
            what = f"the arm did not come to rest within {COMES_TO_REST_S:g} s"
            raise ActionError(f"{what}; find what moves it, such as freedrive or another program") from None

    async def _move(self, action: ApproachStep) -> None:
        pose = action.pose_m_rad
        while True:
            await self.may_move.wait()
            await self._rest()
            # The loop may have interrupted the move during the wait.
            if not self.may_move.is_set():
                continue
            here = self.robot.state
            if here is None:
                raise ActionError("the robot is not connected; `shearloop doctor CONFIG` examines it")
            # The goal is fixed at the first start, so that an interruption does not lengthen the move.
            pose = pose or along_tool(here.tcp_pose, action.along_tool_m or 0.0)
            command = MoveLinear(pose, action.speed_m_per_s, LINEAR_ACCELERATION_M_PER_S2)
            self._moving, self._interrupted = True, False
            try:
                error = await self._move_once(command, here.motion_id)
            finally:
                self._moving = False
            if error is None:
                return
            if not self._interrupted:
                raise ActionError(error)

    async def _move_once(self, command: MoveLinear, previous_id: int) -> str | None:
        """Send a straight move and wait for its end; return None, or why it did not arrive."""
        reply = await self.robot.send(command)
        if not reply.accepted:
            return reply.refusal
        for reason in reply.clipped:
            structlog.get_logger().warning("the move was clipped", reason=reason)
        while True:
            state = await self.robot.next_state()
            if state.motion_id != previous_id and state.end_reason:
                if state.end_reason not in (ARRIVED, STOPPED_ON_COMMAND):
                    # It ended by itself, just before an interruption; do not repeat it.
                    self._interrupted = False
                return None if state.end_reason == ARRIVED else f"the move ended early: {state.end_reason}"


async def tare_all(sensors: Iterable[Tareable], within_s: float = LONGEST_TARE_S) -> None:
    """Zero every sensor at the same time; raises ActionError with the reason of each one that was not zeroed."""
    reasons = await asyncio.gather(*(sensor.tare_and_wait(within_s) for sensor in sensors))
    if any(reasons):
        raise ActionError(" ".join(filter(None, reasons)))


def _accepted(reply: CommandReply) -> None:
    """Raise ActionError for a command that the worker refused."""
    if not reply.accepted:
        raise ActionError(reply.refusal)


def along_tool(pose: Six, distance_m: float) -> Six:
    """Return the pose (x, y, z in m, rotation vector in rad) at a distance along the tool's axis."""
    x, y, z, rx, ry, rz = pose
    dx, dy, dz = tool_axis(pose)
    return x + dx * distance_m, y + dy * distance_m, z + dz * distance_m, rx, ry, rz
