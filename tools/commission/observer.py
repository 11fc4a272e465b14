"""An observer of the robot, outside the processes that drive it: it measures the stops when these processes die."""

from collections.abc import Sequence
from dataclasses import dataclass
from operator import attrgetter

from shearloop.drivers.ur.messages import RUNTIME_PLAYING, RtdeOutputs
from shearloop.drivers.ur.motion import REST_SAMPLES
from shearloop.tools.commission.arrivals import REAL_CLOCK, Arrivals, Clock

WRIST = 5


@dataclass(frozen=True, slots=True)
class Seen:
    """One sample, when the controller made it and when it arrived (monotonic, ns)."""

    made_ns: int
    arrived_ns: int
    outputs: RtdeOutputs

    @property
    def plays(self) -> bool:
        """Whether a program plays."""
        return self.outputs.runtime_state == RUNTIME_PLAYING

    @property
    def fastest_rad_per_s(self) -> float:
        """The speed of the fastest joint."""
        return max(map(abs, self.outputs.qd_rad_per_s))

    @property
    def wrist_rad(self) -> float:
        """The angle of wrist 3."""
        return self.outputs.q_rad[WRIST]

    @property
    def wrist_rad_per_s(self) -> float:
        """The speed of wrist 3."""
        return self.outputs.qd_rad_per_s[WRIST]


class Observer(Arrivals[Seen]):
    """The samples of a controller."""

    def __init__(self, clock: Clock = REAL_CLOCK) -> None:
        """Begin without a sample."""
        super().__init__(attrgetter("made_ns"), clock)

    def interruption(self, since_ns: int, least_ns: int, within_s: float) -> tuple[Seen, Seen] | None:
        """Return the samples before and after the first pause of arrivals since a moment; None without a pause.

        After a short pause the controller may send the samples of the pause, so that none is missing.
        """
        before: list[Seen] = []

        def follows(seen: Seen) -> bool:
            before.append(seen)
            return len(before) > 1 and seen.arrived_ns - before[-2].arrived_ns >= least_ns

        after = self.wait_for(follows, since_ns, within_s)
        return (before[-2], after) if after is not None else None

    def rest_since(self, since_ns: int, rest_rad_per_s: float, within_s: float = 5.0) -> Seen | None:
        """Return the first of some successive samples at rest since a moment, or None if they do not come in time."""
        run: list[Seen] = []

        def rests(seen: Seen) -> bool:
            if seen.fastest_rad_per_s >= rest_rad_per_s:
                run.clear()
            else:
                run.append(seen)
            return len(run) >= REST_SAMPLES

        return run[0] if self.wait_for(rests, since_ns, within_s) is not None else None

    def comes_to_rest(self, rest_rad_per_s: float, within_s: float) -> Seen | None:
        """Return the first sample at rest from the newest one on, or None if it does not come in time."""
        return self.rest_since(self.latest().made_ns, rest_rad_per_s, within_s)


def span_s(samples: Sequence[Seen]) -> float:
    """Return the time between the first and the last sample by the controller's clock."""
    return samples[-1].outputs.timestamp_s - samples[0].outputs.timestamp_s if samples else 0.0
