"""The twist controller: late, noisy torque measurements become a wrist speed, up to 125 times a second.

The tool in the grip is a torsion spring on a wrist with a known angle: torque = K·(θ − θ₀) + d. The offset d covers all
that the spring does not explain (relaxation, hysteresis, slip, a wrong K). Only d is learnt from the torque sensor
(`TorqueFilter`). The other terms are known without delay.

- A measurement y belongs to a past time t_mid (an EIT frame: the middle of its acquisition). It is compared with the
  torque expected *at that time*: ν = y − K·(mean of θ over the acquisition − θ₀) − d. This is the delay compensator,
  the internal-model form of Smith's predictor (Smith 1957; Garcia & Morari, "Internal Model Control. 1", Ind. Eng.
  Chem. Process Des. Dev. 21, 1982) with the *measured* angle, not a simulated one. Each measurement has its own delay,
  a dropped frame only postpones the next correction, and clipped commands or a slow wrist are no modelling error.
- A PI controller in incremental form adds ν to d: i ← i + ki·ν, d ← d + kp·ν + i. (An α-β filter, the steady
  Kalman filter of a drifting offset: Kalata 1984.) i is the drift of the torque at a fixed angle.
- kp is the minimum gain. If the noise σ and the error of K (σ_K) allow more, the gain is the Kalman filter's,
  s²/(s² + σ²), with s² = p·σ² + σ_K²·(θ − θ_d)². So d is a weighted mean of measurements: θ_d is the same mean of their
  angles, and p the sum of the squared weights. s² is the variance of the filtered torque at θ.
- After a jump, which two CUSUM tests of ν detect, d restarts from the mean of the measurements since then. The jump
  began where its likelihood is greatest (Willsky & Jones, IEEE Trans. Automatic Control 21, 1976).
- The wrist turns to the angle at which the expected torque equals the ramp r: speed = bandwidth·(r − torque)/K,
  with feed-forward of the ramp, ṙ/K.

Wind-up: the expectation uses the measured angle, so d does not wind up while a command is clipped (the observer form of
anti-windup: Åström & Wittenmark, Computer-Controlled Systems). The ramp is no faster than the commanded turn of the
wrist, and i does not change while the sent speed is below the wanted speed.
"""

import math
from bisect import bisect_left, bisect_right
from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum
from statistics import fmean
from typing import Self

import numpy as np

from shearloop.daemon.loop_config import LoopConfig
from shearloop.daemon.torques import TorqueSample
from shearloop.words import beyond

# The ramp does not catch up when the loop was late for longer than this.
LONGEST_STEP_NS = 50_000_000
# A rest ends at the deadband, a motion at this fraction of it: the hysteresis keeps noise from toggling the two.
_SETTLED_FRACTION = 0.1
# CUSUM test for jumps, in standard deviations: the slack per innovation, the threshold of the sum, and the bound of an
# innovation, which keeps one wild value below the threshold.
_JUMP_SLACK, _JUMP_SUM, _JUMP_BOUND = 1.2, 5.0, 5.0
# The offset restarts from at most this many measurements after a jump.
_MAX_SINCE_JUMP = 5
# Stands for no measurement at all.
_UNKNOWN = 1e-6
# A drift is extrapolated over at most this many dropped measurements.
_MAX_MISSED = 4


@dataclass(frozen=True, slots=True)
class WristLimit:
    """The wrist's largest speed, and how fast it may speed up, for all speeds that the daemon forms.

    The worker and the script on the robot check the speeds again.
    """

    speed_rad_per_s: float
    acceleration_rad_per_s2: float

    @classmethod
    def of(cls, config: LoopConfig) -> Self:
        """Return the limit that the loop plans with."""
        return cls(config.wrist_speed_rad_per_s, config.planned_acceleration_rad_per_s2)

    def clip(self, wanted_rad_per_s: float) -> float:
        """Return the wanted speed, or the largest one in its direction."""
        return max(-self.speed_rad_per_s, min(self.speed_rad_per_s, wanted_rad_per_s))

    def speed_up(self, sent_rad_per_s: float, wanted_rad_per_s: float, elapsed_s: float) -> float:
        """Return the speed after `elapsed_s` on the way from the sent to the wanted speed; braking is not limited."""
        turning = abs(sent_rad_per_s) if wanted_rad_per_s * sent_rad_per_s > 0.0 else 0.0
        fastest = turning + self.acceleration_rad_per_s2 * elapsed_s
        return math.copysign(min(abs(wanted_rad_per_s), fastest), wanted_rad_per_s)


