"""Identification: small twists excite the tool, and its stiffness, delay and noise are fitted to the record."""

import math
from dataclasses import dataclass
from statistics import fmean

import numpy as np

from shearloop.bank.arrays import FloatArray
from shearloop.daemon.control.torque_controller import WristLimit
from shearloop.daemon.loop_config import LoopConfig
from shearloop.daemon.torques import TorqueSource
from shearloop.errors import UserError
from shearloop.words import beyond

# The grid of the torque's lag behind its stamp.
_LAG_GRID_S = np.arange(-0.4, 1.0001, 0.02)
_ACTUATION_GRID_S = np.arange(0.0, 0.3001, 0.002)
_MIN_TORQUES = 12
_MIN_CYCLES = 2
# After the last swing, the stiffness may be this uncertain.
_WORST_STIFFNESS_FRACTION = 0.1
_NO_TURN_RAD = 1e-4
# The share of the angle's range that counts as rest, and the torque at rest that may be lost over the record.
_REST_FRACTION = 0.2
_SLIP_FRACTION = 0.3
# The residual beyond the noise, relative to the spring's part (relaxation gives about 0.1).
_MISFIT_FRACTION = 0.3
# The expected drift over the record, relative to the spring's part: relaxation.
_DRIFT_FRACTION = 0.04
_ARRIVED_RAD = 2e-3


class IdentifyError(UserError):
    """A record without a reliable result; the message has the numbers and the cure."""


class NotYetKnownError(IdentifyError):
    """A record that is too short: more twists would help."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Record:
    """Wrist angles, commanded speeds and tool torques; times in s from one origin, ascending.

    angle_t_s, angle_rad, sent_rad_per_s (n,): each angle, and the speed that was sent at it. t_mid_s, t_s, torque_nm
    (m,): middle of each acquisition, its arrival, and its torque.
    """

    angle_t_s: FloatArray
    angle_rad: FloatArray
    sent_rad_per_s: FloatArray
    t_mid_s: FloatArray
    t_s: FloatArray
    torque_nm: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class ToolModel:
    """The tool in the grip and the delays of its torque, with standard deviations.

    lag_s: lag of the torque behind its stamps. age_s: from the middle of an acquisition to its arrival (95th
    percentile). actuation_s: from sending a speed until the wrist has it. torque_nm: at angle_rad, the record's last
    angle.
    """

    stiffness_nm_per_rad: float
    stiffness_std: float
    lag_s: float
    lag_std_s: float
    age_s: float
    actuation_s: float
    noise_nm: float
    sample_period_s: float
    angle_rad: float
    torque_nm: float
    torque_std_nm: float

    @property
    def known_measurements(self) -> float:
        """The number of measurements that would give the torque's accuracy; at most 8."""
        return min((self.noise_nm / self.torque_std_nm) ** 2, 8.0) if self.torque_std_nm else 8.0

    @property
    def significant_lag_s(self) -> float:
        """The lag if it exceeds two standard deviations, else 0: no torque is measured before its cause."""
        return self.lag_s if self.lag_s > 2.0 * self.lag_std_s else 0.0


@dataclass(frozen=True, slots=True)
class _Fit:
    """Least squares of torque = stiffness·angle + offset + drift·time (0 at the end), residuals (m,).

    `equations` are their left sides, (m + 1, 3): the last one bounds the drift. The windows of
    `overlap` neighbouring torques overlap, so that they count as one measurement.
    """

    coefficients: FloatArray
    equations: FloatArray
    residuals: FloatArray
    overlap: int

    @property
    def angle_rad(self) -> FloatArray:
        return self.equations[:-1, 0]

    @property
    def squares(self) -> float:
        return float(self.residuals @ self.residuals)

    def covariance(self) -> FloatArray:
        degrees = self.residuals.size / self.overlap - self.coefficients.size
        return np.asarray(self.squares / degrees * np.linalg.pinv(self.equations.T @ self.equations), np.float64)

    def noise_nm(self) -> float:
        """Return the standard deviation of one torque, from torques without overlap (von Neumann 1941)."""
        differences = self.residuals[self.overlap :] - self.residuals[: -self.overlap]
        return float(min(np.sqrt(np.mean(differences**2) / 2.0), np.sqrt(np.mean(self.residuals**2))))


