"""The record of one run of an experiment, for its summary."""

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np

from shearloop.bank.arrays import FloatArray
from shearloop.words import CountedReasons

# The time of each disturbance in ns, and its description.
Events: TypeAlias = Sequence[tuple[int, str]]


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
class StepSummary:
    """The record of one step."""

    number: int
    # Empty for a step that took no time: no message names it.
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


@dataclass(slots=True)
class Run:
    """The record of one run of an experiment."""

    # The first and the latest `loop.state` of the experiment.
    first: Mapping[str, Any]
    last: Mapping[str, Any]
    steps: list[StepSummary] = field(default_factory=list)
    identified: str = ""
    # What the driving torque rests on that nothing checks.
    torque_note: str = ""
    # The part of the hold time with a fault that a busy computer can cause.
    late_s: float = 0.0
    # The holds by kinds of faults, and the kinds of the latest hold, each of which counts once.
    hold_reasons: Counter[str] = field(default_factory=Counter)
    kinds_of_hold: set[str] = field(default_factory=set)
    # By source, why a torque was not valid.
    invalid: defaultdict[str, CountedReasons] = field(default_factory=lambda: defaultdict(CountedReasons))
    # By source, time in ns, torque and the ends of its interval, NaN without one, in N·m.
    torques: dict[str, list[tuple[int, float, float, float]]] = field(default_factory=dict)
    # By source, the times in ns of all torques, also of those that are not valid.
    times_ns: defaultdict[str, list[int]] = field(default_factory=lambda: defaultdict(list))


def elapsed_s(first: Mapping[str, Any], last: Mapping[str, Any]) -> float:
    """Return the time from one message to another."""
    return float(last["t_mono_ns"] - first["t_mono_ns"]) / 1e9
