"""The zero of the wrench under a tool, over the end of a daemon and over the starts of the robot's program."""

from dataclasses import dataclass

import structlog

from shearloop.daemon.control.control_loop import ControlLoop
from shearloop.daemon.control.operator_view import CLAMPED_CURE
from shearloop.daemon.torques import WRENCH
from shearloop.drivers.ur.client import UrRobot
from shearloop.drivers.ur.settings import Six

# A known zero of the wrench needs a step: the command tares sensors alone.
RELEASE_AND_TARE = "run an experiment that begins with the steps `release` and `tare`"


@dataclass(slots=True)
class WrenchZero:
    """Restores the zero of an earlier daemon, and follows whether a tare took the present zero.

    The zero is restored before the robot's program starts, and is kept until the gripper shows whether it still has the
    earlier grip.
    """

    loop: ControlLoop
    robot: UrRobot
    # Whether the wrench has the zero of the earlier daemon, and whether a tare took that zero.
    _restored: bool = False
    _restored_tared: bool = False
    # Whether the gripper has yet to show if it still has the earlier grip.
    _unjudged: bool = False
    # Whether a program is starting: the controller may have zeroed its wrench under load.
    _changes: bool = False
    # Whether the zero was known at the last look.
    _was_known: bool = False

    def restore(self, zero: Six, *, tared: bool) -> None:
        """Use the zero of an earlier daemon; `tared`: a tare took it."""
        self._restored, self._restored_tared, self._unjudged = True, tared, True
        self.robot.restore_wrench_zero(zero)

    def keep(self) -> bool:
        """Keep the restored zero, because the tool is the same; return whether there is one that a tare took."""
        self._unjudged = False
        if self._restored and not self._restored_tared:
            structlog.get_logger().info(
                "the wrench has no known zero with the present tool, and its torques may be off by any load",
                reason="none was taken before the grip, the connection to the robot or its process was lost, or "
                "the last daemon ended while the robot's program started",
                cure=self._cure,
            )
        return self._restored and self._restored_tared

    def forget(self) -> bool:
        """Remove the restored zero, because the tool is another one; return whether there was one."""
        self._unjudged = False
        if self._restored:
            self.robot.forget_wrench_zero()
        return self._restored

    def watch(self) -> None:
        """Look at the robot's state and at the loop; a zero that was lost under a tool is logged."""
        self._follow_program()
        known = self.loop.has_zero(WRENCH)
        if self._was_known and not known and self.loop.tool.may_be_loaded():
            structlog.get_logger().warning(
                "the zero of the wrench is lost with the connection to the robot, or with the process that drives it: "
                "its torques on the present tool may be off by any load",
                cure=self._cure,
            )
        self._was_known = known

    def _follow_program(self) -> None:
        """Note whether a program is starting: if the daemon is killed now, the earlier zero must not be used."""
        state = self.robot.state
        if state is None:
            return
        # A start that is given up leaves motion blocked; its program may run on, with a zero of its own.
        ready = state.program_running and (state.awaits_enable or not state.blocked)
        if state.recovering:
            self._changes = True
        elif ready:
            self._changes = False

    @property
    def zero(self) -> Six:
        """The present zero."""
        return self.robot.wrench_zero

    @property
    def tared(self) -> bool:
        """Whether a tare took the zero, in the running program."""
        if self._changes:
            return False
        return self.loop.has_zero(WRENCH) or (self._restored_tared and self._unjudged)

    @property
    def _cure(self) -> str:
        return RELEASE_AND_TARE if self.loop.tool.has_gripper else CLAMPED_CURE
