"""Stage 7: a tool on a known spring: signs, stiffness, delay, slip, and the repeatability of a grip."""

import math
import statistics
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from typing import Final

from shearloop.daemon.commissioning_report import Line, has_failed
from shearloop.daemon.motion_cap import CAPPED_NM
from shearloop.daemon.rig import gels_of
from shearloop.daemon.rig_identity import source_sha256
from shearloop.daemon.supplied_values import Supplied
from shearloop.daemon.torques import LOAD_CELL, SIGNS, WRENCH, Direction, direction_of
from shearloop.drivers.load_cell import CAPACITY_NM, LoadSample
from shearloop.drivers.ranges import LARGEST_TORQUE_NM
from shearloop.drivers.ur.poses import tool_axis
from shearloop.errors import UserError
from shearloop.tools.commission.arrivals import Arrivals
from shearloop.tools.commission.boards import put_between
from shearloop.tools.commission.context import Context
from shearloop.tools.commission.curves import Curve, middle_s
from shearloop.tools.commission.fingers import FINGERS_MM_PER_S, GRIP_N, close_fingers, open_fingers
from shearloop.tools.commission.listening import SILENT_S
from shearloop.tools.commission.motion import TURN_RAD
from shearloop.tools.commission.operator import Played
from shearloop.tools.commission.report import Measured, judged
from shearloop.tools.commission.tactile import TactileSensor, calibrated_sessions
from shearloop.tools.commission.wrench import read

STAGE: Final = "7 tool and spring"
STIFFNESS_TOLERANCE: Final = 0.1
# The range of the spring's stiffness in N·m/rad. A stiffer one takes the load cell beyond its capacity.
_SOFTEST: Final = 0.05
_STIFFEST: Final = math.floor(CAPACITY_NM / TURN_RAD)
# The torque that remains after the twists, as a fraction of the largest torque.
LARGEST_SLIP: Final = 0.15
REPEATS_MM: Final = 1.0
# Of the wrench and of an estimate, which drive the loop beyond the capped torque only within it.
SCALE_TOLERANCE: Final = 0.2
# A lever presses one way only if the other torques are below this fraction.
_ONE_WAY: Final = 0.3
# A change has a sign if it is larger than these fractions of the spring's torque and of the wrist's turn,
_SHOWN_TORQUE: Final = 0.05
_SHOWN_ANGLE: Final = 0.5
# and than this number of standard errors.
_NOISE_ERRORS: Final = 4.0
# The twists at which the fingertips are read too.
_FELT: Final = 2
_SLOWLY_RAD_PER_S: Final = 0.1
_HELD_S: Final = 1.0
_SETTLES_S: Final = 0.5


@dataclass(frozen=True, slots=True)
class Held:
    """The wrist's angle, the load cell's torque, and the torque of the robot's wrench about the tool's axis.

    `tactile_nm` are the torques of the calibrated fingertips, by their names; None without an estimate. `errors_nm` are
    the standard errors of all these means by their sources.
    """

    wrist_rad: float
    load_nm: float
    wrench_nm: float
    tactile_nm: Mapping[str, float | None] = field(default_factory=dict)
    errors_nm: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Sensors:
    """The sensors of the tool's torque."""

    load: Arrivals[LoadSample]
    rate_hz: float
    tactile: Sequence[TactileSensor]

    def load_nm(self) -> list[float]:
        """Return the load cell's torques of the next `_HELD_S`."""
        samples = self.load.take(max(3, round(_HELD_S * self.rate_hz)), SILENT_S)
        return [sample.torque_nm for sample in samples]


