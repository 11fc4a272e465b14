"""The summary of an experiment, made from the daemon's own messages at its end.

An emulated rig adds the true torque and the disturbances.
"""

from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol, TextIO, TypeAlias

import numpy as np
from numpy.typing import NDArray

from shearloop.bank.arrays import FloatArray
from shearloop.daemon.control.faults import FaultCode
from shearloop.daemon.messaging.messages import stop_times, with_unit
from shearloop.daemon.torques import LOAD_CELL
from shearloop.printable import printable
from shearloop.words import CountedReasons, counted, times

if TYPE_CHECKING:
    from shearloop.daemon.logs import NonBlockingWriter

# A torque within this fraction of the set point counts as held.
BAND = 0.10
# A smaller band is within the noise of every torque.
SMALLEST_BAND_NM = 0.001
# A spread below this fraction of the half interval is none: friction hides how the torque moved.
LEAST_SPREAD = 0.2
# A torque has recovered from a disturbance when it stays in the band for this time.
STAYS_S = 1.0
# Topics with a torque.
TORQUES = ("eit.estimate", "load.torque", "skin.shear")
# The name of the emulated tool's torque, which no sensor measures.
TRUE = "true torque"
_ENDS = ("done", "stopped")
# Of a hold for too long, from this fraction of the time with a fault of a busy computer on.
_LATE_FRACTION = 0.1
_TOO_BUSY = "This computer was too busy for the emulated rig: close other programs and run it again."
_ASKED_FOR = frozenset(code.text for code in FaultCode if code.value.asked_for)
_BY_BUSY_COMPUTER = frozenset(code.text for code in FaultCode if code.value.by_busy_computer)
# The time of each disturbance in ns, and its description.
_Events: TypeAlias = Sequence[tuple[int, str]]


@dataclass(frozen=True, slots=True)
class TorqueSeries:
    """A torque over time: ns of CLOCK_MONOTONIC and N·m, both (n,). `half_ns` is half the acquisition of one torque.

    `bounds_nm` (n, 2) are the ends of the interval of each torque; None for a source without intervals.
    """

    t_ns: FloatArray
    torque_nm: FloatArray
    half_ns: float = 0.0
    bounds_nm: FloatArray | None = None

    def between(self, from_ns: float, to_ns: float) -> "TorqueSeries":
        """Return the torques whose middle is within a time interval."""
        inside = (self.t_ns >= from_ns) & (self.t_ns <= to_ns)
        bounds_nm = self.bounds_nm[inside] if self.bounds_nm is not None else None
        return TorqueSeries(self.t_ns[inside], self.torque_nm[inside], self.half_ns, bounds_nm)

    @property
    def half_width_nm(self) -> float:
        """The mean half width of the intervals; 0 without intervals."""
        return 0.0 if self.bounds_nm is None else 0.5 * float(np.diff(self.bounds_nm).mean())

    def acquired_between(self, from_ns: float, to_ns: float) -> "TorqueSeries":
        """Return the torques whose whole acquisition is within a time interval."""
        return self.between(from_ns + self.half_ns, to_ns - self.half_ns)


@dataclass(slots=True)
class _StepSummary:
    number: int
    name: str
    from_ns: int
    to_ns: int
    holds: int = 0
    # By the operator.
    paused_s: float = 0.0
    set_point_nm: float | None = None
    # The first message of the closed loop that holds.
    held_from_ns: int | None = None
    wrist_from_rad: float | None = None
    wrist_to_rad: float | None = None


class EmulatedTruth(Protocol):
    """An emulated rig; `sent` holds the disturbances, with their times in ns."""

    sent: list[tuple[int, str]]

    def torques(self) -> TorqueSeries | None:
        """Return the true torque so far, None if it is unknown."""


@dataclass(slots=True)
class _Run:
    # The first and the latest `loop.state` of the experiment.
    first: Mapping[str, Any]
    last: Mapping[str, Any]
    steps: list[_StepSummary] = field(default_factory=list)
    identified: str = ""
    # What the driving torque rests on that nothing checks.
    torque_note: str = ""
    # The part of the hold time with a fault that a busy computer can cause.
    late_s: float = 0.0
    hold_reasons: Counter[str] = field(default_factory=Counter)
    # By source, why a torque was not valid.
    invalid: defaultdict[str, CountedReasons] = field(default_factory=lambda: defaultdict(CountedReasons))
    # By source, time in ns, torque and the ends of its interval, NaN without one, in N·m.
    torques: dict[str, list[tuple[int, float, float, float]]] = field(default_factory=dict)
    # By source, the times in ns of all torques, also of those that are not valid.
    times_ns: defaultdict[str, list[int]] = field(default_factory=lambda: defaultdict(list))


