"""Stage 1: the connection to the controller, its registers and its script port. Nothing moves."""

import statistics
from collections.abc import Sequence
from itertools import pairwise
from typing import Final

from shearloop.daemon.commissioning_report import Line
from shearloop.errors import UserError
from shearloop.tools.commission.context import Context
from shearloop.tools.commission.limits import REAL, TimeLimits
from shearloop.tools.commission.observer import Seen, span_s
from shearloop.tools.commission.report import Measured, judged, percentile_99

STAGE: Final = "1 no motion"
_CLOCK_WINDOW_S: Final = 0.5
_STARTS_WITHIN_S: Final = 15.0
_WRITTEN: Final = (1, 12345, -7)


def measure(context: Context) -> Measured:
    """Return the stage's lines."""
    observer = context.observer
    read = [context.rig.write_register(context.registers, value) for value in _WRITTEN]
    context.operator.say(f"Listening to the controller for {context.counts.listen_s:g} s; nothing moves.")
    observer.forget()
    samples = observer.listen(context.counts.listen_s)
    if len(samples) < 2:
        raise UserError("the observer received nothing from the controller: look at its cable")
    lines = judge_samples(samples, context.settings.rate_hz, context.limits)
    same = sum(read_value == value for read_value, value in zip(read, _WRITTEN, strict=True))
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


def judge_samples(samples: Sequence[Seen], rate_hz: float, limits: TimeLimits) -> list[Line]:
    """Return the lines on the samples of one connection."""
    rate = (len(samples) - 1) / span_s(samples) / rate_hz
    ages_s = [(seen.arrived_ns - seen.made_ns) / 1e9 for seen in samples]
    gap_s = max((after.arrived_ns - before.arrived_ns) / 1e9 for before, after in pairwise(samples))
    p99_s = percentile_99(ages_s)
    count = len(samples)
    return [
        judged(
            "rate",
            f"{rate:.3f} of {rate_hz:g} Hz",
            f"at least {limits.least_rate:g}",
            "states come as often as planned",
            passed=rate >= limits.least_rate,
            count=count,
        ),
        judged(
            "largest gap",
            f"{1e3 * gap_s:.0f} ms",
            f"below {1e3 * limits.longest_gap_s:g} ms",
            "no state is older than a deadline allows",
            passed=gap_s < limits.longest_gap_s,
            count=count,
        ),
        Line(
            what="age, median and p99",
            value=f"{1e3 * statistics.median(ages_s):.1f}, {1e3 * p99_s:.1f} ms",
            count=count,
        ),
    ]


def _uploads(context: Context) -> list[Line]:
    """Start the control program again at several times after the connection, and compare its clock with the robot's."""
    operator, mover, clock = context.operator, context.mover, context.clock
    started = 0
    reasons: list[str] = []
    begun_ns = clock.now_ns()
    # Two processes start first.
    if refusal := mover.unlock():
        return [_uploaded(0, context, refusal)]
    for after_s in context.counts.uploads_after_s:
        operator.say(
            f"The control program is stopped and sent again {after_s:g} s after the connection; nothing moves."
        )
        clock.sleep(after_s - (clock.now_ns() - begun_ns) / 1e9)
        refusal = mover.unlock(_STARTS_WITHIN_S) if context.stop_program() else "the program did not stop"
        started += not refusal
        reasons += [refusal] if refusal else []
    line = _uploaded(started, context, *reasons)
    if reasons:
        return [line]
    return [line, judge_clock(context.observer.listen(context.counts.clock_s), context.limits.script_tolerance)]


def _uploaded(started: int, context: Context, *reasons: str) -> Line:
    times_s = context.counts.uploads_after_s
    return judged(
        f"uploads after {', '.join(f'{time_s:g}' for time_s in times_s)} s",
        f"{started} of {len(times_s)}" + (f": {reasons[0]}" if reasons else ""),
        "all",
        "the robot recovers after a stop",
        passed=started == len(times_s),
        count=len(times_s),
    )


def judge_clock(samples: Sequence[Seen], tolerance: float = REAL.script_tolerance) -> Line:
    """Return the line on the clock of the script, by which deadlines end motions.

    A clock that loses cycles by rounding loses them always, so the window with the smallest error counts. A simulator
    that is late for a moment is not such a clock.
    """
    ratios: list[float] = []
    begin = 0
    for seen in samples:
        last = seen.outputs
        while last.timestamp_s - samples[begin].outputs.timestamp_s >= _CLOCK_WINDOW_S:
            first, begin = samples[begin].outputs, begin + 1
            counted_s = (last.script_ticks - first.script_ticks) * last.script_step_s
            ratios.append(counted_s / (last.timestamp_s - first.timestamp_s))
    ratio = min(ratios, key=lambda one: abs(one - 1.0), default=None)
    if ratio is None:
        value = f"not measured: {len(samples)} states of the controller came, over less than {_CLOCK_WINDOW_S:g} s"
    else:
        value = f"{ratio:.4f} of the controller's"
    return judged(
        "script's clock",
        value,
        f"1 ± {tolerance:g}",
        "deadlines end in time, also after hours",
        passed=ratio is not None and abs(ratio - 1.0) <= tolerance,
        count=len(ratios),
    )
