"""The times of a stop: its cause, the decision, the command, and the standstill. No clock and no I/O."""

from dataclasses import replace

from shearloop.daemon.control.safety import SafetyDecision
from shearloop.daemon.messaging.messages import LoopStop
from shearloop.drivers.ur.messages import RobotState

# A standstill that has not been measured by then stays unknown.
LONGEST_NS = 5_000_000_000
# The loop waits this long after the decision for the reply to the command, if the arm stands earlier.
REPLY_NS = 500_000_000


class StopTimeline:
    """Collects the times of one stop at a time."""

    def __init__(self) -> None:
        self._requested_ns: int | None = None
        # A stop on its way, and when it was decided (CLOCK_MONOTONIC).
        self._stop: LoopStop | None = None
        self._decided_ns = 0
        # When the reply came, and the first measurement of the present standstill.
        self._sent_ns: int | None = None
        self._stands_ns: int | None = None
        # Since when the robot takes no command, by its states.
        self._blocked_ns: int | None = None

    @property
    def pending(self) -> bool:
        """Whether the standstill of a stop is still to be measured."""
        return self._stop is not None

    def request(self, now_ns: int) -> None:
        """Note that a person, or the daemon's end, asks for a stop; it counts until the next `update`."""
        self._requested_ns = now_ns

    def begin(
        self,
        run: int,
        experiment: str,
        reason: str,
        decision: SafetyDecision,
        now_ns: int,
        rests_since_ns: int | None = None,
    ) -> None:
        """Take the decision; its cause is the request, or the oldest measurement that shows a fault.

        A request may have waited while the daemon stood still. `rests_since_ns`: since when the arm stands still, if it
        does.
        """
        faults = [one for one in decision.faults if self._requested_ns is None or one.rule.is_past]
        times_ns = [one.t_ns for one in faults if not one.is_consequence]
        measured = [t_ns for t_ns in (self._requested_ns, *times_ns) if t_ns is not None]
        cause_ns = min(measured, default=now_ns)
        self._requested_ns, self._decided_ns, self._sent_ns = None, now_ns, None
        # A standstill that began after the cause is the stop's, also before the decision.
        is_stops = rests_since_ns is not None and rests_since_ns > cause_ns
        self._stands_ns = rests_since_ns if is_stops else None
        self._stop = LoopStop(
            source="loop",
            t_mono_ns=cause_ns,
            run=run,
            experiment=experiment,
            cause=reason,
            faults=decision.codes,
            response=decision.response.name.lower().replace("_", " "),
            decided_after_s=(now_ns - cause_ns) / 1e9 if measured else None,
            sent_after_s=None,
            stands_after_s=None,
            refusal="",
            blocked_after_s=None,
        )

    def on_sent(self, now_ns: int) -> None:
        """Take the reply of the worker to the stop."""
        stop = self._stop
        if stop is not None and self._sent_ns is None:
            self._sent_ns = now_ns
            if self._stands_ns is not None and self._stands_ns > self._decided_ns:
                self._stands_ns = None
            self._stop = replace(stop, sent_after_s=(now_ns - stop.t_mono_ns) / 1e9)

    def on_refused(self, refusal: str) -> None:
        """Take the refusal of the stop: nothing can be sent to the robot, and it stops by itself."""
        if self._stop is not None and self._sent_ns is None:
            self._stop = replace(self._stop, refusal=refusal)

    def update(self, robot: RobotState | None, now_ns: int) -> LoopStop | None:
        """Return the whole stop once, when a state after the command shows the arm at rest, or after `LONGEST_NS`.

        Without a command that was sent, a state after the decision counts.
        """
        measured_ns = now_ns if robot is None else robot.measured_ns
        if robot is not None:
            self._blocked_ns = (self._blocked_ns or measured_ns) if robot.blocked else None
        stop, self._requested_ns = self._stop, None
        if stop is None:
            return None
        since_ns = self._decided_ns if self._sent_ns is None else self._sent_ns
        if robot is not None and measured_ns >= since_ns:
            self._stands_ns = (self._stands_ns or measured_ns) if robot.rests else None
        answered = self._sent_ns is not None or stop.refusal != ""
        awaits_reply = not answered and now_ns - self._decided_ns <= REPLY_NS
        is_known = self._stands_ns is not None and not awaits_reply
        is_given_up = now_ns - self._decided_ns > LONGEST_NS
        return self.end() if is_known or is_given_up else None

    def end(self) -> LoopStop | None:
        """Return the known times of a stop after the wait for its standstill."""
        stop, self._stop = self._stop, None
        if stop is None:
            return None
        blocked_after_s = self._after_cause_s(stop, self._blocked_ns) if stop.refusal else None
        return replace(stop, stands_after_s=self._after_cause_s(stop, self._stands_ns), blocked_after_s=blocked_after_s)

    @staticmethod
    def _after_cause_s(stop: LoopStop, t_ns: int | None) -> float | None:
        return None if t_ns is None else max(0, t_ns - stop.t_mono_ns) / 1e9
