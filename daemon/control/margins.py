"""Gain, phase and delay margins of the sampled twist loop, and where its boundary of stability lies.

Everything between two measurements is computed, not approximated: the wrist loop as the recursion that it is (a speed
held for each command period, an actuation delay), the acquisition as the mean of the angle over its window, the
delays with their fractions of a period. What is left is a discrete loop in x = z⁻¹, one step a measurement (the
pulse-transfer function; Åström & Wittenmark, Computer-Controlled Systems).

With P(x) = kp + ki/(1 − x), the stiffness ratio ρ = true/assumed, and D(x) the response of the window's mean angle
to the corrections (D₀ where the compensator believes the window to be, D₁ where it really is), the controller has
the characteristic equation

    compensated    (1 − x) + P·(x + ρ·D₁ − D₀) = 0        (exact model, ρ = 1 and D₁ = D₀: 1 − x + P·x = 0, no delay)
    uncompensated  (1 − x) + P·ρ·D₁ = 0
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from shearloop.bank.arrays import FloatArray

ComplexArray = NDArray[np.complex128]

# The wrist has arrived when so little of a step is left; the response is cut there.
_SETTLED = 1e-9
_LONGEST_RESPONSE = 200_000
_FREQUENCIES = 4000


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
    # What the compensator does not know: how much stiffer the tool is, and by how much its torque lags the stamps.
    stiffness_ratio: float = 1.0
    lag_error_s: float = 0.0
    compensated: bool = True


@dataclass(frozen=True, slots=True)
class Margins:
    """How far the loop is from instability; all infinite (phase: 180°) where nothing could make it unstable.

    gain: the tool may be so many times stiffer than it is. phase_deg: at the frequencies where the loop gain is 1.
    delay_s: so much more delay that the compensator does not know of.
    """

    gain: float
    phase_deg: float
    delay_s: float


def wrist_response(model: LoopModel) -> FloatArray:
    """Return the wrist's angle (n,) after a unit step of its target, at multiples of the command period, until 1.

    The recursion of the real loop: a speed of bandwidth × (target − angle), held for one period, that the wrist
    takes on after the actuation delay (with its fraction of a period). Raises ValueError where that does not settle.
    """
    return _wrist_response(model.command_period_s, model.wrist_bandwidth_per_s, model.actuation_s)


@lru_cache(maxsize=64)
def _wrist_response(period_s: float, bandwidth_per_s: float, actuation_s: float) -> FloatArray:
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
    """Return the coefficients (n,) of D in x; `lag_s` moves the windows back. See `seen_through_window`."""
    return seen_through_window(wrist_response(model), model, lag_s)


def seen_through_window(angle: FloatArray, model: LoopModel, lag_s: float = 0.0) -> FloatArray:
    """Return how the mean angle over a measurement's window (n,) grows from each measurement to the next.

    `angle` (m,) is the wrist's way to 1, at multiples of the command period, after a unit correction that is made
    with measurement 0 and held. Coefficient k is what measurement k sees beyond what measurement k−1 saw. Raises
    ValueError where a measurement would see its own correction.
    """
    period = model.command_period_s
    running = np.concatenate([[0.0], np.cumsum(0.5 * (angle[1:] + angle[:-1])) * period])
    t_s = np.arange(angle.size) * period
    # A correction waits for the next command: half a command period on the average.
    start_s = model.age_s + 0.5 * period + lag_s
    count = math.ceil((float(t_s[-1]) + start_s + 0.5 * model.window_s) / model.sample_period_s) + 2
    middle_s = np.arange(count, dtype=np.float64) * model.sample_period_s - start_s

    def integral(time_s: FloatArray) -> FloatArray:
        """Return the integral of the response from 0: quadratic between the commands, 1 s a second at the end."""
        place = np.clip(time_s, 0.0, t_s[-1]) / period
        last = np.minimum(place.astype(int), angle.size - 2)
        share = place - last
        within = angle[last] * share + 0.5 * (angle[last + 1] - angle[last]) * share**2
        total: FloatArray = running[last] + within * period + np.maximum(time_s - t_s[-1], 0.0)
        return total

    half = max(0.5 * model.window_s, 1e-6)
    if middle_s[0] + half > 1e-9:
        raise ValueError(f"a torque that is {model.age_s:g} s old cannot be the mean over {model.window_s:g} s")
    seen = (integral(middle_s + half) - integral(middle_s - half)) / (2.0 * half)
    return np.diff(seen, prepend=0.0)


def gain_limit(model: LoopModel, highest: float = 4.0) -> float:
    """Return the smallest kp at which the loop is unstable, ki following as kp²; infinite where `highest` is stable.

    ki is scaled with the square so that the damping stays what it is. Where even the smallest gain that is tried
    (a thousandth of the highest) is unstable, that one is returned.
    """
    trials = np.geomspace(1e-3 * highest, highest, 60)
    unstable = next((n for n, kp in enumerate(trials) if not is_stable(with_gain(model, float(kp)))), None)
    if unstable is None:
        return math.inf
    if unstable == 0:
        return float(trials[0])
    return _bisect(lambda kp: is_stable(with_gain(model, kp)), float(trials[unstable - 1]), float(trials[unstable]))


def with_gain(model: LoopModel, kp: float) -> LoopModel:
    """Return the loop with another kp, and ki as its square follows."""
    return replace(model, kp=kp, ki=model.ki * (kp / model.kp) ** 2)


def margins(model: LoopModel) -> Margins:
    """Return the margins of the loop, broken where the tool's torque arises; (0, 0, 0) where it is unstable."""
    if not is_stable(model):
        return Margins(0.0, 0.0, 0.0)
    omega = np.concatenate([np.geomspace(1e-4, 0.1, _FREQUENCIES // 4), np.linspace(0.1, math.pi, _FREQUENCIES)[1:]])
    ratio = _return_ratio(model, omega)
    return Margins(_gain_margin(ratio), _phase_margin_deg(ratio), _delay_margin_s(model))


def _return_ratio(model: LoopModel, omega: FloatArray) -> ComplexArray:
    """Return what comes back (n,) of the tool's torque, with reversed sign, at the frequencies in rad a sample."""
    x = np.exp(-1j * omega).astype(np.complex128)
    control = model.kp + (model.ki / (1.0 - x) if model.ki else 0.0)
    seen = model.stiffness_ratio * _at(pulse_response(model, model.lag_error_s), x) * control
    known = control * (x - _at(pulse_response(model), x)) if model.compensated else 0.0
    return np.asarray(seen / (1.0 - x + known), dtype=np.complex128)


def _at(coefficients: FloatArray, x: ComplexArray) -> ComplexArray:
    return np.asarray(np.polynomial.polynomial.polyval(x, coefficients), dtype=np.complex128)


def _gain_margin(ratio: ComplexArray) -> float:
    """Return the smallest factor above 1 by which the ratio passes through −1, linear between its samples."""
    imaginary, real = ratio.imag, ratio.real
    across = np.flatnonzero(imaginary[:-1] * imaginary[1:] < 0.0)
    share = imaginary[across] / (imaginary[across] - imaginary[across + 1])
    crossings = real[across] + share * (real[across + 1] - real[across])
    # At the highest frequency, half the sampling rate, the ratio is always real.
    factors = -1.0 / np.append(crossings, real[-1])
    return float(min(factors[factors > 1.0], default=math.inf))


def _phase_margin_deg(ratio: ComplexArray) -> float:
    size = np.abs(ratio) - 1.0
    across = np.flatnonzero(size[:-1] * size[1:] < 0.0)
    if not across.size:
        return 180.0
    share = size[across] / (size[across] - size[across + 1])
    crossings = ratio[across] + share * (ratio[across + 1] - ratio[across])
    return float(np.min(np.abs(np.angle(-crossings, deg=True))))


def _delay_margin_s(model: LoopModel) -> float:
    """Return the smallest further lag of the torque that makes the loop unstable, looked for up to 20 periods."""

    def stable(extra_s: float) -> bool:
        return is_stable(replace(model, lag_error_s=model.lag_error_s + extra_s))

    step = 0.5 * model.sample_period_s
    for tried in range(1, 41):
        if not stable(tried * step):
            return _bisect(stable, (tried - 1) * step, tried * step)
    return math.inf


def _bisect(good: Callable[[float], bool], low: float, high: float) -> float:
    """Return where `good` ends, given that it holds at `low` and not at `high`, to a part in 10⁴ of the latter."""
    while high - low > 1e-4 * high:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if good(middle) else (low, middle)
    return 0.5 * (low + high)


def is_stable(model: LoopModel) -> bool:
    """Return whether all roots of the characteristic polynomial lie outside the unit circle of x = z⁻¹."""
    polynomial = characteristic_polynomial(model)
    # np.roots wants the highest power first; z = 1/x has to lie inside, so the reversed polynomial is asked.
    roots = np.roots(polynomial)
    return bool(np.all(np.abs(roots) < 1.0 - 1e-9))


def characteristic_polynomial(model: LoopModel) -> FloatArray:
    """Return the coefficients (n,) in ascending powers of x, of the equation above times (1 − x) where ki > 0."""
    seen = pulse_response(model, model.lag_error_s) * model.stiffness_ratio
    if model.compensated:
        seen = _sum(_sum(seen, -pulse_response(model)), np.array([0.0, 1.0]))
    integrator = np.array([1.0, -1.0])
    if model.ki == 0.0:
        return np.trim_zeros(_sum(integrator, model.kp * seen), "b")
    numerator = np.array([model.kp + model.ki, -model.kp])
    return np.trim_zeros(_sum(np.convolve(integrator, integrator), np.convolve(numerator, seen)), "b")


def _sum(one: FloatArray, other: FloatArray) -> FloatArray:
    size = max(one.size, other.size)
    return np.pad(one, (0, size - one.size)) + np.pad(other, (0, size - other.size))
