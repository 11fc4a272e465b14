"""The emulated 2F-140: spindle, fingers, registers, activation, faults. No I/O; `step` passes the time."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum, auto

COUNTS_MAX = 255
FIRST_MAJOR_FAULT = 10
ACTIVATION_NOT_FINISHED, NOT_ACTIVATED, NO_COMMUNICATION = 5, 7, 9
RELEASE_RUNNING, RELEASE_DONE = 11, 15
SPEED_MM_S = (30.0, 250.0)
FORCE_N = (10.0, 125.0)


@dataclass(frozen=True, slots=True)
class GripperMechanics:
    """The ends of the fingers' range, and the speeds of activation and release."""

    open_counts: float = 3.0
    open_mm: float = 140.0
    closed_counts: float = 230.0
    activation_speed_mm_s: float = 150.0
    release_speed_mm_s: float = 30.0

    @property
    def mm_per_count(self) -> float:
        """The width per count, mm."""
        return self.open_mm / (self.closed_counts - self.open_counts)

    def counts(self, width_mm: float) -> float:
        """Return the position at a width."""
        return self.closed_counts - width_mm / self.mm_per_count

    def width_mm(self, counts: float) -> float:
        """Return the width at a position, mm."""
        return (self.closed_counts - counts) * self.mm_per_count


class _Activation(Enum):
    RESET = auto()
    OPENING = auto()
    CLOSING = auto()
    OPENING_AGAIN = auto()
    ACTIVE = auto()


def no_object(force_n: float) -> float | None:  # noqa: ARG001 - a callback's signature
    """Return None: there is no object between the fingers."""
    return None


@dataclass(slots=True)
class Command:
    """The command registers."""

    act: bool = False
    gto: bool = False
    atr: bool = False
    ard: bool = False
    pos: int = 0
    spe: int = 0
    force: int = 0


