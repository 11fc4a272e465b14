"""The task of the gripper: read it, publish it, move it."""

import asyncio
import contextlib
from collections.abc import Awaitable, Callable, Mapping

from shearloop.bank.eit.gaussian import TWO_SIDED_95
from shearloop.bank.estimation import Measured, combine
from shearloop.daemon.control.fault_detection import HAND_STALE_S
from shearloop.daemon.control.loop_inputs import GripperStatus
from shearloop.daemon.control.step_runner import GripTo
from shearloop.daemon.messaging.messages import GripperStateMessage, Scalar
from shearloop.daemon.messaging.publisher import Publisher
from shearloop.drivers.errors import DriverError
from shearloop.drivers.robotiq.gripper import RobotiqGripper
from shearloop.drivers.robotiq.messages import GripperCommand, GripperState, ObjectStatus

RELEASE_WIDTH_MM = 140.0
# What a stop asks for is tried for longer than a lost connection takes to be there again.
TRIED_FOR_S, TRIED_AGAIN_S = 5.0, 0.1


class GripperTask:
    """Ties the gripper to the publisher and to the loop."""

    def __init__(
        self,
        gripper: RobotiqGripper,
        publisher: Publisher,
        feel: Callable[[GripperStatus], None],
        *,
        measures_diameters: bool = True,
    ) -> None:
        """Take the gripper; it `measures_diameters` once its widths were calibrated with its fingertips on."""
        self._measures_diameters = measures_diameters
        self._gripper = gripper
        self._publisher = publisher
        self._feel = feel
        self.fingertips_say: Callable[[int], Measured | None] = lambda _: None

    async def read(self) -> None:
        """Publish every state and pass it on, until cancelled."""
        async with contextlib.aclosing(self._gripper.states()) as states:
            async for state in states:
                self._publish(state)
                self._feel(_hand(state))

    async def grip(self, wish: GripTo) -> str:
        """Move to a width and wait for the end; return why it went wrong, or an empty text."""
        try:
            await self._gripper.activate()
            sent = await self._gripper.move(GripperCommand(wish.width_mm, wish.speed_mm_per_s, wish.force_n))
            state = await self._gripper.finish(sent)
        except DriverError as error:
            return str(error)
        # The loop must know what the fingers hold before it hears that they have closed.
        self._feel(_hand(state))
        if wish.expect_object and state.diameter_mm is None:
            return (
                f"the fingers closed to {state.width_mm:.1f} mm and met nothing; "
                "put the tool between them, or correct `width_mm`"
            )
        return ""

    async def release(self) -> str:
        """Open wide; return why it went wrong, or an empty text."""
        return await _tried(lambda: self.grip(GripTo(RELEASE_WIDTH_MM, 100.0, 10.0, expect_object=False)))

    async def halt(self) -> str:
        """Stop the fingers where they are; return why it went wrong, or an empty text."""
        return await _tried(self._halt)

    async def _halt(self) -> str:
        try:
            await self._gripper.halt()
        except DriverError as error:
            return str(error)
        return ""

    async def unlock(self) -> str:
        """Activate anew after a fault, on the operator's word that the fingers are clear."""
        try:
            # Asked for now: the latest state may be from before the fault, and activating opens the fingers.
            state = await self._gripper.read()
            if state.fault.needs_activation:
                await self._gripper.activate(operator_confirmed=True)
        except DriverError as error:
            return str(error)
        return ""

    def held_tool(self, t_ns: int) -> Measured | None:
        """Return the diameter in mm of what is held at t_ns, None where nothing is or nobody knows."""
        state = self._gripper.latest
        if state is None or not self._measures_diameters or t_ns - state.t_ns > HAND_STALE_S * 1e9:
            return None
        if state.diameter_mm is None or state.diameter_std_mm is None:
            return None
        return Measured(state.diameter_mm, TWO_SIDED_95 * state.diameter_std_mm)

    def facts(self) -> Mapping[str, Scalar | Mapping[str, int]]:
        """Return what health tells of the gripper."""
        return self._gripper.facts()

    def _publish(self, state: GripperState) -> None:
        tool = tool_diameter(state, self.fingertips_say(state.t_ns))
        self._publisher.publish(
            GripperStateMessage(
                source="gripper",
                t_mono_ns=state.t_ns,
                width_mm=state.width_mm,
                diameter_mm=state.diameter_mm,
                diameter_std_mm=state.diameter_std_mm,
                tool_diameter_mm=tool.value if tool is not None else None,
                tool_diameter_std_mm=tool.half_width / TWO_SIDED_95 if tool is not None else None,
                current_ma=state.current_ma,
                current_age_s=(state.t_ns - state.current_t_ns) / 1e9,
                object=state.object.text,
                fault=state.fault.code,
                fault_text=state.fault.sentence if state.fault.code else "",
            )
        )


async def _tried(act: Callable[[], Awaitable[str]]) -> str:
    """Return an empty text once something has gone well, or why it has not for a while."""
    tries_until_s = asyncio.get_running_loop().time() + TRIED_FOR_S
    while why := await act():
        if asyncio.get_running_loop().time() > tries_until_s:
            return why
        await asyncio.sleep(TRIED_AGAIN_S)
    return ""


def tool_diameter(state: GripperState, fingertips: Measured | None) -> Measured | None:
    """Return the diameter of what is held by the gripper's width and the fingertips; None while nothing is held."""
    if state.diameter_mm is None:
        return None
    std_mm = state.diameter_std_mm
    return combine(Measured(state.diameter_mm, TWO_SIDED_95 * std_mm) if std_mm else None, fingertips)


def _hand(state: GripperState) -> GripperStatus:
    return GripperStatus(
        state.t_ns,
        state.width_mm,
        holding=state.diameter_mm is not None,
        moving=state.object is ObjectStatus.MOVING,
        fault=state.fault.sentence if state.fault.needs_activation else "",
        # Its own word on objects counts only while it goes to a target (gGTO) or stands there. A reset, by which an
        # activation is ended, and a loss of power leave the fingers where they are, on a tool as well.
        uncertain=state.object is ObjectStatus.UNKNOWN,
    )
