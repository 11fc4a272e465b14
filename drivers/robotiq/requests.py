"""Distinguishes our requests from requests of other programs, by the gripper's echo of the position (PRE)."""

from dataclasses import dataclass

from shearloop.drivers.robotiq.messages import ActivationStatus, GripperMove, ObjectStatus, Readout

# A slow socket asks for the echo once in six readouts.
ECHOED_WITHIN_NS = 2_000_000_000


@dataclass(slots=True)
class RequestWatch:
    """Compares each echo with our latest request.

    The gripper takes up a request some readouts after it was sent. Until then, OBJ belongs to the motion before. Once
    it has echoed the request, another echo is another program's request, and OBJ belongs to that one.
    """

    # Our latest move, unless we have sent something else since.
    sent: GripperMove | None = None
    # Requests of other programs that were seen.
    others: int = 0
    _sent_ns: int = 0
    _others_at_sent: int = 0
    _awaits_echo: bool = False
    # The echo that is accounted for; None where a request of our own, or an activation, may change it.
    _echo: int | None = None

    def on_move(self, sent: GripperMove, t_ns: int) -> None:
        """Take a move that we send."""
        self.sent, self._sent_ns = sent, t_ns
        self._others_at_sent, self._awaits_echo = self.others, True

    def on_action(self, t_ns: int) -> None:
        """Take a request without a target that we send; it may change the echo as well."""
        self.sent, self._sent_ns = None, t_ns
        self._awaits_echo, self._echo = False, None

    def on_connection(self) -> None:
        """Take a new connection: requests over the earlier connection may have been lost."""
        if self._awaits_echo:
            self._echo = None
        self.sent, self._awaits_echo = None, False

    def take(self, readout: Readout, t_ns: int) -> None:
        """Take the next readout."""
        if readout.sta is not ActivationStatus.ACTIVE:
            self._echo = None
            return
        is_recent = t_ns - self._sent_ns <= ECHOED_WITHIN_NS
        if self._awaits_echo:
            if self.carries_out(readout):
                self._awaits_echo, self._echo = False, readout.pre
            elif not is_recent:
                # It was not taken up, or another one came right behind it.
                self._awaits_echo, self._echo = False, readout.pre
            return
        # A late echo of our move is ours.
        ours_may_change_it = (self.sent is None and is_recent) or self.carries_out(readout)
        if self._echo not in (None, readout.pre) and not ours_may_change_it:
            self.others += 1
        self._echo = readout.pre

    def carries_out(self, readout: Readout) -> bool:
        """Return whether a readout belongs to our latest move."""
        return self.sent is not None and readout.gto and readout.pre == self.sent.position

    @property
    def overtaken(self) -> bool:
        """Whether another program has sent a request since our latest move."""
        return self.sent is not None and self.others > self._others_at_sent

    def object_status(self, readout: Readout) -> ObjectStatus:
        """Return what the fingers met in the latest motion, requested by any program."""
        if readout.sta is not ActivationStatus.ACTIVE:
            return ObjectStatus.UNKNOWN
        if self._awaits_echo and not self.carries_out(readout):
            return ObjectStatus.MOVING
        return readout.obj if readout.gto else ObjectStatus.UNKNOWN
