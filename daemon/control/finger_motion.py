"""Records when the gripper's fingers moved, from the commands to the gripper and from its states."""

from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

from shearloop.drivers.robotiq.gripper import ACTIVATION_DEADLINE_NS
from shearloop.drivers.robotiq.messages import GripperState

# More motions than a frame and its delay can see.
_KEPT = 64


class _UnderWay(NamedTuple):
    """A motion that no state at rest has ended: its beginning, and its latest sign."""

    began_ns: int
    sign_ns: int

    @property
    def latest_end_ns(self) -> int:
        """When it is over at the latest."""
        return self.sign_ns + ACTIVATION_DEADLINE_NS


class FingerMotion:
    """Remembers the latest motions of the fingers. A motion lasts until a state shows the fingers at rest.

    Without any state, as after a lost connection, it lasts as long as the longest motion at most.
    """

    def __init__(self) -> None:
        """Begin without a motion."""
        # The beginning and the end of each motion that is over, in ns of CLOCK_MONOTONIC.
        self._over: deque[tuple[int, int]] = deque(maxlen=_KEPT)
        self._under_way: _UnderWay | None = None
        self._commands = 0
        self._latest: GripperState | None = None

    @contextmanager
    def commanded(self, t_ns: int) -> Iterator[None]:
        """Count the fingers as moving from t_ns on; a state at rest ends the motion after this context only."""
        # The gripper reports the rest before a motion until it has taken up the command.
        self._commands += 1
        self._add(t_ns, t_ns)
        try:
            yield
        finally:
            self._commands -= 1

    def take(self, state: GripperState) -> None:
        """Take the gripper's next state; one that is older than the latest is left out."""
        before, under_way = self._latest, self._under_way
        if before is not None and state.t_ns < before.t_ns:
            return
        self._latest = state
        if state.moves:
            # The motion began after the state before.
            self._add(state.t_ns if before is None else before.t_ns, state.t_ns)
        elif under_way is not None:
            if not self._commands:
                self._over.append((under_way.began_ns, min(state.t_ns, under_way.latest_end_ns)))
                self._under_way = None
        elif before is not None and _differ(before, state):
            # The whole motion lies between two states: the fingers lost the tool, met one, or gripped it again.
            self._over.append((before.t_ns, state.t_ns))

    def moved_between(self, from_ns: int, to_ns: int) -> bool:
        """Return whether the fingers moved at any time of an interval, as far as is known."""
        motions = [*self._over]
        if self._under_way is not None:
            motions.append((self._under_way.began_ns, self._under_way.latest_end_ns))
        return any(began_ns <= to_ns and ended_ns >= from_ns for began_ns, ended_ns in motions)

    def _add(self, from_ns: int, sign_ns: int) -> None:
        """Take a sign of motion at sign_ns; the motion began at from_ns, unless it is the one under way."""
        under_way = self._under_way
        if under_way is not None and under_way.latest_end_ns < sign_ns:
            self._over.append((under_way.began_ns, under_way.latest_end_ns))
            under_way = None
        began_ns = from_ns if under_way is None else under_way.began_ns
        self._under_way = _UnderWay(began_ns, sign_ns)


def _differ(one: GripperState, other: GripperState) -> bool:
    return one.object is not other.object or one.others_requests != other.others_requests
