"""Settings of the robot's driver: address, limits and deadlines, read from YAML.

All limits are magnitudes. A measured value beyond a `hard` limit stops the motion. Commands are clipped to the `inner`
limit, so that no command reaches the hard one.
"""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, ClassVar, Final, Literal, get_type_hints

from pydantic import Field, GetCoreSchemaHandler
from pydantic_core.core_schema import CoreSchema, lax_or_strict_schema, no_info_before_validator_function

from shearloop.drivers import ranges
from shearloop.drivers.errors import DriverError
from shearloop.drivers.hosts import is_loopback_host, why_no_address
from shearloop.drivers.ur.poses import tool_axis
from shearloop.models import booleans_as_text

Six = tuple[float, float, float, float, float, float]
Three = tuple[float, float, float]

# An acceleration is the change of a speed over 0.04 s, which needs two states.
_SLOWEST_HZ = 50.0
# Two cycles of a CB3, and some rounding. A shorter deadline would end between two commands.
_SHORTEST_DEADLINE_S = 0.02
# The arm can move this long without its daemon.
_Deadline = Annotated[float, Field(ge=_SHORTEST_DEADLINE_S, le=1)]
# The connection asks several ports in turn, each for at least an eighth of the time.
_SHORTEST_CONNECT_S = 1.0
# A busy computer can pause a process for so long; by then the arm stands.
_SHORTEST_HANG_S = 0.3
# A protective stop can be cleared after 5 s; power and brakes take some more.
_SHORTEST_RECOVERY_S = 10.0
# A controller takes a command in its next cycle, which takes 8 ms on a CB3, 2 ms on an e-Series.
_SHORTEST_REACTION_S = 0.002
# Slower than any arm: such a delay was written in another unit.
LONGEST_REACTION_S = 0.5
# The speeds of an arm at rest reach 0.003 rad/s by noise. With a lower threshold an arm is never at rest.
MIN_REST_RAD_PER_S = 0.002
# The largest age of a state with which a robot on another computer may move.
_LONGEST_STATE_S = 1.0
# The longest time from the last decision until the wrist stands (docs/safety.md).
PROMISED_S = 0.2
# A client has this time to stop a straight move after its deadline; then the script does.
MOVE_GRACE_S = 0.05
# Two cycles of a controller, and some rounding.
_CYCLES_S = 0.02
# A straight move goes on for this fraction of the silence at least.
_SHORTEST_LEASE = 0.3
# The watchdog is slower than a stop by this factor.
_WATCHDOG_FACTOR = 1.5
# Speeds of up to 0.003 rad/s were reported from arms that stand.
REST_RAD_PER_S = 0.01
RestSpeed = Annotated[float, Field(ge=MIN_REST_RAD_PER_S, le=0.05)]


Generation = Literal["e-series", "cb3"]


# A tool centre point within these counts as on the axis of wrist 3.
MAX_ASIDE_M, MAX_TILT_RAD = 0.01, 0.05
# A torque of the wrench is the mean of at least this number of states.
WRENCH_STATES: Final = 16
# Of the states of `rate_hz`, fewer than this fraction are too few to rely on.
ENOUGH_STATES: Final = 2.0 / 3.0


@dataclass(frozen=True, slots=True)
class GenerationFacts:
    """The differences between UR's generations of controllers."""

    name: str
    # PolyScope's major version.
    major: int
    # The largest number of states per second.
    most_hz: float
    # The time of a cycle, in URScript.
    step: str
    # Whether the controller can zero its wrench: `zero_ftsensor` ends a CB3's program.
    zeroes_wrench: bool
    # Whether the controller zeroes its wrench when a program starts.
    zeroes_at_start: bool
    # The noise of the wrench: a CB3 estimates it from the joints' currents.
    noise_n: float
    noise_nm: float

    @property
    def mean_noise_nm(self) -> float:
        """The uncertainty of the mean torque of `WRENCH_STATES` states, N·m; a mean keeps the error of an estimate."""
        return self.noise_nm / math.sqrt(WRENCH_STATES) if self.zeroes_wrench else self.noise_nm

    @property
    def estimated_nm(self) -> float:
        """The uncertainty of an estimated torque, N·m; 0 for a measured one: the commissioning judges its noise."""
        return 0.0 if self.zeroes_wrench else self.noise_nm


GENERATIONS: Final[dict[Generation, GenerationFacts]] = {
    "e-series": GenerationFacts(
        "an e-Series", 5, 500.0, "get_steptime()", zeroes_wrench=True, zeroes_at_start=True, noise_n=3.5, noise_nm=0.2
    ),
    "cb3": GenerationFacts(
        "a CB3", 3, 125.0, "0.008", zeroes_wrench=False, zeroes_at_start=False, noise_n=10.0, noise_nm=5.0
    ),
}


