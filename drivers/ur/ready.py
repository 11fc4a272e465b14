"""Waits, on our own connection, until the control script on the robot is ready for what is sent next.

After a command that is carried out once, ur-rtde's script says that it is done, and once that was acknowledged that it
is ready for the next (output register 0; its text is in `librtde.so`). ur-rtde waits for that in its next call: without
sleeping, for up to 4 s, and without looking whether the program still runs. Where a computer was away for longer than
the robot's watchdog bears, that ended the program between the two, and ready it never was again: such a call lasted
until the process was ended for it.
"""

import math
import time
from typing import Final, Protocol

from shearloop.drivers.ur.messages import RUNTIME_PLAYING
from shearloop.drivers.ur.receiver import Received

READY: Final = 1


class Samples(Protocol):
    """What is needed of a connection to the controller; `shearloop.drivers.ur.receiver.Receiver` has it."""

    connected: bool

    def latest(self) -> Received:
        """Return the newest sample that has arrived."""

    def wait(self, seconds: float) -> bool:
        """Return whether something has come, waiting for it for so long at most."""


class Ready:
    """Knows whether the script has yet to say that it is ready."""

    def __init__(self, samples: Samples, patience_s: float) -> None:
        """Wait for `patience_s` at most: for as long as the robot's watchdog bears to hear nothing."""
        self._samples, self._patience_s = samples, patience_s
        # By the controller's clock; a later sample says how the script is now.
        self._called_s = -math.inf
        self._awaited = False

    def called(self) -> None:
        """Note that a command was done, or a program begun: what has arrived by now may be of before."""
        self._called_s, self._awaited = self._samples.latest().timestamp_s, True

    def wait(self) -> bool:
        """Return whether the script is ready; False where it is not in time, or does not play any more."""
        if not self._awaited:
            return True
        until_s = time.monotonic() + self._patience_s
        while True:
            sample = self._samples.latest()
            if not self._samples.connected or sample.runtime_state != RUNTIME_PLAYING:
                return False
            if sample.timestamp_s > self._called_s and sample.script_state == READY:
                self._awaited = False
                return True
            if not self._samples.wait(until_s - time.monotonic()):
                return False
