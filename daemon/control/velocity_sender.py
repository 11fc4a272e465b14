"""Speeds of the wrist, and stops, on their way to the robot's process: what was told, and when to tell it again."""

from collections.abc import Callable

from shearloop.daemon.control.control_loop import ControlLoop
from shearloop.drivers.ur.client import UrRobot
from shearloop.drivers.ur.messages import CommandReply, Stop, WristSpeed

# Commands on their way to the robot's process at once; a reply takes one of its cycles, and a second command would
# take the first one's place.
MOST_UNANSWERED = 1


class VelocityCommandSender:
    """Tells the robot's process how the wrist turns, and the brain what became of it.

    `sent_rad_per_s` is the speed that the process has taken last; what telling or answering dies of goes to `died_of`.
    """

    def __init__(
        self, robot: UrRobot, brain: ControlLoop, acceleration_rad_per_s2: float, died_of: Callable[[Exception], None]
    ) -> None:
        """Have told nothing."""
        self.sent_rad_per_s = 0.0
        self._robot = robot
        self._brain = brain
        self._acceleration_rad_per_s2 = acceleration_rad_per_s2
        self._died_of = died_of
        # Commands that the robot's process has not answered yet.
        self._unanswered = 0

    @property
    def turns(self) -> bool:
        """Whether the wrist was told to turn, or is being told something."""
        return bool(self.sent_rad_per_s or self._unanswered)

    def turn(self, rad_per_s: float) -> None:
        """Have the wrist turn so fast from now on."""
        if rad_per_s == 0.0 and self.sent_rad_per_s == 0.0:
            return
        if self._unanswered < MOST_UNANSWERED:
            self._send(WristSpeed(rad_per_s, self._acceleration_rad_per_s2))

    def stop(self) -> None:
        """Have the whole arm stop, whatever is on its way."""
        self._send(Stop(self._acceleration_rad_per_s2))

    def _send(self, command: WristSpeed | Stop) -> None:
        self._unanswered += 1
        try:
            self._robot.tell(command, self._answered)
        except Exception as error:  # noqa: BLE001 - told by the next tick, which ends the experiment
            self._unanswered -= 1
            self._died_of(error)

    def _answered(self, reply: CommandReply) -> None:
        self._unanswered -= 1
        try:
            if not reply.accepted:
                # Without a process there is nobody who could have refused it.
                gone = self._robot.state is None
                (self._brain.on_command_unanswered if gone else self._brain.on_command_refused)(reply.refused)
            self.sent_rad_per_s = reply.sent.rad_per_s if isinstance(reply.sent, WristSpeed) else 0.0
            self._brain.on_speed_sent(self.sent_rad_per_s)
        except Exception as error:  # noqa: BLE001 - not the robot's process, which has answered, but the next tick's
            self._died_of(error)
