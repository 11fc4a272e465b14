"""The torques of calibrated fingertips, while the stages move the robot."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final

from shearloop.daemon.config import DaemonConfig
from shearloop.daemon.control.creep import Creep
from shearloop.daemon.sensing.fingertip_task import tactile_frame
from shearloop.daemon.sensing.frame_pairing import FramePairing
from shearloop.daemon.sensing.sessions import COMBINED, open_combined, open_session
from shearloop.drivers.eit_kit import Frame
from shearloop.errors import UserError
from shearloop.estimation import Session
from shearloop.estimation.values import Estimate, TactileFrame
from shearloop.tools.commission.arrivals import Arrivals
from shearloop.tools.commission.listening import SILENT_S

# A mean of that many torques is compared.
ESTIMATES: Final = 3
# Frames without an estimate: after a grip an estimator needs some frames of it.
_MAX_FRAMES: Final = 60


class TactileSensor:
    """One fingertip, or several together: the state of a run, and the frames that it has not taken yet."""

    def __init__(
        self,
        name: str,
        session: Session,
        boards: Mapping[str, Arrivals[Frame]],
        period_s: float,
        creep: Creep | None = None,
    ) -> None:
        """Take the boards of the session's fingertips by their names, and the creep that the control loop subtracts."""
        self.name = name
        self._creep = creep
        self._session, self._boards, self._period_s = session, boards, period_s
        # The frames of each board from this time on were not taken.
        self._from_ns = dict.fromkeys(boards, 0)
        self._pairing: FramePairing[Frame] = FramePairing(tuple(boards), period_s)

    def _next(self) -> list[Estimate]:
        """Wait for a frame of each board, and return the estimates of all frames since the last call."""
        for board in self._boards.values():
            board.take(1, SILENT_S + self._period_s)
        frames = [(name, frame) for name, board in self._boards.items() for frame in board.since(self._from_ns[name])]
        frames.sort(key=lambda one: one[1].t_mid_ns)
        estimates = []
        for name, frame in frames:
            self._from_ns[name] = frame.t_mid_ns + 1
            if (together := self._pairing.add(name, frame)) is not None:
                estimates.append(self._estimate(tactile_frame(together)))
        return estimates

    def _estimate(self, frame: TactileFrame) -> Estimate:
        """Return the estimate with the torque that the control loop has."""
        estimate = self._session.estimate(frame)
        if self._creep is None or estimate.torque_nm is None:
            return estimate
        t_ns = round(1e9 * (frame.t_s - estimate.lag_s))
        return replace(estimate, torque_nm=self._creep.torque_nm(estimate.torque_nm, t_ns))

    def tare(self, now_ns: int) -> None:
        """Take a new idle frame of untouched fingertips, from frames that begin after now; UserError without one."""
        self._session.tare()
        if self._creep is not None:
            self._creep.reset()
        self._from_ns = dict.fromkeys(self._boards, now_ns + round(0.5e9 * self._period_s))
        reason = ""
        for _ in range(_MAX_FRAMES):
            for estimate in self._next():
                reason = "; ".join(estimate.reasons)
            if not self._session.taring:
                return
        raise UserError(f"the idle frame of {self.name} could not be taken: {reason}")

    def on_grip(self) -> None:
        """Begin with a gel at rest after the frames of a grip, as the control loop does."""
        self._next()
        if self._creep is not None:
            self._creep.reset()

    def torques_nm(self) -> list[float]:
        """Return the next torques, at least `ESTIMATES`, or none."""
        # The first frame may have begun before now.
        self._next()
        torques_nm: list[float] = []
        for _ in range(_MAX_FRAMES):
            torques_nm += [estimate.torque_nm for estimate in self._next() if estimate.torque_nm is not None]
            if len(torques_nm) >= ESTIMATES:
                return torques_nm
        return []


def calibrated_sessions(config: DaemonConfig) -> dict[str, tuple[Session, Sequence[str]]]:
    """Return the sessions that measure a torque, and the fingertips of each."""
    found: dict[str, tuple[Session, Sequence[str]]] = {
        name: (open_session(fingertip, name), (name,)) for name, fingertip in config.fingertips.items()
    }
    if config.combined is not None:
        combined = open_combined(config.combined, config.fingertips)
        found[COMBINED] = combined, combined.calibration.sides
    return {name: opened for name, opened in found.items() if opened[0].calibration.measures_torque}