def measure(context: Context) -> Measured:
    """Return the stage's lines and the largest torque that they cover; no torque without a load cell."""
    cell = context.config.load_cell
    if cell is None:
        return Measured([Line(what="tool and spring", value="not measured: no load cell is configured")])
    # Before anything holds the tool: it is then twisted by the announced angles, and by no more.
    context.return_to_pose(_SLOWLY_RAD_PER_S)
    spring = context.operator.number(
        "Mount the tool on a spring of known stiffness; stiffness of spring and pads together in N·m/rad",
        *(_SOFTEST, _STIFFEST),
        Played(
            "it is mounted for you on a spring as stiff as you type, for instance 0.8",
            (*put_between(context).commands, "spring {}"),
        ),
    )
    way = cell.only_sign
    with ExitStack() as opened:
        tactile = _tactile(context, opened)
        lines = repeated_grips(context, tactile) if context.config.gripper is not None else []
        sensors = Sensors(opened.enter_context(context.rig.load_cell()), cell.rate_hz, tactile)
        context.ready()
        turned = _signs(context, sensors, spring, way)
        held, delays_s = _twists(context, sensors)
    scales, right = judge_scales(held, context.settings.facts.estimated_nm, way)
    lines += [*turned, *judge_twists(held, spring, way), *scales]
    delay_s = statistics.median(delays_s)
    lines.append(Line(what="torque behind the angle", value=f"{1e3 * delay_s:.0f} ms (median)", count=len(delays_s)))
    if has_failed(lines):
        return Measured(lines)
    largest_nm = min(LARGEST_TORQUE_NM, round(covered_nm(held, way), 4))
    lines.append(raised_line(largest_nm, right, cell.direction))
    hashes = {name: source_sha256(context.config, name) for name in right}
    sources = {name: own for name, own in hashes.items() if own is not None}
    return Measured(lines, Supplied(torque_nm=largest_nm or None, torque_sources=sources))


def covered_nm(held: Sequence[Held], way: int = 0) -> float:
    """Return the largest torque that the twists reached in the direction `way`, or in both directions if it is 0."""
    first, *twisted = held[:-1]
    ways = (1, -1) if way == 0 else (way,)
    return min(_largest_nm(first, twisted, one) or 0.0 for one in ways)


def _largest_nm(first: Held, twisted: Sequence[Held], way: int) -> float | None:
    """Return the largest torque of the twists of one direction, or None without a twist."""
    return max((abs(hold.load_nm - first.load_nm) for hold in _of_way([first, *twisted], way)[1:]), default=None)


def raised_line(largest_nm: float, right: Sequence[str], direction: Direction | None = None) -> Line:
    """Return the line on the torque that the report allows: for its sources, in both directions or in `direction`."""
    sources = " and ".join([LOAD_CELL, *right])
    if largest_nm <= CAPPED_NM:
        value = (
            f"not raised: the twists reached {largest_nm:.3f} N·m, and {CAPPED_NM:g} N·m need no report; "
            f"a spring that is stiffer together with the pads reaches more within {TURN_RAD:g} rad"
        )
    elif direction is None:
        value = f"up to {largest_nm:.3f} N·m of {sources}; any other source {CAPPED_NM:g} N·m"
    else:
        value = f"up to {largest_nm:.3f} N·m of {sources}, {direction} alone; else {CAPPED_NM:g} N·m"
    return Line(what="allowed torque", value=value)


def _tactile(context: Context, opened: ExitStack) -> list[TactileSensor]:
    """Return the calibrated fingertips; none without a gripper, because they are then never seen untouched."""
    config = context.config
    sessions = calibrated_sessions(config) if config.gripper is not None else {}
    boards = {
        name: opened.enter_context(context.rig.fingertip(name))
        for name in dict.fromkeys(side for _, sides in sessions.values() for side in sides)
    }
    gels = gels_of(config)
    sensors = []
    for name, (session, sides) in sessions.items():
        own_boards = {side: boards[side] for side in sides}
        period_s = config.fingertips[sides[0]].frame_period_s
        sensors.append(TactileSensor(name, session, own_boards, period_s, gels.get(name)))
    return sensors


