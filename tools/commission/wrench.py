"""Stage 5: the wrench at rest, over program starts and poses, and with a hung mass."""

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from scipy import constants

from shearloop.daemon.commissioning_report import Line
from shearloop.drivers.ranges import LARGEST_PAYLOAD_KG
from shearloop.drivers.ur.settings import Six, UrSettings
from shearloop.errors import UserError
from shearloop.tools.arm_models import SMALLEST_ARM_KG, UNKNOWN_ARM, Arm
from shearloop.tools.commission.bounds import LARGEST_M, LARGEST_M_PER_S
from shearloop.tools.commission.context import Context
from shearloop.tools.commission.motion import SPEED_RAD_PER_S, TURN_RAD
from shearloop.tools.commission.observer import Seen
from shearloop.tools.commission.operator import Played
from shearloop.tools.commission.report import Measured, judged

STAGE: Final = "5 wrench"
SIGMAS: Final = 5.0
MASS_TOLERANCE: Final = 0.1
LARGEST_KG: Final = 5.0
_READ_S: Final = 2.0


@dataclass(frozen=True, slots=True)
class Reading:
    """The mean wrench of an arm that stands, the standard deviations of force and torque, and the mean's error."""

    mean: Six
    force_sigma_n: float
    torque_sigma_nm: float
    torque_error_nm: float
    """The standard error of the mean torque."""

    @classmethod
    def of(cls, samples: Sequence[Seen]) -> "Reading":
        """Return the reading of some samples."""
        columns = list(zip(*(seen.outputs.wrench for seen in samples), strict=True))
        x, y, z, a, b, c = (statistics.fmean(column) for column in columns)
        sigmas = [statistics.pstdev(column) for column in columns]
        sigma_nm = math.hypot(*sigmas[3:])
        return cls((x, y, z, a, b, c), math.hypot(*sigmas[:3]), sigma_nm, sigma_nm / math.sqrt(len(samples)))

    @property
    def force_n(self) -> float:
        """The size of the mean force."""
        return math.hypot(*self.mean[:3])

    @property
    def torque_nm(self) -> float:
        """The size of the mean torque."""
        return math.hypot(*self.mean[3:])


def measure(context: Context) -> Measured:
    """Return the stage's lines."""
    context.operator.act("See that nothing touches the tool and that nothing hangs on it")
    readings = [_after_start(context) for _ in range(context.counts.starts)]
    readings += _at_poses(context)
    lines = judge_rest(readings, context.settings)
    return Measured([*lines, hung_mass(context)])


def _after_start(context: Context) -> Reading:
    """Start the control program again, and read the wrench."""
    context.ready()
    context.stop_program()
    context.ready()
    return read(context)


def read(context: Context) -> Reading:
    """Return the wrench of the next seconds; raises UserError where nothing is received."""
    context.observer.forget()
    samples = context.observer.listen(_READ_S)
    if not samples:
        raise UserError("the observer receives nothing from the controller: look at its cable")
    return Reading.of(samples)


def _at_poses(context: Context) -> list[Reading]:
    """Read the wrench at both ends of the allowed turn, and 20 mm back along the tool."""
    mover, middle_rad = context.ready(), context.pose_rad
    context.operator.allow(
        f"wrist 3 turns by {TURN_RAD:g} rad either way at {SPEED_RAD_PER_S:g} rad/s; then the tool moves "
        f"{1e3 * LARGEST_M:g} mm towards the robot at {LARGEST_M_PER_S:g} m/s, and back"
    )
    readings = []
    speed = min(SPEED_RAD_PER_S, context.settings.limits.wrist_speed_rad_per_s.inner)
    for way in (1.0, -1.0):
        mover.move("turn", rad_per_s=way * speed, to_rad=middle_rad + way * TURN_RAD)
        readings.append(read(context))
    mover.move("turn", rad_per_s=speed, to_rad=middle_rad)
    for way in (-1.0, 1.0):
        mover.move("line", metres=way * LARGEST_M, m_per_s=LARGEST_M_PER_S)
        readings.append(read(context))
    return readings


