"""Stage 4: each layer that stops a motion, the wrist's at rising speeds: time and way to rest, mode, recovery."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Protocol

from shearloop.daemon.commissioning_report import Line, has_failed
from shearloop.daemon.supplied_values import Supplied
from shearloop.drivers.ur.client import WORKER
from shearloop.drivers.ur.messages import SAFETY_NORMAL, SAFETY_REDUCED
from shearloop.drivers.ur.poses import tool_axis
from shearloop.drivers.ur.settings import Six
from shearloop.errors import UserError
from shearloop.tools.commission.bounds import LARGEST_M, LARGEST_M_PER_S, LARGEST_RAD
from shearloop.tools.commission.context import STOPS_NEEDED, Context
from shearloop.tools.commission.hand_stops import mode_name, stops_by_hand
from shearloop.tools.commission.limits import MODE_AFTER_S, REHEARSED, RESTS_WITHIN_S
from shearloop.tools.commission.mover import WATCHDOG_WORKER
from shearloop.tools.commission.mover_process import CAUSES, WORKERS
from shearloop.tools.commission.observer import Seen
from shearloop.tools.commission.report import Measured, judged

STAGE: Final = "4 stops"
# A turn begins this far from the pose, on the other side.
START_RAD: Final = 0.085
# To the start of a turn.
_SLOWLY_RAD_PER_S: Final = 0.2
# A straight move of 20 mm at this speed takes a second, so the watchdog ends it during the move.
_WATCHED_M_PER_S: Final = 0.02
# The arm is at the pose within these.
_AT_POSE_M: Final = 0.0005
_AT_POSE_RAD: Final = 0.02
# Two samples of the controller, which may not be the first of their kind.
_RESOLUTION_S: Final = 0.016
_SAFE: Final = (SAFETY_NORMAL, SAFETY_REDUCED)


@dataclass(frozen=True, slots=True)
class Stop:
    """One stop: its layer, time and way to rest, the safety mode after it, and why recovery failed, if it did."""

    layer: str
    time_s: float
    way: float
    safety_mode: int
    refusal: str


class Motion(Protocol):
    """A motion that a layer ends."""

    # In the names of lines, and in the questions to the operator.
    at: str
    shown: str
    unit: str

    def prepare(self) -> None:
        """Move to the beginning of the motion."""

    def begin(self, cause: str) -> int:
        """Begin the motion, which `cause` ends at full speed; return the time."""

    def place(self, seen: Seen) -> float:
        """Return where a sample is on the motion's way, in its unit."""


def _slowly_rad_per_s(context: Context) -> float:
    return min(_SLOWLY_RAD_PER_S, context.settings.limits.wrist_speed_rad_per_s.inner)


class WristTurn:
    """A turn of the wrist from one end of the allowed range towards the other."""

    unit = "rad"

    def __init__(self, context: Context, rad_per_s: float) -> None:
        self._context, self._rad_per_s = context, rad_per_s
        self._sign = 1.0
        self.at = f"at {rad_per_s:g} rad/s"
        self.shown = f"wrist 3 turns {{count}} times at {rad_per_s:g} rad/s, by at most {2 * LARGEST_RAD:g} rad"

    def prepare(self) -> None:
        """Turn to the nearer end."""
        self._context.ready()
        middle_rad = self._context.pose_rad
        here_rad = self._context.observer.latest().wrist_rad
        self._sign = 1.0 if here_rad < middle_rad else -1.0
        start_rad = middle_rad - self._sign * START_RAD
        if (here_rad - start_rad) * self._sign > 0:
            self._context.turn_to(start_rad, min(_SLOWLY_RAD_PER_S, self._rad_per_s))

    def begin(self, cause: str) -> int:
        """Begin to turn towards the other end."""
        to_rad = self._context.pose_rad + self._sign * LARGEST_RAD
        return self._context.mover.request("turn", rad_per_s=self._sign * self._rad_per_s, to_rad=to_rad, cause=cause)

    def place(self, seen: Seen) -> float:
        """Return the wrist's angle."""
        return seen.wrist_rad


