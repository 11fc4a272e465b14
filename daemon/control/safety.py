"""The safety monitor: the response to the present faults, holds that last too long, stops that wait for a person."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

from shearloop.daemon.control.faults import LONGEST_HOLD_S, TABLE, Fault, FaultCode, Response

# A hold's timer runs down at this rate while its fault is absent: a fault that is present for more than a third of the
# time becomes a stop.
DECAY = 0.5
# Robot and gripper show these at rest too, as long as they last, unless another fault of a device hides them.
_STOPS = {FaultCode.PROTECTIVE_STOP, FaultCode.EMERGENCY_STOP, FaultCode.GRIPPER_FAULT}
_SHOWN_AT_REST = _STOPS | {FaultCode.ROBOT_BLOCKED, FaultCode.ROBOT_UNCONTROLLED}
_LOSSES = {FaultCode.ROBOT_LOST, FaultCode.DEVICE_LOST, FaultCode.STATE_STALE, FaultCode.DEVICE_AWAITED}
_OF_DEVICES = _SHOWN_AT_REST | _LOSSES | {FaultCode.ROBOT_STARTING}


@dataclass(frozen=True, slots=True)
class SafetyDecision:
    """The response to all present faults, and the faults."""

    response: Response
    faults: tuple[Fault, ...] = ()

    @property
    def reported(self) -> tuple[Fault, ...]:
        """The faults without consequences, the cause first."""
        return tuple(fault for fault in self.faults if not fault.is_consequence)

    @property
    def codes(self) -> str:
        """The codes of the reported faults, separated by commas, as messages have them."""
        return ", ".join(fault.code.text for fault in self.reported)

    @property
    def reasons(self) -> tuple[str, ...]:
        """One sentence per fault, without consequences."""
        return tuple(fault.sentence for fault in self.reported)


@dataclass(frozen=True, slots=True)
class Stop:
    """A stop, from its first cause until the operator acknowledges it."""

    response: Response
    faults: tuple[Fault, ...]
    # Grows with each cause that begins a stop or joins one.
    number: int
    # Whether it has opened the gripper.
    released: bool = False

    @property
    def causes(self) -> str:
        """The causes, without their cures."""
        return "; ".join(fault.cause for fault in self.faults)

    @property
    def asked_for(self) -> str:
        """The cause of the latest stop on request, such as an operator's; empty for a stop by faults alone."""
        return next((fault.cause for fault in reversed(self.faults) if fault.rule.asked_for), "")


