"""What the devices do for a step beside the wrist's turning: straight moves, grips, zeros. One at a time."""

import asyncio
import math
from collections.abc import Awaitable, Callable

import structlog

from shearloop.daemon.control.gripper_task import GripperTask
from shearloop.daemon.control.step_runner import Action, GripTo, MoveTo, Tare
from shearloop.drivers.ur.client import UrRobot
from shearloop.drivers.ur.messages import ARRIVED, STOPPED_ON_COMMAND, MoveLinear, ZeroForceTorque

LINEAR_ACCELERATION_M_PER_S2 = 0.3
# A wrist that was told to stand rests within this time, or something else moves the arm.
COMES_TO_REST_S = 2.0


class ActionExecutor:
    """Carries out one action; a straight move that is held back brakes, and goes on to its end afterwards."""

    def __init__(
        self,
        robot: UrRobot,
        gripper: GripperTask | None,
        take_zero: Callable[[], Awaitable[str]],
        turns: Callable[[], bool],
    ) -> None:
        """Take what acts; `turns` says whether the wrist was told to turn, or is being told something."""
        self._robot = robot
        self._gripper = gripper
        self._take_zero = take_zero
        self._turns = turns
        self._free = asyncio.Event()
        self._free.set()
        # Whether a straight move is under way, and whether it was held back since it was begun.
        self._moves = self._interrupted = False
        # Whether the fingers were told to go somewhere and are not known to be there; set back by who stops them.
        self.grips = False

    async def perform(self, action: Action) -> str:
        """Carry an action out to its end; return why it went wrong, or an empty text."""
        match action:
            case MoveTo():
                return await self._move(action)
            case GripTo():
                if self._gripper is None:
                    return "no gripper is configured; add a `gripper` section to the configuration"
                return await self._grip(self._gripper, action)
            case Tare():
                return await self._zero()
            case _:
                raise TypeError(f"{action} is not carried out by devices")

    async def _grip(self, gripper: GripperTask, action: GripTo) -> str:
        self.grips = True
        # Of a gripper whose connection was lost, or that answers what it should not, the fingers move on.
        why = await gripper.grip(action)
        self.grips = bool(why)
        return why

    def hold_back(self) -> bool:
        """Begin no straight move until `let_go`; return whether one has to be stopped for it, once for each."""
        self._free.clear()
        stop = self._moves and not self._interrupted
        self._interrupted = self._interrupted or stop
        return stop

    def let_go(self) -> None:
        """Let a straight move go on, or begin."""
        self._free.set()

    async def _rest(self) -> str:
        """Wait until no motion is under way; return why one still is, or an empty text.

        That the joints rest is not enough: a stop, or a last speed of zero, keeps the robot's process busy a little
        longer, and it would refuse the zero or the straight move that is to follow.
        """
        try:
            async with asyncio.timeout(COMES_TO_REST_S):
                state = await self._robot.next_state()
                while self._turns() or state.motion != "idle" or not state.rests:
                    state = await self._robot.next_state()
        except TimeoutError:
            return f"the arm did not come to rest within {COMES_TO_REST_S:g} s; see what moves it"
        return ""

    async def _zero(self) -> str:
        if why := await self._rest():
            return why
        reply = await self._robot.send(ZeroForceTorque())
        return reply.refused if not reply.accepted else await self._take_zero()

    async def _move(self, action: MoveTo) -> str:
        pose = action.pose_m_rad
        while True:
            await self._free.wait()
            if why := await self._rest():
                return why
            # The loop has decided upon the state that told of the rest, and may want it held back.
            if not self._free.is_set():
                continue
            here = self._robot.state
            if here is None:
                return "the robot is not connected"
            # From where the move began first: what is left of it after a hold is not so far again.
            pose = pose or along_tool(here.tcp_pose, action.along_tool_m)
            x, y, z, rx, ry, rz = pose
            command = MoveLinear((x, y, z, rx, ry, rz), action.speed_m_per_s, LINEAR_ACCELERATION_M_PER_S2)
            self._moves, self._interrupted = True, False
            try:
                ended = await self._moved(command, here.motion_id)
            finally:
                self._moves = False
            if not (ended and self._interrupted):
                return ended

    async def _moved(self, command: MoveLinear, before: int) -> str:
        """Begin a straight move and wait for its end; return why it was not one, or an empty text."""
        reply = await self._robot.send(command)
        if not reply.accepted:
            return reply.refused
        for why in reply.clipped:
            structlog.get_logger().warning("the move was clipped", why=why)
        while True:
            state = await self._robot.next_state()
            if state.motion_id != before and state.ended:
                if state.ended not in (ARRIVED, STOPPED_ON_COMMAND):
                    # It ended by itself, just before it was to be held back: what it met is not met again.
                    self._interrupted = False
                return "" if state.ended == ARRIVED else f"the move ended early: {state.ended}"


def along_tool(pose: tuple[float, ...], distance_m: float) -> tuple[float, ...]:
    """Return the pose (x, y, z in m, rotation vector in rad) that lies so far along the tool's axis."""
    x, y, z, *turned = pose
    # Rodrigues' formula for (0, 0, 1); scipy's rotations would lengthen the daemon's start by a tenth of a second.
    angle_rad = math.hypot(*turned)
    u, v, w = (part / angle_rad for part in turned) if angle_rad > 0 else (0.0, 0.0, 1.0)
    sine, rest = math.sin(angle_rad), 1.0 - math.cos(angle_rad)
    dx, dy, dz = v * sine + u * w * rest, -u * sine + v * w * rest, 1.0 - (u * u + v * v) * rest
    return (x + dx * distance_m, y + dy * distance_m, z + dz * distance_m, *turned)
