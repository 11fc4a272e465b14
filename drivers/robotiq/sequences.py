"""What has to be waited for: activation and motion as state machines. They are given readouts and times, no clock."""

from dataclasses import dataclass, field
from enum import Enum, auto

from shearloop.drivers.robotiq.faults import FIRST_MAJOR_CODE, GripperFaultError, fault_of
from shearloop.drivers.robotiq.messages import (
    Activate,
    ActivationStatus,
    GripperMove,
    ObjectStatus,
    Readout,
    Request,
    Reset,
)

# The rest between reset and activation that Robotiq's own clients keep.
PAUSE_NS = 500_000_000
RESET_DEADLINE_NS = 3_000_000_000
# The fingers open and close once; a real one takes two to four seconds.
ACTIVATION_DEADLINE_NS = 15_000_000_000
# The full stroke at the slowest speed takes 4.7 s.
MOTION_DEADLINE_NS = 10_000_000_000
_OVER_TEMPERATURE = 8
# Told while it is normal: an activation that runs has not finished, and a gripper just heard from was not heard before.
_NOT_IN_THE_WAY_OF_ACTIVATION = range(8)
_NO_COMMUNICATION = 9


class _Phase(Enum):
    START = auto()
    RESETTING = auto()
    PAUSE = auto()
    ACTIVATING = auto()
    DONE = auto()


@dataclass(slots=True)
class ActivationSequence:
    """Reset, wait for it, rest, activate, wait for it: a rising edge of ACT, which also ends every fault."""

    _phase: _Phase = field(default=_Phase.START, init=False)
    _since_ns: int = field(default=0, init=False)

    @property
    def done(self) -> bool:
        """Whether the gripper is active."""
        return self._phase is _Phase.DONE

    def step(self, readout: Readout, t_ns: int) -> Request | None:
        """Return the request to send now, if any. Raises GripperFaultError when the activation fails or hangs."""
        match self._phase:
            case _Phase.START:
                self._enter(_Phase.RESETTING, t_ns)
                return Reset()
            case _Phase.RESETTING:
                if not readout.act and readout.sta is ActivationStatus.RESET:
                    self._enter(_Phase.PAUSE, t_ns)
                elif t_ns - self._since_ns > RESET_DEADLINE_NS:
                    raise GripperFaultError("The gripper does not take the reset; check that nothing else commands it.")
            case _Phase.PAUSE:
                if t_ns - self._since_ns >= PAUSE_NS:
                    self._enter(_Phase.ACTIVATING, t_ns)
                    return Activate()
            case _Phase.ACTIVATING:
                self._await_active(readout, t_ns)
            case _Phase.DONE:
                pass
        return None

    def _enter(self, phase: _Phase, t_ns: int) -> None:
        self._phase, self._since_ns = phase, t_ns

    def _await_active(self, readout: Readout, t_ns: int) -> None:
        if readout.act and readout.flt not in _NOT_IN_THE_WAY_OF_ACTIVATION and readout.flt != _NO_COMMUNICATION:
            raise GripperFaultError(fault_of(readout.flt).sentence)
        if readout.act and readout.sta is ActivationStatus.ACTIVE:
            self._enter(_Phase.DONE, t_ns)
        elif t_ns - self._since_ns > ACTIVATION_DEADLINE_NS:
            raise GripperFaultError("The gripper's activation does not end; clear the fingers and activate it again.")


@dataclass(slots=True)
class MotionWatch:
    """Waits for the end of one motion, begun at `since_ns`."""

    request: GripperMove
    since_ns: int

    def finished(self, readout: Readout, t_ns: int) -> bool:
        """Whether the fingers have stopped, at the target or on an object; GripperFaultError when they never will."""
        blocking = blocking_fault(readout)
        if blocking is not None:
            raise GripperFaultError(blocking)
        if object_status(readout, self.request) is not ObjectStatus.MOVING:
            return True
        if t_ns - self.since_ns > MOTION_DEADLINE_NS:
            raise GripperFaultError("The gripper does not finish its motion; check that nothing else commands it.")
        return False


def object_status(readout: Readout, last: GripperMove | None) -> ObjectStatus:
    """Return what the fingers met, in the motion that was asked for last.

    Until the gripper has taken up a target (GTO is 1 and the echo PRE equals it), OBJ speaks of the motion before. One
    that is not active holds nothing, whatever OBJ says.
    """
    if readout.sta is not ActivationStatus.ACTIVE:
        return ObjectStatus.UNKNOWN
    if last is not None and not (readout.gto and readout.pre == last.position):
        return ObjectStatus.MOVING
    return readout.obj if readout.gto else ObjectStatus.UNKNOWN


def blocking_fault(readout: Readout) -> str | None:
    """Return why the gripper would not move now, as a sentence; None when it would."""
    if readout.flt >= FIRST_MAJOR_CODE or readout.flt == _OVER_TEMPERATURE:
        return fault_of(readout.flt).sentence
    if readout.sta is ActivationStatus.ACTIVATING:
        return fault_of(5).sentence
    if not readout.act or readout.sta is not ActivationStatus.ACTIVE:
        return fault_of(7).sentence
    return None
