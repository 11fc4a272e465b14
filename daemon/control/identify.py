"""What is in the grip: stiffness, delay and noise, fitted to a short record of angles and late, noisy torques."""

import math
from dataclasses import dataclass

import numpy as np

from shearloop.bank.arrays import FloatArray
from shearloop.daemon.errors import UserError

# Where the lag of the torque behind its stamp is looked for.
_LAG_GRID_S = np.arange(-0.4, 1.0001, 0.02)
_ACTUATION_GRID_S = np.arange(0.0, 0.3001, 0.002)
_FEWEST = 12
_NO_TURN_RAD = 1e-4
# The part of the angle's range that counts as rest, and what the torque at rest may lose over the record.
_REST_SHARE = 0.2
_SLIP_SHARE = 0.3
# What a spring leaves unexplained, beyond the noise, relative to what it explains (relaxation leaves about 0.1).
_MISFIT_SHARE = 0.3


class IdentifyError(UserError):
    """A record that says nothing reliable of the tool; the message is a sentence with the numbers and the cure."""


class NotYetKnownError(IdentifyError):
    """A record in which nothing is wrong, but too little: more of the same would help."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Record:
    """What was seen; all times in s from one origin, ascending. Angles and speeds of the wrist, torques of the tool.

    angle_t_s, angle_rad (n,); sent_t_s, sent_rad_per_s (s,), which may be empty: speeds as they were sent;
    t_mid_s, t_s, torque_nm (m,): the middle of each acquisition, when it became known, and what it said.
    """

    angle_t_s: FloatArray
    angle_rad: FloatArray
    sent_t_s: FloatArray
    sent_rad_per_s: FloatArray
    t_mid_s: FloatArray
    t_s: FloatArray
    torque_nm: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class ToolModel:
    """The tool in the grip and the way of its torque, with standard deviations.

    lag_s: by how much the torque lags behind its own stamps. age_s: from the middle of an acquisition until its
    torque is known (95th percentile). actuation_s: from sending a speed until the wrist has it; nan where no speeds
    were recorded. torque_nm: at angle_rad, the last one of the record.
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
    measurements: int

    @property
    def known_measurements(self) -> float:
        """Return how many measurements would know the torque as well as the record does; at most 8."""
        return min((self.noise_nm / self.torque_std_nm) ** 2, 8.0) if self.torque_std_nm else 8.0

    @property
    def significant_lag_s(self) -> float:
        """Return the lag where it is beyond two standard deviations, and 0 where it may well be noise."""
        return self.lag_s if abs(self.lag_s) > 2.0 * self.lag_std_s else 0.0


@dataclass(frozen=True, slots=True)
class _Fit:
    """Least squares of torque = stiffness·angle + offset + drift·time, with its residuals (m,) and covariance."""

    lag_s: float
    coefficients: FloatArray
    covariance: FloatArray
    residuals: FloatArray
    angle_rad: FloatArray

    @property
    def squares(self) -> float:
        return float(self.residuals @ self.residuals)


def identify(record: Record, window_s: float, stiffness_share: float = 0.1) -> ToolModel:
    """Return what the record says of the tool, whose torques are means over `window_s`.

    For every lag on a grid the torques are fitted, by least squares, to the mean angles of their windows with an
    offset and a drift; the lag with the least squares left wins, refined by a parabola, and the curvature there
    gives its standard deviation. Raises IdentifyError where the record is too short, the wrist turned too little
    for a stiffness known to `stiffness_share`, the tool slipped, or the torque does not behave as a spring's.
    """
    used = np.isfinite(record.torque_nm) & (record.t_mid_s - 0.5 * window_s > record.angle_t_s[0])
    if used.sum() < _FEWEST:
        raise NotYetKnownError(
            f"identify: {used.sum()} valid torques are too few to learn the stiffness from, {_FEWEST} are needed; "
            f"record for longer, and see why torques are missing"
        )
    t_mid_s, torque_nm = record.t_mid_s[used], record.torque_nm[used]
    angles = _Angles(record)
    fits = [_fit(angles, t_mid_s, torque_nm, window_s, float(lag)) for lag in _LAG_GRID_S]
    best = min(fits, key=lambda fit: fit.squares)
    noise_nm = _noise(best.residuals)
    _refuse_bad(best, torque_nm, noise_nm, stiffness_share)
    lag_s, lag_std_s = _lag(fits, noise_nm)
    now = np.array([record.angle_rad[-1], 1.0, 1.0])
    return ToolModel(
        stiffness_nm_per_rad=float(best.coefficients[0]),
        stiffness_std=math.sqrt(best.covariance[0, 0]),
        lag_s=lag_s,
        lag_std_s=lag_std_s,
        age_s=float(np.quantile(record.t_s[used] - t_mid_s, 0.95)),
        actuation_s=_actuation(record),
        noise_nm=noise_nm,
        sample_period_s=float(np.median(np.diff(record.t_mid_s))),
        angle_rad=float(record.angle_rad[-1]),
        torque_nm=float(now @ best.coefficients),
        torque_std_nm=math.sqrt(now @ best.covariance @ now),
        measurements=int(used.sum()),
    )


def _fit(angles: "_Angles", t_mid_s: FloatArray, torque_nm: FloatArray, window_s: float, lag_s: float) -> _Fit:
    angle = angles.mean(t_mid_s - lag_s, window_s)
    span = t_mid_s[-1] - t_mid_s[0]
    design = np.column_stack([angle, np.ones_like(angle), (t_mid_s - t_mid_s[-1]) / span + 1.0])
    coefficients = np.linalg.lstsq(design, torque_nm, rcond=None)[0]
    residuals = torque_nm - design @ coefficients
    variance = float(residuals @ residuals) / (torque_nm.size - design.shape[1])
    covariance = variance * np.linalg.pinv(design.T @ design)
    return _Fit(lag_s, coefficients, covariance, residuals, angle)


