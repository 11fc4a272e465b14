"""How long after an operator's act its request may be carried out, although a program on its way stood still.

Each part on the way has a clock of its own, and no two are compared. A part gives out a reading of its clock before the
act, and the request carries the reading back. The time since that reading is at least the age of the act.
"""

import time
from collections.abc import Callable
from typing import Final, TypeAlias

# The page's clicks, and commands that are typed, whose program takes a while to begin on a busy computer.
CLICK_WITHIN_S: Final = 2.0
TYPED_WITHIN_S: Final = 5.0
# They let nothing move: they are never too late.
NEVER_LATE: Final = ("status", "stop", "pause")
# Says why a request has become too old while something was waited for, or None. It takes what that was, and its cure.
WhyExpired: TypeAlias = Callable[[str, str], str | None]


def never_expired(_delay: str, _cure: str) -> None:
    """Return that a request has not become too old: it names no time."""


def boot_ns() -> int:
    """Return a clock that goes on while the computer is suspended, in ns."""
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME)


def why_too_old(age_s: float, within_s: float) -> str | None:
    """Return why a request is not carried out at this age of the operator's act, or None."""
    if age_s <= within_s:
        return None
    return (
        f"it may have been asked for {age_s:.1f} s ago, and nothing begins later than {within_s:g} s after that; look "
        "at the rig, and send it again"
    )