@dataclass(frozen=True, slots=True, kw_only=True)
class ControllerSettings:
    """A controller's settings for one tool; `margin_refusal` judges them."""

    # Of the tool in the grip, as identified: torque over wrist angle.
    stiffness_nm_per_rad: float
    # Its standard deviation.
    stiffness_std_nm_per_rad: float = 0.0
    # Of the driving torque: how often it comes, and how long one measurement averages.
    sample_period_s: float
    window_s: float
    # By how much the torque lags behind its own stamp, as identified; 0 where the stamps are right.
    lag_s: float = 0.0
    # Fractions of an innovation: taken up at once, and per measurement from then on.
    kp: float
    ki: float
    wrist_bandwidth_per_s: float
    ramp_nm_per_s: float
    # The wrist rests until the expected torque is this far from the set point.
    deadband_nm: float
    # Standard deviation of one measurement; 0 turns the detection of jumps off.
    noise_nm: float = 0.0
    # Innovations are clipped to this.
    innovation_limit_nm: float = math.inf
    # Bound on the integral: how fast the torque at a fixed angle may drift.
    creep_limit_nm_per_s: float = math.inf
    # The wrist is held when the torque at a fixed angle has moved by this much: slip, or a screw that broke loose.
    offset_limit_nm: float = math.inf
    wrist_limit: WristLimit
    # From the angle at the start, either way.
    travel_limit_rad: float
    # A measurement that is older than this on arrival is refused.
    age_limit_s: float
    # Without a measurement for this time after the latest arrival the wrist is held.
    fresh_s: float


class ControllerReason(StrEnum):
    """Why the wrist does not follow the torque; the text is for the operator."""

    NOT_MEASURED = "the controller has just begun and waits for its first torque"
    STALE = "the torque is stale: no valid measurement has come for too long"
    NOT_FOLLOWING = "the torque no longer follows the wrist: the grip slips, or the screw broke loose or stripped"
    TRAVEL = "the wrist has reached the limit of its travel"
    SPEED = "the wrist turns at its speed limit"


@dataclass(frozen=True, slots=True)
class WristCommand:
    """The wrist speed for now, and all reasons for a difference from the set point."""

    speed_rad_per_s: float = 0.0
    reasons: tuple[str, ...] = ()


class AngleHistory:
    """Wrist angles of the last `span_ns`, interpolated linearly.

    A frame acquired over half a second sees the mean torque, so it is compared with the mean angle over that time.
    """

    def __init__(self, span_ns: int) -> None:
        self.span_ns = span_ns
        self._t_ns: list[int] = []
        self._angle_rad: list[float] = []

    def add(self, t_ns: int, angle_rad: float) -> bool:
        """Append an angle; return False, and drop it, if it is not later than the last one."""
        if self._t_ns and t_ns <= self._t_ns[-1]:
            return False
        self._t_ns.append(t_ns)
        self._angle_rad.append(angle_rad)
        # One sample is kept from before the span, for its beginning.
        old = max(bisect_right(self._t_ns, t_ns - self.span_ns) - 1, 0)
        del self._t_ns[:old], self._angle_rad[:old]
        return True

    def mean(self, from_ns: int, to_ns: int) -> float | None:
        """Return the mean angle in rad between two times; None where the history does not cover the interval."""
        if not self._t_ns or from_ns < self._t_ns[0] or to_ns > self._t_ns[-1] or to_ns < from_ns:
            return None
        inside = slice(bisect_right(self._t_ns, from_ns), bisect_left(self._t_ns, to_ns))
        times_ns = [from_ns, *self._t_ns[inside], to_ns]
        angles_rad = np.interp(times_ns, self._t_ns, self._angle_rad)
        if to_ns == from_ns:
            return float(angles_rad[0])
        return float(0.5 * (angles_rad[1:] + angles_rad[:-1]) @ np.diff(times_ns)) / (to_ns - from_ns)