def judge_rest(readings: Sequence[Reading], settings: UrSettings) -> list[Line]:
    """Return the lines on the wrench that nothing exerts."""
    facts, limits = settings.facts, settings.limits
    lines: list[Line] = []
    for what, unit, bias, sigma, noise, inner in (
        (
            *("force", "N"),
            max(reading.force_n for reading in readings),
            max(reading.force_sigma_n for reading in readings),
            *(facts.noise_n, limits.force_n.inner),
        ),
        (
            *("torque", "N·m"),
            max(reading.torque_nm for reading in readings),
            max(reading.torque_sigma_nm for reading in readings),
            *(facts.noise_nm, limits.torque_nm.inner),
        ),
    ):
        needed = SIGMAS * sigma + bias
        lines += [
            judged(
                f"{what} at rest",
                f"{bias:.3g} {unit}",
                f"at most {noise:g} {unit}, of {facts.name}",
                "the wrench has its zero",
                passed=bias <= noise,
                count=len(readings),
            ),
            judged(
                f"{what}: {SIGMAS:g} σ + bias",
                f"{needed:.3g} {unit}",
                f"at most limits.{'force_n' if unit == 'N' else 'torque_nm'}.inner, {inner:g} {unit}: else widen it",
                "a limit does not stop the arm at random",
                passed=needed <= inner,
                count=len(readings),
            ),
        ]
    return lines


def hung_mass(context: Context) -> Line:
    """Return the line on a mass that the operator hangs on the tool, if one may hang that shows."""
    settings, least_kg = context.settings, least_mass_kg(context.settings)
    payload_kg = settings.tool.payload_kg
    if payload_kg is None:
        payload_kg = context.observer.latest().outputs.payload_kg
    if math.isnan(payload_kg):
        payload_kg = context.operator.number("The payload in kg that is set at the pendant", 0.0, LARGEST_PAYLOAD_KG)
    arm = context.rig.arm()
    if not arm.rated_kg and context.config.emulated:
        arm = Arm("emulated arm", (LARGEST_PAYLOAD_KG,))
    largest_kg, because = largest_mass_kg(settings, payload_kg, arm)
    if largest_kg < least_kg:
        value = (
            f"not measured: the wrench shows masses from {least_kg:g} kg on, and at most {largest_kg:g} kg may hang: "
            f"{because}. The scale of the wrench's force stays unmeasured"
        )
        return Line(what="hung mass", value=value)
    before = read(context)
    kg = context.operator.number(
        f"Hang a known mass on the tool and let it rest ({because}); its mass in kg",
        *(least_kg, largest_kg),
        Played(f"the mass that you type is hung for you, for instance {least_kg:g}", ("robot hang {}",)),
    )
    after = read(context)
    context.operator.act("Take the mass off", Played("it is taken off for you", ("robot hang 0",)))
    return judge_mass(before, after, kg, settings)


def largest_mass_kg(settings: UrSettings, payload_kg: float, arm: Arm = UNKNOWN_ARM) -> tuple[float, str]:
    """Return the largest mass that may hang on the tool in addition to its payload, and its bound in words.

    An arm counts as the smallest one of its model, and as the smallest of all where its model is not known. The weight
    stays below the limit at which the arm stops.
    """
    if not arm.rated_kg:
        rated_kg, rated = SMALLEST_ARM_KG, "an arm of unknown model may be rated for"
    elif len(arm.rated_kg) == 1:
        rated_kg, rated = arm.rated_kg[0], f"this {arm.model} is rated for"
    else:
        rated_kg, rated = arm.rated_kg[0], f"a {arm.model} of an earlier year is rated for"
    stops_n = settings.limits.force_n.hard
    bounds = [
        (LARGEST_KG, f"at most {LARGEST_KG:g} kg is needed"),
        (rated_kg - payload_kg, f"{rated} {rated_kg:g} kg, and its payload is {payload_kg:g} kg"),
        ((stops_n - settings.facts.noise_n) / constants.g, f"limits.force_n.hard stops the arm at {stops_n:g} N"),
    ]
    largest_kg, because = min(bounds)
    return max(0.0, math.floor(10.0 * largest_kg + 1e-9) / 10.0), because


def least_mass_kg(settings: UrSettings) -> float:
    """Return the smallest mass that the wrench must notice: its weight is twice the noise of the wrench."""
    return math.ceil(20 * settings.facts.noise_n / constants.g) / 10


def judge_mass(before: Reading, after: Reading, kg: float, settings: UrSettings) -> Line:
    """Return the line on the force of a known mass."""
    weight_n = kg * constants.g
    found_n = math.dist(after.mean[:3], before.mean[:3])
    allowed_n = max(MASS_TOLERANCE * weight_n, settings.facts.noise_n)
    return judged(
        "hung mass",
        f"{found_n:.2f} N of {weight_n:.2f} N",
        f"± {allowed_n:.2f} N",
        "forces are right",
        passed=abs(found_n - weight_n) <= allowed_n,
    )
