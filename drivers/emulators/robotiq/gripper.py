"""The emulated 2F-140: spindle, fingers, registers, activation, faults. No I/O; `step` passes the time."""

from collections.abc import Callable
from dataclasses import dataclass, replace

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


@dataclass(slots=True)
class GripperRegisters:
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
        between: Callable[[float], float | None] = lambda _: None,
    ) -> None:
        """Start as after power-on: reset, half open."""
        self.mechanics = mechanics or GripperMechanics()
        self.between = between
        self.around: Callable[[float], float | None] = lambda _: None
        self.command = GripperRegisters()
        # The commands that the last step has taken up.
        self.taken = GripperRegisters()
        # The time without a request after which the gripper reports a fault; None where its master is the controller.
        self.watchdog_s: float | None = None
        # gOBJ: 0 moving, 1 contact opening, 2 contact closing, 3 at target; gFLT; gCU: motor current in 10 mA.
        self.obj = self.flt = self.current = 0
        self._silent_s = 0.0
        self._position = float(COUNTS_MAX // 2)
        # The positions that an activation has still to reach; None before it begins.
        self._to_reach: list[float] | None = None

    @property
    def sta(self) -> int:
        """gSTA: 0 reset, 1 activating, 3 active."""
        return 0 if self._to_reach is None else 1 if self._to_reach else 3

    @property
    def pos(self) -> int:
        """gPO: the position, rounded to counts."""
        return min(max(round(self._position), 0), COUNTS_MAX)

    @property
    def width_mm(self) -> float:
        """The true width between the fingers, mm."""
        return self.mechanics.width_mm(self._position)

    @property
    def grip_force_n(self) -> float:
        """The force on the object between the fingers, N; 0 without one."""
        return self._force_n() if self.obj == 2 else 0.0

    def fail(self, code: int) -> None:
        """Report a fault and stop; from 10 on only a rising edge of ACT ends it."""
        self.flt, self.current = code, 0

    def clear_minor(self) -> None:
        """End a fault below 10, as cooling down does."""
        if self.flt < FIRST_MAJOR_FAULT:
            self.flt = 0

    def feed_watchdog(self) -> None:
        """Note a request."""
        self._silent_s = 0.0

    def status_was_read(self) -> None:
        """Note that the status was read, which clears the report of a silence."""
        if self.flt == NO_COMMUNICATION:
            self.flt = 0

    def step(self, dt_s: float) -> None:
        """Take up the command registers, then move for dt_s."""
        self._watch(dt_s)
        self._take_up()
        if self.flt == RELEASE_RUNNING:
            self._release(dt_s)
        elif self.flt >= FIRST_MAJOR_FAULT:
            self.current = 0
        elif self._to_reach:
            self._activate(self._to_reach, dt_s)
        elif self.sta == 3 and self.taken.gto and self.flt != 8:
            low, high = SPEED_MM_S
            self._approach(float(self.taken.pos), low + (high - low) * self.taken.spe / COUNTS_MAX, dt_s)
        else:
            self.current = 0

    def _watch(self, dt_s: float) -> None:
        self._silent_s += dt_s
        if self.watchdog_s is not None and self._silent_s > self.watchdog_s and self.flt == 0:
            self.flt = NO_COMMUNICATION

    def _take_up(self) -> None:
        wanted, before = self.command, self.taken
        self.taken = replace(wanted)
        if not wanted.act:
            self._to_reach, self.obj, self.current = None, 0, 0
            if before.act:
                self.flt = 0
            if wanted.gto and not before.gto:
                self.flt = NOT_ACTIVATED
        elif not before.act:
            opened, closed = self.mechanics.open_counts, self.mechanics.closed_counts
            self._to_reach, self.flt = [opened, closed, opened], ACTIVATION_NOT_FINISHED
        if wanted.atr and not before.atr and wanted.act:
            self.flt = RELEASE_RUNNING

    def _activate(self, to_reach: list[float], dt_s: float) -> None:
        if self._approach(to_reach[0], self.mechanics.activation_speed_mm_s, dt_s):
            del to_reach[0]
            if not to_reach:
                self.flt, self.obj = 0, 3

    def _release(self, dt_s: float) -> None:
        end = self.mechanics.open_counts if self.taken.ard else self.mechanics.closed_counts
        if self._approach(end, self.mechanics.release_speed_mm_s, dt_s):
            self.flt = RELEASE_DONE

    def _force_n(self) -> float:
        low, high = FORCE_N
        return low + (high - low) * self.taken.force / COUNTS_MAX

    def _approach(self, target: float, speed_mm_s: float, dt_s: float) -> bool:
        """Move towards a position; return whether the fingers have stopped, there or at an object."""
        travel = speed_mm_s * dt_s / self.mechanics.mm_per_count
        closing = target > self._position
        # The fingers' own stops count as the target: a real gripper that closes on air reports no object.
        target = min(max(target, self.mechanics.open_counts), self.mechanics.closed_counts)
        width_mm = (self.between if closing else self.around)(self._force_n())
        met = target if width_mm is None else self.mechanics.counts(width_mm)
        stop = (min if closing else max)(target, met)
        if closing:
            # An object wider than the opening pushes the fingers apart.
            self._position = min(self._position + travel, stop)
        else:
            self._position = max(self._position - travel, stop)
        if self._position != stop:
            self.obj, self.current = 0, 15
            return False
        if stop == target:
            self.obj, self.current = 3, 0
        else:
            self.obj = 2 if closing else 1
            self.current = 5 + self.taken.force // 5
        return True
