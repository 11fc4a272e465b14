"""Commands and measured states held against the limits; pure functions, every reason told."""

import math
from operator import le
from typing import NamedTuple

from shearloop.drivers.ur.messages import MoveLinear, RtdeSample, Stop, WristSpeed
from shearloop.drivers.ur.settings import Bound, UrLimits

WRIST = 5
# However gently a stop is asked for.
LONGEST_STOP_S = 1.0
# Close to the end the speed is distance/t, taking hold late by the reaction time: x'(s) = -x(s - reaction)/t, which
# creeps up to the end without passing it only for t ≥ e·reaction.
_NO_OVERSHOOT = math.e


class Clipped(NamedTuple):
    """A wrist speed as it may be sent, and every reason for its not being what was asked."""

    sent: WristSpeed
    reasons: tuple[str, ...]


class ClippedMove(NamedTuple):
    """A linear move as it may be sent, and every reason for its not being what was asked."""

    sent: MoveLinear
    reasons: tuple[str, ...]


def clip_wrist(asked: WristSpeed, reading: RtdeSample, limits: UrLimits, reaction_s: float) -> Clipped:
    """Return the wrist speed that keeps speed, acceleration, force and the wrist's range.

    Near the end of the range the speed is what can still be braked within it, the brake taking hold late:
    v·t + v²/2a = distance, with t = e·`reaction_s`. Between the inner and the hard limit of force or torque the speed
    fades to nothing.
    """
    reasons: list[str] = []
    acceleration, slower = _at_most(asked.acceleration_rad_per_s2, limits.wrist_acceleration_rad_per_s2, "acceleration")
    reasons += slower
    braking = limits.wrist_acceleration_rad_per_s2.inner
    room = max(_room(asked.rad_per_s, reading, limits), 0.0)
    lag_s = _NO_OVERSHOOT * reaction_s
    brakeable = braking * (math.sqrt(lag_s**2 + 2 * room / braking) - lag_s)
    top = limits.wrist_speed_rad_per_s.inner
    speed = abs(asked.rad_per_s)
    if top < speed:
        speed = top
        reasons.append(f"wrist speed is limited to {top:g} rad/s")
    if brakeable < speed:
        speed = brakeable
        reasons.append(f"wrist 3 at {reading.wrist_rad:.3f} rad is near the end of its range")
    for part, reason in _fading(reading, limits):
        if top * part < speed:
            speed = top * part
            reasons.append(reason)
    target = math.copysign(speed, asked.rad_per_s)
    ramp = _safe_ramp(acceleration, target, reading, limits, reaction_s)
    if ramp > acceleration:
        reasons.append(f"wrist 3 at {reading.wrist_rad:.3f} rad has to brake harder to stay within its range")
    return Clipped(WristSpeed(target, ramp), tuple(reasons))


def clip_stop(asked: Stop, reading: RtdeSample, limits: UrLimits, reaction_s: float) -> Stop:
    """Return the stop with a deceleration between what is needed and the hard limit of acceleration.

    Needed is what keeps the wrist's range, and what ends the fastest joint's motion within `LONGEST_STOP_S`.
    """
    brisk = max(asked.deceleration_rad_per_s2, reading.fastest_rad_per_s / LONGEST_STOP_S)
    safe = _safe_ramp(brisk, 0.0, reading, limits, reaction_s)
    return Stop(min(safe, limits.wrist_acceleration_rad_per_s2.hard))


def clip_linear(asked: MoveLinear, limits: UrLimits) -> ClippedMove:
    """Return the linear move with its end within the inner workspace and its speed and acceleration within theirs.

    The box is convex: a line to a point inside it, from a point inside it, stays inside.
    """
    box, reasons = limits.workspace, []
    position = []
    for axis, value, low, high in zip("xyz", asked.pose[:3], box.lower_m, box.upper_m, strict=True):
        inside = min(max(value, low + box.margin_m), high - box.margin_m)
        if inside != value:
            reasons.append(f"{axis} = {value:.4f} m is outside the workspace; its edge is {inside:.4f} m")
        position.append(inside)
    speed, reason = _at_most(asked.speed_m_per_s, limits.linear_speed_m_per_s, "linear speed")
    reasons += reason
    acceleration, reason = _at_most(
        asked.acceleration_m_per_s2, limits.linear_acceleration_m_per_s2, "linear acceleration"
    )
    reasons += reason
    x, y, z = position
    return ClippedMove(MoveLinear((x, y, z, *asked.pose[3:]), speed, acceleration), tuple(reasons))


def violation(reading: RtdeSample, limits: UrLimits) -> str:
    """Return a sentence naming the hard limit that the measured state is beyond, or the empty string."""
    return "" if within(reading, limits) else beyond(reading, limits)