class StraightMove:
    """A straight move from the pose towards the robot, along the tool's axis."""

    unit = "m"

    def __init__(self, context: Context, m_per_s: float, at: str) -> None:
        self._context, self._m_per_s = context, m_per_s
        self._home: Six = context.confirm().outputs.tcp_pose
        self.at = at
        self.shown = (
            f"the tool moves {{count}} times {1e3 * LARGEST_M:g} mm towards the robot at {m_per_s:g} m/s, and back"
        )

    def prepare(self) -> None:
        """Turn and move back to the pose: at the end of the wrist's range every straight move stops."""
        mover = self._context.ready()
        if abs(self._context.observer.latest().wrist_rad - self._context.pose_rad) > _AT_POSE_RAD:
            self._context.turn_to(self._context.pose_rad, _slowly_rad_per_s(self._context))
        away_m = self.place(self._context.observer.latest())
        if abs(away_m) > _AT_POSE_M:
            mover.move("line", metres=-away_m, m_per_s=self._m_per_s)

    def begin(self, cause: str = "") -> int:
        """Begin to move towards the robot."""
        return self._context.mover.request("line", metres=-LARGEST_M, m_per_s=self._m_per_s, cause=cause)

    def place(self, seen: Seen) -> float:
        """Return the distance from the pose along the tool's axis, positive away from the robot."""
        here = seen.outputs.tcp_pose[:3]
        axis = tool_axis(self._home)
        return sum(component * (at - home) for component, at, home in zip(axis, here, self._home[:3], strict=True))


def rising_speeds(speeds_rad_per_s: Sequence[float], fastest_rad_per_s: float) -> list[float]:
    """Return rising speeds within the robot's limit; if a speed is above the limit, the limit is the last one.

    The report allows the largest speed at which every layer passed.
    """
    return sorted({min(speed, fastest_rad_per_s) for speed in speeds_rad_per_s})


def measure(context: Context) -> Measured:
    """Return the stage's lines, the largest speed at which every layer passed, and the largest angle to rest."""
    context.confirm()
    lines: list[Line] = []
    passed_rad_per_s, largest_rad = 0.0, 0.0
    limits = context.settings.limits
    fastest = limits.wrist_speed_rad_per_s.inner
    speeds = rising_speeds(context.counts.speeds_rad_per_s, fastest)
    for speed in speeds:
        stops, found = _all_layers(context, WristTurn(context, speed))
        lines += found
        if has_failed(found):
            if blocked := [f"{faster:g}" for faster in speeds if faster > speed]:
                lines.append(
                    Line(what="blocked speeds", value=f"{', '.join(blocked)} rad/s: a layer failed below them")
                )
            return Measured(lines)
        passed_rad_per_s, largest_rad = speed, max(largest_rad, *(stop.way for stop in stops))
    m_per_s = min(LARGEST_M_PER_S, limits.linear_speed_m_per_s.inner)
    _, found = _all_layers(context, StraightMove(context, m_per_s, f"on a line at {m_per_s:g} m/s"))
    lines += found
    if has_failed(found):
        return Measured(lines)
    lines += [_watchdog_at_rest(context), _watchdog_in_motion(context)]
    by_hand, largest_by_hand_rad, stopped_rad_per_s = stops_by_hand(context, speeds)
    lines += by_hand
    if has_failed(by_hand) or context.counts.stops < STOPS_NEEDED:
        return Measured(lines)
    raised_rad_per_s = min(passed_rad_per_s, stopped_rad_per_s)
    value = f"{raised_rad_per_s:g} rad/s, from which every layer has stopped the wrist"
    if raised_rad_per_s < passed_rad_per_s:
        value += f"; a person stopped no faster turn, and `--stages 4` tries again up to {passed_rad_per_s:g} rad/s"
    lines.append(Line(what="allowed speed", value=value))
    # A wrist that turned on to the end of its way says nothing of the way of a stop.
    stop_rad = None if context.limits.rehearsed else round(max(largest_rad, largest_by_hand_rad), 4)
    return Measured(lines, Supplied(wrist_speed_rad_per_s=raised_rad_per_s, stop_rad=stop_rad))


