"""The robot's limits: commands stay within the inner ones, and a measured value beyond a hard one stops the arm.

No clock and no state, but for the samples of `Accelerations`.
"""

import math
from collections import deque

from shearloop.drivers.ur.messages import MoveLinear, RtdeOutputs, RtdeSample, WristSpeed
from shearloop.drivers.ur.poses import ONLY_TURNS_M, is_close, turn_between
from shearloop.drivers.ur.settings import Bound, InstalledTool, Six, UrLimits, UrSettings
from shearloop.errors import Hint
from shearloop.words import beyond

WRIST = 5
# The longest stop, however gentle the command.
LONGEST_STOP_S = 1.0
# Near the end of the range the speed is distance/t and takes effect after the reaction time:
# x'(s) = -x(s - reaction)/t, which approaches the end without overshoot only for t ≥ e·reaction.
_NO_OVERSHOOT = math.e
# Accelerations are means over this time by the controller's clock: the difference of two samples is mostly noise.
ACCELERATION_S = 0.04
# The pendant shows grams, tenths of a millimetre and thousandths of a radian.
PAYLOAD_KG, TOOL_M_RAD = 0.01, 1e-3
# The controller rounds its factors on speeds; the slider's steps are 1 %.
SCALING_TOLERANCE = 0.005


def clip_wrist(asked: WristSpeed, sample: RtdeSample, settings: UrSettings) -> tuple[WristSpeed, tuple[str, ...]]:
    """Return the wrist speed within the limits of speed, acceleration, force and range, and what slows the motion.

    Near the end of the range the speed is the one that can still be braked within it: v·t + v²/2a = distance, with
    t = e·`reaction_s`. Between the inner and the hard limit of force or torque the speed falls linearly to zero.
    """
    limits = settings.limits
    reasons: list[str] = []
    acceleration = _at_most(
        asked.acceleration_rad_per_s2, limits.wrist_acceleration_rad_per_s2, "acceleration", reasons
    )
    braking = limits.wrist_acceleration_rad_per_s2.inner
    if asked.rad_per_s == 0 and acceleration < braking:
        acceleration = braking
    room = max(_room(asked.rad_per_s, sample, limits), 0.0)
    lag_s = _NO_OVERSHOOT * settings.reaction_s
    brakeable = braking * (math.sqrt(lag_s**2 + 2 * room / braking) - lag_s)
    top = limits.wrist_speed_rad_per_s.inner
    speed = _at_most(abs(asked.rad_per_s), limits.wrist_speed_rad_per_s, "wrist speed", reasons, " rad/s")
    if brakeable < speed:
        speed = brakeable
        reasons.append(f"wrist 3 at {sample.wrist_rad:.3f} rad is near the end of its range")
    for share, reason in _fading(sample, limits):
        if top * share < speed:
            speed = top * share
            reasons.append(reason)
    target = math.copysign(speed, asked.rad_per_s)
    ramp = _safe_ramp(acceleration, target, sample, settings)
    if ramp > acceleration:
        reasons.append(f"wrist 3 at {sample.wrist_rad:.3f} rad has to brake harder to stay within its range")
    return WristSpeed(target, ramp), tuple(reasons)


def clip_stop(asked: float, sample: RtdeSample, settings: UrSettings) -> float:
    """Return a deceleration (rad/s²) between the needed one and the hard limit.

    The needed one is the inner limit at least, as in the script on the robot. It keeps the wrist within its range and
    ends the fastest joint's motion within `LONGEST_STOP_S`.
    """
    bound = settings.limits.wrist_acceleration_rad_per_s2
    brisk = max(asked, bound.inner, sample.fastest_rad_per_s / LONGEST_STOP_S)
    return min(_safe_ramp(brisk, 0.0, sample, settings), bound.hard)


def clip_linear(asked: MoveLinear, here: Six, limits: UrLimits) -> tuple[MoveLinear, tuple[str, ...]]:
    """Return the straight move within the inner speeds and accelerations, and each reason for a change.

    The tool turns evenly on its way: a short one with a large turn is slowed to the wrist's limits.
    """
    reasons: list[str] = []
    speed = _at_most(asked.speed_m_per_s, limits.linear_speed_m_per_s, "linear speed", reasons)
    acceleration = _at_most(
        asked.acceleration_m_per_s2, limits.linear_acceleration_m_per_s2, "linear acceleration", reasons
    )
    way_m, turn_rad = math.dist(here[:3], asked.pose[:3]), turn_between(here, asked.pose)
    if turn_rad > 0:
        # The speed of a move that only turns is one in rad/s.
        m_per_rad = way_m / turn_rad if way_m > ONLY_TURNS_M else 1.0
        turning_m_per_s = m_per_rad * limits.wrist_speed_rad_per_s.inner
        if speed > turning_m_per_s:
            reasons.append(f"linear speed is limited to {turning_m_per_s:.2g}: the tool turns by {turn_rad:.2g} rad")
            speed = turning_m_per_s
        acceleration = min(acceleration, m_per_rad * limits.wrist_acceleration_rad_per_s2.inner)
    return MoveLinear(asked.pose, speed, acceleration), tuple(reasons)