def identify(record: Record, window_s: float, stiffness_share: float = _WORST_STIFFNESS_FRACTION) -> ToolModel:
    """Return the tool model of a record of torques, each a mean over `window_s`.

    For every lag of a grid, the torques are fitted by least squares to the mean angles of their windows, with an offset
    and a small drift. The lag with the smallest residual wins, refined by a parabola; the curvature gives its standard
    deviation. Raises IdentifyError if the record is too short, the wrist turned too little for a stiffness known to
    `stiffness_share`, the tool slipped, or the torque does not follow a spring.
    """
    used = np.isfinite(record.torque_nm) & (record.t_mid_s - 0.5 * window_s > record.angle_t_s[0])
    period_s = float(np.median(np.diff(record.t_mid_s))) if record.t_mid_s.size > 1 else math.inf
    overlap = max(1, round(window_s / period_s))
    needed = _MIN_TORQUES * overlap
    if used.sum() < needed:
        raise NotYetKnownError(
            f"identify: {used.sum()} valid torques are too few to learn the stiffness from, {needed} are needed; "
            f"record for longer, and check why torques are missing"
        )
    t_mid_s, torque_nm = record.t_mid_s[used], record.torque_nm[used]
    # The wrist rests before the first motion and after the last. All lags at once, because the loop waits.
    lagged_s = (t_mid_s - _LAG_GRID_S[:, np.newaxis]).ravel()
    angles = window_means(record.angle_t_s, record.angle_rad, lagged_s, window_s).reshape(-1, t_mid_s.size)
    fits = [_fit(angle_rad, t_mid_s, torque_nm, overlap) for angle_rad in angles]
    best = min(fits, key=lambda fit: fit.squares)
    noise_nm = best.noise_nm()
    _refuse_bad(best, torque_nm, noise_nm, stiffness_share)
    lag_s, lag_std_s = _lag(fits, noise_nm)
    now, covariance = np.array([record.angle_rad[-1], 1.0, 0.0]), best.covariance()
    return ToolModel(
        stiffness_nm_per_rad=float(best.coefficients[0]),
        stiffness_std=math.sqrt(covariance[0, 0]),
        lag_s=lag_s,
        lag_std_s=lag_std_s,
        age_s=float(np.quantile(record.t_s[used] - t_mid_s, 0.95)),
        actuation_s=_actuation(record),
        noise_nm=noise_nm,
        sample_period_s=period_s,
        angle_rad=float(record.angle_rad[-1]),
        torque_nm=float(now @ best.coefficients),
        torque_std_nm=math.sqrt(now @ covariance @ now),
    )


def _fit(angle_rad: FloatArray, t_mid_s: FloatArray, torque_nm: FloatArray, overlap: int) -> _Fit:
    since = (t_mid_s - t_mid_s[-1]) / (t_mid_s[-1] - t_mid_s[0])
    design = np.column_stack([angle_rad, np.ones_like(angle_rad), since])
    degrees = torque_nm.size - design.shape[1]
    free = np.linalg.lstsq(design, torque_nm, rcond=None)[0]
    std = float(np.linalg.norm(torque_nm - design @ free)) / math.sqrt(degrees)
    # The expected size of the drift as one more equation: else noise passes for drift, and spoils the last torque.
    drift_nm = max(_DRIFT_FRACTION * abs(float(free[0])) * float(np.ptp(angle_rad)), 1e-9)
    bounded = np.vstack([design, [0.0, 0.0, std / drift_nm]])
    coefficients = np.linalg.lstsq(bounded, np.append(torque_nm, 0.0), rcond=None)[0]
    return _Fit(coefficients, bounded, torque_nm - design @ coefficients, overlap)


def window_means(t_s: FloatArray, values: FloatArray, middle_s: FloatArray, window_s: float) -> FloatArray:
    """Return the means (m,) of a broken line over windows around m times; the line stays constant beyond its ends."""
    integral = np.concatenate([[0.0], np.cumsum(0.5 * (values[1:] + values[:-1]) * np.diff(t_s))])

    def until(time_s: FloatArray) -> FloatArray:
        last = np.maximum(np.searchsorted(t_s, time_s, side="right") - 1, 0)
        here = np.interp(time_s, t_s, values)
        return np.asarray(integral[last] + 0.5 * (values[last] + here) * (time_s - t_s[last]))

    half_s = max(0.5 * window_s, 1e-6)
    return (until(middle_s + half_s) - until(middle_s - half_s)) / (2.0 * half_s)


