"""The robot's wrench as a torque source: a mean over states, because a single state is known only to 0.2 N·m."""

from collections import deque

from shearloop.daemon.control.state_publisher import PUBLISH_EVERY
from shearloop.daemon.torques import WRENCH, TorqueSource
from shearloop.drivers.ur.messages import RobotState
from shearloop.drivers.ur.settings import WRENCH_STATES


def wrench_source(rate_hz: float, noise_nm: float = 0.0) -> TorqueSource:
    """Return the torque source of a robot's wrench, from the robot's rate of states and the noise of a mean."""
    return TorqueSource(
        name=WRENCH,
        period_s=PUBLISH_EVERY / rate_hz,
        window_s=wrench_window_s(rate_hz),
        from_robot=True,
        needs_zero=True,
        noise_nm=noise_nm,
    )


def wrench_window_s(rate_hz: float) -> float:
    """Return the time that a mean is over: at most a third of its states may be missing."""
    return 1.5 * WRENCH_STATES / rate_hz


class WrenchMean:
    """The mean torque about the tool's axis of the latest states."""

    def __init__(self, rate_hz: float) -> None:
        """Begin without a state."""
        self._window_ns = round(1e9 * wrench_window_s(rate_hz))
        # Times by the controller's clock in ns, ascending, and torques in N·m.
        self._states: deque[tuple[int, float]] = deque()

    def add(self, state: RobotState) -> None:
        """Take the next state, once, and forget those before the window."""
        t_ns = state.t_mono_ns - state.age_ns
        if self._states and t_ns <= self._states[-1][0]:
            return
        self._states.append((t_ns, state.wrist_torque_nm))
        while self._states[0][0] <= t_ns - self._window_ns:
            self._states.popleft()

    @property
    def known(self) -> bool:
        """Whether the mean is of enough states."""
        return len(self._states) >= WRENCH_STATES

    @property
    def torque_nm(self) -> float:
        """The mean of the states in the window, N·m."""
        return sum(torque_nm for _, torque_nm in self._states) / len(self._states)

    @property
    def t_mid_ns(self) -> int:
        """The mean of their times, ns."""
        return sum(t_ns for t_ns, _ in self._states) // len(self._states)