def _all_layers(context: Context, motion: Motion) -> tuple[list[Stop], list[Line]]:
    """Return the stops of a motion by each layer, up to the first that fails, and the lines on them."""
    stops: list[Stop] = []
    count, longest_s = context.counts.stops, context.limits.rest_s(context.settings)
    for layer in CAUSES:
        _use_worker(context, WORKERS.get(layer, WORKER))
        context.operator.allow(f"{motion.shown.format(count=count)}; each is ended by: {layer}")
        for _ in range(count):
            stops.append(_stop(context, layer, motion))
            lines = judge_stops(stops, motion.at, motion.unit, longest_s, rehearsed=context.limits.rehearsed)
            if has_failed(lines):
                return stops, lines
    _use_worker(context, WORKER)
    return stops, lines


def _use_worker(context: Context, worker: str) -> None:
    """Drive the robot through this worker from here on."""
    if context.mover.worker != worker:
        context.mover.restart(worker=worker)


def _stop(context: Context, layer: str, motion: Motion) -> Stop:
    """Move, end the motion by a layer, and recover."""
    observer, mover = context.observer, context.mover
    motion.prepare()
    observer.forget()
    context.comes_to_rest(RESTS_WITHIN_S)
    asked_ns = motion.begin(layer)
    cause = mover.event("cause", asked_ns, RESTS_WITHIN_S)
    if cause is None:
        raise UserError(f"the arm did not reach its speed {motion.at}: {mover.ended(asked_ns)}")
    rest = observer.rest_since(cause["t_ns"], context.settings.rest_rad_per_s, RESTS_WITHIN_S)
    if rest is None:
        raise UserError(f"the arm did not come to rest after: {layer}. Look at the teach pendant")
    before = observer.since(asked_ns, cause["t_ns"])
    way = abs(motion.place(rest) - motion.place(before[-1])) if before else 0.0
    observer.listen(MODE_AFTER_S)
    mode = observer.latest().outputs.safety_mode
    mover.restart()
    return Stop(layer, (rest.made_ns - cause["t_ns"]) / 1e9, way, mode, mover.unlock())


def judge_stops(stops: Sequence[Stop], at: str, unit: str, longest_s: float, *, rehearsed: bool = False) -> list[Line]:
    """Return the lines on all stops of one motion; `rehearsed`: the times and ways to rest are of no layer."""
    worst = max(stops, key=lambda stop: stop.time_s)
    abnormal = [stop for stop in stops if stop.safety_mode not in _SAFE]
    failed = [stop for stop in stops if stop.refusal]
    recovered = len(stops) - len(failed)
    time = judged(
        f"time to rest {at}",
        f"{worst.time_s:.3f} s ({worst.layer})",
        f"at most {longest_s:g} s",
        "each layer alone stops the arm",
        passed=worst.time_s <= longest_s,
        count=len(stops),
    )
    lines = [
        _unmeasured(time) if rehearsed else time,
        judged(
            f"safety mode after stops {at}",
            f"{mode_name(abnormal[0].safety_mode)} ({abnormal[0].layer})" if abnormal else "normal",
            "normal",
            "a stop does not lock the robot",
            passed=not abnormal,
            count=len(stops),
        ),
        judged(
            f"recovery {at}",
            f"{recovered} of {len(stops)}" + (f": {failed[0].refusal}" if failed else ""),
            "all",
            "the robot is ready again after a stop",
            passed=not failed,
            count=len(stops),
        ),
    ]
    for layer in dict.fromkeys(stop.layer for stop in stops):
        own = [stop for stop in stops if stop.layer == layer]
        times, ways = [stop.time_s for stop in own], [stop.way for stop in own]
        value = f"{min(times):.3f} to {max(times):.3f} s, up to {max(ways):.4f} {unit}"
        if rehearsed:
            value = REHEARSED
        lines.append(Line(what=f"{layer} {at}", value=value, count=len(own)))
    return lines


