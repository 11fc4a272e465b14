"""Commands clipped to the limits, and measured states checked against them."""

import math

from shearloop.drivers.ur.messages import (
    ROBOT_MODE_RUNNING,
    SAFETY_NORMAL,
    SAFETY_REDUCED,
    MoveLinear,
    RtdeSample,
    Stop,
    WristSpeed,
)
from shearloop.drivers.ur.settings import Bound, UrLimits, UrSettings

WRIST = 5
# The longest stop, however gentle the command.
LONGEST_STOP_S = 1.0
# Near the end of the range the speed is distance/t and takes effect after the reaction time:
# x'(s) = -x(s - reaction)/t, which approaches the end without overshoot only for t ≥ e·reaction.
_NO_OVERSHOOT = math.e


def clip_wrist(
    asked: WristSpeed, sample: RtdeSample, limits: UrLimits, reaction_s: float
) -> tuple[WristSpeed, tuple[str, ...]]:
    """Return the wrist speed within the limits of speed, acceleration, force and range, and each reason for a change.

    Near the end of the range the speed is the one that can still be braked within it: v·t + v²/2a = distance, with
    t = e·`reaction_s`. Between the inner and the hard limit of force or torque the speed falls linearly to zero.
    """
    reasons: list[str] = []
    acceleration, slower = _at_most(asked.acceleration_rad_per_s2, limits.wrist_acceleration_rad_per_s2, "acceleration")
    reasons += slower
    braking = limits.wrist_acceleration_rad_per_s2.inner
    room = max(_room(asked.rad_per_s, sample, limits), 0.0)
    lag_s = _NO_OVERSHOOT * reaction_s
    brakeable = braking * (math.sqrt(lag_s**2 + 2 * room / braking) - lag_s)
    top = limits.wrist_speed_rad_per_s.inner
    speed = abs(asked.rad_per_s)
    if top < speed:
        speed = top
        reasons.append(f"wrist speed is limited to {top:g} rad/s")
    if brakeable < speed:
        speed = brakeable
        reasons.append(f"wrist 3 at {sample.wrist_rad:.3f} rad is near the end of its range")
    for share, reason in _fading(sample, limits):
        if top * share < speed:
            speed = top * share
            reasons.append(reason)
    target = math.copysign(speed, asked.rad_per_s)
    ramp = _safe_ramp(acceleration, target, sample, limits, reaction_s)
    if ramp > acceleration:
        reasons.append(f"wrist 3 at {sample.wrist_rad:.3f} rad has to brake harder to stay within its range")
    return WristSpeed(target, ramp), tuple(reasons)


def clip_stop(asked: Stop, sample: RtdeSample, limits: UrLimits, reaction_s: float) -> Stop:
    """Return the stop with a deceleration between the needed one and the hard limit.

    The needed one keeps the wrist within its range and ends the fastest joint's motion within `LONGEST_STOP_S`.
    """
    brisk = max(asked.deceleration_rad_per_s2, sample.fastest_rad_per_s / LONGEST_STOP_S)
    safe = _safe_ramp(brisk, 0.0, sample, limits, reaction_s)
    return Stop(min(safe, limits.wrist_acceleration_rad_per_s2.hard))


