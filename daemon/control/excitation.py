"""The identification step: a small wrist programme that excites the tool, within limits, until it is known."""

import math
from collections import deque
from dataclasses import dataclass, fields

import numpy as np

from shearloop.daemon.control.identify import IdentifyError, NotYetKnownError, Record, ToolModel, identify
from shearloop.daemon.errors import UserError

_ARRIVED_RAD = 2e-3


@dataclass(frozen=True, slots=True, kw_only=True)
class ExciteSettings:
    """How to shake the tool: back and forth between its first angle and `amplitude_rad` away (the sign says where).

    The first swing goes half as far. Ends when the stiffness is known to `stiffness_share`, and fails after
    `most_cycles` without that. Raises UserError for a value out of its range.
    """

    amplitude_rad: float
    sample_period_s: float
    window_s: float
    torque_limit_nm: float
    stiffness_share: float = 0.03
    worst_stiffness_share: float = 0.1
    speed_rad_per_s: float = 0.5
    acceleration_rad_per_s2: float = 2.0
    bandwidth_per_s: float = 5.0
    dwell_s: float = 2.5
    fewest_cycles: int = 2
    most_cycles: int = 8

    def __post_init__(self) -> None:
        """Refuse what cannot be meant."""
        for item in fields(self):
            value = getattr(self, item.name)
            if not math.isfinite(value) or (value <= 0 and item.name not in ("amplitude_rad", "window_s")):
                raise UserError(f"identify: {item.name} is {value!r}, and must be a number above 0")
        if self.amplitude_rad == 0.0 or self.window_s < 0.0:
            raise UserError("identify: amplitude_rad must not be 0, and window_s must not be negative")


class StiffnessExcitation:
    """Turns the wrist, listens, and knows the tool at the end. Times are CLOCK_MONOTONIC ns; no I/O.

    `command` gives the speed to send until `done`; then `result` holds what was found, or `failure` says why not.
    """

    def __init__(self, settings: ExciteSettings) -> None:
        self.settings = settings
        self.result: ToolModel | None = None
        self.failure: str | None = None
        self._origin_ns = 0
        self._angles: list[tuple[float, float]] = []
        self._sent: list[tuple[float, float]] = []
        self._torques: list[tuple[float, float, float]] = []
        self._latest: deque[float] = deque(maxlen=3)
        self._leg = 0  # even: at the first angle; odd: away
        self._arrived_s: float | None = None
        self._speed = 0.0

    @property
    def done(self) -> bool:
        """Return whether the step has ended, well or not."""
        return self.result is not None or self.failure is not None

    def measure(self, torque_nm: float | None, t_mid_ns: int, t_ns: int) -> None:
        """Take in a torque; a value that is missing or not a number, or comes out of order, is left out."""
        if torque_nm is None or not math.isfinite(torque_nm) or not self._angles:
            return
        t_mid_s = (t_mid_ns - self._origin_ns) / 1e9
        if self._torques and t_mid_s <= self._torques[-1][0]:
            return
        self._torques.append((t_mid_s, (t_ns - self._origin_ns) / 1e9, torque_nm))
        self._latest.append(torque_nm)
        # The mean of three, so that the noise of one does not end the step.
        mean = sum(self._latest) / len(self._latest)
        if abs(mean) > self.settings.torque_limit_nm and len(self._latest) == self._latest.maxlen:
            self.failure = (
                f"identify: the torque has reached {mean:.3g} N·m and the limit of the step is "
                f"{self.settings.torque_limit_nm:g} N·m; turn less than {self.settings.amplitude_rad:g} rad"
            )

    def command(self, t_ns: int, wrist_angle_rad: float) -> float:
        """Return the wrist speed for now in rad/s; 0 once done, or while the wrist angle is not a number."""
        if self.done or not math.isfinite(wrist_angle_rad):
            self._speed = 0.0
            return 0.0
        if not self._angles:
            self._origin_ns = t_ns
        now_s = (t_ns - self._origin_ns) / 1e9
        elapsed_s = now_s - self._angles[-1][0] if self._angles else 0.0
        if self._angles and elapsed_s <= 0.0:
            return self._speed
        self._angles.append((now_s, wrist_angle_rad))
        self._speed = self._towards(self._goal_rad() - wrist_angle_rad, now_s, min(elapsed_s, 0.05))
        self._sent.append((now_s, self._speed))
        return self._speed

    def sent(self, speed_rad_per_s: float) -> None:
        """Tell what was really sent for the last command, after all clipping."""
        if self._sent and math.isfinite(speed_rad_per_s):
            self._speed = speed_rad_per_s
            self._sent[-1] = (self._sent[-1][0], speed_rad_per_s)

    def _goal_rad(self) -> float:
        first = self._angles[0][1]
        if self._leg % 2 == 0:
            return first
        return first + self.settings.amplitude_rad * (0.5 if self._leg == 1 else 1.0)

    def _towards(self, missing_rad: float, now_s: float, elapsed_s: float) -> float:
        own = self.settings
        if abs(missing_rad) < _ARRIVED_RAD:
            if self._arrived_s is None:
                self._arrived_s = now_s
            # Dwells of different lengths, so that measurements meet the swings at different phases; the first one is
            # twice as long, because all that follows is compared with it to see whether the tool has slipped.
            dwell_s = own.dwell_s * (1.0 if self._leg else 2.0) + (self._leg % 4) * 0.25 * own.sample_period_s
            if now_s - self._arrived_s >= dwell_s:
                self._end_leg()
            return 0.0
        speed = max(-own.speed_rad_per_s, min(own.speed_rad_per_s, own.bandwidth_per_s * missing_rad))
        turning = abs(self._speed) if self._speed * speed > 0.0 else 0.0
        return math.copysign(min(abs(speed), turning + own.acceleration_rad_per_s2 * elapsed_s), speed)

    def _end_leg(self) -> None:
        self._leg, self._arrived_s = self._leg + 1, None
        cycles, rests = divmod(self._leg - 1, 2)
        if self._leg % 2 == 0 or cycles < self.settings.fewest_cycles or rests:
            return
        last = cycles >= self.settings.most_cycles
        share = self.settings.worst_stiffness_share if last else self.settings.stiffness_share
        try:
            self.result = identify(self.record(), self.settings.window_s, share)
        except NotYetKnownError as error:
            self.failure = str(error) if last else None
        except IdentifyError as error:
            self.failure = str(error)

    def record(self) -> Record:
        """Return everything that was seen so far."""
        angles, sent = np.array(self._angles).reshape(-1, 2), np.array(self._sent).reshape(-1, 2)
        torques = np.array(self._torques).reshape(-1, 3)
        return Record(
            angle_t_s=angles[:, 0],
            angle_rad=angles[:, 1],
            sent_t_s=sent[:, 0],
            sent_rad_per_s=sent[:, 1],
            t_mid_s=torques[:, 0],
            t_s=torques[:, 1],
            torque_nm=torques[:, 2],
        )
