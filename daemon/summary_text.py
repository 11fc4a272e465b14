"""The text of a run's summary: its steps, and how each torque was held."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from shearloop.bank.arrays import FloatArray
from shearloop.daemon.messaging.messages import with_unit
from shearloop.daemon.run_record import Events, Run, StepSummary, TorqueSeries, elapsed_s
from shearloop.daemon.torques import LOAD_CELL
from shearloop.words import counted, times

# A torque within this fraction of the set point counts as held.
BAND = 0.10
# A smaller band is within the noise of every torque.
SMALLEST_BAND_NM = 0.001
# A torque that was measured within this time of a step's end is that of its end.
_AT_THE_END_S = 1.5
# A spread below this fraction of the half interval is none: friction hides how the torque moved.
MIN_SPREAD = 0.2
# A torque has recovered from a disturbance when it stays in the band for this time.
STAYS_S = 1.0
# The name of the emulated tool's torque, which no sensor measures.
TRUE = "true torque"


def lines_of(run: Run, truth: TorqueSeries | None, events: Events, *, asked_for: bool) -> Iterator[str]:
    """Yield the summary of a run, with the true torque and the disturbances of an emulated rig.

    `asked_for`: a person stopped it.
    """
    done = run.last["phase"] == "done"
    took_s = elapsed_s(run.first, run.last)
    if done:
        ended = "done"
    elif asked_for:
        ended = "stopped as asked"
    else:
        ended = "STOPPED before its end"
    yield f"What happened: {run.first['experiment']!r} was {ended}, after {took_s:.0f} s."
    if not done:
        # The cause alone: the message has every reason.
        yield f"  {run.last['activity'] if asked_for else run.last['cause'] or run.last['activity']}"
    before_nm: float | None = None
    for step in run.steps:
        took_s = (step.to_ns - step.from_ns) / 1e9
        held = f"   {counted(step.holds, 'angle')} held" if step.holds else ""
        details = {"identify": run.identified, "twist": held}.get(step.name, "")
        paused = f"   {step.paused_s:.1f} s of them paused" if step.paused_s else ""
        name = step.name or "at once"
        yield f"  step {step.number} of {run.first['steps']}  {name:<12} {took_s:6.1f} s{paused}{details}"
        if step.set_point_nm is not None and step.held_from_ns is not None:
            here = [event for event in events if step.from_ns <= event[0] <= step.to_ns]
            changes = step.set_point_nm != before_nm
            yield from _held(step, step.set_point_nm, step.held_from_ns, run, truth, here, changes=changes)
        before_nm = step.set_point_nm
        if step.name == "tighten":
            yield from _turned(step, run, truth)
    if run.torque_note:
        yield f"  {run.torque_note}"
    yield from _counted(run)


def _turned(step: StepSummary, run: Run, truth: TorqueSeries | None) -> Iterator[str]:
    driving = run.first["torque_source"]
    if step.wrist_from_rad is not None and step.wrist_to_rad is not None:
        turned = with_unit("robot.state", "wrist_rad", step.wrist_to_rad - step.wrist_from_rad, "+.3f")
        yield f"    turned by {turned}; {_named(driving, truth)}"
    for name, series in _all_torques(run, truth).items():
        turning = series.between(step.from_ns, step.to_ns)
        if turning.torque_nm.size and name in (TRUE, driving):
            largest_nm = turning.torque_nm[np.abs(turning.torque_nm).argmax()]
            when = _before_the_end(turning, step.to_ns)
            yield f"    {name:<11} {_torque(turning.torque_nm[-1], '+.4f')} {when}, {largest_nm:+.4f} at most"


def _before_the_end(series: TorqueSeries, end_ns: float) -> str:
    """Return when the last torque was measured, before the end or at it."""
    before_s = (end_ns - series.t_ns[-1]) / 1e9
    # The next one is under way, and one may be missing.
    is_last = before_s <= max(_AT_THE_END_S, 4 * series.half_ns / 1e9)
    return "at the end" if is_last else f"{before_s:.1f} s before the end, and none since"


def _torque(torque_nm: float, form: str) -> str:
    return with_unit("loop.state", "torque_nm", torque_nm, form)


def _named(driving: str, truth: TorqueSeries | None) -> str:
    return f"torque source: {driving}{f'; {TRUE}: of the emulated tool' if truth is not None else ''}"


def _all_torques(run: Run, truth: TorqueSeries | None) -> dict[str, TorqueSeries]:
    sources: dict[str, TorqueSeries] = {}
    for name, values in run.torques.items():
        t_ns, torque_nm, low_nm, high_nm = map(np.array, zip(*values, strict=True))
        bounds_nm = np.stack((low_nm, high_nm), axis=1)
        # A sensor acquires all the time: the acquisition of one torque takes one period.
        periods_ns = np.diff(run.times_ns[name])
        half_ns = 0.5 * float(np.median(periods_ns)) if periods_ns.size else 0.0
        sources[name] = TorqueSeries(t_ns, torque_nm, half_ns, None if np.isnan(bounds_nm).any() else bounds_nm)
    return sources if truth is None else {TRUE: truth, **sources}


def _held(
    step: StepSummary,
    set_nm: float,
    from_ns: int,
    run: Run,
    truth: TorqueSeries | None,
    events: Events,
    *,
    changes: bool,
) -> Iterator[str]:
    """Yield the lines of a hold; `changes`: its set point is another one than of the step before."""
    has_band = BAND * abs(set_nm) >= SMALLEST_BAND_NM
    driving, held_s = run.first["torque_source"], (step.to_ns - from_ns) / 1e9
    sources = _all_torques(run, truth)
    form = "+.3f" if has_band or not set_nm else "+.2g"
    yield f"    set point {_torque(set_nm, form)}, held for {held_s:.0f} s; {_named(driving, truth)}"
    for name, series in sources.items():
        held = series.acquired_between(from_ns, step.to_ns)
        if held.torque_nm.size:
            yield f"    {name:<11} {_spread(held, set_nm if has_band else None)}"
    # Judge by the true torque, the load cell or another source, never by the one that drove the loop.
    judges = (name for name in sources if name != driving and sources[name].half_width_nm <= BAND * abs(set_nm))
    names = sorted(judges, key=lambda name: (name != TRUE, name != LOAD_CELL, name))
    for name in names[:1]:
        during = sources[name].acquired_between(step.from_ns, step.to_ns)
        reached_s = recovered_s((during.t_ns - step.from_ns) / 1e9, during.torque_nm, set_nm)
        if reached_s < np.inf and has_band and changes:
            yield f"    within ± {BAND:.0%} {reached_s:.1f} s after the set point changed, by {name}"
        for t_ns, description in events:
            # The next disturbance has a line of its own.
            next_ns = min((other_ns for other_ns, _ in events if other_ns > t_ns), default=None)
            after = sources[name].acquired_between(t_ns, step.to_ns if next_ns is None else next_ns - 1)
            if after.torque_nm.size:
                worst_nm = np.abs(after.torque_nm - set_nm).max()
                back_s = recovered_s((after.t_ns - t_ns) / 1e9, after.torque_nm, set_nm)
                never = "not back by the end" if next_ns is None else "not back by the next one"
                back = never if back_s == np.inf else f"back within ± {BAND:.0%} after {back_s:.1f} s"
                since_s = (t_ns - from_ns) / 1e9
                off = f"    disturbed after {since_s:.1f} s ({description}): {_torque(worst_nm, '.3f')} off"
                yield f"{off}, {back}" if has_band else off


def _spread(held: TorqueSeries, set_nm: float | None) -> str:
    """Return the mean, the interval and the spread of a held torque; without a set point, nothing of its band."""
    torque_nm, half_nm = held.torque_nm, held.half_width_nm
    parts = [f"{_torque(torque_nm.mean(), '+.4f')} on average"]
    if held.bounds_nm is not None:
        low_nm, high_nm = held.bounds_nm.mean(axis=0)
        parts.append(f"its interval is {low_nm:+.4f} to {high_nm:+.4f}")
    if torque_nm.std() >= MIN_SPREAD * half_nm:
        parts.append(f"standard deviation {torque_nm.std():.4f}")
    if set_nm is not None and half_nm <= BAND * abs(set_nm):
        parts.append(f"within ± {BAND:.0%} for {np.mean(_in_band(torque_nm, set_nm)):.0%} of the time")
    return ", ".join(parts)


def _in_band(torque_nm: FloatArray, set_nm: float) -> NDArray[np.bool_]:
    return np.abs(torque_nm - set_nm) <= BAND * abs(set_nm)


def recovered_s(t_s: FloatArray, torque_nm: FloatArray, set_nm: float) -> float:
    """Return when a torque (n,) comes into its band for STAYS_S at least; infinite if it does not."""
    outside = np.flatnonzero(~_in_band(torque_nm, set_nm))
    came, left_s = np.append(0, outside + 1), np.append(t_s[outside], t_s[-1:])
    for at, end_s in zip(came, left_s, strict=False):
        if at < len(t_s) and end_s - t_s[at] >= STAYS_S:
            return float(t_s[at])
    return np.inf


def _counted(run: Run) -> Iterator[str]:
    if run.hold_reasons:
        reasons = "; ".join(f"{times(count)} {reason}" for reason, count in run.hold_reasons.most_common())
        yield f"  by faults, the wrist was held for {run.last['held_s']:.1f} s in all: {reasons}"
    else:
        yield "  the wrist was never held by a fault"
    for source, reasons_of in run.invalid.items():
        # A source without any torque has another purpose.
        if source in run.torques:
            count, (_, most) = reasons_of.total, reasons_of.most_frequent_first[0]
            every = count + len(run.torques[source])
            unused = f"{count} of {counted(every, 'torque')} of {source} {'was' if count == 1 else 'were'}"
            yield f"  {unused} not valid and not used, most often: {most}"
