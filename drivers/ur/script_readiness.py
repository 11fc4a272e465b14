"""Waits for the control script between two commands."""

import math
import time
from typing import Final

from shearloop.drivers.ur.messages import RUNTIME_PLAYING
from shearloop.drivers.ur.receiver import RtdeReceiver

SCRIPT_READY: Final = 1


class ScriptReadiness:
    """Waits until the control script is ready for the next command (the first output register).

    ur-rtde waits for that itself at the start of each call: without sleeping, for up to 4 s, also after the program has
    ended. Waiting here first keeps its calls short.
    """

    def __init__(self, samples: RtdeReceiver, timeout_s: float) -> None:
        """Wait for `timeout_s` at most: meanwhile nothing else is sent, and nothing extends a motion."""
        self._samples, self._timeout_s = samples, timeout_s
        # By the controller's clock; only a later sample shows the script after the command.
        self._command_s = -math.inf
        self.waiting = False

    def command_sent(self) -> None:
        """Note that a one-time command was sent, or a program started."""
        self._command_s, self.waiting = self._samples.latest().timestamp_s, True

    def wait(self) -> bool:
        """Return whether the script is ready; False after the timeout or when the program does not play."""
        if not self.waiting:
            return True
        until_s = time.monotonic() + self._timeout_s
        while True:
            sample = self._samples.latest()
            if not self._samples.connected or sample.runtime_state != RUNTIME_PLAYING:
                return False
            if sample.timestamp_s > self._command_s and sample.script_state == SCRIPT_READY:
                self.waiting = False
                return True
            if not self._samples.wait(until_s - time.monotonic()):
                return False
