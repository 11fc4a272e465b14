"""Stability margins of the sampled twist loop, and the controller gain that noise and margins allow.

Everything between two measurements is computed exactly: the wrist loop as its recursion (a speed held for each command
period, an actuation delay), the acquisition as the mean angle over its window, delays with their fractions of a period.
The result is a discrete loop in x = z⁻¹, one step a measurement (the pulse-transfer function; Åström & Wittenmark,
Computer-Controlled Systems).

With P(x) = kp + ki/(1 − x), the stiffness ratio ρ = true/assumed, and D(x) the response of the window's mean angle to
the corrections (D₀ for the window that the compensator assumes, D₁ for the true one), the characteristic equation is

    compensated    (1 − x) + P·(x + ρ·D₁ − D₀) = 0        (exact model, ρ = 1 and D₁ = D₀: 1 − x + P·x = 0, no delay)
    uncompensated  (1 − x) + P·ρ·D₁ = 0

kp and ki are the filter's steady gains. Its greater gains after a start, a turn or a jump last for some measurements.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.polynomial.polynomial import polyadd, polyval
from numpy.typing import NDArray

from shearloop.bank.arrays import FloatArray
from shearloop.daemon.control.identification import ToolModel, window_means
from shearloop.daemon.control.torque_controller import ControllerSettings
from shearloop.daemon.loop_config import LoopConfig

ComplexArray = NDArray[np.complex128]

# The step response is cut at this remainder.
_SETTLED = 1e-9
_LONGEST_RESPONSE = 200_000
_FREQUENCIES = 4000
# Above this gain the loop follows single measurements rather than their mean.
MAX_GAIN = 0.5
MIN_GAIN = 1e-3
# An automatic gain without the required margins is lowered to this fraction, at most this number of times.
LOWERED_TO, MAX_LOWERINGS = 0.8, 3
# The delay margin that a controller must have, in measurement periods.
DELAY_MARGIN_PERIODS = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopModel:
    """The loop around one torque source. Times in s; `age_s` from the middle of an acquisition to its correction."""

    sample_period_s: float
    window_s: float
    age_s: float
    actuation_s: float
    wrist_bandwidth_per_s: float
    kp: float
    ki: float = 0.0
    command_period_s: float = 0.008
    # Unknown to the compensator: the ratio of true to assumed stiffness, and the torque's lag behind its stamps.
    stiffness_ratio: float = 1.0
    lag_error_s: float = 0.0
    compensated: bool = True


@dataclass(frozen=True, slots=True)
class Margins:
    """Distance of the loop from instability; infinite (phase: 180°) where no value makes it unstable.

    gain: factor on the tool's stiffness. phase_deg: at the frequencies where the loop gain is 1. delay_s: further delay
    that is unknown to the compensator.
    """

    gain: float
    phase_deg: float
    delay_s: float


@lru_cache(maxsize=64)
def wrist_response(period_s: float, bandwidth_per_s: float, actuation_s: float) -> FloatArray:
    """Return the wrist angle (n,) after a unit step of its target, at multiples of the command period, until 1.

    The recursion of the real loop: a speed of bandwidth × (target − angle), held for one period and applied after the
    actuation delay (with its fraction of a period). Raises ValueError if it does not settle.
    """
    gain = bandwidth_per_s * period_s
    whole, part = divmod(actuation_s / period_s, 1.0)
    delay = int(whole)
    angle, speeds = [0.0], [0.0] * (delay + 1)
    while abs(1.0 - angle[-1]) > _SETTLED or abs(speeds[-1]) > _SETTLED or len(angle) < delay + 3:
        speeds.append(gain * (1.0 - angle[-1]))
        angle.append(angle[-1] + (1.0 - part) * speeds[-1 - delay] + part * speeds[-2 - delay])
        if len(angle) > _LONGEST_RESPONSE or abs(angle[-1]) > 1e3:
            raise ValueError(
                f"the wrist itself does not settle: a bandwidth of {bandwidth_per_s:g} /s is too much for its "
                f"actuation delay of {actuation_s:g} s"
            )
    response = np.array(angle)
    response.setflags(write=False)
    return response


def pulse_response(model: LoopModel, lag_s: float = 0.0) -> FloatArray:
    """Return the coefficients (n,) of D in x: the growth of the windows' mean angle, measurement by measurement.

    After a unit correction made with measurement 0, coefficient k is the mean angle of measurement k minus the one of
    k−1. `lag_s` moves the windows back. Raises ValueError if a measurement would see its own correction.
    """
    period = model.command_period_s
    angle = wrist_response(period, model.wrist_bandwidth_per_s, model.actuation_s)
    t_s = np.arange(angle.size, dtype=np.float64) * period
    # A correction waits for the next command: half a command period on average.
    start_s = model.age_s + 0.5 * period + lag_s
    count = math.ceil((float(t_s[-1]) + start_s + 0.5 * model.window_s) / model.sample_period_s) + 2
    middle_s = np.arange(count, dtype=np.float64) * model.sample_period_s - start_s
    if _sees_its_own_correction(model, lag_s):
        raise ValueError(f"a torque that is {model.age_s:g} s old cannot be the mean over {model.window_s:g} s")
    return np.diff(window_means(t_s, angle, middle_s, model.window_s), prepend=0.0)


def _sees_its_own_correction(model: LoopModel, lag_s: float = 0.0) -> bool:
    """Return whether a torque would arrive before its acquisition has ended."""
    return 0.5 * model.window_s - (model.age_s + 0.5 * model.command_period_s + lag_s) > 1e-9


def gain_limit(model: LoopModel, highest: float = 4.0) -> float:
    """Return the smallest unstable kp, with ki scaled as kp² (constant damping); infinite if `highest` is stable.

    The smallest gain that is tried is a thousandth of the highest.
    """
    return _limit(lambda kp: is_stable(with_gain(model, kp)), np.geomspace(1e-3 * highest, highest, 60))


def with_gain(model: LoopModel, kp: float) -> LoopModel:
    """Return the loop with another kp, and ki scaled with its square."""
    return replace(model, kp=kp, ki=model.ki * (kp / model.kp) ** 2)


def margins(model: LoopModel) -> Margins:
    """Return the margins of the loop, opened at the tool's torque; (0, 0, 0) if it is unstable."""
    if not is_stable(model):
        return Margins(0.0, 0.0, 0.0)
    omega = np.concatenate([np.geomspace(1e-4, 0.1, _FREQUENCIES // 4), np.linspace(0.1, math.pi, _FREQUENCIES)[1:]])
    ratio = _return_ratio(model, omega)
    return Margins(_gain_margin(ratio), _phase_margin_deg(ratio), _delay_margin_s(model))


def _return_ratio(model: LoopModel, omega: FloatArray) -> ComplexArray:
    """Return the loop's return ratio (n,) at frequencies in rad per sample, broken at the tool's torque."""
    x = np.exp(-1j * omega).astype(np.complex128)
    control = model.kp + (model.ki / (1.0 - x) if model.ki else 0.0)
    seen = model.stiffness_ratio * polyval(x, pulse_response(model, model.lag_error_s)) * control
    known = control * (x - polyval(x, pulse_response(model))) if model.compensated else 0.0
    return np.asarray(seen / (1.0 - x + known), dtype=np.complex128)


def _gain_margin(ratio: ComplexArray) -> float:
    """Return the smallest factor above 1 that makes the ratio pass through −1, linear between its samples."""
    # At half the sampling rate the ratio is real.
    factors = -1.0 / np.append(_at_zeros(ratio.imag, ratio).real, ratio[-1].real)
    return float(min(factors[factors > 1.0], default=math.inf))


def _phase_margin_deg(ratio: ComplexArray) -> float:
    crossings = _at_zeros(np.abs(ratio) - 1.0, ratio)
    return float(np.min(np.abs(np.angle(-crossings, deg=True)), initial=180.0))


def _at_zeros(values: FloatArray, ratio: ComplexArray) -> ComplexArray:
    """Return the ratio where `values` changes its sign, linear between the samples."""
    across = np.flatnonzero(values[:-1] * values[1:] < 0.0)
    share = values[across] / (values[across] - values[across + 1])
    return np.asarray(ratio[across] + share * (ratio[across + 1] - ratio[across]))


def _delay_margin_s(model: LoopModel) -> float:
    """Return the smallest further lag of the torque that makes the loop unstable, searched up to 20 periods."""

    def stable(extra_s: float) -> bool:
        return is_stable(replace(model, lag_error_s=model.lag_error_s + extra_s))

    return _limit(stable, 0.5 * model.sample_period_s * np.arange(41, dtype=np.float64))


def _limit(good: Callable[[float], bool], trials: FloatArray) -> float:
    """Return the first value that is not good, among ascending trials and between, with a relative error of 10⁻⁴.

    It is the first trial if no trial is good, and infinite if all are.
    """
    bad = next((number for number, trial in enumerate(trials.tolist()) if not good(trial)), None)
    if bad is None:
        return math.inf
    low, high = trials[max(bad - 1, 0)], trials[bad]
    while high - low > 1e-4 * high:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if good(middle) else (low, middle)
    return float(0.5 * (low + high))


def is_stable(model: LoopModel) -> bool:
    """Return whether all roots of the characteristic polynomial lie outside the unit circle of x = z⁻¹.

    The Schur-Cohn recursion: each step divides out one root's worth of the reflected polynomial, and the roots lie
    outside the circle exactly if every ratio of last to first coefficient is below 1.
    """
    row = characteristic_polynomial(model)
    while row.size > 1:
        ratio = row[-1] / row[0]
        if not abs(ratio) < 1.0:
            return False
        row = row[:-1] - ratio * row[:0:-1]
    return True


def characteristic_polynomial(model: LoopModel) -> FloatArray:
    """Return the coefficients (n,) in ascending powers of x, of the equation above times (1 − x) where ki > 0."""
    seen = pulse_response(model, model.lag_error_s) * model.stiffness_ratio
    if model.compensated:
        seen = polyadd(polyadd(seen, -pulse_response(model)), np.array([0.0, 1.0]))
    integrator = np.array([1.0, -1.0])
    if model.ki == 0.0:
        return np.asarray(polyadd(integrator, model.kp * seen))
    numerator = np.array([model.kp + model.ki, -model.kp])
    return np.asarray(polyadd(np.convolve(integrator, integrator), np.convolve(numerator, seen)))


def integral_gain(kp: float) -> float:
    """Return the ki for a kp: kp²/10, well damped (ζ = 1.6).

    Critical damping (kp²/4) follows a drift faster, but passes a tenth more noise and extrapolates the gel's creep
    further (docs/decisions/0020-controller.md).
    """
    return 0.1 * kp * kp


def noise_share(kp: float, ki: float) -> float:
    """Return the standard deviation of the torque caused by measurement noise of standard deviation 1.

    It is the square root of the stationary variance of the controller's filter d ← d + i + (kp + ki)·ν, i ← i + ki·ν,
    ν = noise − d. This is the variance of the prediction of an α-β filter, α = kp and β = ki (Kalata 1984). It is exact
    if the wrist arrives within a period, and slightly too large otherwise.
    """
    return math.sqrt((2.0 * kp * kp + kp * ki + 2.0 * ki) / (kp * (4.0 - 2.0 * kp - ki)))


def gain_for_noise(noise_nm: float, allowed_nm: float) -> float:
    """Return the largest kp, up to MAX_GAIN, that keeps the noise of the torque within `allowed_nm`."""
    kps = np.geomspace(MIN_GAIN, MAX_GAIN, 200)
    fitting = [float(kp) for kp in kps if noise_share(float(kp), integral_gain(float(kp))) * noise_nm <= allowed_nm]
    return max(fitting, default=MIN_GAIN)


def loop_model(settings: ControllerSettings, found: ToolModel) -> LoopModel:
    """Return the loop that these settings close around an identified tool."""
    return LoopModel(
        sample_period_s=found.sample_period_s,
        window_s=settings.window_s,
        age_s=found.age_s,
        actuation_s=found.actuation_s,
        wrist_bandwidth_per_s=settings.wrist_bandwidth_per_s,
        kp=settings.kp,
        ki=settings.ki,
        stiffness_ratio=found.stiffness_nm_per_rad / settings.stiffness_nm_per_rad,
        lag_error_s=found.significant_lag_s - settings.lag_s,
    )


def passing_gain(model: LoopModel, config: LoopConfig) -> float | None:
    """Return a kp just below the first without the required margins, at most MAX_GAIN, or None."""

    def passes(kp: float) -> bool:
        return _passes(margins(with_gain(model, kp)), config, model.sample_period_s)

    limit = _limit(passes, np.geomspace(MIN_GAIN, MAX_GAIN, 25))
    # Rounded to three digits, it passes as well.
    return min(0.99 * limit, MAX_GAIN) if limit > MIN_GAIN else None


def with_margins(settings: ControllerSettings, found: ToolModel, config: LoopConfig) -> ControllerSettings:
    """Return the settings with a gain that is lowered until it has the required margins, never raised.

    After MAX_LOWERINGS without them the settings are returned as they are: the loop waits for the result.
    """
    model = loop_model(settings, found)
    if _sees_its_own_correction(model):
        return settings
    for number in range(MAX_LOWERINGS + 1):
        lowered = with_gain(model, settings.kp * LOWERED_TO**number)
        if _passes(margins(lowered), config, found.sample_period_s):
            return replace(settings, kp=lowered.kp, ki=lowered.ki)
    return settings


@dataclass(frozen=True, slots=True)
class JudgedGain:
    """The gains that a loop may be closed with, or why it may not."""

    kp: float
    ki: float
    refusal: str | None


def judged_gain(settings: ControllerSettings, found: ToolModel, config: LoopConfig) -> JudgedGain:
    """Return the gains of these settings after the check of their margins.

    It takes up to some seconds on a busy computer. An automatic gain is lowered where it lacks the required margins; a
    person's is refused rather than changed.
    """
    if config.kp is None:
        settings = with_margins(settings, found, config)
    return JudgedGain(settings.kp, settings.ki, margin_refusal(settings, found, config))


def margin_refusal(settings: ControllerSettings, found: ToolModel, config: LoopConfig) -> str | None:
    """Return None for a controller with the required margins, else a sentence with the margins and the cure."""
    model = loop_model(settings, found)
    if _sees_its_own_correction(model):
        return (
            f"controller refused: its torques arrive {found.age_s:.3g} s after the middle of their acquisition, which "
            f"is said to take {settings.window_s:.3g} s; give the sensor's true period in the configuration "
            "(`frame_period_s`, for the load cell `rate_hz`), and identify again"
        )
    has = margins(model)
    if _passes(has, config, found.sample_period_s):
        return None
    passing = passing_gain(model if settings.ki else replace(model, ki=0.0), config)
    cure = "no gain would pass; identify again, and check the timestamps of the torque"
    if passing is not None:
        would = with_gain(model, passing)
        cure = f"kp {would.kp:.3g} with ki {would.ki:.2g} would pass"
    return (
        f"controller refused: with kp {settings.kp:g} and ki {settings.ki:.2g} the gain margin is {has.gain:.2f} "
        f"(required {config.gain_margin:.2f}), the phase margin {has.phase_deg:.0f}° ({config.phase_margin_deg:.0f}°) "
        f"and the delay margin {has.delay_s:.2f} s ({DELAY_MARGIN_PERIODS * found.sample_period_s:.2f} s), for a "
        f"stiffness of {found.stiffness_nm_per_rad:.3g} N·m/rad ({settings.stiffness_nm_per_rad:.3g} assumed), torques "
        f"{found.age_s:.2f} s old, every {found.sample_period_s:.3g} s, {found.significant_lag_s:.2f} s behind their "
        f"stamps; {cure}"
    )


def _passes(has: Margins, config: LoopConfig, period_s: float) -> bool:
    return (
        has.gain >= config.gain_margin
        and has.phase_deg >= config.phase_margin_deg
        and has.delay_s >= DELAY_MARGIN_PERIODS * period_s
    )
