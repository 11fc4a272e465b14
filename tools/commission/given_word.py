"""The operator's word for a motion, and whether this program stood still since it was typed."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Final

from shearloop.daemon.messaging.bound_requests import TYPED_WITHIN_S
from shearloop.daemon.messaging.deadlines import boot_ns

# A word that is older than a typed command may be is no longer meant for what moves now.
LONGEST_STANDSTILL_S: Final = TYPED_WITHIN_S
_BEAT_S: Final = 0.2


class GivenWord:
    """The motion that was allowed last, and the longest standstill of this program since then.

    A commissioning takes minutes between a word and the last of its motions, so their distance says nothing. A thread
    that runs all the time says it: Ctrl-Z stops it, and so does a suspended computer.
    """

    def __init__(self, now_ns: Callable[[], int] = boot_ns) -> None:
        """`now_ns` is a clock that goes on while the computer is suspended."""
        self.motion = ""
        self._now_ns = now_ns
        self._lock = threading.Lock()
        self._watched = False
        self._beat_ns = now_ns()
        self._stood_s = 0.0

    def give(self, motion: str) -> None:
        """Take that a motion is allowed from now on."""
        self.beat()
        with self._lock:
            self.motion, self._stood_s = motion, 0.0

    def beat(self) -> None:
        """Note that this program runs."""
        with self._lock:
            now_ns = self._now_ns()
            self._stood_s = max(self._stood_s, (now_ns - self._beat_ns) / 1e9)
            self._beat_ns = now_ns

    def standstill_s(self) -> float:
        """Return how long this program stood still since the word; 0 where that was short, or outside `watched`."""
        if not self._watched:
            return 0.0
        self.beat()
        return self._stood_s if self._stood_s > LONGEST_STANDSTILL_S else 0.0

    @contextmanager
    def watched(self) -> Iterator[None]:
        """Watch this program in a thread of its own."""
        ended = threading.Event()

        def watch() -> None:
            while not ended.wait(_BEAT_S):
                self.beat()

        self.beat()
        watching = threading.Thread(target=watch, name="standstill", daemon=True)
        watching.start()
        self._watched = True
        try:
            yield
        finally:
            self._watched = False
            ended.set()
            watching.join()
