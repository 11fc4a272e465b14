"""The gripper's task: reads, publishes and moves it."""

import asyncio
import contextlib
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field, replace

from shearloop.daemon.clock import Clock
from shearloop.daemon.control.control_loop import ControlLoop
from shearloop.daemon.control.experiment_schema import GripStep, Opening, opening
from shearloop.daemon.control.fault_detection import GRIPPER_STALE_S
from shearloop.daemon.control.finger_motion import FingerMotion
from shearloop.daemon.control.fingertip_diameters import FingertipDiameters
from shearloop.daemon.control.inputs import GripperStatus
from shearloop.daemon.control.operator_view import activation_sentence
from shearloop.daemon.messaging.messages import GripperStateMessage
from shearloop.daemon.messaging.publisher import Publisher
from shearloop.drivers.connection import Diagnostics
from shearloop.drivers.errors import DriverError
from shearloop.drivers.robotiq.gripper import Permit, RobotiqGripper, permitted
from shearloop.drivers.robotiq.messages import (
    ActivationStatus,
    GripperCommand,
    GripperInactiveError,
    GripperState,
    GripperTooHotError,
    ObjectStatus,
)
from shearloop.drivers.robotiq.models import LARGEST_STROKE_MM
from shearloop.errors import ActionError, NotBegunError
from shearloop.estimation import Measured, combine
from shearloop.estimation.values import TWO_SIDED_95

# Every model opens as wide as it can, and as gently.
OPENING = opening(LARGEST_STROKE_MM, 100.0)
# The fingers' own stop may lie this far before the widest target.
OPEN_WITHIN_MM = 10.0
# A release that opens the fingers by less may not let go: about three of the gripper's positions.
MIN_OPENING_MM = 2.0
# Fingertips that touch are closer together than this number of standard deviations of a measured width.
TOUCHING_STDS = 3.0
# A width by the maker's figures is off by at most this number of standard deviations: bare fingers bow, and are open at
# other counts.
LARGEST_ERROR_STDS = 3.0
# A release or halt is retried for longer than a reconnection takes.
TRIED_FOR_S, TRIED_AGAIN_S = 5.0, 0.1