def repeated_grips(context: Context, tactile: Sequence[TactileSensor]) -> list[Line]:
    """Tare the fingertips, grip the tool several times, and leave it gripped."""
    count = context.counts.starts
    context.operator.allow(
        f"the fingers open, and close onto the tool {count} times at {FINGERS_MM_PER_S:g} mm/s with at most "
        f"{GRIP_N:g} N, and stay closed; a gripper that lost its power, as in stage 4, opens and closes once before"
    )
    diameters_mm = []
    with context.gripper() as gripper:
        gripper.activate()
        open_fingers(gripper, GRIP_N)
        for sensor in tactile:
            sensor.tare(context.clock.now_ns())
        for _ in range(count):
            open_fingers(gripper, GRIP_N)
            closed = close_fingers(gripper, GRIP_N)
            if closed.diameter_mm is None:
                raise UserError("the gripper holds nothing: put the tool between its fingers, and run the stage again")
            diameters_mm.append(closed.diameter_mm)
        for sensor in tactile:
            sensor.on_grip()
    spread_mm = max(diameters_mm) - min(diameters_mm)
    return [
        judged(
            "width of repeated grips",
            f"{spread_mm:.2f} mm apart",
            f"at most {REPEATS_MM:g} mm",
            "a grip repeats",
            passed=spread_mm <= REPEATS_MM,
            count=count,
        )
    ]


def _hold(context: Context, sensors: Sensors) -> Held:
    """Return the measurements while the wrist stands, without the fingertips."""
    loads_nm = sensors.load_nm()
    outputs = context.observer.latest().outputs
    reading = read(context)
    # The loop's sign of a torque: the torque of the wrist on the tool.
    axis = tool_axis(outputs.tcp_pose)
    wrench_nm = -sum(one * other for one, other in zip(axis, reading.mean[3:], strict=True))
    errors_nm = {LOAD_CELL: standard_error(loads_nm), WRENCH: reading.torque_error_nm}
    return Held(context.observer.latest().wrist_rad, statistics.fmean(loads_nm), wrench_nm, errors_nm=errors_nm)


def _hold_and_feel(context: Context, sensors: Sensors) -> Held:
    """Return the measurements while the wrist stands, with those of the fingertips."""
    held = _hold(context, sensors)
    means_nm: dict[str, float | None] = {}
    errors_nm = dict(held.errors_nm)
    for sensor in sensors.tactile:
        torques_nm = sensor.torques_nm()
        if torques_nm:
            means_nm[sensor.name] = statistics.fmean(torques_nm)
            errors_nm[sensor.name] = standard_error(torques_nm)
        else:
            means_nm[sensor.name] = None
    return replace(held, tactile_nm=means_nm, errors_nm=errors_nm)


def standard_error(values: Sequence[float]) -> float:
    """Return the standard error of the mean of some independent values."""
    return statistics.stdev(values) / math.sqrt(len(values))


def _turn(context: Context, by_rad: float) -> None:
    """Turn to an angle from the pose."""
    context.turn_to(context.pose_rad + by_rad, _SLOWLY_RAD_PER_S)


def _signs(context: Context, sensors: Sensors, spring: float, way: int) -> list[Line]:
    """Turn once, the way that the load cell measures; the operator says which way the tool turned."""
    context.confirm()
    turn_rad = (way or 1) * TURN_RAD
    context.operator.allow(f"wrist 3 turns the tool by {turn_rad:+g} rad at {_SLOWLY_RAD_PER_S:g} rad/s, and back")
    before = _hold_and_feel(context, sensors)
    _turn(context, turn_rad)
    after = _hold_and_feel(context, sensors)
    said = context.operator.choose(
        "Which way did the gripper turn, seen from in front of it:",
        tuple(SIGNS),
        Played(
            f"wrist 3 turned from {before.wrist_rad:.3f} to {after.wrist_rad:.3f} rad; with a growing angle "
            "it turns counterclockwise, seen from in front of it"
        ),
    )
    _turn(context, 0.0)
    noise_nm = context.settings.facts.estimated_nm
    return judge_signs(before, after, said, spring, noise_nm, way or 1, emulated=context.config.emulated)


