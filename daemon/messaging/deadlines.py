"""How long after an operator's act its request may be carried out, although a program on its way stood still.

Each part on the way has a clock of its own, and no two are compared. A part gives out a reading of its clock before the
act, and the request carries the reading back. The time since that reading is at least the age of the act.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

# They let nothing move: they are never too late.
NEVER_LATE: Final = ("status", "stop", "pause")
# Any other command that acts is refused without its time and its daemon: an old request could move something.
MAY_BE_UNBOUND: Final = (*NEVER_LATE, "tare")


def boot_ns() -> int:
    """Return a clock that goes on while the computer is suspended, in ns."""
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME)


def stood_still(stood_s: float) -> str:
    """Return the refusal of a command because of the daemon's own standstill."""
    return f"the daemon stood still for {stood_s:.1f} s: look at the rig, and send the command again"


@dataclass(frozen=True, slots=True)
class Deadline:
    """The time until which a request may begin something, and when it came, both by `now_ns`.

    Without `until_ns` it may begin at any time.
    """

    until_ns: int | None = None
    came_ns: int = 0
    now_ns: Callable[[], int] = boot_ns

    def why_passed(self, delay: str = "", cure: str = "", stood_s: float = 0.0) -> str | None:
        """Return why it is too late to begin, or None.

        `delay` names the wait since the request came in time, and `cure` says how to avoid it. `stood_s`: the daemon
        stood still for this time meanwhile.
        """
        now_ns = self.now_ns()
        late_s = (now_ns - self.until_ns) / 1e9 if self.until_ns is not None else 0.0
        if late_s <= 0.0:
            return None
        if late_s <= stood_s:
            return stood_still(stood_s)
        reason = f"it came {late_s:.1f} s too late to be what the operator wants now"
        if delay:
            took_s = (now_ns - self.came_ns) / 1e9
            reason = f"{delay} took {took_s:.1f} s, and the request had expired {late_s:.1f} s before"
        return f"{reason}; {cure}look at the rig, and send it again"


NO_DEADLINE: Final = Deadline()
