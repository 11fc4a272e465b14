"""What happened in an experiment, in the lines that are printed at its end: made of the daemon's own messages.

On an emulated rig the truth is known too, and what was done to it; then the summary says what was really held.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from shearloop.bank.arrays import FloatArray
from shearloop.daemon.sensing.load_cell_task import LOAD_CELL

# The share of the set point within which a torque counts as held.
BAND = 0.10
# Back after a disturbance is who stays in the band for so long.
STAYS_S = 1.0
# Topics whose messages carry a torque.
TORQUES = ("eit.estimate", "load.torque", "skin.shear")
_MOVING, _ENDS = "running", ("done", "stopped")


@dataclass(frozen=True, slots=True)
class Known:
    """A torque over time: stamps in ns (CLOCK_MONOTONIC) and N·m, both (n,)."""

    t_ns: FloatArray
    torque_nm: FloatArray

    def between(self, from_ns: float, to_ns: float) -> "Known":
        """Return the part that belongs to a time."""
        inside = (self.t_ns >= from_ns) & (self.t_ns <= to_ns)
        return Known(self.t_ns[inside], self.torque_nm[inside])


@dataclass(slots=True)
class _Step:
    number: int
    name: str
    from_ns: int
    to_ns: int
    holds: int = 0
    set_point_nm: float | None = None
    # From the first to the last message of a closed loop that holds.
    held_from_ns: int | None = None
    # The wrist's own angle at its beginning and at its end.
    wrist_from_rad: float | None = None
    wrist_to_rad: float | None = None


@dataclass(slots=True)
class _Run:
    name: str
    driving: str
    steps_planned: int
    from_ns: int
    tool_mm: float | None
    steps: list[_Step] = field(default_factory=list)
    identified: tuple[float, float, float] | None = None
    held_s: float = 0.0
    held_why: Counter[str] = field(default_factory=Counter)
    refused: Counter[str] = field(default_factory=Counter)
    invalid: Counter[str] = field(default_factory=Counter)
    torques: dict[str, list[tuple[int, float]]] = field(default_factory=dict)
    diameters: dict[str, list[float]] = field(default_factory=dict)
    last: Mapping[str, Any] | None = None


class RunSummary:
    """Listens to every message of a daemon; `tell` is called with a summary's lines when an experiment has ended."""

    def __init__(
        self,
        tell: Callable[[Sequence[str]], object],
        truth: Callable[[], Known | None] = lambda: None,
        happened: Callable[[], Sequence[tuple[int, str]]] = tuple,
    ) -> None:
        """Take what prints, what is really so, and what was done to an emulated rig (time in ns, words)."""
        self._tell = tell
        self._truth = truth
        self._happened = happened
        self._run: _Run | None = None

    def __call__(self, topic: str, content: Mapping[str, Any]) -> None:
        """Take one message in."""
        if topic == "loop.state":
            self._loop(content)
        elif self._run is not None:
            self._sense(self._run, topic, content)

    def _loop(self, content: Mapping[str, Any]) -> None:
        run, phase = self._run, content["phase"]
        if phase == "idle" or (run is None and phase in _ENDS):
            return
        if run is None:
            named = content["experiment"], content["torque_source"], content["steps"]
            run = self._run = _Run(*named, content["t_mono_ns"], content["tool_mm"])
        _note(run, content)
        if phase in _ENDS:
            self._run = None
            self._tell(tuple(_lines(run, phase, self._truth(), self._happened())))

    def _sense(self, run: _Run, topic: str, content: Mapping[str, Any]) -> None:
        source, gripped = content["source"], run.steps and run.steps[-1].holds
        if topic == "robot.state" and run.steps:
            step = run.steps[-1]
            step.wrist_to_rad = content["wrist_rad"]
            step.wrist_from_rad = step.wrist_to_rad if step.wrist_from_rad is None else step.wrist_from_rad
        if topic in TORQUES and content.get("torque_nm") is not None and content.get("valid", True):
            run.torques.setdefault(source, []).append((content["t_mono_ns"], content["torque_nm"]))
        elif topic in TORQUES and not content.get("valid", True):
            run.invalid[source] += 1
        if topic in ("eit.estimate", "gripper.state") and gripped and content.get("diameter_mm") is not None:
            run.diameters.setdefault(source, []).append(content["diameter_mm"])


def _note(run: _Run, content: Mapping[str, Any]) -> None:
    now_ns = content["t_mono_ns"]
    if run.last is not None and run.last["phase"] == "held":
        run.held_s += (now_ns - run.last["t_mono_ns"]) / 1e9
    if content["response"] == "hold" and (run.last is None or run.last["response"] != "hold"):
        # What it was, without the numbers of the moment.
        run.held_why[content["reasons"].split(":")[0].rstrip(".")] += 1
    if "a command was refused" in content["reasons"]:
        run.refused[content["reasons"]] += 1
    run.last = content
    if content["phase"] in _ENDS:
        if run.steps:
            run.steps[-1].to_ns = now_ns
        return
    if not run.steps or run.steps[-1].number != content["step"]:
        if run.steps:
            run.steps[-1].to_ns = now_ns
        run.steps.append(_Step(content["step"], content["step_name"], now_ns, now_ns))
    step = run.steps[-1]
    step.to_ns, step.holds = now_ns, max(step.holds, content["hold"])
    if content["set_point_nm"] is not None and content["step_name"] == "hold_torque":
        step.set_point_nm = content["set_point_nm"]
        if content["hold"] and step.held_from_ns is None:
            step.held_from_ns = now_ns
    if content["stiffness_nm_per_rad"] is not None:
        run.identified = (content["stiffness_nm_per_rad"], content["delay_s"], content["noise_nm"])


