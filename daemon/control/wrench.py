"""The robot's wrench as a torque source: a mean over states, because a single state is known only to 0.2 N·m."""

from collections import deque

from shearloop.daemon.torques import WRENCH, TorqueSource
from shearloop.drivers.ur.messages import RobotState
from shearloop.drivers.ur.settings import ENOUGH_STATES, WRENCH_STATES

# How often the robot's state is published, with a torque of the wrench; and the time that the torque is a mean over.
PUBLISHED_HZ, MEAN_OVER_S = 25.0, 0.192


def publish_every(rate_hz: float) -> int:
    """Return of how many of the robot's states one is published, from their rate."""
    return max(1, round(rate_hz / PUBLISHED_HZ))


def wrench_source(rate_hz: float, noise_nm: float = 0.0) -> TorqueSource:
    """Return the torque source of a robot's wrench, from the robot's rate of states and the noise of a mean."""
    return TorqueSource(
        name=WRENCH,
        period_s=publish_every(rate_hz) / rate_hz,
        window_s=wrench_window_s(rate_hz),
        from_robot=True,
        needs_zero=True,
        noise_nm=noise_nm,
    )


def wrench_window_s(rate_hz: float) -> float:
    """Return the time that a mean is over: long enough for `WRENCH_STATES` states where some are missing."""
    return max(MEAN_OVER_S, WRENCH_STATES / (ENOUGH_STATES * rate_hz))


class WrenchMean:
    """The mean torque about the tool's axis of the latest states."""

    def __init__(self, rate_hz: float) -> None:
        """Begin without a state."""
        self._rate_hz, self._window_ns = rate_hz, round(1e9 * wrench_window_s(rate_hz))
        # Times by the controller's clock in ns, ascending, and torques in N·m.
        self._states: deque[tuple[int, float]] = deque()

    def add(self, state: RobotState) -> None:
        """Take the next state, once, and forget those before the window."""
        t_ns = state.measured_ns
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
    def why_unknown(self) -> str:
        """Why there is no mean, in a sentence; empty where it is known."""
        if self.known:
            return ""
        return (
            f"{len(self._states)} of the robot's states came in {self._window_ns / 1e9:.2f} s, and a torque takes "
            f"{WRENCH_STATES} (`rate_hz` of its settings is {self._rate_hz:g})"
        )

    @property
    def torque_nm(self) -> float:
        """The mean of the states in the window, N·m."""
        return sum(torque_nm for _, torque_nm in self._states) / len(self._states)

    @property
    def t_mid_ns(self) -> int:
        """The mean of their times, ns."""
        return sum(t_ns for t_ns, _ in self._states) // len(self._states)