@dataclass(frozen=True, slots=True)
class GripperTask:
    """Connects the gripper to publisher and control loop; `diameters` are the fingertips'.

    A gripper `measures_diameters` if its widths were calibrated with its fingertips on. `patience` is the factor on the
    deadlines, above 1 on an emulated rig alone.
    """

    gripper: RobotiqGripper
    publisher: Publisher
    control_loop: ControlLoop
    diameters: FingertipDiameters
    # The time of commands.
    clock: Clock
    measures_diameters: bool = True
    patience: float = 1.0
    _motion: FingerMotion = field(default_factory=FingerMotion)

    async def run(self) -> None:
        """Publish every state and pass it on, until cancelled."""
        async with contextlib.aclosing(self.gripper.states()) as states:
            async for state in states:
                self._publish(state)
                self._take(state)

    async def grip(self, target: GripStep, permit: Permit = permitted) -> None:
        """Move to a width and wait for the end; raises DriverError and ActionError.

        A release activates the gripper where that is needed. A grip never does. `permit` is as in the driver.
        """
        with self._motion.commanded(self.clock.now_ns()):
            try:
                await self.gripper.activate(may_drop=isinstance(target, Opening), permit=permit)
            except GripperTooHotError as error:
                raise NotBegunError(str(error)) from error
            except GripperInactiveError as error:
                raise NotBegunError(
                    "the gripper is not active, as after a loss of power: its activation opens the fingers, and a tool "
                    "that they may hold drops; secure the tool, then send `shearloop command release --yes`"
                ) from error
            state, width_mm = await self.gripper.read(), target.width_mm
            if not isinstance(target, Opening):
                self._refuse_to_open(target, state, permit)
            elif self._is_open(target, state):
                self.gripper.take_as_open()
                self._take(replace(state, opened=True))
                return
            else:
                width_mm = self._opening_width(target, state)
            command = GripperCommand(width_mm, target.speed_mm_per_s, target.force_n)
            sent = await self.gripper.move(command, permit)
            state = await self.gripper.finish(sent)
        widest_mm = min(width_mm, self.gripper.model.stroke_mm)
        # The loop needs the state before the end of the action.
        self._take(state)
        if state.object is ObjectStatus.CONTACT_OPENING and state.width_mm < widest_mm - OPEN_WITHIN_MM:
            stopped = f"the fingers met something as they opened, and stopped at {state.width_mm:.1f} mm"
            raise ActionError(f"{stopped}; clear their way")
        if target.expect_object and not self._holds(state):
            closed = f"the fingers closed to {state.width_mm:.1f} mm and met nothing wider"
            thinner = "put the tool between them, or make `width_mm` some millimetres less than the tool"
            raise ActionError(f"{closed}; {thinner}")

    def _is_open(self, target: Opening, state: GripperState) -> bool:
        """Return whether a release has nothing to do: it never closes the fingers."""
        return not self._may_grip(state) and state.width_mm >= target.width_mm

    def _opening_width(self, target: Opening, state: GripperState) -> float:
        """Return the width that lets go: fully open, where the target is not well above the present width."""
        lets_go = target.width_mm > state.width_mm + MIN_OPENING_MM
        return LARGEST_STROKE_MM if self._may_grip(state) and not lets_go else target.width_mm

    def _may_grip(self, state: GripperState) -> bool:
        """Return whether the fingers hold something, or may; of a tool as wide as their target they feel nothing."""
        gripped = state.opened is False or self.control_loop.tool.was_gripped
        return state.object is not ObjectStatus.AT_TARGET or (self._unfelt(state) and gripped)

    def _refuse_to_open(self, target: GripStep, state: GripperState, permit: Permit) -> None:
        """Raise ActionError where a grip would open the fingers and drop something, NotBegunError where they rest."""
        may_hold = state.object is not ObjectStatus.AT_TARGET or self._unfelt(state)
        # In counts: the fingers may stand less than one count from the target.
        opens = self.gripper.calibration.counts(target.width_mm) < state.position_counts
        if opens and may_hold and (self._holds(state) or not self._nearly_open(state)):
            refused: type[ActionError] = NotBegunError
            if state.object is ObjectStatus.MOVING:
                # Fingers that another program moves are halted too.
                permit()
                refused = ActionError
            raise refused(
                f"the fingers are {state.width_mm:.1f} mm apart and hold something, or may hold it, and a grip to "
                f"{target.width_mm:g} mm would open them and drop it; put a `release` before it, or correct `width_mm`"
            )

    async def release(self, permit: Permit = permitted) -> None:
        """Open wide; raises DriverError and ActionError, and what `permit` raises."""
        await _tried(lambda: self.grip(OPENING, permit))

    async def open_by_operator(self, permit: Permit = permitted) -> None:
        """Open wide, also after a fault, once the operator says that a tool may drop; raises as `release` does."""
        await self._end_fault(permit, confirmed=True)
        await self.release(permit)

    async def halt(self) -> None:
        """Stop the fingers; raises DriverError."""
        with self._motion.commanded(self.clock.now_ns()):
            await _tried(self.gripper.halt)

    async def unlock(self, permit: Permit = permitted, *, confirmed: bool = False) -> None:
        """Activate again after a fault, which opens the fingers; raises DriverError and ActionError.

        Where they hold something, or may, it has to be `confirmed` by the operator, else this raises NotBegunError.
        """
        if await self._end_fault(permit, confirmed=confirmed):
            # An activation leaves the fingers open. Only a motion shows the gripper whether they hold something.
            await self.release(permit)

    async def _end_fault(self, permit: Permit, *, confirmed: bool) -> bool:
        """Activate the gripper if it has a fault that needs it; return whether it had one. Raises as `unlock` does."""
        # Read now: the latest state may be older than the fault.
        state = await self.gripper.read()
        if not state.fault.needs_activation:
            return False
        status = self.status_of(state)
        self.control_loop.on_gripper(status)
        if not confirmed and status.may_hold:
            what = f"its fingers are {status.width_mm:.1f} mm apart, and hold something or may hold it"
            raise NotBegunError(f"{activation_sentence(what)}; confirm it with `shearloop command unlock --yes`")
        with self._motion.commanded(self.clock.now_ns()):
            await self.gripper.activate(operator_confirmed=True, permit=permit)
        return True

    @property
    def is_holding(self) -> bool | None:
        """Whether its latest state shows something between the fingers; None before the first state."""
        state = self.gripper.latest
        return None if state is None else self._holds(state)

    def held_tool(self, t_ns: int) -> Measured | None:
        """Return the diameter in mm of the held tool at t_ns, or None."""
        state = self.gripper.latest
        if state is None or not self.measures_diameters:
            return None
        if t_ns - state.t_ns > self.patience * GRIPPER_STALE_S * 1e9:
            return None
        return self._diameter(state)

    def moved_between(self, from_ns: int, to_ns: int) -> bool:
        """Return whether the fingers moved at any time of an interval, as far as is known."""
        return self._motion.moved_between(from_ns, to_ns)

    def diagnostics(self) -> Diagnostics:
        """Return the gripper's part of `health`."""
        return self.gripper.diagnostics()

    def _take(self, state: GripperState) -> None:
        self._motion.take(state)
        self.control_loop.on_gripper(self.status_of(state))

    def status_of(self, state: GripperState) -> GripperStatus:
        """Return what the control loop knows of a gripper's state."""
        holding = self._holds(state)
        by_figures = Measured(state.width_mm, LARGEST_ERROR_STDS * state.width_std_mm)
        return GripperStatus(
            state.t_ns,
            state.width_mm,
            holding=holding,
            unmeasured_mm=by_figures if holding and not self.measures_diameters else None,
            moving=state.object is ObjectStatus.MOVING,
            fault=state.fault.sentence if state.fault.needs_activation else "",
            # The gripper detects objects only on its way to a target (gGTO) and there. A reset or a loss of power
            # leaves the fingers where they are, possibly on a tool.
            uncertain=state.object is ObjectStatus.UNKNOWN,
            unfelt=self._unfelt(state),
            requested_counts=state.requested_counts,
            others_requests=state.others_requests,
            inactive=state.activation is not ActivationStatus.ACTIVE,
            too_hot=state.fault.too_hot,
        )

    def _holds(self, state: GripperState) -> bool:
        """Return whether the fingers hold something: fingertips that touch each other do not, if that is measured."""
        if state.diameter_mm is None:
            return False
        return not self.measures_diameters or state.width_mm > TOUCHING_STDS * state.width_std_mm

    def _unfelt(self, state: GripperState) -> bool:
        """Return whether the fingers stand at their target, and did not open to it: an object as wide is not felt.

        A gripper tells an object from its target only if they differ by some millimetres (manual of the 2F-140, object
        detection).
        """
        at_target = state.object is ObjectStatus.AT_TARGET or state.diameter_mm is not None
        return at_target and not (state.opened or self._nearly_open(state) or self._holds(state))

    def _nearly_open(self, state: GripperState) -> bool:
        """Return whether the fingers are so far apart that they hold nothing."""
        return state.width_mm >= self.gripper.model.stroke_mm - OPEN_WITHIN_MM

    def _diameter(self, state: GripperState) -> Measured | None:
        """Return the held tool's diameter from the gripper alone; None while nothing is held."""
        if not self._holds(state) or state.diameter_std_mm is None:
            return None
        return Measured(state.width_mm, TWO_SIDED_95 * state.diameter_std_mm)

    def _publish(self, state: GripperState) -> None:
        own = self._diameter(state)
        tool = combine(own, self.diameters.latest(state.t_ns)) if own is not None else None
        self.publisher.publish(
            GripperStateMessage(
                source="gripper",
                t_mono_ns=state.t_ns,
                width_mm=state.width_mm,
                diameter_mm=state.diameter_mm if own is not None else None,
                diameter_std_mm=state.diameter_std_mm if own is not None else None,
                tool_diameter_mm=tool.value if tool is not None else None,
                tool_diameter_std_mm=tool.half_width / TWO_SIDED_95 if tool is not None else None,
                current_ma=state.current_ma,
                object=state.object.text,
                fault=state.fault.code,
                fault_text=state.fault.sentence if state.fault.code else "",
            )
        )


async def _tried(act: Callable[[], Awaitable[None]]) -> None:
    """Repeat an action until it succeeds; raises its last error after a while."""
    tries_until_s = asyncio.get_running_loop().time() + TRIED_FOR_S
    while True:
        try:
            return await act()
        except NotBegunError:
            # What is refused for a reason does not begin later by itself.
            raise
        except (ActionError, DriverError):
            if asyncio.get_running_loop().time() > tries_until_s:
                raise
        await asyncio.sleep(TRIED_AGAIN_S)
