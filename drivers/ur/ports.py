"""What recovering and flying need of the robot; `shearloop.drivers.ur.arm.Arm` has it. False: the robot did not take
it."""

from typing import Protocol

from shearloop.drivers.ur.messages import MoveLinear, WristSpeed


class CureArm(Protocol):
    """What recovering needs of the robot."""

    def unlock(self) -> None:
        """Unlock a protective stop."""

    def close_popups(self) -> None:
        """Close what the pendant shows."""

    def power_on(self) -> None:
        """Begin to switch the arm's power on."""

    def release_brakes(self) -> None:
        """Begin to release the brakes."""

    def stop_program(self) -> None:
        """Stop whatever program runs or is paused."""

    def clear_command(self) -> bool:
        """See that the register which holds the last command moves nothing any more; False: to be asked again."""

    def upload(self) -> bool:
        """Send the control script."""

    def arm_watchdog(self) -> bool:
        """Have the robot end its program when it hears nothing."""


class PilotArm(CureArm, Protocol):
    """What flying needs of the robot."""

    def wrist(self, command: WristSpeed) -> bool:
        """Turn wrist 3."""

    def end_speed(self, deceleration_rad_per_s2: float) -> bool:
        """End the speed thread of an arm at rest."""

    def move(self, command: MoveLinear) -> bool:
        """Begin a linear move."""

    def stop_move(self, deceleration_rad_per_s2: float) -> bool:
        """Begin to end a linear move."""

    def kick(self) -> bool:
        """Tell the robot's watchdog that we live."""

    def zero_wrench(self) -> bool:
        """Take the present wrench as zero."""