def _unmeasured(line: Line) -> Line:
    """Return the line of a rehearsal in the place of one that passed; one that failed stays."""
    passed = line.verdict == "passed"
    return line.model_copy(update={"value": REHEARSED, "limit": "", "verdict": "noted"}) if passed else line


def _watchdog_s(context: Context) -> float:
    """Return the longest time until the robot's watchdog ends a program without commands."""
    settings = context.settings
    return 1.0 / settings.watchdog_hz + 2 / settings.rate_hz + _RESOLUTION_S + (context.limits.late_s or 0.0)


def _program_end(context: Context, stopped_ns: int) -> Seen | None:
    return context.observer.wait_for(lambda seen: not seen.plays, stopped_ns, RESTS_WITHIN_S)


def _watchdog_at_rest(context: Context) -> Line:
    """Return the line on the robot's watchdog alone: a program without commands ends, here while the arm stands."""
    longest_s = _watchdog_s(context)
    times_s = []
    for _ in range(context.counts.stops):
        mover = context.ready()
        stopped_ns = mover.stop_worker()
        ended = _program_end(context, stopped_ns)
        times_s.append((ended.made_ns - stopped_ns) / 1e9 if ended is not None else math.inf)
        mover.restart()
    line = judged(
        "watchdog alone, at rest",
        f"{max(times_s):.3f} s",
        f"at most {longest_s:.3f} s",
        "a program without its client ends",
        passed=max(times_s) <= longest_s,
        count=len(times_s),
    )
    return _unmeasured(line) if context.limits.rehearsed else line


def _watchdog_in_motion(context: Context) -> Line:
    """Return the line on the watchdog alone during a straight move with a deadline too long to end the move first."""
    count, longest_s, rest_s = context.counts.stops, _watchdog_s(context), context.limits.rest_s(context.settings)
    motion = StraightMove(context, _WATCHED_M_PER_S, "")
    context.operator.allow(f"{motion.shown.format(count=count)}; each is ended by: the robot's watchdog alone")
    times_s = []
    for _ in range(count):
        motion.prepare()
        context.comes_to_rest(RESTS_WITHIN_S)
        context.mover.restart(worker=WATCHDOG_WORKER)
        mover = context.ready()
        asked_ns = motion.begin("worker stopped")
        cause = mover.event("cause", asked_ns, RESTS_WITHIN_S)
        if cause is None:
            raise UserError(f"the arm did not reach {_WATCHED_M_PER_S:g} m/s: {mover.ended(asked_ns)}")
        ended = _program_end(context, cause["t_ns"])
        rest = context.observer.rest_since(cause["t_ns"], context.settings.rest_rad_per_s, RESTS_WITHIN_S)
        end_ns, rest_ns = ((seen.made_ns if seen is not None else math.inf) for seen in (ended, rest))
        times_s.append(((end_ns - cause["t_ns"]) / 1e9, (rest_ns - end_ns) / 1e9))
        mover.restart(worker=WORKER)
    end_s, after_s = max(end for end, _ in times_s), max(after for _, after in times_s)
    context.ready()
    motion.prepare()
    line = judged(
        "watchdog alone, on a line",
        f"{end_s:.3f} s, and {max(0.0, after_s):.3f} s to rest",
        f"at most {longest_s:.3f} s, and {rest_s:g} s to rest",
        "a program without its client ends in motion, and the arm stops",
        passed=end_s <= longest_s and after_s <= rest_s,
        count=count,
    )
    return _unmeasured(line) if context.limits.rehearsed else line
