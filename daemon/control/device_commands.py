"""Commands to robot and gripper: wrist velocities and stops, and a step's moves, grips and tares."""

import asyncio
from collections.abc import Awaitable, Callable

import structlog

from shearloop.daemon.control.control_loop import ControlLoop
from shearloop.daemon.control.experiment_schema import ApproachStep, TareStep
from shearloop.daemon.control.gripper_task import GripperTask
from shearloop.daemon.control.step_runner import Action, GripTo
from shearloop.drivers.ur.client import UrRobot
from shearloop.drivers.ur.messages import (
    ARRIVED,
    STOPPED_ON_COMMAND,
    CommandReply,
    MoveLinear,
    Stop,
    WristSpeed,
    ZeroForceTorque,
    tool_axis,
)

LINEAR_ACCELERATION_M_PER_S2 = 0.3
# The arm rests within this time after a stop, unless something else moves it.
COMES_TO_REST_S = 2.0


class VelocityCommandSender:
    """Sends wrist velocities and stops to the robot's process, and reports the results to the control loop."""

    def __init__(
        self,
        robot: UrRobot,
        control_loop: ControlLoop,
        acceleration_rad_per_s2: float,
        on_error: Callable[[Exception], None],
    ) -> None:
        # The speed that the robot's process accepted last.
        self.sent_rad_per_s = 0.0
        self._robot = robot
        self._control_loop = control_loop
        self._acceleration_rad_per_s2 = acceleration_rad_per_s2
        self._on_error = on_error
        self._unanswered = 0

    @property
    def active(self) -> bool:
        """Whether the wrist turns on command, or a command waits for its reply."""
        return bool(self.sent_rad_per_s or self._unanswered)

    def turn(self, rad_per_s: float) -> None:
        """Send a wrist speed, unless the wrist stands still already or a command waits for its reply."""
        if (rad_per_s or self.sent_rad_per_s) and not self._unanswered:
            self._send(WristSpeed(rad_per_s, self._acceleration_rad_per_s2))

    def stop(self) -> None:
        """Stop the whole arm."""
        self._send(Stop(self._acceleration_rad_per_s2))

    def _send(self, command: WristSpeed | Stop) -> None:
        self._unanswered += 1
        try:
            self._robot.send_nowait(command, self._on_reply)
        except Exception as error:  # noqa: BLE001 - the next decision ends the experiment
            self._unanswered -= 1
            self._on_error(error)

    def _on_reply(self, reply: CommandReply) -> None:
        self._unanswered -= 1
        if not reply.accepted and self._robot.state is None:
            self._control_loop.on_command_unanswered(reply.refusal)
        elif not reply.accepted:
            self._control_loop.on_command_refused(reply.refusal)
        self.sent_rad_per_s = reply.sent.rad_per_s if isinstance(reply.sent, WristSpeed) else 0.0
        self._control_loop.on_speed_sent(self.sent_rad_per_s)


class ActionExecutor:
    """Carries out one action at a time; a straight move that is interrupted continues to its end afterwards."""

    def __init__(
        self,
        robot: UrRobot,
        gripper: GripperTask | None,
        tare: Callable[[], Awaitable[str]],
        velocity: VelocityCommandSender,
    ) -> None:
        self._robot = robot
        self._gripper = gripper
        self._tare = tare
        self._velocity = velocity
        self._may_move = asyncio.Event()
        self._may_move.set()
        self._moving = self._interrupted = False
        # The fingers may be on their way; cleared by a stop of the fingers.
        self.fingers_move = False

    async def run(self, action: Action) -> str:
        """Carry out an action; return an error, or an empty string."""
        match action:
            case ApproachStep():
                return await self._move(action)
            case GripTo():
                if self._gripper is None:
                    return "no gripper is configured; add a `gripper` section to the configuration"
                return await self._grip(self._gripper, action)
            case TareStep():
                return await self._zero()
            case _:
                raise TypeError(f"{action} is not an action of the devices")

    def interrupt(self) -> bool:
        """Delay straight moves until `resume`; return whether one is under way and must be stopped now."""
        self._may_move.clear()
        stop = self._moving and not self._interrupted
        self._interrupted = self._interrupted or stop
        return stop

    def resume(self) -> None:
        """Continue an interrupted straight move."""
        self._may_move.set()

    async def _grip(self, gripper: GripperTask, action: GripTo) -> str:
        self.fingers_move = True
        # After a failure, such as a lost connection, the fingers may still move.
        error = await gripper.grip(action)
        self.fingers_move = bool(error)
        return error

    async def _rest(self) -> str:
        """Wait until no motion is under way; return an error, or an empty string.

        Resting joints are not enough: after a stop the robot's process is busy a little longer, and refuses a move.
        """
        try:
            async with asyncio.timeout(COMES_TO_REST_S):
                state = await self._robot.next_state()
                while self._velocity.active or state.motion != "idle" or not state.rests:
                    state = await self._robot.next_state()
        except TimeoutError:
            return f"the arm did not come to rest within {COMES_TO_REST_S:g} s; check what moves it"
        return ""

    async def _zero(self) -> str:
        if error := await self._rest():
            return error
        reply = await self._robot.send(ZeroForceTorque())
        return reply.refusal if not reply.accepted else await self._tare()

    async def _move(self, action: ApproachStep) -> str:
        pose: tuple[float, ...] | None = action.pose_m_rad
        while True:
            await self._may_move.wait()
            if error := await self._rest():
                return error
            # The loop may have interrupted the move during the wait.
            if not self._may_move.is_set():
                continue
            here = self._robot.state
            if here is None:
                return "the robot is not connected"
            # The goal is fixed at the first start, so that an interruption does not lengthen the move.
            pose = pose or along_tool(here.tcp_pose, action.along_tool_m or 0.0)
            x, y, z, rx, ry, rz = pose
            command = MoveLinear((x, y, z, rx, ry, rz), action.speed_m_per_s, LINEAR_ACCELERATION_M_PER_S2)
            self._moving, self._interrupted = True, False
            try:
                error = await self._move_once(command, here.motion_id)
            finally:
                self._moving = False
            if not (error and self._interrupted):
                return error

    async def _move_once(self, command: MoveLinear, previous_id: int) -> str:
        """Send a straight move and wait for its end; return an error, or an empty string."""
        reply = await self._robot.send(command)
        if not reply.accepted:
            return reply.refusal
        for reason in reply.clipped:
            structlog.get_logger().warning("the move was clipped", reason=reason)
        while True:
            state = await self._robot.next_state()
            if state.motion_id != previous_id and state.end_reason:
                if state.end_reason not in (ARRIVED, STOPPED_ON_COMMAND):
                    # It ended by itself, just before an interruption; do not repeat it.
                    self._interrupted = False
                return "" if state.end_reason == ARRIVED else f"the move ended early: {state.end_reason}"


def along_tool(pose: tuple[float, ...], distance_m: float) -> tuple[float, ...]:
    """Return the pose (x, y, z in m, rotation vector in rad) at a distance along the tool's axis."""
    x, y, z, *turned = pose
    dx, dy, dz = tool_axis(pose)
    return (x + dx * distance_m, y + dy * distance_m, z + dz * distance_m, *turned)