class JumpDetector:
    """Two CUSUM tests (Page 1954) for a lasting jump of the torque, one for each direction."""

    def __init__(self) -> None:
        self._sums = [0.0, 0.0]
        # The latest offsets since each sum was 0, which is where a jump would have begun.
        self._offsets_nm: list[list[float]] = [[], []]

    def add(self, innovation_sigmas: float, offset_nm: float) -> list[float]:
        """Take an innovation in standard deviations, and its offset; return the latest offsets of a jump, else []."""
        bounded = max(-_JUMP_BOUND, min(_JUMP_BOUND, innovation_sigmas))
        for number, deviation in enumerate((bounded, -bounded)):
            self._sums[number] = max(self._sums[number] + deviation - _JUMP_SLACK, 0.0)
            since_nm = [*self._offsets_nm[number], offset_nm] if self._sums[number] else []
            self._offsets_nm[number] = since_nm[-_MAX_SINCE_JUMP:]
        if max(self._sums) <= _JUMP_SUM:
            return []
        jumped = self._offsets_nm[self._sums.index(max(self._sums))]
        self._sums, self._offsets_nm = [0.0, 0.0], [[], []]
        return jumped


class TorqueFilter:
    """Fuses wrist angles, stiffness and late torques into one torque with its variance. Times: CLOCK_MONOTONIC ns."""

    def __init__(
        self, settings: ControllerSettings, t_ns: int, angle_rad: float, torque_nm: float, known_measurements: float
    ) -> None:
        """Begin at a wrist angle and its torque, known as well as the mean of `known_measurements`."""
        self.offset_nm = torque_nm
        # Of the torque at a fixed angle, from one measurement to the next.
        self.drift_nm = 0.0
        # The arrival of the latest measurement.
        self.fresh_ns: int | None = None
        # The torque at a fixed angle has moved too far since the loop was closed.
        self.slipped = False
        span_s = settings.age_limit_s + settings.window_s + settings.lag_s
        self.angles = AngleHistory(int(1e9 * (span_s + 1.0)))
        self.angles.add(t_ns, angle_rad)
        self.origin_rad = angle_rad
        self._settings = settings
        self._reference_nm = torque_nm
        # The offset is a weighted mean of measurements: its variance relative to one measurement, and their mean angle.
        self._variance_ratio, self._mean_angle_rad = 1.0 / max(known_measurements, _UNKNOWN), angle_rad
        self._jumps = JumpDetector()
        self._t_mid_ns = t_ns

    def expected_nm(self, angle_rad: float) -> float:
        """Return the tool's torque at a wrist angle."""
        return self._settings.stiffness_nm_per_rad * (angle_rad - self.origin_rad) + self.offset_nm

    def std_nm(self, angle_rad: float) -> float:
        """Return the standard deviation of `expected_nm` that noise and the stiffness's error cause."""
        from_noise_nm = math.sqrt(self._variance_ratio) * self._settings.noise_nm
        turned_rad = angle_rad - self._mean_angle_rad
        return math.hypot(from_noise_nm, self._settings.stiffness_std_nm_per_rad * turned_rad)

    @property
    def not_following(self) -> str:
        """By how much the torque at one angle has moved since the loop was closed; empty unless that is too much."""
        if not self.slipped:
            return ""
        moved_nm, limit_nm = self.offset_nm - self._reference_nm, self._settings.offset_limit_nm
        return f"at one angle it moved by {beyond(moved_nm, limit_nm, 3, '+')} N·m, and {limit_nm:g} are allowed"

    def measure(self, torque_nm: float | None, t_mid_ns: int, t_ns: int, *, integrates: bool = True) -> bool:
        """Use a torque of the time t_mid_ns that arrived at t_ns; return whether it can be used.

        It cannot if it is not valid, not later than the one before, stamped in the future, too old, or from a time at
        which the wrist angle is not known. The drift is learnt while the loop `integrates`.
        """
        settings = self._settings
        if torque_nm is None or not self._t_mid_ns < t_mid_ns <= t_ns:
            return False
        if t_ns - t_mid_ns > settings.age_limit_s * 1e9:
            return False
        middle_ns, half_ns = t_mid_ns - int(settings.lag_s * 1e9), int(settings.window_s * 0.5e9)
        angle = self.angles.mean(middle_ns - half_ns, middle_ns + half_ns)
        if angle is None:
            return False
        missed = min(round((t_mid_ns - self._t_mid_ns) * 1e-9 / settings.sample_period_s) - 1, _MAX_MISSED)
        if self.fresh_ns is not None and missed > 0:
            self.offset_nm += self.drift_nm * missed
        self._correct(torque_nm - self.expected_nm(angle), angle, integrates=integrates)
        self.slipped |= abs(self.offset_nm - self._reference_nm) > settings.offset_limit_nm
        self._t_mid_ns, self.fresh_ns = t_mid_ns, t_ns
        return True

    def _correct(self, innovation_nm: float, angle_rad: float, *, integrates: bool) -> None:
        """Correct the offset by an innovation at a mean angle: by its Kalman gain, or all of it after a jump."""
        settings = self._settings
        turned_rad = angle_rad - self._mean_angle_rad
        # s²/σ² of the module's docstring.
        ratio = self._variance_ratio
        if settings.noise_nm:
            ratio += (settings.stiffness_std_nm_per_rad * turned_rad / settings.noise_nm) ** 2
            sigmas = innovation_nm / (settings.noise_nm * math.sqrt(1.0 + ratio))
            if jumped := self._jumps.add(sigmas, self.offset_nm + innovation_nm):
                self._jump(jumped, angle_rad)
                return
        gain = max(settings.kp, ratio / (1.0 + ratio))
        bounded = max(-settings.innovation_limit_nm, min(settings.innovation_limit_nm, innovation_nm))
        if gain == settings.kp and integrates:
            most = settings.creep_limit_nm_per_s * settings.sample_period_s
            self.drift_nm = max(-most, min(most, self.drift_nm + settings.ki * bounded))
        self.offset_nm += gain * bounded + self.drift_nm
        self._variance_ratio = (1.0 - gain) ** 2 * self._variance_ratio + gain**2
        self._mean_angle_rad += gain * turned_rad

    def _jump(self, offsets_nm: list[float], angle_rad: float) -> None:
        """Restart from the mean of the latest offsets, as many as most likely came after the jump."""

        def sigmas(count: int) -> float:
            return math.sqrt(count) * abs(fmean(offsets_nm[-count:]) - self.offset_nm)

        count = max(range(1, len(offsets_nm) + 1), key=sigmas)
        self.offset_nm = fmean(offsets_nm[-count:])
        self._variance_ratio, self._mean_angle_rad = 1.0 / count, angle_rad