def _refuse_bad(fit: _Fit, torque_nm: FloatArray, noise_nm: float, stiffness_share: float) -> None:
    stiffness, std = float(fit.coefficients[0]), math.sqrt(fit.covariance()[0, 0])
    turned = float(np.ptp(fit.angle_rad))
    if turned < _NO_TURN_RAD:
        raise IdentifyError("identify: the wrist did not turn, so the stiffness is unknown")
    if stiffness < -2.0 * std:
        raise IdentifyError(
            f"identify: the torque falls by {-stiffness:.3g} N·m for each rad that the wrist turns; the sign of torque "
            f"or wrist angle is wrong"
        )
    lost, lost_std = _lost_at_rest(fit, torque_nm, noise_nm)
    if lost > max(_SLIP_FRACTION * abs(stiffness) * turned, 3.5 * lost_std):
        raise IdentifyError(
            f"identify: back at its first angle the torque is {lost:.3g} N·m lower than before: the tool slipped in "
            f"the grip (grip harder, or turn less than {turned:.2g} rad), or the torque itself errs by as much (drive "
            "by the load cell, or calibrate the fingertip better)"
        )
    if stiffness <= 0.0 or std > stiffness_share * stiffness:
        raise NotYetKnownError(
            f"identify: turning {turned:.2g} rad gives a stiffness of {stiffness:.3g} ± {std:.2g} N·m/rad, and it must "
            f"be known to {100 * stiffness_share:.3g} %; turn farther, or more often (noise {noise_nm:.2g} N·m)"
        )
    misfit = math.sqrt(max(float(np.mean(fit.residuals**2)) - noise_nm**2, 0.0))
    explained = stiffness * float(np.std(fit.angle_rad))
    if misfit > _MISFIT_FRACTION * explained:
        raise IdentifyError(
            f"identify: a spring of {stiffness:.3g} N·m/rad leaves {misfit:.2g} N·m of the torque unexplained and "
            f"explains {explained:.2g}; check for slip, play or a saturated torque sensor"
        )


def _lost_at_rest(fit: _Fit, torque_nm: FloatArray, noise_nm: float) -> tuple[float, float]:
    """Return the loss of torque at the first angle, from before the first motion to after the last, and its std."""
    away = np.flatnonzero(np.abs(fit.angle_rad - fit.angle_rad[0]) > _REST_FRACTION * np.ptp(fit.angle_rad))
    before, after = torque_nm[: away[0]], torque_nm[away[-1] + 1 :]
    if before.size < 2 or after.size < 2:
        return 0.0, 0.0
    of_means = fit.overlap * (1.0 / before.size + 1.0 / after.size)
    return float(before.mean() - after.mean()), noise_nm * math.sqrt(of_means)


def _lag(fits: list[_Fit], noise_nm: float) -> tuple[float, float]:
    """Return the lag of the smallest residual, and its standard deviation from the curvature."""
    squares = np.array([fit.squares for fit in fits])
    at = int(np.clip(np.argmin(squares), 2, len(fits) - 3))
    near = slice(at - 2, at + 3)
    curve = np.polyfit(_LAG_GRID_S[near] - _LAG_GRID_S[at], squares[near], 2)
    if curve[0] <= 0.0:
        return float(_LAG_GRID_S[at]), math.inf
    offset = float(np.clip(-curve[1] / (2.0 * curve[0]), -0.04, 0.04))
    return float(_LAG_GRID_S[at]) + offset, noise_nm * math.sqrt(fits[at].overlap / float(curve[0]))