def judge_signs(
    before: Held,
    after: Held,
    said: str,
    spring: float,
    wrench_noise_nm: float = 0.0,
    way: int = 1,
    *,
    emulated: bool = False,
) -> list[Line]:
    """Return the lines on a turn in the direction `way`: the signs of command, wrist, load cell, wrench and estimates.

    A change within the noise, or within a small fraction of the spring's torque, has no sign. The sign of the wrench is
    judged only for a torque beyond `wrench_noise_nm`. A calibration on recordings of real fingertips may refuse
    `emulated` frames.
    """
    wanted = direction_of(way)

    def compared(what: str, change: float, smallest: float, unit: str) -> Line:
        if abs(change) <= smallest:
            return _sign_line(what, f"no change beyond {smallest:.2g} {unit}", wanted, passed=False)
        direction = direction_of(change)
        return _sign_line(what, str(direction), wanted, passed=direction == wanted)

    def noise_nm(source: str) -> float:
        return _NOISE_ERRORS * math.hypot(before.errors_nm.get(source, 0.0), after.errors_nm.get(source, 0.0))

    def torques_compared(what: str, source: str, change_nm: float) -> Line:
        smallest_nm = max(_SHOWN_TORQUE * spring * TURN_RAD, noise_nm(source))
        return compared(what, change_nm, smallest_nm, "N·m")

    is_right = said == wanted
    load_nm = after.load_nm - before.load_nm
    lines = [
        _sign_line("command", said if is_right else f"the operator said {said!r}", wanted, passed=is_right),
        compared("wrist", after.wrist_rad - before.wrist_rad, _SHOWN_ANGLE * TURN_RAD, "rad"),
        torques_compared("load cell", LOAD_CELL, load_nm),
    ]
    known_to_nm = max(wrench_noise_nm, noise_nm(WRENCH))
    if abs(load_nm) >= known_to_nm:
        lines.append(torques_compared("wrench", WRENCH, after.wrench_nm - before.wrench_nm))
    else:
        noise = f"not measured: the robot's wrench is known to {known_to_nm:.2g} N·m, and the twist is smaller"
        lines.append(Line(what="sign of the wrench", value=noise))
    for name, after_nm in after.tactile_nm.items():
        before_nm, what = before.tactile_nm[name], f"estimate of {name}"
        if after_nm is not None and before_nm is not None:
            lines.append(torques_compared(what, name, after_nm - before_nm))
        elif emulated:
            lines.append(Line(what=f"sign of the {what}", value="not measured: no estimate in the grip"))
        else:
            lines.append(_sign_line(what, "no estimate in the grip", wanted, passed=False))
    if not after.tactile_nm:
        unmeasured = "not measured: it needs a gripper, and a fingertip with a calibration"
        lines.append(Line(what="sign of the estimate", value=unmeasured))
    return lines


def _sign_line(what: str, value: str, wanted: Direction | None, *, passed: bool) -> Line:
    """Return the line on one sign."""
    limit = f"{wanted} for an eye that faces the gripper"
    return judged(f"sign of the {what}", value, limit, "the loop turns the right way", passed=passed)


def _twists(context: Context, sensors: Sensors) -> tuple[list[Held], list[float]]:
    """Return the measurements at the pose, at each twist's end and at the pose again, and each twist's delay in s."""
    count = context.counts.twists
    context.operator.allow(
        f"wrist 3 turns the tool {count} times by {TURN_RAD:g} rad either way at {_SLOWLY_RAD_PER_S:g} rad/s"
    )
    held, delays_s = [_hold_and_feel(context, sensors)], []
    for number in range(count):
        begun_ns = context.clock.now_ns()
        _turn(context, TURN_RAD if number % 2 == 0 else -TURN_RAD)
        context.observer.listen(_SETTLES_S)
        angles = [(seen.made_ns, seen.wrist_rad) for seen in context.observer.since(begun_ns)]
        torques = [(sample.t_mid_ns, sample.torque_nm) for sample in sensors.load.since(begun_ns)]
        delays_s.append(_middle_s(torques) - _middle_s(angles))
        # One twist each way shows the scale of an estimate, whose frames take long.
        if number < _FELT:
            held.append(_hold_and_feel(context, sensors))
        else:
            held.append(_hold(context, sensors))
    _turn(context, 0.0)
    held.append(_hold(context, sensors))
    return held, delays_s


def _middle_s(curve: Curve) -> float:
    return middle_s(curve, curve[0][1], curve[-1][1])


def _of_way(held: Sequence[Held], way: int) -> list[Held]:
    """Return the measurements at the pose and those that the load cell can read: `way` is the only sign, 0 for both."""
    first, *others = held
    return [first, *(hold for hold in others if way == 0 or (hold.wrist_rad - first.wrist_rad) * way > 0)]


