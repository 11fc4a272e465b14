"""Stage 5: the wrench at rest, over program starts and poses, and with a hung mass."""

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from scipy import constants

from shearloop.daemon.commissioning import Line
from shearloop.drivers.ur.settings import Six, UrSettings
from shearloop.errors import UserError
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
    """The mean wrench of an arm that stands, and the standard deviations of its force and torque."""

    mean: Six
    force_sigma_n: float
    torque_sigma_nm: float

    @classmethod
    def of(cls, samples: Sequence[Seen]) -> "Reading":
        """Return the reading of some samples."""
        columns = list(zip(*(seen.outputs.wrench for seen in samples), strict=True))
        x, y, z, a, b, c = (statistics.fmean(column) for column in columns)
        sigmas = [statistics.pstdev(column) for column in columns]
        return cls((x, y, z, a, b, c), math.hypot(*sigmas[:3]), math.hypot(*sigmas[3:]))

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
    return Measured([*lines, _hung_mass(context)])


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


def _hung_mass(context: Context) -> Line:
    before, least_kg = read(context), least_mass_kg(context.settings)
    kg = context.operator.number(
        "Hang a known mass on the tool and let it rest; its mass in kg",
        *(least_kg, LARGEST_KG),
        Played(f"the mass that you type is hung for you, for instance {math.ceil(least_kg):g}", ("robot hang {}",)),
    )
    after = read(context)
    context.operator.act("Take the mass off", Played("it is taken off for you", ("robot hang 0",)))
    return judge_mass(before, after, kg, context.settings)


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
