"""Straight moves of the arm, which the control loop interrupts and lets continue."""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum

import structlog

from shearloop.daemon.control.command_sender import CommandSender
from shearloop.daemon.control.experiment_schema import ApproachStep
from shearloop.drivers.ur.client import UrRobot
from shearloop.drivers.ur.messages import ARRIVED, STOPPED_ON_COMMAND, MoveLinear
from shearloop.drivers.ur.poses import along_tool
from shearloop.errors import ActionError

LINEAR_ACCELERATION_M_PER_S2 = 0.3


class MoveEnd(Enum):
    """How the robot's motion ended."""

    ARRIVED = "arrived"
    INTERRUPTED = "interrupted"  # by the control loop: the rest of the way follows
    ENDED_EARLY = "ended early"  # by anything else, such as a force: it is not repeated


@dataclass(slots=True)
class StraightMoves:
    """Carries out one straight move at a time; one that is interrupted continues to its end afterwards."""

    robot: UrRobot
    sender: CommandSender
    # Set while a move may go on.
    _may_go_on: asyncio.Event = field(default_factory=asyncio.Event)
    # Whether the robot has a move, and whether the control loop has interrupted this move.
    _under_way: bool = False
    _interrupted: bool = False

    def go_on(self) -> None:
        """Let a move begin or continue."""
        self._may_go_on.set()

    def interrupt(self) -> bool:
        """Delay every move until `go_on`; return whether one is under way and must be stopped now."""
        self._may_go_on.clear()
        stop = self._under_way and not self._interrupted
        self._interrupted = self._interrupted or stop
        return stop

    async def carry_out(self, step: ApproachStep, permit: Callable[[], None]) -> None:
        """Move to the end of the step; raises DriverError, ActionError, and what `permit` raises."""
        pose = step.pose_m_rad
        while True:
            await self._may_go_on.wait()
            await self.sender.wait_for_rest()
            # The loop may have interrupted the move during the wait.
            if not self._may_go_on.is_set():
                continue
            here = self.robot.state
            if here is None:
                raise ActionError("the robot is not connected; `shearloop doctor CONFIG` examines it")
            # The goal is fixed at the first start, so that an interruption does not lengthen the move.
            pose = pose or along_tool(here.tcp_pose, step.along_tool_m or 0.0)
            command = MoveLinear(pose, step.speed_m_per_s, LINEAR_ACCELERATION_M_PER_S2)
            permit()
            self._under_way, self._interrupted = True, False
            try:
                end, reason = await self._move_once(command, here.motion_id)
            finally:
                self._under_way = False
            match end:
                case MoveEnd.ARRIVED:
                    return
                case MoveEnd.INTERRUPTED:
                    continue
                case MoveEnd.ENDED_EARLY:
                    raise ActionError(reason)

    async def _move_once(self, command: MoveLinear, previous_id: int) -> tuple[MoveEnd, str]:
        """Send a move and wait for its end; return how it ended, and why it did not arrive."""
        reply = await self.robot.send(command)
        if not reply.accepted:
            return self._end_by_stop(), reply.refusal
        for reason in reply.clipped:
            structlog.get_logger().warning("the move was clipped", reason=reason)
        while True:
            state = await self.robot.next_state()
            if state.motion_id == previous_id or not state.end_reason:
                continue
            if state.end_reason == ARRIVED:
                return MoveEnd.ARRIVED, ""
            # One that ended by itself just before an interruption is not repeated.
            end = self._end_by_stop() if state.end_reason == STOPPED_ON_COMMAND else MoveEnd.ENDED_EARLY
            return end, f"the move ended early: {state.end_reason}"

    def _end_by_stop(self) -> MoveEnd:
        """Return how a move ended that was stopped or refused: interrupted, if the control loop has stopped it."""
        return MoveEnd.INTERRUPTED if self._interrupted else MoveEnd.ENDED_EARLY