class RunSummary:
    """Collects every message of a daemon; `text` is the summary of the last experiment that ended, or empty."""

    def __init__(
        self,
        out: "TextIO | NonBlockingWriter | None" = None,
        emulated: EmulatedTruth | None = None,
        *,
        heading: str = "",
    ) -> None:
        """Take the output for each summary, if any, an emulated rig, which adds its true torque, and a first line."""
        self._heading = heading
        self.text = ""
        # Whether no experiment has been stopped by anything but a person.
        self.ended_as_asked = True
        self.out = out
        self._emulated = emulated
        self._run: _Run | None = None

    def __call__(self, topic: str, content: Mapping[str, Any]) -> None:
        """Handle one message."""
        if topic == "loop.state":
            self._on_loop_state(content)
        elif topic == "loop.stop":
            self.add(f"The stop, {stop_times(content)}.")
        elif self._run is not None:
            _on_sample(self._run, topic, content)

    def _on_loop_state(self, content: Mapping[str, Any]) -> None:
        run, phase = self._run, content["phase"]
        if phase == "idle" or (run is None and phase in _ENDS):
            return
        if run is None:
            run = self._run = _Run(content, {**content, "phase": "", "response": ""})
        _update(run, content)
        if phase in _ENDS:
            self._run = None
            self.ended_as_asked = phase == "done" or _was_asked_for(content)
            rig = self._emulated
            lines = list(_lines(run, None, ()) if rig is None else _lines(run, rig.torques(), rig.sent))
            if rig is not None and phase != "done" and _may_be_late(run, content):
                lines.insert(0, _TOO_BUSY)
            if self._heading:
                lines.insert(0, self._heading)
            self.text = ""
            self.add("\n".join(lines))

    def add(self, text: str) -> None:
        """Append to the summary, and write it to the output, if there is one."""
        self.text = f"{self.text}\n{text}".lstrip("\n")
        if self.out is not None:
            self.out.write(f"\n{printable(text)}\n\n")


def _was_asked_for(content: Mapping[str, Any]) -> bool:
    """Return whether a person stopped the experiment of a `loop.state`."""
    return bool(_ASKED_FOR.intersection(_codes(content)[:1]))


def _may_be_late(run: _Run, content: Mapping[str, Any]) -> bool:
    """Return whether a busy computer can be the cause of a stop; a consequence of another fault does not count."""
    codes = _codes(content)
    if FaultCode.HELD_TOO_LONG.text not in codes[:1]:
        return bool(_BY_BUSY_COMPUTER.intersection(codes[:1]))
    # Several holds together have no cause among them, and those that were before may be gone.
    return bool(_BY_BUSY_COMPUTER.intersection(codes)) or 0.0 < _LATE_FRACTION * content["held_s"] <= run.late_s


def _codes(content: Mapping[str, Any]) -> list[str]:
    """Return the codes of the faults of a `loop.state`, the cause's first."""
    return list(filter(None, content["faults"].split(", ")))


def _on_sample(run: _Run, topic: str, content: Mapping[str, Any]) -> None:
    source, step = content["source"], run.steps[-1] if run.steps else None
    if topic == "robot.state" and step is not None:
        step.wrist_to_rad = content["wrist_rad"]
        step.wrist_from_rad = step.wrist_to_rad if step.wrist_from_rad is None else step.wrist_from_rad
    if topic in TORQUES:
        run.times_ns[source].append(content["t_mono_ns"])
    if topic in TORQUES and content.get("torque_nm") is not None and content.get("valid", True):
        low_nm, high_nm = (content.get(f"torque_{end}_nm") for end in ("low", "high"))
        bounds_nm = (np.nan, np.nan) if low_nm is None or high_nm is None else (low_nm, high_nm)
        run.torques.setdefault(source, []).append((content["t_mono_ns"], content["torque_nm"], *bounds_nm))
    elif topic in TORQUES and not content.get("valid", True):
        run.invalid[source].add(content["reason"])