class Gripper:
    """One gripper. Servers write `command` and read the status; `step` moves the fingers.

    `between` returns the width in mm of an object that stops closing fingers with a given force in N, or None; `around`
    does so for opening fingers. The next step takes up commands: until then the status belongs to the motion before, as
    on the real gripper.
    """

    def __init__(
        self,
        mechanics: GripperMechanics | None = None,
        between: Callable[[float], float | None] = no_object,
        around: Callable[[float], float | None] = no_object,
    ) -> None:
        """Start as after power-on: reset, half open."""
        self.mechanics = mechanics or GripperMechanics()
        self.between = between
        self.around = around
        self.command = Command()
        # The time without a request after which the gripper reports a fault; None where its master is the controller.
        self.watchdog_s: float | None = None
        self._silent_s = 0.0
        self._position = float(COUNTS_MAX // 2)
        self._activation = _Activation.RESET
        self._fault = 0
        self._taken = Command()
        self._obj = 0
        self._current = 0

    @property
    def act(self) -> bool:
        """gACT."""
        return self._taken.act

    @property
    def gto(self) -> bool:
        """gGTO."""
        return self._taken.gto

    @property
    def sta(self) -> int:
        """gSTA: 0 reset, 1 activating, 3 active."""
        match self._activation:
            case _Activation.RESET:
                return 0
            case _Activation.ACTIVE:
                return 3
            case _:
                return 1

    @property
    def obj(self) -> int:
        """gOBJ: 0 moving, 1 contact opening, 2 contact closing, 3 at target."""
        return self._obj

    @property
    def flt(self) -> int:
        """gFLT."""
        return self._fault

    @property
    def pre(self) -> int:
        """gPR: the echo of the target."""
        return self._taken.pos

    @property
    def pos(self) -> int:
        """gPO: the position, rounded to counts."""
        return min(max(round(self._position), 0), COUNTS_MAX)

    @property
    def current(self) -> int:
        """gCU: motor current in 10 mA."""
        return self._current

    @property
    def width_mm(self) -> float:
        """The true width between the fingers, mm."""
        return self.mechanics.width_mm(self._position)

    @property
    def grip_force_n(self) -> float:
        """The force on the object between the fingers, N; 0 without one."""
        return self._force_n() if self._obj == 2 else 0.0

    def fail(self, code: int) -> None:
        """Report a fault and stop; from 10 on only a rising edge of ACT ends it."""
        self._fault, self._current = code, 0

    def clear_minor(self) -> None:
        """End a fault below 10, as cooling down does."""
        if self._fault < FIRST_MAJOR_FAULT:
            self._fault = 0

    def feed_watchdog(self) -> None:
        """Note a request."""
        self._silent_s = 0.0

    def status_was_read(self) -> None:
        """Note that the status was read, which clears the report of a silence."""
        if self._fault == NO_COMMUNICATION:
            self._fault = 0

    def step(self, dt_s: float) -> None:
        """Take up the command registers, then move for dt_s."""
        self._watch(dt_s)
        self._take_up()
        if self._fault >= FIRST_MAJOR_FAULT and self._fault != RELEASE_RUNNING:
            self._current = 0
            return
        if self._fault == RELEASE_RUNNING:
            self._release(dt_s)
        elif self.sta == 1:
            self._activate(dt_s)
        elif self.sta == 3 and self._taken.gto and self._fault != 8:
            self._go(dt_s)
        else:
            self._current = 0

    def _watch(self, dt_s: float) -> None:
        self._silent_s += dt_s
        if self.watchdog_s is not None and self._silent_s > self.watchdog_s and self._fault == 0:
            self._fault = NO_COMMUNICATION

    def _take_up(self) -> None:
        wanted, before = self.command, self._taken
        self._taken = Command(wanted.act, wanted.gto, wanted.atr, wanted.ard, wanted.pos, wanted.spe, wanted.force)
        if not wanted.act:
            self._activation, self._obj, self._current = _Activation.RESET, 0, 0
            if before.act:
                self._fault = 0
            if wanted.gto and not before.gto:
                self._fault = NOT_ACTIVATED
        elif not before.act:
            self._activation, self._fault = _Activation.OPENING, ACTIVATION_NOT_FINISHED
        if wanted.atr and not before.atr and wanted.act:
            self._fault = RELEASE_RUNNING

    def _activate(self, dt_s: float) -> None:
        match self._activation:
            case _Activation.OPENING:
                if self._approach(self.mechanics.open_counts, self.mechanics.activation_speed_mm_s, dt_s):
                    self._activation = _Activation.CLOSING
            case _Activation.CLOSING:
                if self._approach(self.mechanics.closed_counts, self.mechanics.activation_speed_mm_s, dt_s):
                    self._activation = _Activation.OPENING_AGAIN
            case _:
                if self._approach(self.mechanics.open_counts, self.mechanics.activation_speed_mm_s, dt_s):
                    self._activation, self._fault, self._obj = _Activation.ACTIVE, 0, 3

    def _release(self, dt_s: float) -> None:
        end = self.mechanics.open_counts if self._taken.ard else self.mechanics.closed_counts
        if self._approach(end, self.mechanics.release_speed_mm_s, dt_s):
            self._fault = RELEASE_DONE

    def _go(self, dt_s: float) -> None:
        low, high = SPEED_MM_S
        self._approach(float(self._taken.pos), low + (high - low) * self._taken.spe / COUNTS_MAX, dt_s)

    def _force_n(self) -> float:
        low, high = FORCE_N
        return low + (high - low) * self._taken.force / COUNTS_MAX

    def _approach(self, target: float, speed_mm_s: float, dt_s: float) -> bool:
        """Move towards a position; return whether the fingers have stopped, there or at an object."""
        travel = speed_mm_s * dt_s / self.mechanics.mm_per_count
        closing = target > self._position
        # The fingers' own stops count as the target: a real gripper that closes on air reports no object.
        target = min(max(target, self.mechanics.open_counts), self.mechanics.closed_counts)
        met = self._obstacle(closing=closing)
        stop = target if met is None else (min if closing else max)(target, met)
        if closing:
            # An object wider than the opening pushes the fingers apart.
            self._position = min(self._position + travel, stop)
        else:
            self._position = max(self._position - travel, stop)
        if self._position != stop:
            self._obj, self._current = 0, 15
            return False
        if stop == target:
            self._obj, self._current = 3, 0
        else:
            self._obj = 2 if closing else 1
            self._current = 5 + self._taken.force // 5
        return True

    def _obstacle(self, *, closing: bool) -> float | None:
        width_mm = (self.between if closing else self.around)(self._force_n())
        return None if width_mm is None else self.mechanics.counts(width_mm)
