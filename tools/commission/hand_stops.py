"""The stops of stage 4 that a person makes by hand: emergency stop, stop at the pendant, pulled cable."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

from shearloop.daemon.commissioning_report import Line
from shearloop.drivers.ur.messages import SAFETY_EMERGENCY_STOPS, SAFETY_MODES
from shearloop.errors import UserError
from shearloop.tools.commission.bounds import LARGEST_RAD
from shearloop.tools.commission.context import Context
from shearloop.tools.commission.limits import MODE_AFTER_S, REHEARSED, RESTS_WITHIN_S
from shearloop.tools.commission.observer import Observer, Seen
from shearloop.tools.commission.operator import NOTHING_TO_DO, Played
from shearloop.tools.commission.report import judged

# The wrist turns back at this angle from the pose.
_TURNS_ROUND_RAD: Final = 0.5 * LARGEST_RAD
_STARTS_WITHIN_S: Final = 5.0
# The longest time until a stop is seen, and until the controller is connected again after a pulled cable.
_SEEN_WITHIN_S: Final = 5.0
_CONNECTED_WITHIN_S: Final = 20.0
# After this time without a sample the connection was interrupted; the wrist has stopped long before.
INTERRUPTED_NS: Final = 500_000_000
# The wrist turned at the stop if it had half of its speed within this time before; at each end of its way it stands.
_TURNED_WITHIN_NS: Final = 500_000_000
# A stopped speed is rounded down to 0.01 rad/s.
_STEPS_PER_RAD_PER_S: Final = 100
# The error of the floating-point number of steps is smaller.
_STEP_ERROR: Final = 1e-6
# How often the operator is asked for a stop, if it is not seen.
_TRIES: Final = 3


@dataclass(frozen=True, slots=True)
class Found:
    """A stop as the observer saw it: the last sample before it, and the first sample at rest, if there is one.

    `whole`: samples of the whole way have arrived, so the time to rest is known too.
    """

    before: Seen
    rest: Seen | None
    whole: bool = True


@dataclass(frozen=True, slots=True)
class HandStop:
    """One stop: the requested speed, the speed before the stop, time and angle to rest, mode, why no recovery.

    The time is None if no sample came until rest, and infinite if the arm did not come to rest.
    """

    asked_rad_per_s: float
    rad_per_s: float
    time_s: float | None
    rad: float
    safety_mode: int
    refusal: str = ""

    def stopped_rad_per_s(self, noise_rad_per_s: float) -> float:
        """Return the speed that was really stopped: the asked one within the noise, else the speed before the stop.

        The speed before the stop is rounded down, because no faster turn was stopped.
        """
        if self.rad_per_s >= self.asked_rad_per_s - noise_rad_per_s:
            return self.asked_rad_per_s
        return math.floor(_STEPS_PER_RAD_PER_S * self.rad_per_s + _STEP_ERROR) / _STEPS_PER_RAD_PER_S


@dataclass(frozen=True, slots=True)
class Layer:
    """One way to stop the wrist by hand; `find` returns the stop, or None if it is not seen."""

    what: str
    action: str
    played: Played
    find: Callable[[Context, int], Found | None]
    unseen: str
    # The operator's action before the recovery.
    after: str = ""
    played_after: Played | None = None
    # Whether the processes that drive the robot have lost the connection.
    loses_robot: bool = False


def _found_since(context: Context, asked_ns: int, stopped: Callable[[Seen], bool]) -> Found | None:
    """Return the stop that begins with the first sample that `stopped` is true of."""
    observer = context.observer
    first = observer.wait_for(stopped, asked_ns, _SEEN_WITHIN_S)
    before = observer.since(asked_ns, first.made_ns) if first is not None else []
    if first is None or not before:
        return None
    return Found(before[-1], observer.rest_since(first.made_ns, context.settings.rest_rad_per_s, RESTS_WITHIN_S))


def _emergency_stop(context: Context, asked_ns: int) -> Found | None:
    return _found_since(context, asked_ns, lambda seen: seen.outputs.safety_mode in SAFETY_EMERGENCY_STOPS)


def _program_stop(context: Context, asked_ns: int) -> Found | None:
    return _found_since(context, asked_ns, lambda seen: not seen.plays)


def _outage(context: Context, asked_ns: int) -> Found | None:
    """Return the stop at an outage; the samples of a short outage may arrive late, and then show the whole way."""
    observer = context.observer
    gap = observer.interruption(asked_ns, INTERRUPTED_NS, _CONNECTED_WITHIN_S)
    if gap is None:
        return None
    before, _ = gap
    rest = observer.rest_since(before.made_ns, context.settings.rest_rad_per_s, RESTS_WITHIN_S)
    return Found(before, rest, whole=rest is not None and _is_whole(observer, before, rest))


def _is_whole(observer: Observer, before: Seen, rest: Seen) -> bool:
    """Return whether no sample is missing between two."""
    samples = observer.since(before.made_ns, rest.made_ns + 1)
    return all(later.made_ns - earlier.made_ns < INTERRUPTED_NS for earlier, later in pairwise(samples))


LAYERS: Final = (
    Layer(
        "emergency stop",
        "press the emergency stop",
        Played("it is pressed for you", ("robot emergency-stop",)),
        _emergency_stop,
        "No emergency stop was seen.",
        "Make the cell safe, and release the emergency stop",
        Played("it is released for you", ("robot release",)),
    ),
    Layer(
        "stop at the pendant",
        "press the stop of the program at the pendant",
        Played("it is pressed for you", ("robot stop",)),
        _program_stop,
        "The end of the program was not seen.",
    ),
    Layer(
        "cable pulled",
        "pull the robot's network cable, wait for 5 s, and plug it in again",
        Played("it is pulled for you, and plugged in again", ("robot silence 1.2",)),
        _outage,
        f"The connection was not interrupted for {INTERRUPTED_NS / 1e9:g} s.",
        loses_robot=True,
    ),
)


def hand_speeds(passed_rad_per_s: Sequence[float], count: int) -> list[float]:
    """Return the speed of each stop by hand: each speed once in rising order, and the largest for all that are left."""
    return [passed_rad_per_s[min(number, len(passed_rad_per_s) - 1)] for number in range(count)]


def stops_by_hand(context: Context, passed_rad_per_s: Sequence[float]) -> tuple[list[Line], float, float]:
    """Have each layer stop the wrist at speeds that all other layers passed.

    Return the lines, the largest angle, and the largest speed from which every layer has stopped the wrist.
    """
    speeds = hand_speeds(passed_rad_per_s, context.counts.stops)
    of_layers = [stops_of_layer(context, layer, speeds) for layer in LAYERS]
    lines, angles_rad, stopped_rad_per_s = zip(*of_layers, strict=True)
    return list(lines), max(angles_rad), min(stopped_rad_per_s)


def stops_of_layer(context: Context, layer: Layer, speeds: Sequence[float]) -> tuple[Line, float, float]:
    """Have one layer stop the wrist at each speed; return the line, the largest angle and the largest stopped speed."""
    shown = ", ".join(f"{speed:g}" for speed in speeds)
    context.operator.allow(
        f"wrist 3 turns to and fro within {LARGEST_RAD:g} rad of the pose, {len(speeds)} times until you stop it, "
        f"at {shown} rad/s; during each turn {layer.action}"
    )
    stops: list[HandStop] = []
    for number, speed in enumerate(speeds, 1):
        which = f"stop {number} of {len(speeds)}, at {speed:g} rad/s"
        then = "the arm gets ready" + (" and turns again" if number < len(speeds) else "")
        stop = _stop(context, layer, speed, which, f": after your word {then}")
        if stop is None:
            break
        stops.append(stop)
    unseen = "" if len(stops) == len(speeds) else layer.unseen
    longest_s, rehearsed = context.limits.rest_s(context.settings), context.limits.rehearsed
    line = judge_hand_stops(layer.what, stops, len(speeds), longest_s, unseen, rehearsed=rehearsed)
    # Up to this speed an arm counts as at rest, so a measured speed is no more exact.
    noise_rad_per_s = context.settings.rest_rad_per_s
    stopped_rad_per_s = max((stop.stopped_rad_per_s(noise_rad_per_s) for stop in stops), default=0.0)
    return line, max((stop.rad for stop in stops), default=0.0), stopped_rad_per_s


def _stop(context: Context, layer: Layer, speed: float, which: str, then: str) -> HandStop | None:
    """Turn to and fro until the operator stops it, and recover; return None if no stop is seen after some tries.

    The question to the operator has `which` for this stop, and `then` for the motion after the last typed word.
    """
    for _ in range(_TRIES):
        asked_ns = _swing(context, speed)
        context.operator.act(f"Now {layer.action} ({which}){'' if layer.after else then}", layer.played)
        found = layer.find(context, asked_ns)
        context.observer.listen(MODE_AFTER_S)
        mode = context.observer.latest().outputs.safety_mode
        if layer.after and mode in SAFETY_EMERGENCY_STOPS:
            context.operator.act(f"{layer.after}{then}", layer.played_after or NOTHING_TO_DO)
        if found is None:
            context.operator.say(f"{layer.unseen} The stop is asked for again.")
        elif not _turned(context.observer, asked_ns, found.before, speed):
            context.operator.say("The wrist had ended its turn before the stop. The stop is asked for again.")
        else:
            if layer.loses_robot:
                context.mover.restart()
            return _hand_stop(speed, found, mode, context.mover.unlock())
        context.mover.restart()
    return None


def _swing(context: Context, speed: float) -> int:
    """Begin to turn to and fro; return when that was asked for."""
    mover = context.ready()
    context.observer.forget()
    asked_ns = mover.request("swing", rad_per_s=speed, middle_rad=context.pose_rad, by_rad=_TURNS_ROUND_RAD)
    turns = context.observer.wait_for(lambda seen: abs(seen.wrist_rad_per_s) > 0.9 * speed, asked_ns, _STARTS_WITHIN_S)
    if turns is None:
        raise UserError(f"the wrist did not turn: {mover.ended(asked_ns)}")
    return asked_ns


def _turned(observer: Observer, asked_ns: int, before: Seen, speed: float) -> bool:
    """Return whether the wrist turned until a stop: a swing ends by itself after a while."""
    since_ns = max(asked_ns, before.made_ns - _TURNED_WITHIN_NS)
    return any(abs(seen.wrist_rad_per_s) > 0.5 * speed for seen in observer.since(since_ns, before.made_ns + 1))


def _hand_stop(speed: float, found: Found, mode: int, refusal: str) -> HandStop:
    before, rest = found.before, found.rest
    time_s: float | None = math.inf
    if rest is not None:
        time_s = (rest.made_ns - before.made_ns) / 1e9 if found.whole else None
    angle_rad = abs(rest.wrist_rad - before.wrist_rad) if rest is not None else math.inf
    return HandStop(speed, abs(before.wrist_rad_per_s), time_s, angle_rad, mode, refusal)


def judge_hand_stops(
    what: str, stops: Sequence[HandStop], asked: int, longest_s: float, unseen: str = "", *, rehearsed: bool = False
) -> Line:
    """Return the line on all stops of a layer: time and angle to rest, mode and recovery; `unseen` is why some lack.

    `rehearsed`: times and angles are of no real deadline, and are not shown.
    """
    limit = f"at most {longest_s:g} s, and the angle of that time at the asked speed; recovery {asked} of {asked}"
    promise = "a person, or a lost connection, stops the wrist"
    if not stops:
        return judged(what, unseen, limit, promise, passed=False, count=0)
    times_s = [stop.time_s for stop in stops if stop.time_s is not None]
    time = f"{min(times_s):.3f} to {max(times_s):.3f} s to rest" if times_s else "time to rest not seen"
    angle = f"up to {max(stop.rad for stop in stops):.4f} rad"
    if rehearsed:
        time, angle = REHEARSED, ""
    speeds = [stop.rad_per_s for stop in stops]
    modes = ", ".join(dict.fromkeys(mode_name(stop.safety_mode) for stop in stops))
    failed = [stop.refusal for stop in stops if stop.refusal]
    recovery = f"recovery {len(stops) - len(failed)} of {asked}" + (f": {failed[0]}" if failed else "")
    parts = [time, angle, f"from {min(speeds):.2f} to {max(speeds):.2f} rad/s", f"then {modes}", recovery, unseen]
    return judged(
        what,
        "; ".join(filter(None, parts)),
        limit,
        promise,
        passed=len(stops) == asked and not failed and all(_is_short(stop, longest_s) for stop in stops),
        count=len(stops),
    )


def _is_short(stop: HandStop, longest_s: float) -> bool:
    return (stop.time_s is None or stop.time_s <= longest_s) and stop.rad <= stop.asked_rad_per_s * longest_s


def mode_name(mode: int) -> str:
    """Return a safety mode in words."""
    return SAFETY_MODES.get(mode, f"unknown mode {mode}")