def _actuation(record: Record) -> float:
    """Return the delay that best aligns the integral of the sent speeds with the angle."""
    travelled = np.concatenate([[0.0], np.cumsum(record.sent_rad_per_s[:-1] * np.diff(record.angle_t_s))])
    # A thousand samples are enough, and the loop waits for the result.
    some = slice(None, None, max(1, record.angle_t_s.size // 1000))
    at_s, angle_rad = record.angle_t_s[some], record.angle_rad[some]

    def misfit(delay_s: float) -> float:
        difference = angle_rad - np.interp(at_s - delay_s, record.angle_t_s, travelled)
        return float(np.var(difference))

    return float(min(_ACTUATION_GRID_S, key=misfit))


@dataclass(frozen=True, slots=True, kw_only=True)
class ExciteSettings:
    """The identification's swings: between the first angle and `amplitude_rad` away.

    The first swing goes half as far. Ends when the stiffness is known to `stiffness_share`, and fails after
    `most_cycles` without that.
    """

    amplitude_rad: float
    torque_limit_nm: float
    dwell_s: float
    stiffness_share: float = 0.03
    most_cycles: int = 8


class StiffnessExcitation:
    """Twists the tool, records, and identifies it. Times are CLOCK_MONOTONIC ns; no I/O.

    `command` returns the speed to send until `done`; then `result` has the tool model, or `failure` the reason.
    """

    def __init__(self, settings: ExciteSettings, source: TorqueSource, config: LoopConfig) -> None:
        self._settings = settings
        self._source = source
        self._config = config
        self._limit = WristLimit.of(config)
        self.result: ToolModel | None = None
        self.failure: str | None = None
        self._origin_ns = 0
        self._angles: list[tuple[float, float]] = []
        # The speed that was sent at each angle.
        self._speeds: list[float] = []
        self._torques: list[tuple[float, float, float]] = []
        self._leg = 0  # even: at the first angle; odd: away
        self._arrived_s: float | None = None
        self._speed = 0.0

    @property
    def done(self) -> bool:
        """Whether the step has ended, with a result or a failure."""
        return self.result is not None or self.failure is not None

    def measure(self, torque_nm: float | None, t_mid_ns: int, t_ns: int) -> None:
        """Record a torque; missing and out-of-order values are skipped."""
        if torque_nm is None or not self._angles:
            return
        t_mid_s = (t_mid_ns - self._origin_ns) / 1e9
        if self._torques and t_mid_s <= self._torques[-1][0]:
            return
        self._torques.append((t_mid_s, (t_ns - self._origin_ns) / 1e9, torque_nm))
        # The mean of three: the noise of one must not end the step.
        mean = fmean(latest_nm for *_, latest_nm in self._torques[-3:])
        if abs(mean) > self._settings.torque_limit_nm and len(self._torques) >= 3:
            reached_nm = beyond(mean, self._settings.torque_limit_nm, 3)
            self.failure = (
                f"identify: the torque has reached {reached_nm} N·m and the limit of the step is "
                f"{self._settings.torque_limit_nm:g} N·m; turn less than {self._settings.amplitude_rad:g} rad"
            )

    def command(self, t_ns: int, wrist_angle_rad: float) -> float:
        """Return the wrist speed for now in rad/s; 0 once done."""
        if self.done:
            self._speed = 0.0
            return 0.0
        if not self._angles:
            self._origin_ns = t_ns
        now_s = (t_ns - self._origin_ns) / 1e9
        elapsed_s = now_s - self._angles[-1][0] if self._angles else 0.0
        if self._angles and elapsed_s <= 0.0:
            return self._speed
        self._angles.append((now_s, wrist_angle_rad))
        # A leg that ends here identifies from the record with this angle, where the wrist rests.
        self._speeds.append(0.0)
        self._speed = self._towards(self._goal_rad() - wrist_angle_rad, now_s, min(elapsed_s, 0.05))
        self._speeds[-1] = self._speed
        return self._speed

    def sent(self, speed_rad_per_s: float) -> None:
        """Correct the speed that was sent for the last command, after clipping."""
        if self._speeds:
            self._speed = self._speeds[-1] = speed_rad_per_s

    def _goal_rad(self) -> float:
        first = self._angles[0][1]
        if self._leg % 2 == 0:
            return first
        return first + self._settings.amplitude_rad * (0.5 if self._leg == 1 else 1.0)

    def _towards(self, missing_rad: float, now_s: float, elapsed_s: float) -> float:
        if abs(missing_rad) < _ARRIVED_RAD:
            if self._arrived_s is None:
                self._arrived_s = now_s
            # Dwells of different lengths sample the swings at different phases. The first one is twice as long: it is
            # the reference for slip.
            dwell_s = self._settings.dwell_s * (1.0 if self._leg else 2.0)
            dwell_s += (self._leg % 4) * 0.25 * self._source.period_s
            if now_s - self._arrived_s >= dwell_s:
                self._end_leg()
            return 0.0
        wanted = self._limit.clip(self._config.angle_bandwidth_per_s * missing_rad)
        return self._limit.speed_up(self._speed, wanted, elapsed_s)

    def _end_leg(self) -> None:
        self._leg, self._arrived_s = self._leg + 1, None
        cycles, rests = divmod(self._leg - 1, 2)
        if self._leg % 2 == 0 or cycles < _MIN_CYCLES or rests:
            return
        last = cycles >= self._settings.most_cycles
        share = _WORST_STIFFNESS_FRACTION if last else self._settings.stiffness_share
        try:
            self.result = identify(self.record(), self._source.window_s, share)
        except NotYetKnownError as error:
            self.failure = str(error) if last else None
        except IdentifyError as error:
            self.failure = str(error)

    def record(self) -> Record:
        """Return the record so far."""
        angle_t_s, angle_rad = np.array(self._angles).reshape(-1, 2).T
        t_mid_s, t_s, torque_nm = np.array(self._torques).reshape(-1, 3).T
        return Record(
            angle_t_s=angle_t_s, angle_rad=angle_rad, sent_rad_per_s=np.array(self._speeds),
            t_mid_s=t_mid_s, t_s=t_s, torque_nm=torque_nm,
        )  # fmt: skip