class Accelerations:
    """The measured accelerations of wrist and tool: the changes of their speeds over `ACCELERATION_S`. No clock.

    What gets slower does not count: a stop brakes up to the hard limit, and the robot's own stops brake harder.
    """

    def __init__(self) -> None:
        self._samples: deque[RtdeSample] = deque()

    def add(self, sample: RtdeSample) -> None:
        """Take a sample; a sample without a later timestamp starts again, unless it is the latest one."""
        samples = self._samples
        if samples and sample.timestamp_s <= samples[-1].timestamp_s:
            if sample.timestamp_s == samples[-1].timestamp_s:
                return
            samples.clear()
        samples.append(sample)
        while len(samples) > 2 and sample.timestamp_s - samples[1].timestamp_s > ACCELERATION_S - 1e-6:
            samples.popleft()

    def violation(self, limits: UrLimits) -> str:
        """Return a sentence that names the hard limit that an acceleration exceeds, or the empty string."""
        first, last = self._samples[0], self._samples[-1]
        span_s = last.timestamp_s - first.timestamp_s
        if span_s < ACCELERATION_S - 1e-6:
            return ""
        before, after = first.qd_rad_per_s[WRIST], last.qd_rad_per_s[WRIST]
        wrist = abs(after - before) / span_s if abs(after) >= abs(before) else 0.0
        faster = last.tcp_speed_m_per_s >= first.tcp_speed_m_per_s
        tool = math.dist(last.tcp_speed[:3], first.tcp_speed[:3]) / span_s if faster else 0.0
        return _beyond("wrist acceleration", wrist, limits.wrist_acceleration_rad_per_s2, "rad/s²") or _beyond(
            "tool acceleration", tool, limits.linear_acceleration_m_per_s2, "m/s²"
        )


def violation(sample: RtdeSample, settings: UrSettings) -> str:
    """Return a sentence that names the hard limit or the setting that the sample contradicts, or the empty string."""
    measured = (*sample.q_rad, *sample.qd_rad_per_s, *sample.tcp_pose, *sample.tcp_speed, *sample.wrench)
    if not all(map(math.isfinite, measured)):
        return "The controller reports values that are no numbers."
    limits = settings.limits
    if (outside := position_beyond_limits(sample, limits)) is not None:
        return outside.sentence
    speeds = [
        (f"joint {number} speed" if number <= WRIST else "wrist speed", abs(qd), limits.wrist_speed_rad_per_s, "rad/s")
        for number, qd in enumerate(sample.qd_rad_per_s, 1)
    ]
    tool = ("tool speed", sample.tcp_speed_m_per_s, limits.linear_speed_m_per_s, "m/s")
    for measurement in (*speeds, tool, *_loads(sample, limits)):
        if beyond := _beyond(*measurement):
            return beyond
    found = slowed_by(sample) or tool_difference(sample, settings.tool)
    return found.sentence if found is not None else ""


def position_beyond_limits(sample: RtdeOutputs, limits: UrLimits) -> Hint | None:
    """Return which joint is beyond its range, or that the tool is beyond the workspace, and the cure; or None."""
    joints, box = limits.joints, limits.box
    cure = "move the arm back with freedrive at the teach pendant, or correct `limits.{}` in the robot's settings"
    for number, (q, low, high) in enumerate(zip(sample.q_rad, joints.lower_rad, joints.upper_rad, strict=True), 1):
        if not low <= q <= high:
            at = beyond(q, low if q < low else high, 3)
            cause = f"Joint {number} is at {at} rad, beyond its hard limits of {low:g} and {high:g} rad"
            return Hint(cause, cure.format("joints"))
    for axis, value, low, high in zip("xyz", sample.tcp_pose[:3], box.lower_m, box.upper_m, strict=True):
        if not low <= value <= high:
            at = beyond(value, low if value < low else high, 3)
            cause = f"The tool is at {axis} = {at} m, beyond the workspace's {low:g} to {high:g} m"
            return Hint(cause, cure.format("workspace"))
    return None


def slowed_by(sample: RtdeOutputs) -> Hint | None:
    """Return what makes the arm turn slower than commanded, or None: a factor on speeds is a gain of the loop."""
    if abs(sample.speed_slider - 1.0) > SCALING_TOLERANCE:
        return Hint(
            f"The speed slider is at {100 * sample.speed_slider:.0f} %, which slows every motion and changes the "
            "control loop's gain",
            "set it to 100 % at the bottom of the teach pendant's screen (on a CB3, of its tabs Run and Move)",
        )
    if abs(sample.limiter_scaling - 1.0) > SCALING_TOLERANCE:
        return Hint(
            f"The controller slows every motion to {100 * sample.limiter_scaling:.0f} % by itself, which changes the "
            "control loop's gain",
            "look at the teach pendant for its limits of speed and power",
        )
    return None