def judge_twists(held: Sequence[Held], spring: float, way: int = 0) -> list[Line]:
    """Return the lines on stiffness and slip; the first and the last measurements are at the pose.

    `way` is the sign of the only torques that the load cell measures, 0 for both: a lever may press one way only.
    """
    first, *twisted, last = held
    seen = _of_way([first, *twisted], way)[1:]
    # From a twist to the next one, or from the pose if the load cell reads nothing at the other twists.
    begins = [first, *seen] if way == 0 else [first] * len(seen)
    stiffnesses = [
        (after.load_nm - before.load_nm) / (after.wrist_rad - before.wrist_rad)
        for before, after in zip(begins, seen, strict=False)
    ]
    found = abs(statistics.fmean(stiffnesses))
    largest_nm = max(abs(hold.load_nm - first.load_nm) for hold in seen)
    # The last angle differs a little from the first, and explains a part of the torque; the rest is slip.
    expected_nm = statistics.fmean(stiffnesses) * (last.wrist_rad - first.wrist_rad)
    slip = abs(last.load_nm - first.load_nm - expected_nm) / largest_nm if largest_nm else 1.0
    return [
        judged(
            "stiffness",
            f"{found:.3f} N·m/rad{_one_way_only(first, seen) if way == 0 else ''}",
            f"{spring:g} N·m/rad ± {STIFFNESS_TOLERANCE:.0%}",
            "torque and angle fit together",
            passed=abs(found / spring - 1.0) <= STIFFNESS_TOLERANCE,
            count=len(seen),
        ),
        judged(
            "slip in the grip",
            f"{slip:.1%} of {largest_nm:.3f} N·m",
            f"at most {LARGEST_SLIP:.0%}",
            "the grip holds this torque",
            passed=slip <= LARGEST_SLIP,
            count=len(seen),
        ),
    ]


def _one_way_only(first: Held, twisted: Sequence[Held]) -> str:
    """Return that the load cell shows the twists of one direction alone, with the cure, or an empty string."""
    up_nm, down_nm = (_largest_nm(first, twisted, way) for way in (1, -1))
    if up_nm is None or down_nm is None or min(up_nm, down_nm) > _ONE_WAY * max(up_nm, down_nm):
        return ""
    direction = direction_of(1 if up_nm > down_nm else -1)
    return (
        f"; the load cell shows twists {direction} alone: if its lever presses one way only, write "
        f"`load_cell.direction: {direction}` into the configuration"
    )


def judge_scales(held: Sequence[Held], wrench_noise_nm: float = 0.0, way: int = 0) -> tuple[list[Line], list[str]]:
    """Return the lines on the scale of the wrench and of each estimate, and the sources whose scale is right.

    The scale is the slope over the load cell's torque. A wrong one fails nothing: the source's torques stay capped.
    """
    seen, lines, right = _of_way(held[:-1], way), [], []
    pairs: dict[str, list[tuple[float, float]]] = {}
    if not wrench_noise_nm:
        pairs[WRENCH] = [(hold.load_nm, hold.wrench_nm) for hold in seen]
    for name in held[0].tactile_nm:
        felt = [(hold.load_nm, hold.tactile_nm.get(name)) for hold in seen if name in hold.tactile_nm]
        pairs[name] = [(load_nm, nm) for load_nm, nm in felt if nm is not None]
    for name, torques_nm in pairs.items():
        scale = _slope(torques_nm)
        passed = scale is not None and abs(scale - 1.0) <= SCALE_TOLERANCE
        right += [name] if passed else []
        lines.append(
            Line(
                what=f"scale of {name}",
                value="no estimate in the grip" if scale is None else f"{scale:.2f} of the load cell's",
                limit=f"1 ± {SCALE_TOLERANCE:g}; else the torque that it drives stays capped at {CAPPED_NM:g} N·m",
                count=len(torques_nm),
                verdict="passed" if passed else "noted",
            )
        )
    return lines, right


def _slope(points: Sequence[tuple[float, float]]) -> float | None:
    """Return the slope of a line through points, or None where they have one abscissa."""
    if len({x for x, _ in points}) < 2:
        return None
    return statistics.linear_regression(*zip(*points, strict=True)).slope