def _update(run: _Run, content: Mapping[str, Any]) -> None:
    now_ns = content["t_mono_ns"]
    # A late decision was held before it is known.
    holding = run.last if run.last["phase"] == "held" else content
    if _BY_BUSY_COMPUTER.intersection(_codes(holding)):
        run.late_s += content["held_s"] - run.last["held_s"]
    if run.last["phase"] == "paused" and run.steps:
        run.steps[-1].paused_s += _elapsed_s(run.last, content)
    if content["response"] == "hold" and run.last["response"] != "hold":
        run.hold_reasons[FaultCode.of_text(_codes(content)[0]).value.kind] += 1
    run.last = content
    run.torque_note = content.get("torque_note") or run.torque_note
    if run.steps:
        run.steps[-1].to_ns = now_ns
    if content["phase"] in _ENDS:
        if content["phase"] == "done":
            _add_passed(run, content["steps"] + 1, now_ns)
        return
    if not run.steps or run.steps[-1].number != content["step"]:
        _add_passed(run, content["step"], now_ns)
        run.steps.append(_StepSummary(content["step"], content["step_name"], now_ns, now_ns))
    step = run.steps[-1]
    step.holds = max(step.holds, content["hold"])
    if content["set_point_nm"] is not None and content["step_name"] == "hold_torque":
        step.set_point_nm = content["set_point_nm"]
        if content["hold"] and step.held_from_ns is None:
            step.held_from_ns = now_ns
    found = (
        ("stiffness", "stiffness_nm_per_rad", ".3f"),
        ("delay", "delay_s", ".2f"),
        ("noise of one torque", "noise_nm", ".4f"),
    )
    if all(content[key] is not None for _, key, _ in found):
        named = (f"{name} {with_unit('loop.state', key, content[key], form)}" for name, key, form in found)
        run.identified = f"   {', '.join(named)}"


def _add_passed(run: _Run, next_number: int, now_ns: int) -> None:
    """Add the steps that took no time, such as `wait: 0`: no message speaks of them."""
    while run.steps and run.steps[-1].number + 1 < next_number:
        run.steps.append(_StepSummary(run.steps[-1].number + 1, "at once", now_ns, now_ns))


def _lines(run: _Run, truth: TorqueSeries | None, events: _Events) -> Iterator[str]:
    done = run.last["phase"] == "done"
    took_s, asked_for = _elapsed_s(run.first, run.last), _was_asked_for(run.last)
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
        yield f"  step {step.number} of {run.first['steps']}  {step.name:<12} {took_s:6.1f} s{paused}{details}"
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


def _elapsed_s(first: Mapping[str, Any], last: Mapping[str, Any]) -> float:
    return float(last["t_mono_ns"] - first["t_mono_ns"]) / 1e9


def _turned(step: _StepSummary, run: _Run, truth: TorqueSeries | None) -> Iterator[str]:
    driving = run.first["torque_source"]
    if step.wrist_from_rad is not None and step.wrist_to_rad is not None:
        turned = with_unit("robot.state", "wrist_rad", step.wrist_to_rad - step.wrist_from_rad, "+.3f")
        yield f"    turned by {turned}; {_named(driving, truth)}"
    for name, series in _all_torques(run, truth).items():
        turning = series.between(step.from_ns, step.to_ns).torque_nm
        if turning.size and name in (TRUE, driving):
            largest_nm = turning[np.abs(turning).argmax()]
            yield f"    {name:<11} {_torque(turning[-1], '+.4f')} at the end, {largest_nm:+.4f} at most"


def _torque(torque_nm: float, form: str) -> str:
    return with_unit("loop.state", "torque_nm", torque_nm, form)


def _named(driving: str, truth: TorqueSeries | None) -> str:
    return f"torque source: {driving}{f'; {TRUE}: of the emulated tool' if truth is not None else ''}"


def _all_torques(run: _Run, truth: TorqueSeries | None) -> dict[str, TorqueSeries]:
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
    step: _StepSummary,
    set_nm: float,
    from_ns: int,
    run: _Run,
    truth: TorqueSeries | None,
    events: _Events,
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
    if torque_nm.std() >= LEAST_SPREAD * half_nm:
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


def _counted(run: _Run) -> Iterator[str]:
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
