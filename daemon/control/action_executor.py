"""Carries out the actions of an experiment, and the release or the halt that a stop ends with."""

import asyncio
from collections.abc import Awaitable, Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial

import structlog

from shearloop.daemon.control.command_sender import CommandSender, raise_if_refused
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
from shearloop.daemon.control.faults import FaultCode
from shearloop.daemon.control.fingers import Fingers
from shearloop.daemon.control.straight_moves import StraightMoves
from shearloop.daemon.supervisor import error_text
from shearloop.daemon.torques import LONGEST_TARE_S, Adaptable, Tareable
from shearloop.drivers.errors import DriverError
from shearloop.drivers.robotiq.gripper import Permit
from shearloop.drivers.ur.client import UrRobot
from shearloop.drivers.ur.messages import ZeroForceTorque
from shearloop.errors import ActionError, NotBegunError

# A release is tried for 5 s and takes up to 2 s; systemd kills a service 10 s after it asked for the end.
RELEASED_WITHIN_S = 7.0
# A tare gives up this much before its step is overdue, so that the sensors' reasons are reported.
GIVES_UP_BEFORE_S = 0.1


# Writes the state that a later daemon finds; returns why it cannot be written, or None.
WriteState = Callable[[], Awaitable[str | None]]


@dataclass(slots=True)
class ActionExecutor:
    """Carries out one action at a time; the final action of a stop takes its place."""

    robot: UrRobot
    fingers: Fingers
    sensors: Mapping[str, Tareable]
    sender: CommandSender
    straight_moves: StraightMoves
    control_loop: ControlLoop
    write_state: WriteState
    _task: asyncio.Task[None] | None = None
    # The last action of a stop: to open the gripper, or to halt its fingers.
    _final_task: asyncio.Task[None] | None = None

    @property
    def finishing(self) -> bool:
        """Whether the last release or halt of a stop is under way."""
        return self._final_task is not None and not self._final_task.done()

    def begin(self, action: Action, permit: Permit) -> None:
        """Carry out an action, and report its end to the control loop; `permit` is asked before each motion."""
        self._start(action.do, partial(self._run, action, permit), self.control_loop.on_action_ended)

    def release(self) -> None:
        """Open the gripper after a stop."""
        gripper = self.fingers.gripper
        if gripper is not None:
            self._final_task = self._start("open", gripper.release, self.control_loop.tool.on_release_ended)

    def cancel(self) -> None:
        """Cancel the present action, unless it is the last one of a stop; moving fingers are halted."""
        gripper, may_be_moving = self.fingers.gripper, self.fingers.may_be_moving
        self.fingers.may_be_moving = False
        if may_be_moving and gripper is not None:
            self._final_task = self._start("halt", gripper.halt, self._on_halted)
        elif self._task is not None and self._task is not self._final_task:
            self._task.cancel()

    def halt_fingers(self) -> None:
        """Halt the fingers if they may be moving, which cancels the present action."""
        if self.fingers.may_be_moving:
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
            self.fingers.may_be_moving = True
            detail = f"the fingers did not stop, keep clear of them: {error}"
            self.control_loop.on_fault(FaultCode.COMMAND_REFUSED, detail)

    async def _run(self, action: Action, permit: Permit) -> None:
        """Carry out an action; raises DriverError and ActionError."""
        match action:
            case ApproachStep():
                await self.straight_moves.carry_out(action, permit)
            case GripStep():
                await self._grip(action, permit)
            case TareStep():
                await self._tare(action)
            case AdaptStep():
                sensor = self.sensors.get(action.fingertip)
                if not isinstance(sensor, Adaptable):
                    raise ActionError(f"{action.fingertip} is not a fingertip; name one calibrated on recordings")
                await sensor.adapt(action.reference)
            case IdentifyStep():
                raise TypeError("the control loop identifies by itself")

    async def _grip(self, action: GripStep, permit: Permit) -> None:
        gripper = self.fingers.gripper
        if gripper is None:
            raise ActionError("no gripper is configured; add a `gripper` section to the configuration")
        try:
            if not isinstance(action, Opening):
                await self._write_new_grip()
            with self.fingers.moving(permit) as begin:
                await gripper.grip(action, begin)
        except NotBegunError:
            self.control_loop.tool.on_grip_refused()
            raise

    async def _write_new_grip(self) -> None:
        """Write the grip that begins: a later daemon would go on with an earlier one; raises NotBegunError."""
        try:
            reason = await self.write_state()
        except asyncio.CancelledError:
            self.control_loop.tool.on_grip_refused()
            raise
        if reason:
            raise NotBegunError(f"the fingers were not closed: {reason}")

    async def _tare(self, action: TareStep) -> None:
        loop, longest_s = asyncio.get_running_loop(), action.timeout_s or LONGEST_TARE_S
        until_s = loop.time() + longest_s - GIVES_UP_BEFORE_S
        if reason := await self.write_state():
            raise ActionError(f"no zero was taken: {reason}")
        await self.sender.wait_for_rest()
        raise_if_refused(await self.robot.send(ZeroForceTorque()))
        await tare_all(self.sensors.values(), until_s - loop.time())


async def tare_all(sensors: Iterable[Tareable], within_s: float = LONGEST_TARE_S) -> None:
    """Zero every sensor at the same time; raises ActionError with the reason of each one that was not zeroed."""
    reasons = await asyncio.gather(*(sensor.tare_and_wait(within_s) for sensor in sensors))
    if any(reasons):
        raise ActionError(" ".join(filter(None, reasons)))
