"""When the robot's process goes through its next cycle, and of which it tells. No clock: the time is an argument.

Each waking costs, here and in the daemon, whatever is done then. While the daemon needs few states and nothing moves,
all that can come between two of them is a message, and that is answered when it comes. The robot needs its signs of
life more often than the daemon needs a state: not every cycle at ease tells one. Nor does every cycle of a wrist that
turns: of those that say nothing new two in five are told (`shearloop.drivers.ur.news`).
"""

import math

from shearloop.drivers.ur.messages import Ease, Message
from shearloop.drivers.ur.settings import UrSettings

# Of the robot's patience with a silent client (1/watchdog_hz), at rest and while it turns on as before: the three
# quarters left are for a busy computer. Once they are over the robot's program ends, and waits for the operator.
OF_THE_WATCHDOG = 0.25
# Where the daemon is not at ease one state of so many cycles is told though it says nothing new, and no later than so
# long after the last one: with the even ones below two of five, 50 a second of a wrist that stands or turns slowly, and
# each of one that turns fast. The loop decides upon what is told.
QUIET_CYCLES, LONGEST_QUIET_S = 3, 0.025
# Then every fifth cycle is told, whatever was told before: of these the daemon publishes the state and hears the
# wrench, evenly, so that nothing else that measures torque goes for long without one to be compared with.
EVEN_CYCLES = 5
# Of the time for which a wrist speed holds: at a state that is told it is renewed, and one that is missed is borne.
OF_THE_COMMANDS_TIMEOUT = 0.2


class Pace:
    """Numbers the cycles, and says when each is due. Those at ease have multiples for numbers."""

    def __init__(self, settings: UrSettings, now_s: float) -> None:
        """Begin with a cycle that is due now, and with a daemon that needs every one."""
        self._period_s = 1.0 / settings.rate_hz
        self._most = max(1, int(OF_THE_WATCHDOG * settings.rate_hz / settings.watchdog_hz))
        quiet_s = min(LONGEST_QUIET_S, OF_THE_COMMANDS_TIMEOUT * settings.command_timeout_s)
        self._quiet = max(1, min(QUIET_CYCLES, int(quiet_s * settings.rate_hz)))
        # How many cycles at rest the daemon needs one state of, and of which cycle it was told last.
        self._wanted, self._told = 1, -QUIET_CYCLES
        self.cycle, self._due_s = 0, now_s
        self._next, self._next_s = 0, now_s

    @property
    def at_ease(self) -> bool:
        """Whether the daemon does not need every cycle to be gone through."""
        return self._wanted > 1

    def hear(self, message: Message) -> None:
        """Note what the daemon needs: every cycle, once it has said anything but `Ease`."""
        self._wanted = max(1, message.cycles) if isinstance(message, Ease) else 1

    def tells(self, *, rests: bool, news: bool) -> bool:
        """Return whether this cycle's state is told: always with `news`, else when the last one was long enough ago."""
        if rests and self.at_ease:
            # Those that are gone through are not those that are wanted: the first one in each stretch of these.
            due = self.cycle // self._wanted != self._told // self._wanted
        else:
            due = quiet_is_due(self.cycle, self._told, self._quiet)
        if not (news or due):
            return False
        self._told = self.cycle
        return True

    def plan(self, now_s: float, *, rests: bool) -> None:
        """Choose the next cycle once the work of this one is done; `rests`: nothing moves, and nothing is under way."""
        step = min(self._wanted, self._most) if rests else 1
        self._next = self.cycle + step - self.cycle % step
        # A late cycle is not caught up with: two commands at once are no use to anyone.
        self._next_s = max(self._due_s + (self._next - self.cycle) * self._period_s, now_s)

    def hurry(self, now_s: float) -> None:
        """Take the next cycle of the rate instead, where more of them were to pass."""
        soon = self.cycle + max(1, math.ceil((now_s - self._due_s) / self._period_s))
        if soon < self._next:
            self._next, self._next_s = soon, self._due_s + (soon - self.cycle) * self._period_s

    def left_s(self, now_s: float) -> float:
        """Return the time until the next cycle is due; 0 or less where it is."""
        return self._next_s - now_s

    def begin(self) -> None:
        """Begin the cycle that was chosen."""
        self.cycle, self._due_s = self._next, self._next_s


def quiet_is_due(cycle: int, told: int, most_apart: int = QUIET_CYCLES) -> bool:
    """Whether a cycle that says nothing new is told to a daemon that is not at ease; `told` is the last that was."""
    return cycle % EVEN_CYCLES == 0 or cycle - told >= most_apart
