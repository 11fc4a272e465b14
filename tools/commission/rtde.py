"""Stage 1: the connection to the controller, its registers and its script port. Nothing moves."""

import math
import statistics
import time
from collections.abc import Sequence
from itertools import pairwise
from typing import Final

from shearloop.daemon.commissioning import Line
from shearloop.drivers.ur.control_box import ask_dashboard, register_round_trip
from shearloop.drivers.ur.messages import RUNTIME_PLAYING
from shearloop.drivers.ur.settings import UrSettings
from shearloop.errors import UserError
from shearloop.tools.commission.context import Context
from shearloop.tools.commission.observer import Seen, span_s
from shearloop.tools.commission.report import Measured, judged

STAGE: Final = "1 no motion"
LEAST_RATE: Final = 0.99
LONGEST_GAP_S: Final = 0.04
# Times on one connection to the script port after which a program has to start.
UPLOADS_AFTER_S: Final = (0.0, 5.0, 60.0)
# A clock that counts a cycle too few here and there makes every deadline late.
CLOCK_TOLERANCE: Final = 0.005
_CLOCK_WINDOW_S: Final = 0.5
_STARTS_WITHIN_S: Final = 15.0
_WRITTEN: Final = (1, 12345, -7)


def measure(context: Context) -> Measured:
    """Return the stage's lines."""
    settings, observer = context.settings, context.observer
    read = [
        register_round_trip(settings.host, settings.connect_timeout_s, context.registers, value) for value in _WRITTEN
    ]
    context.operator.say(f"Listening to the controller for {context.counts.listen_s:g} s; nothing moves.")
    observer.forget()
    samples = observer.listen(context.counts.listen_s)
    if len(samples) < 2:
        raise UserError("the observer received nothing from the controller: look at its cable")
    lines = judge_samples(samples, settings)
    same = sum(one == value for one, value in zip(read, _WRITTEN, strict=True))
    lines.append(
        judged(
            "registers read back",
            f"{same} of {len(_WRITTEN)}",
            "all",
            "commands arrive",
            passed=same == len(_WRITTEN),
            count=len(_WRITTEN),
        )
    )
    return Measured([*lines, *_uploads(context)])


def judge_samples(samples: Sequence[Seen], settings: UrSettings) -> list[Line]:
    """Return the lines on the samples of one connection."""
    rate = (len(samples) - 1) / span_s(samples) / settings.rate_hz
    ages_s = sorted((seen.arrived_ns - seen.made_ns) / 1e9 for seen in samples)
    gap_s = max((after.arrived_ns - before.arrived_ns) / 1e9 for before, after in pairwise(samples))
    p99_s = ages_s[math.ceil(0.99 * len(ages_s)) - 1]
    count = len(samples)
    return [
        judged(
            "rate",
            f"{rate:.3f} of {settings.rate_hz:g} Hz",
            f"at least {LEAST_RATE:g}",
            "states come as often as planned",
            passed=rate >= LEAST_RATE,
            count=count,
        ),
        judged(
            "largest gap",
            f"{1e3 * gap_s:.0f} ms",
            f"below {1e3 * LONGEST_GAP_S:g} ms",
            "no state is older than a deadline allows",
            passed=gap_s < LONGEST_GAP_S,
            count=count,
        ),
        Line(
            what="age, median and p99",
            value=f"{1e3 * statistics.median(ages_s):.1f}, {1e3 * p99_s:.1f} ms",
            count=count,
        ),
    ]


def _uploads(context: Context) -> list[Line]:
    """Start the control program anew at several times after the connection, and compare its clock with the robot's."""
    operator, mover, settings = context.operator, context.mover, context.settings
    started = 0
    reasons: list[str] = []
    begun_s = time.monotonic()
    # Two processes start first.
    if refusal := mover.unlock():
        return [_uploaded(0, context, refusal)]
    for after_s in context.counts.uploads_after_s:
        operator.say(
            f"The control program is stopped and sent again {after_s:g} s after the connection; nothing moves."
        )
        time.sleep(max(0.0, begun_s + after_s - time.monotonic()))
        ask_dashboard(settings.host, settings.connect_timeout_s, ("stop",))
        since_ns = time.monotonic_ns()
        stopped = context.observer.wait_for(lambda seen: seen.outputs.runtime_state != RUNTIME_PLAYING, since_ns, 5.0)
        refusal = mover.unlock(_STARTS_WITHIN_S) if stopped is not None else "the program did not stop"
        started += not refusal
        reasons += [refusal] if refusal else []
    line = _uploaded(started, context, *reasons)
    if reasons:
        return [line]
    return [line, judge_clock(context.observer.listen(context.counts.clock_s))]


def _uploaded(started: int, context: Context, *reasons: str) -> Line:
    times_s = context.counts.uploads_after_s
    return judged(
        f"uploads after {', '.join(f'{one:g}' for one in times_s)} s",
        f"{started} of {len(times_s)}" + (f": {reasons[0]}" if reasons else ""),
        "all",
        "the robot recovers after a stop",
        passed=started == len(times_s),
        count=len(times_s),
    )


def judge_clock(samples: Sequence[Seen]) -> Line:
    """Return the line on the clock of the script, by which deadlines end motions.

    A clock that loses cycles by rounding always loses them, so that the closest window counts: a simulator that is late
    for a moment is no such clock.
    """
    ratios: list[float] = []
    begin = 0
    for seen in samples:
        last = seen.outputs
        while last.timestamp_s - samples[begin].outputs.timestamp_s >= _CLOCK_WINDOW_S:
            first, begin = samples[begin].outputs, begin + 1
            counted_s = (last.script_ticks - first.script_ticks) * last.script_step_s
            ratios.append(counted_s / (last.timestamp_s - first.timestamp_s))
    ratio = min(ratios, key=lambda one: abs(one - 1.0), default=0.0)
    return judged(
        "script's clock",
        f"{ratio:.4f} of the controller's",
        f"1 ± {CLOCK_TOLERANCE:g}",
        "deadlines end in time, also after hours",
        passed=abs(ratio - 1.0) <= CLOCK_TOLERANCE,
        count=len(ratios),
    )