class TorqueController:
    """Drives the wrist so that the tool's torque reaches and keeps a set point. Times are CLOCK_MONOTONIC ns."""

    def __init__(
        self,
        settings: ControllerSettings,
        t_ns: int,
        angle_rad: float,
        torque_nm: float,
        known_measurements: float = 0.0,
    ) -> None:
        """Begin at a wrist angle and its torque, known as well as the mean of `known_measurements`.

        The first measurements are averaged with that torque (gain 1/(n+1)) until kp is the greater gain. The torque is
        kept until `change_set_point`.
        """
        self.settings = settings
        self.filter = TorqueFilter(settings, t_ns, angle_rad, torque_nm, known_measurements)
        # The filtered torque at the latest command.
        self.torque_nm = torque_nm
        self._moving = False
        self.set_point_nm = self.ramp_nm = torque_nm
        self._angle_rad = angle_rad
        self._t_ns = t_ns
        # The latest command before and after clipping; `sent` replaces the second by what was sent.
        self._wanted_rad_per_s = self._speed_rad_per_s = 0.0
        # Less was sent than was wanted; nothing is integrated then.
        self._clipped = False

    @property
    def torque_std_nm(self) -> float:
        """The standard deviation of the filtered torque at the latest command."""
        return self.filter.std_nm(self._angle_rad)

    def change_set_point(self, torque_nm: float, settings: ControllerSettings | None = None) -> None:
        """Change the set point; the ramp continues. `settings` count from this set point on, if its ramp differs."""
        self.settings = settings or self.settings
        self.set_point_nm = torque_nm

    def resume(self) -> None:
        """Continue after a hold without commands; the ramp restarts at the present torque.

        The reference of the offset stays: a grip that slips a little before each of many holds has slipped far.
        """
        self._rest()

    def measure(self, torque: TorqueSample) -> bool:
        """Use a torque; return whether it can be used.

        Of a friction band, the torque that is nearest to the expected one counts.
        """
        torque_nm = torque.torque_nm
        if torque_nm is not None and torque.low_nm is not None and torque.high_nm is not None:
            torque_nm = min(max(self.filter.expected_nm(self._angle_rad), torque.low_nm), torque.high_nm)
        return self.filter.measure(torque_nm, torque.t_mid_ns, torque.t_ns, integrates=not self._clipped)

    def command(self, t_ns: int, wrist_angle_rad: float, torques: Iterable[TorqueSample] = ()) -> WristCommand:
        """Return the wrist speed for now, from the angle that the robot reports and new torques.

        The torques come after the angle, which their windows need, and before the decision. The speed is 0 while
        anything forbids motion, and never exceeds the limit. It counts as sent until `sent` corrects it.
        """
        tool = self.filter
        elapsed_s = min(max(t_ns - self._t_ns, 0), LONGEST_STEP_NS) / 1e9
        self._t_ns = max(t_ns, self._t_ns)
        self._angle_rad = wrist_angle_rad
        tool.angles.add(t_ns, wrist_angle_rad)
        for torque in torques:
            self.measure(torque)
        self.torque_nm = tool.expected_nm(self._angle_rad)
        reasons = []
        if tool.fresh_ns is None:
            reasons.append(ControllerReason.NOT_MEASURED)
        elif t_ns - tool.fresh_ns > self.settings.fresh_s * 1e9:
            reasons.append(ControllerReason.STALE)
        if tool.slipped:
            reasons.append(ControllerReason.NOT_FOLLOWING)
        if reasons:
            self._rest()
            return WristCommand(0.0, tuple(reasons))
        return self._drive(elapsed_s)

    def sent(self, speed_rad_per_s: float) -> None:
        """Correct the speed that was sent for the last command, after clipping by driver and safety."""
        self._speed_rad_per_s = speed_rad_per_s
        is_slower = abs(self._speed_rad_per_s) < abs(self._wanted_rad_per_s)
        self._clipped = is_slower and abs(self._speed_rad_per_s - self._wanted_rad_per_s) > 1e-9

    def _rest(self) -> None:
        """Stand still; the next ramp begins at the present torque."""
        self._moving = self._clipped = False
        self._wanted_rad_per_s = self._speed_rad_per_s = 0.0
        self.ramp_nm = self.torque_nm

    def _drive(self, elapsed_s: float) -> WristCommand:
        settings = self.settings
        slope_nm_per_s = self._ramp_slope(elapsed_s)
        self.ramp_nm += slope_nm_per_s * elapsed_s
        missing_nm = self.ramp_nm - self.torque_nm
        bound_nm = settings.deadband_nm * (_SETTLED_FRACTION if self._moving else 1.0)
        self._moving = slope_nm_per_s != 0.0 or abs(missing_nm) > bound_nm
        wanted_rad_per_s = 0.0
        if self._moving:
            wanted_nm_per_s = settings.wrist_bandwidth_per_s * missing_nm + slope_nm_per_s
            wanted_rad_per_s = wanted_nm_per_s / settings.stiffness_nm_per_rad
        clipped_rad_per_s = settings.wrist_limit.clip(wanted_rad_per_s)
        reasons = [ControllerReason.SPEED] if clipped_rad_per_s != wanted_rad_per_s else []
        speed_rad_per_s = settings.wrist_limit.speed_up(self._speed_rad_per_s, clipped_rad_per_s, elapsed_s)
        # Slow down towards the limit of the travel, so that one period does not overshoot it.
        travel_rad = self._angle_rad - self.filter.origin_rad
        room_rad = max(settings.travel_limit_rad - travel_rad * math.copysign(1.0, speed_rad_per_s), 0.0)
        brakeable_rad_per_s = settings.wrist_bandwidth_per_s * room_rad
        if abs(speed_rad_per_s) > brakeable_rad_per_s:
            reasons.append(ControllerReason.TRAVEL)
            speed_rad_per_s = math.copysign(brakeable_rad_per_s, speed_rad_per_s)
        self._wanted_rad_per_s, self._speed_rad_per_s = wanted_rad_per_s, speed_rad_per_s
        self._clipped = abs(wanted_rad_per_s) - abs(speed_rad_per_s) > 1e-9
        return WristCommand(speed_rad_per_s, tuple(reasons))

    def _ramp_slope(self, elapsed_s: float) -> float:
        """Return the ramp's slope in N·m/s: it moves no further than the wrist was commanded to turn."""
        settings = self.settings
        blocked = self._speed_rad_per_s == 0.0 and self._wanted_rad_per_s != 0.0
        if blocked or elapsed_s <= 0.0:
            return 0.0
        missing_nm = self.set_point_nm - self.ramp_nm
        towards = math.copysign(1.0, missing_nm)
        speed_up_rad_per_s = settings.wrist_limit.acceleration_rad_per_s2 * elapsed_s
        turning_rad_per_s = max(self._speed_rad_per_s * towards, 0.0) + speed_up_rad_per_s
        slope_nm_per_s = min(
            settings.ramp_nm_per_s, settings.stiffness_nm_per_rad * turning_rad_per_s, abs(missing_nm) / elapsed_s
        )
        return towards * slope_nm_per_s