def tool_difference(sample: RtdeOutputs, tool: InstalledTool) -> Hint | None:
    """Return how payload, centre of gravity or tool centre point differ from the settings, or None.

    A value that the controller does not report is NaN and differs.
    """
    load, cog, tcp = tool.payload_kg, tool.payload_cog_m, tool.tcp_offset
    if not tool.reported and _is_reported(sample.payload_kg):
        return Hint(
            "The controller reports its payload, and the robot's settings say that it does not",
            "enter payload_kg, payload_cog_m and tcp_offset of `tool` in the place of `reported`",
        )
    checks = (
        ("payload_kg", load, sample.payload_kg, load is None or abs(sample.payload_kg - load) < PAYLOAD_KG),
        ("payload_cog_m", cog, sample.payload_cog_m, cog is None or math.dist(sample.payload_cog_m, cog) < TOOL_M_RAD),
        ("tcp_offset", tcp, sample.tcp_offset, tcp is None or is_close(sample.tcp_offset, tcp, TOOL_M_RAD)),
    )  # fmt: skip
    for name, configured, found, same in checks:
        if not same and not _is_reported(found):
            return Hint(
                f"The controller does not report {name}, and the robot's settings have {_rounded(configured)}",
                "install PolyScope 3.12 (CB3) or 5.5.1 (e-Series), or write `tool: {reported: false}` into the "
                "settings",
            )
        if not same:
            return Hint(
                f"The controller has {name} {_rounded(found)}, the robot's settings have {_rounded(configured)}",
                "correct the payload and the tool centre point at the teach pendant, or the settings",
            )
    return None


def _is_reported(value: float | tuple[float, ...]) -> bool:
    values = value if isinstance(value, tuple) else (value,)
    return not any(map(math.isnan, values))


def _rounded(value: float | tuple[float, ...] | None) -> str:
    values = value if isinstance(value, tuple) else (value,)
    return ", ".join("unknown" if number is None else f"{number:.4g}" for number in values)


def _beyond(name: str, value: float, bound: Bound, unit: str) -> str:
    # Rounding errors do not count.
    if round(value, 9) <= bound.hard:
        return ""
    return (
        f"{name.capitalize()} is {beyond(value, bound.hard, 2)} {unit}, beyond the hard limit of {bound.hard:g} {unit}."
    )


def line_violation(sample: RtdeSample, limits: UrLimits) -> str:
    """Return a sentence that names the inner limit that a straight move has reached, or the empty string.

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
    return next((reason for _, reason in _fading(sample, limits)), "")


def _at_most(asked: float, bound: Bound, name: str, reasons: list[str], unit: str = "") -> float:
    if asked > bound.inner:
        reasons.append(f"{name} is limited to {bound.inner:g}{unit}")
    return min(asked, bound.inner)


def _safe_ramp(asked: float, target: float, sample: RtdeSample, settings: UrSettings) -> float:
    """Return the acceleration asked for, or full braking where the gentle ramp would leave the range."""
    speed = sample.qd_rad_per_s[WRIST]
    if target * math.copysign(1.0, speed) >= abs(speed):
        return asked
    room = _room(speed, sample, settings.limits) - abs(speed) * _NO_OVERSHOOT * settings.reaction_s
    needed = math.inf if room <= 0 else speed * speed / (2 * room)
    # Twice, because the needed braking only grows as the room shrinks.
    return asked if asked >= 2 * needed else max(asked, settings.limits.wrist_acceleration_rad_per_s2.inner)


def _room(direction: float, sample: RtdeSample, limits: UrLimits) -> float:
    margin = limits.joints.margin_rad
    if direction >= 0:
        return limits.joints.upper_rad[WRIST] - margin - sample.wrist_rad
    return sample.wrist_rad - limits.joints.lower_rad[WRIST] - margin


def _fading(sample: RtdeSample, limits: UrLimits) -> list[tuple[float, str]]:
    """Return the fraction of the speed left, and the reason, for each of force and torque above its inner limit."""
    found = []
    for name, value, bound, unit in _loads(sample, limits):
        if value > bound.inner:
            share = max(0.0, (bound.hard - value) / (bound.hard - bound.inner))
            measured = beyond(value, bound.inner, 2)
            found.append((share, f"{name} of {measured} {unit} is above the inner limit of {bound.inner:g} {unit}"))
    return found


def _loads(sample: RtdeSample, limits: UrLimits) -> tuple[tuple[str, float, Bound, str], ...]:
    force_n, torque_nm = math.hypot(*sample.wrench[:3]), math.hypot(*sample.wrench[3:])
    return ("force", force_n, limits.force_n, "N"), ("torque", torque_nm, limits.torque_nm, "N m")
