"""The moments that the viewer gives out to its pages: a click names the latest one, which shows the age of the click.

The page's clock is not compared with the viewer's. A tab, the connection or the viewer may have stood still since.
"""

import secrets
from collections.abc import Callable

from shearloop.daemon.messaging.deadlines import boot_ns
from shearloop.words import is_whole_number

# Of a clock's nanoseconds in 64 bits.
_MAX_DIGITS = len(str(1 << 63))


class UnknownMomentError(ValueError):
    """A text is no moment of this viewer."""


class Moments:
    """Gives out moments, and says when it gave one out."""

    def __init__(self, now_ns: Callable[[], int] = boot_ns) -> None:
        self._now_ns = now_ns
        # A moment of another viewer says nothing here.
        self._own = secrets.token_hex(8)

    def present(self) -> str:
        """Return the present moment."""
        return f"{self._own}-{self._now_ns()}"

    def given_ns(self, moment: str) -> int:
        """Return when a moment was given out, by the viewer's clock; raises UnknownMomentError."""
        own, _, digits = moment.partition("-")
        if own != self._own or not is_whole_number(digits, _MAX_DIGITS):
            raise UnknownMomentError(moment)
        given_ns = int(digits)
        if given_ns > self._now_ns():
            raise UnknownMomentError(moment)
        return given_ns

    def since_s(self, given_ns: int) -> float:
        """Return how long ago the moment of this time was given out."""
        return (self._now_ns() - given_ns) / 1e9
