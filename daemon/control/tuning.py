"""From what was identified to a controller: the gain that noise and margins allow, and whether a given one passes."""

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_discrete_lyapunov

from shearloop.daemon.control.identify import ToolModel
from shearloop.daemon.control.margins import LoopModel, Margins, margins, with_gain
from shearloop.daemon.control.settings import ControllerSettings

# Above this the loop answers single measurements rather than what they have in common.
MOST_GAIN = 0.5
LEAST_GAIN = 1e-3


@dataclass(frozen=True, slots=True, kw_only=True)
class RequiredMargins:
    """What a controller must have to be let at the robot: see `Margins`. The delay margin in measurement periods."""

    gain: float = 2.0
    phase_deg: float = 45.0
    delay_periods: float = 1.0


def integral_gain(kp: float) -> float:
    """Return the ki that goes with a kp: kp²/10, well damped (ζ = 1.6).

    Critical damping (kp²/4) follows a drift faster, but passes on a tenth more noise and carries the gel's own creep
    on further; measured in docs/decisions/0020-controller.md.
    """
    return 0.1 * kp * kp


def noise_share(kp: float, ki: float) -> float:
    """Return the standard deviation of the torque that noise of standard deviation 1 a measurement leaves behind.

    The stationary variance of the controller's filter d ← d + i + (kp + ki)·ν, i ← i + ki·ν, ν = noise − d. It
    is the torque's own where the wrist arrives within a period, and a little more than it where it does not.
    """
    turn = np.array([[1.0 - kp - ki, 1.0], [-ki, 1.0]]) if ki else np.array([[1.0 - kp]])
    push = np.array([[kp + ki], [ki]]) if ki else np.array([[kp]])
    return math.sqrt(float(solve_discrete_lyapunov(turn, push @ push.T)[0, 0]))


def gain_for_noise(noise_nm: float, allowed_nm: float) -> float:
    """Return the largest kp, up to MOST_GAIN, whose share of the noise in the torque is at most what is allowed."""
    kps = np.geomspace(LEAST_GAIN, MOST_GAIN, 200)
    fitting = [float(kp) for kp in kps if noise_share(float(kp), integral_gain(float(kp))) * noise_nm <= allowed_nm]
    return max(fitting, default=LEAST_GAIN)


def loop_model(settings: ControllerSettings, found: ToolModel) -> LoopModel:
    """Return the loop that these settings close around the tool that was identified.

    An actuation delay that was not identified counts as one command period. A torque that seems to be ahead of its
    stamps is believed only as far as its age allows: nothing is known before its acquisition has ended.
    """
    earliest_s = 0.5 * settings.window_s - found.age_s
    return LoopModel(
        sample_period_s=found.sample_period_s,
        window_s=settings.window_s,
        age_s=found.age_s,
        actuation_s=found.actuation_s if math.isfinite(found.actuation_s) else 0.008,
        wrist_bandwidth_per_s=settings.wrist_bandwidth_per_s,
        kp=settings.kp,
        ki=settings.ki,
        stiffness_ratio=found.stiffness_nm_per_rad / settings.stiffness_nm_per_rad,
        lag_error_s=max(found.significant_lag_s - settings.lag_s, earliest_s),
    )


def passing_gain(model: LoopModel, required: RequiredMargins) -> float | None:
    """Return the largest kp, to 1 % and at most MOST_GAIN, with which the loop has the required margins, or None."""

    def passes(kp: float) -> bool:
        return _passes(margins(with_gain(model, kp)), required, model.sample_period_s)

    trials = [float(kp) for kp in np.geomspace(MOST_GAIN, LEAST_GAIN, 25)]
    first = next((number for number, kp in enumerate(trials) if passes(kp)), None)
    if first is None:
        return None
    best, too_much = trials[first], trials[max(first - 1, 0)]
    while too_much > 1.01 * best:
        middle = math.sqrt(best * too_much)
        best, too_much = (middle, too_much) if passes(middle) else (best, middle)
    return best


def refusal(settings: ControllerSettings, found: ToolModel, required: RequiredMargins) -> str | None:
    """Return None for a controller with the required margins, or else the sentence that refuses it.

    The sentence has the margins, what they should be, from which stiffness and delay, and the gain that would pass.
    """
    model = loop_model(settings, found)
    has = margins(model)
    if _passes(has, required, found.sample_period_s):
        return None
    passing = passing_gain(model if settings.ki else replace(model, ki=0.0), required)
    cure = "no gain would pass; identify again, and see whether the stamps of the torque are right"
    if passing is not None:
        would = with_gain(model, passing)
        cure = f"kp {would.kp:.3g} with ki {would.ki:.2g} would pass"
    return (
        f"controller refused: with kp {settings.kp:g} and ki {settings.ki:.2g} the gain margin is {has.gain:.2f} "
        f"(required {required.gain:.2f}), the phase margin {has.phase_deg:.0f}° ({required.phase_deg:.0f}°) and the "
        f"delay margin {has.delay_s:.2f} s ({required.delay_periods * found.sample_period_s:.2f} s), for a stiffness "
        f"of {found.stiffness_nm_per_rad:.3g} N·m/rad ({settings.stiffness_nm_per_rad:.3g} assumed), torques "
        f"{found.age_s:.2f} s old, every {found.sample_period_s:.3g} s, {found.significant_lag_s:.2f} s behind their "
        f"stamps; {cure}"
    )


def _passes(has: Margins, required: RequiredMargins, period_s: float) -> bool:
    return (
        has.gain >= required.gain
        and has.phase_deg >= required.phase_deg
        and has.delay_s >= required.delay_periods * period_s
    )
