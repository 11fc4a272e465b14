"""Stage 3: an empty gripper turns by 0.1 rad either way: noise at rest, delay, tracking, acceleration, slider."""

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from shearloop.daemon.commissioning_report import Line, has_failed
from shearloop.daemon.supplied_values import Supplied
from shearloop.drivers.ur.limits import ACCELERATION_S, slowed_by
from shearloop.drivers.ur.messages import RtdeOutputs
from shearloop.drivers.ur.settings import MIN_REST_RAD_PER_S
from shearloop.errors import UserError
from shearloop.tools.commission.bounds import LARGEST_RAD
from shearloop.tools.commission.context import Context
from shearloop.tools.commission.observer import WRIST, Seen
from shearloop.tools.commission.operator import Played
from shearloop.tools.commission.report import Measured, judged, percentile_99

STAGE: Final = "3 empty gripper"
SPEED_RAD_PER_S: Final = 0.2
# Noise that many standard deviations high is rare enough for a threshold of rest.
SIGMAS: Final = 4.0
TRACKING: Final = 0.03
# Later stages turn by this, either way from the confirmed pose; the distance to the bound is for braking.
TURN_RAD: Final = 0.08
# In this stage no brake is known yet: the distance also holds one of 0.5 rad/s², an eighth of the usual, and the delay.
FIRST_TURN_RAD: Final = 0.05
_SLIDER: Final = 0.5
_SLIDER_ERROR: Final = 0.2
_COMES_TO_REST_S: Final = 3.0


@dataclass(frozen=True, slots=True)
class Turn:
    """One turn: the time of its command, the commanded speed, and its samples."""

    sent_ns: int
    asked_rad_per_s: float
    samples: Sequence[Seen]

    def delay_s(self, noise_rad_per_s: float) -> float:
        """Return the time until the wrist moved, beyond the noise; infinite where it did not."""
        for seen in self.samples:
            if seen.made_ns >= self.sent_ns and abs(seen.wrist_rad_per_s) > noise_rad_per_s:
                return (seen.made_ns - self.sent_ns) / 1e9
        return math.inf

    def cruise(self) -> list[float]:
        """Return the speeds after the start and before the stop, as fractions of the asked one."""
        fractions = [seen.wrist_rad_per_s / self.asked_rad_per_s for seen in self.samples]
        fast = [number for number, fraction in enumerate(fractions) if fraction > 0.5]
        if len(fast) < 10:
            return fractions[fast[0] : fast[-1] + 1] if fast else []
        quarter = (fast[-1] - fast[0]) // 4
        return fractions[fast[0] + quarter : fast[-1] - quarter + 1]

    def largest_acceleration(self) -> float:
        """Return the largest change of the wrist's speed over `ACCELERATION_S`, in rad/s²."""
        largest, first = 0.0, 0
        for seen in self.samples:
            while seen.outputs.timestamp_s - self.samples[first].outputs.timestamp_s > ACCELERATION_S + 1e-6:
                first += 1
            before = self.samples[first]
            span_s = seen.outputs.timestamp_s - before.outputs.timestamp_s
            if span_s > 0.5 * ACCELERATION_S:
                largest = max(largest, abs(seen.wrist_rad_per_s - before.wrist_rad_per_s) / span_s)
        return largest


def measure(context: Context) -> Measured:
    """Return the stage's lines, and the threshold of rest and the delays."""
    rest = context.observer.listen(context.counts.rest_s)
    noise_line, sigma_rad_per_s = judge_noise(rest, context.settings.rest_rad_per_s)
    mover, middle_rad = context.ready(), context.pose_rad
    count, speed = context.counts.turns, min(SPEED_RAD_PER_S, context.settings.limits.wrist_speed_rad_per_s.inner)
    context.operator.allow(
        f"wrist 3 turns {count} times between {middle_rad - FIRST_TURN_RAD:.3f} and "
        f"{middle_rad + FIRST_TURN_RAD:.3f} rad at {speed:g} rad/s, with an empty gripper"
    )
    turns = []
    mover.move("turn", rad_per_s=-speed, to_rad=middle_rad - FIRST_TURN_RAD)
    for number in range(count):
        sign = 1.0 if number % 2 == 0 else -1.0
        context.comes_to_rest(_COMES_TO_REST_S)
        asked_ns = mover.request("turn", rad_per_s=sign * speed, to_rad=middle_rad + sign * FIRST_TURN_RAD)
        sent = mover.event("sent", asked_ns, _COMES_TO_REST_S)
        if (refusal := mover.ended(asked_ns)) or sent is None:
            raise UserError(f"the wrist did not turn: {refusal}")
        context.comes_to_rest(_COMES_TO_REST_S)
        turns.append(Turn(sent["t_ns"], sign * speed, context.observer.since(sent["t_ns"])))
        context.observer.forget()
    lines, delays_s = judge_turns(turns, context, SIGMAS * sigma_rad_per_s)
    lines = [noise_line, *lines, _slider(context)]
    if has_failed(lines):
        return Measured(lines)
    rest_rad_per_s = max(MIN_REST_RAD_PER_S, round(SIGMAS * sigma_rad_per_s, 4))
    return Measured(lines, Supplied.model_validate({"rest_rad_per_s": rest_rad_per_s, **delays_s}))