class _Angles:
    """The integral of the wrist's angle, formed once for all lags."""

    def __init__(self, record: Record) -> None:
        self._t_s, self._rad = record.angle_t_s, record.angle_rad
        parts = 0.5 * (self._rad[1:] + self._rad[:-1]) * np.diff(self._t_s)
        self._integral = np.concatenate([[0.0], np.cumsum(parts)])

    def mean(self, middle_s: FloatArray, window_s: float) -> FloatArray:
        """Return the mean angle (m,) over windows around m times."""
        half = max(0.5 * window_s, 1e-3)
        mean: FloatArray = (self._until(middle_s + half) - self._until(middle_s - half)) / (2.0 * half)
        return mean

    def _until(self, time_s: FloatArray) -> FloatArray:
        # Beyond its ends the wrist is taken to rest, as it does before the first motion and after the last.
        inside = np.interp(time_s, self._t_s, self._integral)
        before, after = np.minimum(time_s - self._t_s[0], 0.0), np.maximum(time_s - self._t_s[-1], 0.0)
        total: FloatArray = inside + before * self._rad[0] + after * self._rad[-1]
        return total


def _noise(residuals: FloatArray) -> float:
    """Return the standard deviation of one measurement, from what changes between neighbours (von Neumann 1941)."""
    return float(min(np.sqrt(np.mean(np.diff(residuals) ** 2) / 2.0), np.sqrt(np.mean(residuals**2))))


def _refuse_bad(fit: _Fit, torque_nm: FloatArray, noise_nm: float, stiffness_share: float) -> None:
    stiffness, std = float(fit.coefficients[0]), math.sqrt(fit.covariance[0, 0])
    turned = float(np.ptp(fit.angle_rad))
    if turned < _NO_TURN_RAD:
        raise IdentifyError("identify: the wrist did not turn, so nothing can be said of the stiffness")
    if stiffness < -2.0 * std:
        raise IdentifyError(
            f"identify: the torque falls by {-stiffness:.3g} N·m for each rad that the wrist turns; torque or wrist "
            f"is counted the wrong way round"
        )
    lost, lost_std = _lost_at_rest(fit, torque_nm, noise_nm)
    if lost > max(_SLIP_SHARE * abs(stiffness) * turned, 3.5 * lost_std):
        raise IdentifyError(
            f"identify: back at its first angle the torque is {lost:.3g} N·m lower than before; the tool slipped in "
            f"the grip, so grip harder or turn less than {turned:.2g} rad"
        )
    if stiffness <= 0.0 or std > stiffness_share * stiffness:
        raise NotYetKnownError(
            f"identify: turning {turned:.2g} rad gives a stiffness of {stiffness:.3g} ± {std:.2g} N·m/rad, and it must "
            f"be known to {100 * stiffness_share:.3g} %; turn farther, or more often (noise {noise_nm:.2g} N·m)"
        )
    misfit = math.sqrt(max(float(np.mean(fit.residuals**2)) - noise_nm**2, 0.0))
    explained = stiffness * float(np.std(fit.angle_rad))
    if misfit > _MISFIT_SHARE * explained:
        raise IdentifyError(
            f"identify: a spring of {stiffness:.3g} N·m/rad leaves {misfit:.2g} N·m of the torque unexplained beside "
            f"{explained:.2g} that it explains; slip, play or a torque sensor that saturates would look like this"
        )


def _lost_at_rest(fit: _Fit, torque_nm: FloatArray, noise_nm: float) -> tuple[float, float]:
    """Return by how much the torque at the first angle fell from before the first motion to after the last, ± std."""
    away = np.flatnonzero(np.abs(fit.angle_rad - fit.angle_rad[0]) > _REST_SHARE * np.ptp(fit.angle_rad))
    before, after = torque_nm[: away[0]], torque_nm[away[-1] + 1 :]
    if before.size < 2 or after.size < 2:
        return 0.0, 0.0
    return float(before.mean() - after.mean()), noise_nm * math.sqrt(1.0 / before.size + 1.0 / after.size)


def _lag(fits: list[_Fit], noise_nm: float) -> tuple[float, float]:
    """Return the lag at the least squares, and its standard deviation from the curvature there."""
    squares = np.array([fit.squares for fit in fits])
    at = int(np.clip(np.argmin(squares), 2, len(fits) - 3))
    near = slice(at - 2, at + 3)
    curve = np.polyfit(_LAG_GRID_S[near] - _LAG_GRID_S[at], squares[near], 2)
    if curve[0] <= 0.0:
        return float(_LAG_GRID_S[at]), math.inf
    offset = float(np.clip(-curve[1] / (2.0 * curve[0]), -0.04, 0.04))
    return float(_LAG_GRID_S[at]) + offset, noise_nm / math.sqrt(float(curve[0]))


def _actuation(record: Record) -> float:
    """Return the delay at which the integral of the sent speeds lies best on the angle; nan without speeds."""
    if record.sent_t_s.size < 2:
        return math.nan
    steps = np.diff(record.sent_t_s)
    travelled = np.concatenate([[0.0], np.cumsum(record.sent_rad_per_s[:-1] * steps)])

    # A thousand moments tell the delay as well as all, and the loop waits meanwhile.
    some = slice(None, None, max(1, record.angle_t_s.size // 1000))
    at_s, angle_rad = record.angle_t_s[some], record.angle_rad[some]

    def misfit(delay_s: float) -> float:
        difference = angle_rad - np.interp(at_s - delay_s, record.sent_t_s, travelled)
        return float(np.var(difference))

    return float(min(_ACTUATION_GRID_S, key=misfit))