class SafetyMonitor:
    """Judges faults: a hold ends with its cause, a stop stays until the operator acknowledges it."""

    def __init__(self, patience: float = 1.0) -> None:
        """`patience` is the factor on the longest holds; above 1 on an emulated rig alone."""
        self._patience = patience
        # The stop that waits for the operator, and the one that was acknowledged last.
        self.waiting: Stop | None = None
        self.acknowledged: Stop | None = None
        self.acknowledgements = 0
        # How many causes have begun a stop, or joined one that waits for the operator.
        self._causes = 0
        # How long faults have held the wrist since the experiment began.
        self.held_ns = 0
        # Hold timers of faults and of the wrist, and the faults of the last judgement that hold.
        self._hold_ns: dict[str, int] = {}
        self._wrist_ns = 0
        self._holding: frozenset[FaultCode] = frozenset()
        # Each fault's contribution to the wrist's timer, for the report.
        self._share_ns: dict[FaultCode, int] = {}
        self._judged_ns: int | None = None
        # The faults of the latest judgement or report; None before the first one.
        self._active: tuple[Fault, ...] | None = None

    def begin_experiment(self) -> None:
        """Count the hold time from now on."""
        self.held_ns = 0

    def judge(self, faults: Iterable[Fault], t_ns: int) -> SafetyDecision:
        """Return the response to the faults at t_ns (monotonic clock) while an experiment runs."""
        active = self._active = tuple(faults)
        if active or self._wrist_ns or self._holding:
            self._count(active, t_ns)
        self._judged_ns = t_ns
        if not active and self.waiting is None:
            return SafetyDecision(Response.NOTE)
        response = max(map(self._response, active), default=Response.NOTE)
        if response is Response.HOLD and self._wrist_ns > self._patience * LONGEST_HOLD_S * 1e9:
            active = (*active, Fault(FaultCode.HELD_TOO_LONG, self._hold_report()))
            response = TABLE[FaultCode.HELD_TOO_LONG].response
        # Faults that stop come before faults that hold: the message begins with the cause of the stop.
        active = tuple(sorted(active, key=self._response, reverse=True))
        decision = SafetyDecision(response, self._explained(active, _explaining(active)))
        if response >= Response.STOP_AND_KEEP_GRIP and (self.waiting is None or response > self.waiting.response):
            self._causes += 1
            self.waiting = Stop(response, decision.faults, self._causes)
        return decision if self.waiting is None else self._with_stop(self.waiting, active)

    def report(self, faults: Iterable[Fault]) -> SafetyDecision:
        """Return the faults while nothing moves: a pending stop is kept, and only the robot's own stops begin one."""
        before = {fault.code for fault in self._active or ()}
        active = self._active = tuple(faults)
        self._reset_timers()
        for fault in active:
            # A fault that lasts is one cause and keeps its first words. During an unlock the robot reports progress.
            lasts = fault.code in before and self._waiting_fault(fault.code) is not None
            if fault.rule.stops_at_rest and not lasts:
                self._causes += 1
                self._join(fault)
        return SafetyDecision(Response.NOTE, active) if self.waiting is None else self._with_stop(self.waiting, active)

    def stop(self, fault: Fault) -> None:
        """Begin a stop that no input shows, such as an operator's; it keeps the grip, and a stronger one stays."""
        self._causes += 1
        # A further stop of an arm that stands does not hide the cause of the first one.
        self._join(self._waiting_fault(fault.code) or fault)

    def _waiting_fault(self, code: FaultCode) -> Fault | None:
        """Return the fault of this code in the stop that waits."""
        waiting = self.waiting.faults if self.waiting is not None else ()
        return next((one for one in waiting if one.code is code), None)

    def _join(self, fault: Fault) -> None:
        """Let a fault join the stop that waits, or begin one; of each code, the first and the latest one are kept."""
        stop = self.waiting or Stop(Response.STOP_AND_KEEP_GRIP, (), self._causes)
        first = self._waiting_fault(fault.code)
        kept = tuple(one for one in stop.faults if one.code is not fault.code or one is first)
        faults = kept if fault in kept else (*kept, fault)
        self.waiting = replace(stop, faults=faults, number=self._causes)

    def release_once(self) -> bool:
        """Return whether the stop that waits has to open the gripper now; it counts as done."""
        stop = self.waiting
        if stop is None or stop.released or stop.response is not Response.STOP_AND_RELEASE:
            return False
        self.waiting = replace(stop, released=True)
        return True

    def acknowledge(self) -> None:
        """Clear a stop on the operator's command; a fault that persists stops again at the next judgement."""
        if self.waiting is not None:
            self.acknowledged, self.waiting = self.waiting, None
            self.acknowledgements += 1
        self._reset_timers()

    @property
    def refusing(self) -> tuple[Fault, ...]:
        """The faults of the stop that waits, its cause first, and the present ones that refuse a start."""
        if self.waiting is None or self._active is None:
            return self.waiting.faults if self.waiting is not None else ()
        reported = self._with_stop(self.waiting, self._active).reported
        return (*reported[:1], *(fault for fault in reported[1:] if fault.rule.response >= Response.REFUSE_START))

    @property
    def stop_number(self) -> int:
        """The number of the stop that waits for the operator; 0 without one."""
        return self.waiting.number if self.waiting is not None else 0

    @classmethod
    def _explained(cls, active: tuple[Fault, ...], cause: Fault | None) -> tuple[Fault, ...]:
        """Return the faults with their cause first and its consequences marked; without a cause, as they are."""
        if cause is None:
            return active
        others = (fault for fault in active if fault.code is not cause.code)
        return (cause, *(replace(one, is_consequence=True) if one.rule.may_be_consequence else one for one in others))

    @classmethod
    def _with_stop(cls, stop: Stop, active: tuple[Fault, ...]) -> SafetyDecision:
        """Return the stop's faults, updated with the present ones."""
        active_codes = {fault.code for fault in active}
        # In the order of the stop, so that its cause stays first.
        stop_codes = list(dict.fromkeys(fault.code for fault in stop.faults))
        over_codes: set[FaultCode] = set()
        later_codes: set[FaultCode] = set()
        if active_codes & _OF_DEVICES:
            # It may hide the robot's other faults, and makes the robot refuse commands. Both are reported after it.
            later_codes = (_SHOWN_AT_REST - active_codes) | {FaultCode.COMMAND_REFUSED}
        else:
            over_codes = _SHOWN_AT_REST | _LOSSES
        kept = [replace(one, is_over=one.code in over_codes) for one in stop.faults if one.code not in active_codes]
        kept += [fault for fault in active if fault.code in stop_codes]
        kept.sort(key=lambda fault: stop_codes.index(fault.code))
        new = (fault for fault in active if fault.code not in stop_codes)
        reported = sorted((*kept, *new), key=lambda fault: fault.code in later_codes)
        return SafetyDecision(stop.response, cls._explained(tuple(reported), _explaining(stop.faults)))

    def _count(self, active: tuple[Fault, ...], t_ns: int) -> None:
        """Advance the hold timers to t_ns: up for faults that lasted until now, down for the others."""
        passed_ns = 0 if self._judged_ns is None else t_ns - self._judged_ns
        holding = frozenset(fault.code for fault in active if fault.rule.hold_at_most_s is not None)
        lasted = self._holding.union(code for code in holding if TABLE[code].is_past)
        lasted_timers = {code.timer for code in lasted}
        holding_timers = {code.timer for code in holding}
        counted = {
            timer: _counted(self._hold_ns.get(timer, 0), passed_ns, up=timer in lasted_timers)
            for timer in (*self._hold_ns, *holding_timers)
        }
        self._hold_ns = {timer: hold_ns for timer, hold_ns in counted.items() if hold_ns or timer in holding_timers}
        self._wrist_ns = _counted(self._wrist_ns, passed_ns, up=bool(lasted))
        self.held_ns += passed_ns if lasted else 0
        if not self._wrist_ns:
            self._share_ns.clear()
        for code in lasted:
            self._share_ns[code] = self._share_ns.get(code, 0) + passed_ns
        self._holding = holding

    def _reset_timers(self) -> None:
        self._hold_ns.clear()
        self._share_ns.clear()
        self._wrist_ns, self._holding, self._judged_ns = 0, frozenset(), None

    def _response(self, fault: Fault) -> Response:
        rule = fault.rule
        longest_s = rule.hold_at_most_s
        if longest_s is not None and self._hold_ns[fault.code.timer] > self._patience * longest_s * 1e9:
            return Response.STOP_AND_KEEP_GRIP
        return rule.response

    def _hold_report(self) -> str:
        """Return the hold time of each fault, the longest first."""
        longest_first = sorted(self._share_ns.items(), key=lambda entry: -entry[1])
        return ", ".join(f"{code.text} for {hold_ns / 1e9:.1f} s" for code, hold_ns in longest_first)


def _explaining(faults: tuple[Fault, ...]) -> Fault | None:
    return next((fault for fault in faults if fault.rule.explains), None)


def _counted(hold_ns: int, passed_ns: int, *, up: bool) -> int:
    """Return a hold timer after `passed_ns`, which it counts up or down."""
    return hold_ns + passed_ns if up else max(0, hold_ns - round(DECAY * passed_ns))
