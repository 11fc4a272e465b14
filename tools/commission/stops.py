"""Stage 4: each layer that stops the wrist, at rising speeds: time and angle to rest, the mode after it, recovery."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

from shearloop.daemon.commissioning import Line, Supplied
from shearloop.drivers.ur.messages import (
    RUNTIME_PLAYING,
    SAFETY_EMERGENCY_STOPS,
    SAFETY_MODES,
    SAFETY_NORMAL,
    SAFETY_REDUCED,
)
from shearloop.errors import UserError
from shearloop.tools.commission.bounds import LARGEST_RAD
from shearloop.tools.commission.context import STOPS_NEEDED, Context
from shearloop.tools.commission.mover_process import CAUSES
from shearloop.tools.commission.observer import Seen
from shearloop.tools.commission.report import Measured, judged

STAGE: Final = "4 stops"
PROMISED_S: Final = 0.2
# A turn begins this far from the pose, on the other side.
START_RAD: Final = 0.085
# To the start of a turn.
_SLOWLY_RAD_PER_S: Final = 0.2
_RESTS_WITHIN_S: Final = 5.0
# A mode that follows a stop has come by then.
_MODE_AFTER_S: Final = 0.5
# Two samples of the controller, which may not be the first of their kind.
_RESOLUTION_S: Final = 0.016
_SAFE: Final = (SAFETY_NORMAL, SAFETY_REDUCED)
# The connection is interrupted where no sample is made for this time.
_INTERRUPTED_NS: Final = 500_000_000


@dataclass(frozen=True, slots=True)
class Stop:
    """One stop: its layer, time and angle to rest, the safety mode after it, and why recovery failed, if it did."""

    layer: str
    time_s: float
    angle_rad: float
    safety_mode: int
    refusal: str


def measure(context: Context) -> Measured:
    """Return the stage's lines, the largest speed at which every layer passed, and the largest angle to rest."""
    lines: list[Line] = []
    passed_rad_per_s, largest_rad = 0.0, 0.0
    fastest = context.settings.limits.wrist_speed_rad_per_s.inner
    speeds = [speed for speed in context.counts.speeds_rad_per_s if speed <= fastest]
    for speed in speeds:
        stops = [stop for layer in CAUSES for stop in _stops(context, layer, speed)]
        found = judge_stops(stops, speed)
        lines += found
        if any(line.verdict == "failed" for line in found):
            if blocked := [f"{one:g}" for one in speeds if one > speed]:
                lines.append(
                    Line(what="blocked speeds", value=f"{', '.join(blocked)} rad/s: a layer failed below them")
                )
            return Measured(lines)
        passed_rad_per_s, largest_rad = speed, max(largest_rad, *(stop.angle_rad for stop in stops))
    lines.append(_watchdog(context))
    lines += _by_hand(context, min(_SLOWLY_RAD_PER_S, fastest))
    enough = context.counts.stops >= STOPS_NEEDED and passed_rad_per_s > 0
    supplies = (
        Supplied(wrist_speed_rad_per_s=passed_rad_per_s, stop_rad=round(largest_rad, 4)) if enough else Supplied()
    )
    return Measured(lines, supplies)


def _stops(context: Context, layer: str, speed: float) -> list[Stop]:
    count = context.counts.stops
    context.operator.allow(
        f"wrist 3 turns {count} times at {speed:g} rad/s, by at most {2 * LARGEST_RAD:g} rad; each turn is ended by: "
        f"{layer}"
    )
    return [_stop(context, layer, speed) for _ in range(count)]


def _stop(context: Context, layer: str, speed: float) -> Stop:
    """Turn, end the turn by a layer, and recover."""
    mover, observer, middle_rad = context.ready(), context.observer, context.pose_rad
    observer.forget()
    # From the nearer end to the other.
    sign = 1.0 if observer.latest().wrist_rad < middle_rad else -1.0
    slowly = min(_SLOWLY_RAD_PER_S, speed)
    start_rad = middle_rad - sign * START_RAD
    if (observer.latest().wrist_rad - start_rad) * sign > 0:
        mover.move("turn", rad_per_s=-sign * slowly, to_rad=start_rad)
    rest_rad_per_s = context.settings.rest_rad_per_s
    observer.rest_since(observer.latest().made_ns, rest_rad_per_s, _RESTS_WITHIN_S)
    asked_ns = mover.request("turn", rad_per_s=sign * speed, to_rad=middle_rad + sign * LARGEST_RAD, cause=layer)
    cause = mover.event("cause", asked_ns, _RESTS_WITHIN_S)
    if cause is None:
        raise UserError(f"the wrist did not reach {speed:g} rad/s: {mover.ended(asked_ns)}")
    rest = observer.rest_since(cause["t_ns"], rest_rad_per_s, _RESTS_WITHIN_S)
    if rest is None:
        raise UserError(f"the wrist did not come to rest after: {layer}. Look at the teach pendant")
    before = observer.since(asked_ns, cause["t_ns"])
    angle_rad = abs(rest.wrist_rad - before[-1].wrist_rad) if before else 0.0
    observer.listen(_MODE_AFTER_S)
    mode = observer.latest().outputs.safety_mode
    mover.kill()
    mover.start()
    return Stop(layer, (rest.made_ns - cause["t_ns"]) / 1e9, angle_rad, mode, mover.unlock())


