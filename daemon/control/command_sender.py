"""Sends wrist speeds and stops to the worker, keeps the speed that it accepted last, and waits for the arm to rest."""

import asyncio
from dataclasses import dataclass
from functools import partial

import structlog

from shearloop.daemon.clock import Clock
from shearloop.daemon.control.control_loop import ControlLoop
from shearloop.daemon.control.faults import FaultCode
from shearloop.daemon.control.stop_timeline import StopTimeline
from shearloop.daemon.supervisor import error_text
from shearloop.drivers.ur.client import UrRobot
from shearloop.drivers.ur.messages import CommandReply, Stop, WristSpeed
from shearloop.errors import ActionError
from shearloop.timeouts import timeout

# The arm rests within this time after a stop, unless something else moves it.
COMES_TO_REST_S = 2.0


@dataclass(slots=True)
class CommandSender:
    """Sends wrist speeds and stops to the worker; a refusal is a fault of the control loop."""

    robot: UrRobot
    control_loop: ControlLoop
    stops: StopTimeline
    clock: Clock
    # The speed that the worker accepted last.
    sent_rad_per_s: float = 0.0
    # Commands that wait for their replies.
    unanswered: int = 0

    @property
    def stop_command(self) -> Stop:
        """The stop of the arm, including a straight move."""
        return Stop(self.control_loop.config.wrist_acceleration_rad_per_s2)

    def stop(self) -> None:
        """Stop the arm."""
        self._send(self.stop_command)

    def turn(self, rad_per_s: float, decided_ns: int) -> None:
        """Turn the wrist, unless it stands still already or a command waits for its reply.

        A straight move goes on for as long as the loop decides, and each decision turns the wrist.
        """
        if not self.unanswered and (rad_per_s or self.sent_rad_per_s):
            acceleration_rad_per_s2 = self.control_loop.config.wrist_acceleration_rad_per_s2
            self._send(WristSpeed(rad_per_s, acceleration_rad_per_s2, decided_ns))
        self.robot.keep_moving()

    async def wait_for_rest(self) -> None:
        """Wait until no motion is under way; raises ActionError.

        Resting joints are not enough: after a stop the worker is busy a little longer, and refuses a move.
        """
        try:
            async with timeout(COMES_TO_REST_S):
                state = await self.robot.next_state()
                while self.sent_rad_per_s or self.unanswered or state.motion != "idle" or not state.rests:
                    state = await self.robot.next_state()
        except TimeoutError:
            what = f"the arm did not come to rest within {COMES_TO_REST_S:g} s"
            raise ActionError(f"{what}; find what moves it, such as freedrive or another program") from None

    def _send(self, command: WristSpeed | Stop) -> None:
        self.unanswered += 1
        try:
            self.robot.send(command).add_done_callback(partial(self._on_reply, command))
        except Exception as error:  # noqa: BLE001 - the next decision ends the experiment
            self.unanswered -= 1
            self._fail(error)

    def _on_reply(self, command: WristSpeed | Stop, replied: asyncio.Future[CommandReply]) -> None:
        self.unanswered -= 1
        try:
            reply = replied.result()
            if not reply.accepted:
                unanswered = self.robot.state is None
                code = FaultCode.COMMAND_UNANSWERED if unanswered else FaultCode.COMMAND_REFUSED
                self.control_loop.on_fault(code, reply.refusal)
            if isinstance(command, Stop):
                if reply.accepted:
                    self.stops.on_sent(self.clock.now_ns())
                else:
                    self.stops.on_refused(reply.refusal)
            self.sent_rad_per_s = reply.sent.rad_per_s if isinstance(reply.sent, WristSpeed) else 0.0
        except Exception as error:  # noqa: BLE001 - the next decision ends the experiment
            self._fail(error)

    def _fail(self, error: Exception) -> None:
        structlog.get_logger().exception("a command to the robot failed")
        self.control_loop.on_fault(FaultCode.TASK_DIED, f"loop: {error_text(error)}")


def raise_if_refused(reply: CommandReply) -> None:
    """Raise ActionError for a command that the worker refused."""
    if not reply.accepted:
        raise ActionError(reply.refusal)