class _Checked:
    """Makes pydantic refuse unknown keys, booleans and infinities as numbers, and describe keys by their docstrings."""

    __slots__ = ()
    __pydantic_config__: ClassVar = {"extra": "forbid", "allow_inf_nan": False, "use_attribute_docstrings": True}

    @classmethod
    def __get_pydantic_core_schema__(cls, source: type, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Return a section's schema that refuses a boolean as a number; pydantic's strict schema does so by itself."""
        types, strict = get_type_hints(source), handler(source)
        lax = no_info_before_validator_function(lambda content: booleans_as_text(content, types), strict)
        return lax_or_strict_schema(lax, strict)


@dataclass(frozen=True, slots=True)
class Bound(_Checked):
    """A limit: commands stay at or below `inner`, measured values below `hard`."""

    inner: float
    """Commands are clipped to it."""
    hard: float
    """A measured value beyond it stops the motion."""

    def __post_init__(self) -> None:
        """Refuse limits in the wrong order."""
        if self.inner >= self.hard:
            raise ValueError(f"inner ({self.inner:g}) must be below hard ({self.hard:g})")


@dataclass(frozen=True, slots=True)
class WristSpeedBound(Bound):
    """Limits on the wrist's speed."""

    inner: ranges.WristSpeed
    """Commands are clipped to it."""
    hard: ranges.MeasuredWristSpeed
    """A faster joint stops the motion."""


@dataclass(frozen=True, slots=True)
class WristAccelerationBound(Bound):
    """Limits on the wrist's acceleration."""

    inner: ranges.WristAcceleration
    """Commands are clipped to it."""
    hard: ranges.WristAcceleration
    """A larger measured value stops the motion; a stop brakes between `inner` and this value."""


@dataclass(frozen=True, slots=True)
class SpeedBound(Bound):
    """Limits on the tool's speed."""

    inner: ranges.Speed
    """Commands are clipped to it."""
    hard: ranges.MeasuredSpeed
    """A faster tool stops the motion."""


@dataclass(frozen=True, slots=True)
class AccelerationBound(Bound):
    """Limits on the tool's acceleration."""

    inner: ranges.Acceleration
    """Commands are clipped to it."""
    hard: ranges.Acceleration
    """A larger measured value stops the motion."""


@dataclass(frozen=True, slots=True)
class ForceBound(Bound):
    """Limits on the force on the tool."""

    inner: ranges.ToolForce
    """From this value on the wrist turns slower, and a straight move stops."""
    hard: ranges.ToolForce
    """A larger measured value stops the motion. The script on a CB3 does not subtract a tare."""


@dataclass(frozen=True, slots=True)
class TorqueBound(Bound):
    """Limits on the torque on the tool."""

    inner: ranges.ToolTorque
    """From this value on the wrist turns slower, and a straight move stops."""
    hard: ranges.ToolTorque
    """A larger measured value stops the motion. The script on a CB3 does not subtract a tare."""


def _check_range(lower: tuple[float, ...], upper: tuple[float, ...], margin: float) -> None:
    for number, (low, high) in enumerate(zip(lower, upper, strict=True), start=1):
        if low + 2 * margin >= high:
            raise ValueError(f"entry {number}: no room between {low:g} and {high:g} with a margin of {margin:g}")


@dataclass(frozen=True, slots=True)
class JointRange(_Checked):
    """The hard ends of each joint's range in rad, and the margin that commands keep from them."""

    lower_rad: ranges.Joints
    """Lowest angle of each joint."""
    upper_rad: ranges.Joints
    """Highest angle of each joint."""
    margin_rad: ranges.AngleMargin
    """Distance that commands keep from both."""

    def __post_init__(self) -> None:
        """Refuse a range without room between the margins."""
        _check_range(self.lower_rad, self.upper_rad, self.margin_rad)


@dataclass(frozen=True, slots=True)
class Workspace(_Checked):
    """The box for the tool centre point in m, in the base frame, and the margin that commands keep from its faces."""

    lower_m: ranges.Position
    """Lowest x, y and z of the tool centre point in the base frame."""
    upper_m: ranges.Position
    """Highest x, y and z."""
    margin_m: ranges.CoordinateMargin
    """Distance that commands keep from both."""

    def __post_init__(self) -> None:
        """Refuse a box without room between the margins."""
        _check_range(self.lower_m, self.upper_m, self.margin_m)

    def why_outside(self, position_m: Three) -> str:
        """Return which coordinate of a tool centre point commands may not reach, with its bounds, or an empty string.

        The box is convex: a straight line between two points inside stays inside.
        """
        for axis, value, low, high in zip("xyz", position_m, self.lower_m, self.upper_m, strict=True):
            lowest, highest = low + self.margin_m, high - self.margin_m
            if not lowest <= value <= highest:
                box = f"{lowest:g} to {highest:g} m with its margin"
                return f"{axis} = {value:g} m, outside the robot's workspace, which is {box}"
        return ""


# If the settings leave the workspace open, an emulated arm stands in this box, and a real robot does not run.
_EMULATED_WORKSPACE = Workspace(lower_m=(-0.8, -0.8, 0.0), upper_m=(0.8, 0.8, 0.9), margin_m=0.02)


@dataclass(frozen=True, slots=True)
class UrLimits(_Checked):
    """The limits on commands and on measured states."""

    joints: JointRange
    """Range of each joint."""
    workspace: Workspace | None = field(default=None, kw_only=True)
    """Box for the tool centre point; a real robot does not run without it."""
    wrist_speed_rad_per_s: WristSpeedBound
    """Speed of the last joint."""
    wrist_acceleration_rad_per_s2: WristAccelerationBound
    """Acceleration of the last joint."""
    linear_speed_m_per_s: SpeedBound
    """Speed of the tool centre point."""
    linear_acceleration_m_per_s2: AccelerationBound
    """Acceleration of the tool centre point."""
    force_n: ForceBound
    """Force as the controller reports it."""
    torque_nm: TorqueBound
    """Torque as the controller reports it."""

    @property
    def box(self) -> Workspace:
        """The workspace; if it is left open, the workspace of an emulated arm."""
        return _EMULATED_WORKSPACE if self.workspace is None else self.workspace


@dataclass(frozen=True, slots=True)
class InstalledTool(_Checked):
    """Payload and tool centre point that the pendant must have for motion; a real robot does not run without them."""

    payload_kg: ranges.Payload | None = None
    """Mass of the load."""
    payload_cog_m: ranges.ToolCentre | None = None
    """Centre of gravity of the load, from the flange."""
    tcp_offset: ranges.ToolOffset | None = None
    """Tool centre point from the flange: position in m, rotation vector in rad."""
    reported: bool = True
    """`false` for a controller below PolyScope 3.12 or 5.5.1, which reports none of these values: none is compared."""

    def __post_init__(self) -> None:
        """Refuse values that no controller reports."""
        if not self.reported and len(self.absent) < len(self._values):
            raise ValueError(f"`reported: false` compares nothing: take {' and '.join(self._values)} out")
        if self.tcp_offset is not None and (beside := _beside_the_axis(self.tcp_offset)):
            raise ValueError(
                f"tcp_offset: the tool centre point {beside}, and the torque about wrist 3 is then not the one on the "
                "tool: put it onto the axis, at the teach pendant too"
            )

    @property
    def _values(self) -> dict[str, object]:
        return {"payload_kg": self.payload_kg, "payload_cog_m": self.payload_cog_m, "tcp_offset": self.tcp_offset}

    @property
    def absent(self) -> list[str]:
        """The keys without a value."""
        return [key for key, value in self._values.items() if value is None]


def _beside_the_axis(tcp_offset: Six) -> str:
    """Return how a tool centre point leaves the axis of wrist 3, or an empty string."""
    aside_m = math.hypot(*tcp_offset[:2])
    tilt_rad = math.acos(min(1.0, max(-1.0, tool_axis(tcp_offset)[2])))
    if aside_m > MAX_ASIDE_M:
        return f"lies {1e3 * aside_m:.0f} mm beside the axis of wrist 3"
    if tilt_rad > MAX_TILT_RAD:
        return f"is tilted by {tilt_rad:.2f} rad against the axis of wrist 3"
    return ""


@dataclass(frozen=True, slots=True)
class UrSettings(_Checked):
    """The robot's address, its limits, and the deadlines of the driver."""

    host: str
    """The robot's address."""
    limits: UrLimits
    """Limits on commands and on measured states."""
    generation: Generation = "e-series"
    """The controller's generation."""
    tool: InstalledTool = InstalledTool()
    """Payload and tool centre point that the pendant must have for motion."""
    rate_hz: Annotated[float, Field(ge=_SLOWEST_HZ, le=500)] = 125.0
    """Robot states per second; up to 125 from a CB3."""
    command_timeout_s: _Deadline = 0.1
    """A wrist speed holds for this long after its decision, and after the robot's last state; then the wrist stops."""
    silence_timeout_s: _Deadline = 0.1
    """Other motion stops when the daemon sends nothing for this long."""
    state_timeout_s: Annotated[float, Field(ge=_SHORTEST_DEADLINE_S, le=10)] = 0.25
    """An older state blocks motion; at three times this age the connection counts as lost. More than 1 s
    only for an emulated robot on this computer."""
    connect_timeout_s: Annotated[float, Field(ge=_SHORTEST_CONNECT_S, le=60)] = 10.0
    """Time for connecting."""
    hang_timeout_s: Annotated[float, Field(ge=_SHORTEST_HANG_S, le=10)] = 1.5
    """A longer cycle is a hang and ends the worker, because calls of ur-rtde block for up to 301 s."""
    recover_timeout_s: Annotated[float, Field(ge=_SHORTEST_RECOVERY_S, le=300)] = 30.0
    """Time for each step of making the robot ready: power, brakes, control program."""
    reaction_s: Annotated[float, Field(ge=_SHORTEST_REACTION_S, le=LONGEST_REACTION_S)] = 0.04
    """Delay until a commanded speed takes effect; distances to the joint limits include it."""
    rest_rad_per_s: RestSpeed = REST_RAD_PER_S
    """A joint slower than this is at rest."""

    def __post_init__(self) -> None:
        """Refuse an invalid host."""
        if reason := why_no_address(self.host):
            raise ValueError(f"`host` {reason}")
        if self.state_timeout_s > _LONGEST_STATE_S and not is_loopback_host(self.host):
            raise ValueError(
                f"state_timeout_s: {self.state_timeout_s:g} s is above {_LONGEST_STATE_S:g} s, and {self.host} is not "
                f"this computer: give {_LONGEST_STATE_S:g} or less"
            )
        facts = self.facts
        if self.rate_hz > facts.most_hz:
            raise ValueError(
                f"rate_hz: {facts.name} sends {facts.most_hz:g} states a second at most, not {self.rate_hz:g}"
            )
        for key, inner, noise, unit in (
            ("force_n", self.limits.force_n.inner, facts.noise_n, "N"),
            ("torque_nm", self.limits.torque_nm.inner, facts.noise_nm, "N·m"),
        ):
            if inner <= noise:
                raise ValueError(
                    f"limits.{key}: inner ({inner:g} {unit}) is within the noise of the wrench of {facts.name}, "
                    f"± {noise:g} {unit}, so that it would stop the arm at random: give more; "
                    "commissioning measures how much, five standard deviations and the bias"
                )

    def left_open(self) -> dict[str, str]:
        """Return the parts that a real robot needs and that are not filled in, each with its cure."""
        found = {}
        if self.limits.workspace is None:
            found["limits.workspace"] = "measure the free space of your cell, and enter lower_m, upper_m and margin_m"
        if self.tool.reported and (absent := self.tool.absent):
            found[f"tool ({', '.join(absent)})"] = "enter what the pendant has for gripper and fingertips"
        return found

    @property
    def facts(self) -> GenerationFacts:
        """The facts of the controller's generation."""
        return GENERATIONS[self.generation]

    @property
    def standstill_s(self) -> float:
        """Longest time until the wrist stands after the last decision: deadline, two cycles, braking."""
        wrist = self.limits
        braking_s = wrist.wrist_speed_rad_per_s.inner / wrist.wrist_acceleration_rad_per_s2.hard
        return max(self.command_timeout_s, self.silence_timeout_s) + 2 / self.rate_hz + braking_s

    @property
    def lease_s(self) -> float:
        """How long a straight move continues after a cycle of the worker, if no further cycle follows.

        With the script's grace this is the longest silence. A worker that is late by less ends no program.
        """
        return max(_SHORTEST_LEASE * self.silence_timeout_s, self.silence_timeout_s - MOVE_GRACE_S - _CYCLES_S)

    @property
    def watchdog_hz(self) -> float:
        """The robot ends its program if it receives nothing for one period of this frequency.

        By then the arm stands, because a program that ends while the arm moves may end in a protective stop.
        """
        return 1.0 / (_WATCHDOG_FACTOR * self.standstill_s)

    @property
    def why_too_slow(self) -> str:
        """Why a robot on another computer takes longer to stand than docs/safety.md promises; empty if it does not."""
        if self.standstill_s <= PROMISED_S or is_loopback_host(self.host):
            return ""
        return (
            f"the wrist may turn for {self.standstill_s:.2g} s after the last decision, longer than {PROMISED_S:g} s: "
            "lower command_timeout_s, silence_timeout_s or the inner limit of wrist_speed_rad_per_s, or raise rate_hz "
            "or the hard limit of wrist_acceleration_rad_per_s2"
        )


def read_settings(path: Path) -> UrSettings:
    """Return the robot's settings from a YAML file.

    Raises:
        DriverError: the file cannot be read, or settings are wrong, and the message names every mistake. A robot on
            another computer that takes longer to stand than docs/safety.md promises is a mistake too.
    """
    from shearloop.yaml_files import load_model

    settings = load_model(path, UrSettings, DriverError, "robot's settings")
    if settings.why_too_slow:
        raise DriverError(f"{path}: {settings.why_too_slow}")
    return settings