def judge_stops(stops: Sequence[Stop], speed: float) -> list[Line]:
    """Return the lines on all stops at one speed."""
    at = f"at {speed:g} rad/s"
    worst = max(stops, key=lambda stop: stop.time_s)
    abnormal = [stop for stop in stops if stop.safety_mode not in _SAFE]
    failed = [stop for stop in stops if stop.refusal]
    recovered = len(stops) - len(failed)
    lines = [
        judged(
            f"time to rest {at}",
            f"{worst.time_s:.3f} s ({worst.layer})",
            f"at most {PROMISED_S:g} s",
            "each layer alone stops the wrist",
            passed=worst.time_s <= PROMISED_S,
            count=len(stops),
        ),
        judged(
            f"safety mode after stops {at}",
            f"{SAFETY_MODES[abnormal[0].safety_mode]} ({abnormal[0].layer})" if abnormal else "normal",
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
        times, angles = [stop.time_s for stop in own], [stop.angle_rad for stop in own]
        value = f"{min(times):.3f} to {max(times):.3f} s, up to {max(angles):.4f} rad"
        lines.append(Line(what=f"{layer} {at}", value=value, count=len(own)))
    return lines


def _watchdog(context: Context) -> Line:
    """Return the line on the robot's watchdog alone: a program without commands ends, here while the arm stands."""
    mover, observer, settings = context.ready(), context.observer, context.settings
    longest_s = 1.0 / settings.watchdog_hz + 2 / settings.rate_hz + _RESOLUTION_S
    times = []
    for _ in range(context.counts.stops):
        mover = context.ready()
        stopped_ns = mover.stop_worker()
        ended = observer.wait_for(lambda seen: seen.outputs.runtime_state != RUNTIME_PLAYING, stopped_ns, 5.0)
        times.append((ended.made_ns - stopped_ns) / 1e9 if ended is not None else float("inf"))
        mover.kill()
        mover.start()
    return judged(
        "watchdog alone, at rest",
        f"{max(times):.3f} s",
        f"at most {longest_s:.3f} s",
        "a program without its client ends",
        passed=max(times) <= longest_s,
        count=len(times),
    )


def _by_hand(context: Context, speed: float) -> list[Line]:
    """Return the lines on the stops that only the operator can bring about."""
    return [
        _stopped_by(
            context,
            speed,
            "emergency stop",
            "press the emergency stop",
            lambda seen: seen.outputs.safety_mode in SAFETY_EMERGENCY_STOPS,
            "Make the cell safe, and release the emergency stop",
        ),
        _stopped_by(
            context,
            speed,
            "stop at the pendant",
            "press the stop of the program at the pendant",
            lambda seen: seen.outputs.runtime_state != RUNTIME_PLAYING,
            "",
        ),
        _cable(context, speed),
    ]


def _swing(context: Context, speed: float, action: str) -> int:
    """Turn to and fro, and have the operator stop that; return when it began."""
    mover = context.ready()
    context.observer.forget()
    context.operator.allow(
        f"wrist 3 turns to and fro at {speed:g} rad/s within {LARGEST_RAD:g} rad; during it {action}"
    )
    asked_ns = mover.request("swing", rad_per_s=speed, middle_rad=context.pose_rad, by_rad=0.5 * LARGEST_RAD)
    if context.observer.wait_for(lambda seen: abs(seen.wrist_rad_per_s) > 0.9 * speed, asked_ns, 5.0) is None:
        raise UserError(f"the wrist did not turn: {mover.ended(asked_ns)}")
    context.operator.act(f"Now {action}")
    return asked_ns


def _stopped_by(
    context: Context, speed: float, what: str, action: str, stopped: Callable[[Seen], bool], after: str
) -> Line:
    asked_ns = _swing(context, speed, action)
    first = context.observer.wait_for(stopped, asked_ns, _RESTS_WITHIN_S)
    rest = None
    if first is not None:
        rest = context.observer.rest_since(first.made_ns, context.settings.rest_rad_per_s, _RESTS_WITHIN_S)
    time_s = (rest.made_ns - first.made_ns) / 1e9 if first is not None and rest is not None else float("inf")
    if after:
        context.operator.act(after)
    refusal = context.mover.unlock()
    return judged(
        what,
        f"{time_s:.3f} s to rest" + (f", then: {refusal}" if refusal else ", recovered"),
        f"at most {PROMISED_S:g} s, recovery",
        "a person stops the wrist",
        passed=time_s <= PROMISED_S and not refusal,
    )


def _cable(context: Context, speed: float) -> Line:
    """Return the line on a pulled cable: nothing is seen meanwhile, so that the angle counts."""
    asked_ns = _swing(context, speed, "pull the robot's network cable, wait for 3 s, and plug it in again")
    mover, observer = context.mover, context.observer
    found = observer.interruption(asked_ns, _INTERRUPTED_NS, 10.0)
    largest_rad = speed * PROMISED_S
    angle_rad = abs(found[1].wrist_rad - found[0].wrist_rad) if found is not None else float("inf")
    mover.kill()
    mover.start()
    refusal = mover.unlock()
    return judged(
        "cable pulled",
        (f"{angle_rad:.4f} rad" if found is not None else "the connection was not interrupted")
        + (f", then: {refusal}" if refusal else ", recovered"),
        f"at most {largest_rad:.4f} rad, as in {PROMISED_S:g} s, and recovery",
        "the wrist stops without a connection",
        passed=angle_rad <= largest_rad and not refusal,
    )