def judge_noise(samples: Sequence[Seen], rest_rad_per_s: float) -> tuple[Line, float]:
    """Return the line on the speeds of an arm that stands, and the standard deviation of the noisiest joint."""
    sigma = max(statistics.pstdev(seen.outputs.qd_rad_per_s[joint] for seen in samples) for joint in range(WRIST + 1))
    line = judged(
        "velocity noise at rest",
        f"{SIGMAS:g} σ = {1e3 * SIGMAS * sigma:.2f} mrad/s",
        f"below {1e3 * rest_rad_per_s:g} mrad/s",
        "an arm that stands is known to stand",
        passed=SIGMAS * sigma < rest_rad_per_s,
        count=len(samples),
    )
    return line, sigma


def judge_turns(turns: Sequence[Turn], context: Context, noise_rad_per_s: float) -> tuple[list[Line], dict[str, float]]:
    """Return the lines on delay, tracking and acceleration, and the delays by their names in `Supplied`.

    There are no delays where the computer is later than `reaction_s`, which only an emulated rig may be.
    """
    settings, longest_s = context.settings, context.limits.reaction_s(context.settings)
    # The ramp takes some milliseconds to a speed that noise does not have.
    threshold = max(noise_rad_per_s, 0.02 * SPEED_RAD_PER_S)
    delays_s = [turn.delay_s(threshold) for turn in turns]
    p99_s = percentile_99(delays_s)
    fractions = [fraction for turn in turns for fraction in turn.cruise()]
    reached = statistics.mean(fractions) if fractions else 0.0
    acceleration = max(turn.largest_acceleration() for turn in turns)
    hard = settings.limits.wrist_acceleration_rad_per_s2.hard
    farthest = max(abs(seen.wrist_rad - context.pose_rad) for turn in turns for seen in turn.samples)
    lines = [
        judged(
            "command to motion, p99",
            f"{1e3 * p99_s:.1f} ms (median {1e3 * statistics.median(delays_s):.1f})",
            f"at most {'reaction_s' if longest_s == settings.reaction_s else 'for an emulated rig'}, "
            f"{1e3 * longest_s:g} ms",
            "the wrist brakes within its range",
            passed=p99_s <= longest_s,
            count=len(delays_s),
        ),
        judged(
            "speed that is reached",
            f"{reached:.3f} of the asked one",
            f"1 ± {TRACKING:g}",
            "the loop's gain",
            passed=abs(reached - 1.0) <= TRACKING,
            count=len(turns),
        ),
        judged(
            "largest acceleration",
            f"{acceleration:.2f} rad/s²",
            f"at most {hard:g} rad/s²",
            "no jerk on the tool",
            passed=acceleration <= hard,
            count=len(turns),
        ),
        judged(
            "farthest from the pose",
            f"{farthest:.3f} rad",
            f"at most {LARGEST_RAD:g} rad",
            "motions stay within their bounds",
            passed=farthest <= LARGEST_RAD,
            count=len(turns),
        ),
    ]
    if p99_s > settings.reaction_s:
        return lines, {}
    return lines, {"actuation_s": round(statistics.median(delays_s), 4), "reaction_s": round(p99_s, 4)}


def _slider(context: Context) -> Line:
    """Return the line on a motion at half speed, which has to be refused."""
    mover, here_rad = context.mover, context.pose_rad
    context.operator.act(
        f"Set the speed slider at the pendant to {_SLIDER:.0%}",
        Played("it is set for you", (f"robot slider {_SLIDER:g}",)),
    )
    context.observer.wait_for(lambda seen: _is_at_half(seen.outputs), context.observer.latest().made_ns, 5.0)
    context.operator.allow(f"a turn of {FIRST_TURN_RAD:g} rad at {SPEED_RAD_PER_S:g} rad/s, which has to be refused")
    refusal = mover.ended(mover.request("turn", rad_per_s=SPEED_RAD_PER_S, to_rad=here_rad + FIRST_TURN_RAD))
    outputs = context.observer.latest().outputs
    context.operator.act("Set the speed slider back to 100 %", Played("it is set for you", ("robot slider 1",)))
    return judge_slider(refusal, outputs)


def _is_at_half(outputs: RtdeOutputs) -> bool:
    return abs(outputs.speed_slider - _SLIDER) < _SLIDER_ERROR


def judge_slider(refusal: str, outputs: RtdeOutputs) -> Line:
    """Return the line on the refusal of a motion, by the robot's outputs at this time."""
    slowed = slowed_by(outputs)
    return judged(
        "slider at 50 %",
        refusal or "it turned",
        "refused because of the slider",
        "the loop's gain",
        passed=_is_at_half(outputs) and slowed is not None and slowed.sentence in refusal,
    )