def beyond(reading: RtdeSample, limits: UrLimits) -> str:
    """Return what `violation` does; it looks at every value in turn, which is worth while only when one is beyond."""
    if not all(map(math.isfinite, (*reading.q_rad, *reading.qd_rad_per_s, *reading.tcp_pose, *reading.wrench))):
        return "The controller reports values that are no numbers."
    joints, box = limits.joints, limits.workspace
    for number, (q, low, high) in enumerate(zip(reading.q_rad, joints.lower_rad, joints.upper_rad, strict=True), 1):
        if not low <= q <= high:
            return f"Joint {number} is at {q:.3f} rad, beyond its hard limits of {low:g} and {high:g} rad."
    for axis, value, low, high in zip("xyz", reading.tcp_pose[:3], box.lower_m, box.upper_m, strict=True):
        if not low <= value <= high:
            return f"The tool is at {axis} = {value:.3f} m, beyond the workspace's {low:g} to {high:g} m."
    for name, value, bound, unit in (
        ("Wrist speed", abs(reading.qd_rad_per_s[WRIST]), limits.wrist_speed_rad_per_s, "rad/s"),
        ("Force", _norm(reading.wrench[:3]), limits.force_n, "N"),
        ("Torque", _norm(reading.wrench[3:]), limits.torque_nm, "N m"),
    ):
        if value > bound.hard:
            return f"{name} is {value:.2f} {unit}, beyond the hard limit of {bound.hard:g} {unit}."
    return ""


def within(reading: RtdeSample, limits: UrLimits) -> bool:
    """Return whether all is finite and within the hard limits, at a tenth of the price of saying what is not."""
    joints, box, wrench = limits.joints, limits.workspace, reading.wrench
    position = reading.tcp_pose[:3]
    # Of what is no number all comparisons are false, and so is a sum with it among others finite.
    return (
        math.isfinite(sum(reading.q_rad) + sum(reading.qd_rad_per_s) + sum(reading.tcp_pose) + sum(wrench))
        and all(map(le, joints.lower_rad, reading.q_rad))
        and all(map(le, reading.q_rad, joints.upper_rad))
        and all(map(le, box.lower_m, position))
        and all(map(le, position, box.upper_m))
        and abs(reading.qd_rad_per_s[WRIST]) <= limits.wrist_speed_rad_per_s.hard
        and _norm(wrench[:3]) <= limits.force_n.hard
        and _norm(wrench[3:]) <= limits.torque_nm.hard
    )


def line_violation(reading: RtdeSample, limits: UrLimits) -> str:
    """Return a sentence naming the inner limit that a linear move has come to, or the empty string.

    Where a line takes the joints and what it meets is known only under way, so that it is watched and stopped at the
    inner limits, short of the hard ones.
    """
    joints = limits.joints
    braking = limits.wrist_acceleration_rad_per_s2.inner
    for number, (q, qd, low, high) in enumerate(
        zip(reading.q_rad, reading.qd_rad_per_s, joints.lower_rad, joints.upper_rad, strict=True), 1
    ):
        comes_to = q + math.copysign(qd * qd / (2 * braking), qd)
        if (qd > 0 and comes_to > high - joints.margin_rad) or (qd < 0 and comes_to < low + joints.margin_rad):
            return f"joint {number} at {q:.3f} rad came to the inner limit of its range"
    fading = _fading(reading, limits)
    return fading[0][1] if fading else ""


def _at_most(asked: float, bound: Bound, name: str) -> tuple[float, list[str]]:
    if asked <= bound.inner:
        return asked, []
    return bound.inner, [f"{name} is limited to {bound.inner:g}"]


def _safe_ramp(asked: float, target: float, reading: RtdeSample, limits: UrLimits, reaction_s: float) -> float:
    """Return the acceleration asked for, or the full braking one where the gentle one would end beyond the range."""
    speed = reading.qd_rad_per_s[WRIST]
    if target * math.copysign(1.0, speed) >= abs(speed):
        return asked
    room = _room(speed, reading, limits) - abs(speed) * _NO_OVERSHOOT * reaction_s
    needed = math.inf if room <= 0 else speed * speed / (2 * room)
    # Twice, because it only gets steeper: what a gentle ramp does not do now must be done in less room.
    return asked if asked >= 2 * needed else max(asked, limits.wrist_acceleration_rad_per_s2.inner)


def _room(direction: float, reading: RtdeSample, limits: UrLimits) -> float:
    margin = limits.joints.margin_rad
    if direction >= 0:
        return limits.joints.upper_rad[WRIST] - margin - reading.wrist_rad
    return reading.wrist_rad - limits.joints.lower_rad[WRIST] - margin


def _fading(reading: RtdeSample, limits: UrLimits) -> list[tuple[float, str]]:
    found = []
    for name, value, bound, unit in (
        ("force", _norm(reading.wrench[:3]), limits.force_n, "N"),
        ("torque", _norm(reading.wrench[3:]), limits.torque_nm, "N m"),
    ):
        if value > bound.inner:
            part = max(0.0, (bound.hard - value) / (bound.hard - bound.inner))
            found.append((part, f"{name} of {value:.2f} {unit} is above the inner limit of {bound.inner:g} {unit}"))
    return found


def _norm(vector: tuple[float, ...]) -> float:
    x, y, z = vector
    return math.sqrt(x * x + y * y + z * z)