def _lines(run: _Run, phase: str, truth: Known | None, happened: Sequence[tuple[int, str]]) -> Iterator[str]:
    end_ns = run.last["t_mono_ns"] if run.last is not None else run.from_ns
    ended = "done" if phase == "done" else "STOPPED before its end"
    yield f"What happened: {run.name!r} was {ended}, after {(end_ns - run.from_ns) / 1e9:.0f} s."
    if run.last is not None and phase != "done":
        yield f"  {run.last['activity']}"
    for step in run.steps:
        took_s = (step.to_ns - step.from_ns) / 1e9
        yield f"  step {step.number} of {run.steps_planned}  {step.name:<12} {took_s:6.1f} s{_beside(step, run)}"
        if step.set_point_nm is not None and step.held_from_ns is not None:
            here = [event for event in happened if step.from_ns <= event[0] <= step.to_ns]
            yield from _held(step, step.set_point_nm, step.held_from_ns, run, truth, here)
        if step.name == "tighten":
            yield from _turned(step, run, truth)
    yield from _counted(run)


def _beside(step: _Step, run: _Run) -> str:
    if step.name == "identify" and run.identified is not None:
        stiffness, delay_s, noise_nm = run.identified
        return f"   stiffness {stiffness:.3f} N·m/rad, delay {delay_s:.2f} s, noise of one torque {noise_nm:.4f} N·m"
    if step.name == "twist":
        return f"   {step.holds} angles held"
    return ""


def _turned(step: _Step, run: _Run, truth: Known | None) -> Iterator[str]:
    if step.wrist_from_rad is not None and step.wrist_to_rad is not None:
        yield f"    turned by {step.wrist_to_rad - step.wrist_from_rad:+.3f} rad; what drove: {run.driving}"
    for name, known in _known(run, truth).items():
        turning = known.between(step.from_ns, step.to_ns).torque_nm
        if turning.size and name in ("the truth", run.driving):
            largest_nm = turning[np.abs(turning).argmax()]
            yield f"    {name:<10} {turning[-1]:+.4f} N·m at the end, {largest_nm:+.4f} at the most"


def _known(run: _Run, truth: Known | None) -> dict[str, Known]:
    sources = {name: Known(*map(np.array, zip(*values, strict=True))) for name, values in run.torques.items()}
    return sources if truth is None else {"the truth": truth, **sources}


def _held(
    step: _Step, set_nm: float, from_ns: int, run: _Run, truth: Known | None, happened: list[tuple[int, str]]
) -> Iterator[str]:
    held_s = (step.to_ns - from_ns) / 1e9
    yield f"    set point {set_nm:+.3f} N·m, held for {held_s:.0f} s; what drove: {run.driving}"
    sources = _known(run, truth)
    for name, known in sources.items():
        held = known.between(from_ns, step.to_ns).torque_nm
        if held.size:
            share = np.mean(np.abs(held - set_nm) <= BAND * abs(set_nm))
            yield (
                f"    {name:<10} {held.mean():+.4f} N·m on average, ± {held.std():.4f}, "
                f"within ± {BAND:.0%} for {share:.0%} of the time"
            )
    # The truth, or the load cell, or whatever else did not drive: who judges itself is always right.
    names = sorted(set(sources) - {run.driving}, key=lambda name: (name != "the truth", name != LOAD_CELL, name))
    if not names:
        return
    judge = sources[names[0]]
    if (reached_s := _back_s(judge.between(step.from_ns, step.to_ns), step.from_ns, set_nm)) is not None:
        yield f"    within ± {BAND:.0%} {reached_s:.1f} s after the set point was given, by {names[0]}"
    for t_ns, words in happened:
        after = judge.between(t_ns, step.to_ns)
        if after.torque_nm.size:
            back_s, worst_nm = _back_s(after, t_ns, set_nm), float(np.abs(after.torque_nm - set_nm).max())
            back = f"back within ± {BAND:.0%} after {back_s:.1f} s" if back_s is not None else "not back by the end"
            yield f"    disturbed after {(t_ns - from_ns) / 1e9:.1f} s ({words}): {worst_nm:.3f} N·m off, {back}"


def _back_s(known: Known, since_ns: float, set_nm: float) -> float | None:
    """Return how long after a moment the torque came into the band to stay there; None where that was not seen."""
    inside = np.abs(known.torque_nm - set_nm) <= BAND * abs(set_nm)
    seen = known.t_ns <= known.t_ns[-1:] - STAYS_S * 1e9
    for at in np.flatnonzero(inside & seen):
        stays = inside[(known.t_ns >= known.t_ns[at]) & (known.t_ns <= known.t_ns[at] + STAYS_S * 1e9)]
        if stays.all():
            return float(known.t_ns[at] - since_ns) / 1e9
    return None


def _counted(run: _Run) -> Iterator[str]:
    if run.tool_mm is not None:
        yield f"  the tool is of {run.tool_mm:g} mm, as the experiment names it"
    for source, values in run.diameters.items():
        yield f"  diameter by {source}: {np.mean(values):.1f} mm ± {np.std(values):.1f} of one reading"
    total = sum(run.held_why.values())
    if total:
        why = "; ".join(f"{count} times {reason}" for reason, count in run.held_why.most_common())
        yield f"  the wrist was held for {run.held_s:.1f} s in all: {why}"
    else:
        yield "  the wrist was never held"
    for source, count in run.invalid.items():
        # Who never gave a torque is there for something else.
        if source in run.torques:
            of = count + len(run.torques[source])
            yield f"  {count} of {of} torques of {source} were not valid, as while it took its zero, and were not used"
    if run.refused:
        for reason, count in run.refused.most_common():
            yield f"  {count} times {reason}"
    else:
        yield "  no command was refused"
