"""Whether a state says something new: what the daemon need not be woken for it is not told at once. No clock, no I/O.

The torque comes with a frame or a sample, the wrench with every fifth cycle: of a state in between the daemon needs how
far the wrist has turned, and whether anything has happened.
"""

from shearloop.drivers.ur.messages import RobotState

# What a wrist at the full speed of an experiment (0.5 rad/s) turns in half of a cycle at 125 Hz: then each is told. The
# narrowest limit on a twist in the experiments that come along (0.3 rad) is 150 times as far.
ANGLE_NEWS_RAD = 0.002


class News:
    """Compares each state with the last one that was told."""

    def __init__(self) -> None:
        """Have told nothing."""
        self._told: RobotState | None = None

    def tell(self, state: RobotState) -> None:
        """Note that a state was told."""
        self._told = state

    def brings(self, state: RobotState) -> bool:
        """Return whether the wrist has turned on, or anything but measured values has changed, since the last one."""
        told = self._told
        if told is None:
            return True
        # Of what is no number nobody knows whether it has changed.
        turned_on = not abs(state.wrist_rad - told.wrist_rad) <= ANGLE_NEWS_RAD
        return turned_on or _happened(state) != _happened(told)


def _happened(state: RobotState) -> tuple[object, ...]:
    # Not what was sent, and for which command: who commanded hears it by the reply.
    return (
        state.robot_mode,
        state.safety_mode,
        state.runtime_state,
        state.moving_linearly,
        state.blocked,
        state.recovering,
        state.motion,
        state.ended,
        state.clipped,
        state.ours,
        state.stops_in_vain,
    )