def clip_linear(asked: MoveLinear, limits: UrLimits) -> tuple[MoveLinear, tuple[str, ...]]:
    """Return the linear move within the inner workspace, speed and acceleration, and each reason for a change.

    The box is convex: a line between two points inside it stays inside.
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
    return MoveLinear((x, y, z, *asked.pose[3:]), speed, acceleration), tuple(reasons)


def is_recent(sample: RtdeSample, settings: UrSettings) -> bool:
    """Return whether the connection is up and the sample is young enough to act on."""
    return sample.connected and sample.age_ns <= settings.state_timeout_s * 1e9


def why_unfit(sample: RtdeSample, settings: UrSettings) -> str:
    """Return why the controller cannot take motion commands, or the empty string."""
    if not sample.connected:
        return f"The connection to the robot at {settings.host} is lost."
    if not is_recent(sample, settings):
        return (
            f"The latest state from the controller at {settings.host} is {sample.age_ns / 1e9:.2f} s old: check its "
            "cable, other traffic on the network, and with a simulator whether its clock is slower than real time."
        )
    if sample.protective_stop:
        return "Protective stop: look for its cause, clear the workspace, then unlock (not in the first 5 s)."
    if sample.emergency_stop:
        return "Emergency stop: make the cell safe, release the button, then unlock."
    if sample.safety_mode not in (SAFETY_NORMAL, SAFETY_REDUCED):
        return _SAFETY.get(sample.safety_mode, f"The robot's safety system is in mode {sample.safety_mode}.")
    if sample.robot_mode != ROBOT_MODE_RUNNING:
        return f"The arm is not powered and released (robot mode {sample.robot_mode}): unlock to power it."
    if sample.program_paused:
        return (
            "A program on the robot is paused, and goes on with what it did when it is resumed: stop it at the teach "
            "pendant, or unlock, which stops it and starts the control program."
        )
    if not sample.program_running:
        return (
            "The control program on the robot does not run: it was stopped at the pendant, or by the watchdog when "
            "commands came late. Unlock to start it again."
        )
    return ""


_SAFETY = {
    4: "The robot is in recovery mode: move it back within its safety limits at the teach pendant.",
    5: "A safeguard stop holds the robot: close the safeguard, then unlock.",
    8: "The robot's safety system reports a violation: restart it at the teach pendant.",
    9: "The robot's safety system reports a fault: restart the controller.",
}


def violation(sample: RtdeSample, limits: UrLimits) -> str:
    """Return a sentence that names the hard limit that the sample exceeds, or the empty string."""
    if not all(map(math.isfinite, (*sample.q_rad, *sample.qd_rad_per_s, *sample.tcp_pose, *sample.wrench))):
        return "The controller reports values that are no numbers."
    joints, box = limits.joints, limits.workspace
    for number, (q, low, high) in enumerate(zip(sample.q_rad, joints.lower_rad, joints.upper_rad, strict=True), 1):
        if not low <= q <= high:
            return f"Joint {number} is at {q:.3f} rad, beyond its hard limits of {low:g} and {high:g} rad."
    for axis, value, low, high in zip("xyz", sample.tcp_pose[:3], box.lower_m, box.upper_m, strict=True):
        if not low <= value <= high:
            return f"The tool is at {axis} = {value:.3f} m, beyond the workspace's {low:g} to {high:g} m."
    for name, value, bound, unit in (
        ("Wrist speed", abs(sample.qd_rad_per_s[WRIST]), limits.wrist_speed_rad_per_s, "rad/s"),
        ("Force", math.hypot(*sample.wrench[:3]), limits.force_n, "N"),
        ("Torque", math.hypot(*sample.wrench[3:]), limits.torque_nm, "N m"),
    ):
        if value > bound.hard:
            return f"{name} is {value:.2f} {unit}, beyond the hard limit of {bound.hard:g} {unit}."
    return ""


def line_violation(sample: RtdeSample, limits: UrLimits) -> str:
    """Return a sentence that names the inner limit that a linear move has reached, or the empty string.

    The joint angles and forces along a line are not known in advance, so that the move stops at the inner limits.
    """
    joints = limits.joints
    braking = limits.wrist_acceleration_rad_per_s2.inner
    for number, (q, qd, low, high) in enumerate(
        zip(sample.q_rad, sample.qd_rad_per_s, joints.lower_rad, joints.upper_rad, strict=True), 1
    ):
        stops_at = q + math.copysign(qd * qd / (2 * braking), qd)
        if (qd > 0 and stops_at > high - joints.margin_rad) or (qd < 0 and stops_at < low + joints.margin_rad):
            return f"joint {number} at {q:.3f} rad came to the inner limit of its range"
    fading = _fading(sample, limits)
    return fading[0][1] if fading else ""


def _at_most(asked: float, bound: Bound, name: str) -> tuple[float, list[str]]:
    if asked <= bound.inner:
        return asked, []
    return bound.inner, [f"{name} is limited to {bound.inner:g}"]


def _safe_ramp(asked: float, target: float, sample: RtdeSample, limits: UrLimits, reaction_s: float) -> float:
    """Return the acceleration asked for, or full braking where the gentle ramp would leave the range."""
    speed = sample.qd_rad_per_s[WRIST]
    if target * math.copysign(1.0, speed) >= abs(speed):
        return asked
    room = _room(speed, sample, limits) - abs(speed) * _NO_OVERSHOOT * reaction_s
    needed = math.inf if room <= 0 else speed * speed / (2 * room)
    # Twice, because the needed braking only grows as the room shrinks.
    return asked if asked >= 2 * needed else max(asked, limits.wrist_acceleration_rad_per_s2.inner)


def _room(direction: float, sample: RtdeSample, limits: UrLimits) -> float:
    margin = limits.joints.margin_rad
    if direction >= 0:
        return limits.joints.upper_rad[WRIST] - margin - sample.wrist_rad
    return sample.wrist_rad - limits.joints.lower_rad[WRIST] - margin


def _fading(sample: RtdeSample, limits: UrLimits) -> list[tuple[float, str]]:
    """Return the share of the speed left, and the reason, for each of force and torque above its inner limit."""
    found = []
    for name, value, bound, unit in (
        ("force", math.hypot(*sample.wrench[:3]), limits.force_n, "N"),
        ("torque", math.hypot(*sample.wrench[3:]), limits.torque_nm, "N m"),
    ):
        if value > bound.inner:
            share = max(0.0, (bound.hard - value) / (bound.hard - bound.inner))
            found.append((share, f"{name} of {value:.2f} {unit} is above the inner limit of {bound.inner:g} {unit}"))
    return found
