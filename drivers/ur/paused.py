"""A program of ours that is paused is stopped: resumed by anybody, it would do what it did until its watchdog ends it.

No clock and no ur-rtde: the arm is a port and the time an argument. Where the dashboard hangs or refuses it is asked
again, less and less often and not for ever; what became of it is told.
"""

from shearloop.drivers.errors import DriverError
from shearloop.drivers.ur import error_messages as sentences
from shearloop.drivers.ur.ports import CureArm
from shearloop.drivers.ur.recovery import ENDS_ITSELF_S

# After so long it is asked again, while the program is paused still. A dashboard that hangs takes 2.5 s more each time.
AGAIN_S = (1.0, 2.0, 5.0, 10.0, 10.0)


class PausedProgram:
    """Says when our paused program is to be stopped, and stops it; `why` is what the operator has to know of it."""

    def __init__(self, arm: CureArm) -> None:
        """Know of no program that is paused."""
        self._arm = arm
        self._asked, self._next_ns = 0, 0
        self.why = ""
        # How many times it was asked, and the program was paused still.
        self.in_vain = 0

    def forget(self) -> None:
        """Take note that no program is there."""
        self._asked, self._next_ns, self.why = 0, 0, ""

    def due(self, now_ns: int) -> bool:
        """Return whether a program that is paused is to be stopped now."""
        return now_ns >= self._next_ns and self._asked <= len(AGAIN_S)

    def stop(self, now_ns: int) -> None:
        """Ask for it, which may take seconds."""
        if self._asked and not self.why:
            # It was promised the last time.
            self._failed("the dashboard said that it is stopped, and it is not")
        self._next_ns = now_ns + int(1e9 * AGAIN_S[min(self._asked, len(AGAIN_S) - 1)])
        self._asked += 1
        try:
            self._arm.stop_program()
        except DriverError as error:
            self._failed(str(error))

    def _failed(self, why: str) -> None:
        self.in_vain += 1
        self.why = sentences.still_paused(why)


class ForeignProgramDetector:
    """Tells a program that is somebody else's by its going on without a sign of life from us: ours ends by itself."""

    def __init__(self) -> None:
        """Know of no program that plays."""
        self._since_ns: int | None = None

    def outlives(self, now_ns: int, *, plays: bool) -> bool:
        """Return whether one has played without us for longer than ours can; to be asked in every cycle."""
        if not plays:
            self._since_ns = None
        elif self._since_ns is None:
            self._since_ns = now_ns
        return self._since_ns is not None and now_ns - self._since_ns > ENDS_ITSELF_S * 1e9
