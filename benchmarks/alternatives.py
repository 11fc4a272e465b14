"""Loops that the twist controller is compared with: what one would write first. Never used on a robot."""

from dataclasses import dataclass

from shearloop.daemon.control.controller import AngleHistory, WristCommand


@dataclass(slots=True, kw_only=True)
class HeldSpeed:
    """PI without a compensator: a wrist speed in proportion to the latest torque error, held until the next one.

    kp is the share of an error that one period at the held speed makes up for.
    """

    stiffness_nm_per_rad: float
    sample_period_s: float
    kp: float
    ki: float = 0.0
    set_point_nm: float = 0.0
    speed_limit_rad_per_s: float = float("inf")
    _speed: float = 0.0
    _creep_nm: float = 0.0

    def measure(self, torque_nm: float | None, t_mid_ns: int, t_ns: int) -> None:  # noqa: ARG002  (the controller's)
        """Take in a torque, whenever it was measured."""
        if torque_nm is None:
            return
        error = self.set_point_nm - torque_nm
        self._creep_nm += self.ki * error
        speed = (self.kp * error + self._creep_nm) / (self.stiffness_nm_per_rad * self.sample_period_s)
        self._speed = max(-self.speed_limit_rad_per_s, min(self.speed_limit_rad_per_s, speed))

    def command(self, t_ns: int, wrist_angle_rad: float) -> WristCommand:  # noqa: ARG002  (the controller's)
        """Return the held speed."""
        return WristCommand(self._speed)


@dataclass(slots=True, kw_only=True)
class LateCorrection:
    """The twist controller without its compensator: each torque is taken for the present one.

    The difference from the present set point is what corrects; wrist loop, ramp and feed-forward are the same.
    """

    stiffness_nm_per_rad: float
    kp: float
    ki: float = 0.0
    wrist_bandwidth_per_s: float = 5.0
    ramp_nm_per_s: float = float("inf")
    speed_limit_rad_per_s: float = float("inf")
    set_point_nm: float = 0.0
    _ramp_nm: float = 0.0
    _offset_nm: float = 0.0
    _creep_nm: float = 0.0
    _origin_rad: float | None = None
    _t_ns: int = 0

    def measure(self, torque_nm: float | None, t_mid_ns: int, t_ns: int) -> None:  # noqa: ARG002  (the controller's)
        """Take in a torque, whenever it was measured."""
        if torque_nm is None:
            return
        excess = torque_nm - self._ramp_nm
        self._creep_nm += self.ki * excess
        self._offset_nm += self.kp * excess + self._creep_nm

    def command(self, t_ns: int, wrist_angle_rad: float) -> WristCommand:
        """Return the speed towards the corrected angle."""
        if self._origin_rad is None:
            self._origin_rad, self._t_ns = wrist_angle_rad, t_ns
        most = self.ramp_nm_per_s * (t_ns - self._t_ns) / 1e9 if t_ns > self._t_ns else 0.0
        self._t_ns = t_ns
        self._ramp_nm += max(-most, min(most, self.set_point_nm - self._ramp_nm))
        goal = self._origin_rad + (self._ramp_nm - self._offset_nm) / self.stiffness_nm_per_rad
        speed = self.wrist_bandwidth_per_s * (goal - wrist_angle_rad)
        return WristCommand(max(-self.speed_limit_rad_per_s, min(self.speed_limit_rad_per_s, speed)))


@dataclass(slots=True, kw_only=True)
class LatestPredicted:
    """The simplest compensator: the latest torque, carried on by the angle turned since it was measured.

    torque now = y + K·(θ(now) − mean θ over the acquisition); speed = rate·(r − torque now)/K. kp is the share of
    an error that is made up for in one period, and with it of each measurement's noise.
    """

    stiffness_nm_per_rad: float
    window_s: float
    rate_per_s: float
    ramp_nm_per_s: float = float("inf")
    speed_limit_rad_per_s: float = float("inf")
    set_point_nm: float = 0.0
    _ramp_nm: float = 0.0
    _torque_nm: float = 0.0
    _then_rad: float | None = None
    _t_ns: int = -1
    _history: AngleHistory | None = None

    def measure(self, torque_nm: float | None, t_mid_ns: int, t_ns: int) -> None:  # noqa: ARG002  (the controller's)
        """Take in a torque and the angle that belongs to it."""
        half_ns = round(0.5e9 * self.window_s)
        angle = self._history.mean(t_mid_ns - half_ns, t_mid_ns + half_ns) if self._history else None
        if torque_nm is not None and angle is not None:
            self._torque_nm, self._then_rad = torque_nm, angle

    def command(self, t_ns: int, wrist_angle_rad: float) -> WristCommand:
        """Return the speed towards the set point, from the torque as it should be now."""
        if self._history is None:
            self._history, self._t_ns = AngleHistory(5_000_000_000), t_ns
        self._history.add(t_ns, wrist_angle_rad)
        if self._then_rad is None:
            return WristCommand(0.0)
        most = self.ramp_nm_per_s * (t_ns - self._t_ns) / 1e9 if t_ns > self._t_ns else 0.0
        self._t_ns = t_ns
        step = max(-most, min(most, self.set_point_nm - self._ramp_nm))
        self._ramp_nm += step
        now_nm = self._torque_nm + self.stiffness_nm_per_rad * (wrist_angle_rad - self._then_rad)
        slope = step / (most / self.ramp_nm_per_s) if most > 0.0 else 0.0
        speed = (self.rate_per_s * (self._ramp_nm - now_nm) + slope) / self.stiffness_nm_per_rad
        return WristCommand(max(-self.speed_limit_rad_per_s, min(self.speed_limit_rad_per_s, speed)))
