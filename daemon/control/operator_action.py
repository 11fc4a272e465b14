"""What the operator does to robot and gripper while no experiment runs: unlock both, or open the gripper."""

import asyncio
from collections.abc import Callable, Coroutine
from dataclasses import dataclass
from typing import Any

from shearloop.daemon.control.command_sender import raise_if_refused
from shearloop.daemon.control.fingers import Fingers
from shearloop.daemon.messaging.deadlines import Deadline
from shearloop.drivers.errors import DriverError
from shearloop.drivers.ur.client import UrRobot
from shearloop.drivers.ur.messages import Unlock
from shearloop.errors import ActionError, NotBegunError


@dataclass(slots=True)
class MotionPermit:
    """A person's permission of a motion: until it expires, and as long as the daemon does not stand still.

    What has begun in time does not expire. `why_stood_still` says whether the daemon stood still since it was given.
    """

    deadline: Deadline
    why_stood_still: Callable[[], str | None]
    _in_time: bool = False

    def begin(self) -> None:
        """Begin a motion, or the next one; raises NotBegunError where it is no longer what the person wants."""
        late = None if self._in_time else self.deadline.why_passed("reaching the robot or the gripper")
        if (reason := late or self.why_stood_still()) is not None:
            raise NotBegunError(reason)
        self._in_time = True


@dataclass(slots=True)
class OperatorAction:
    """Carries out one `unlock` or `release` at a time; while it is `under_way`, the runner begins no other."""

    robot: UrRobot
    fingers: Fingers
    _task: asyncio.Task[None] | None = None

    @property
    def under_way(self) -> bool:
        """Whether robot and gripper are being unlocked, or the gripper is being opened."""
        return self._task is not None and not self._task.done()

    async def unlock(self, permit: MotionPermit, *, confirmed: bool = False) -> None:
        """Enable robot and gripper; raises DriverError and ActionError.

        `confirmed`: the operator says that a tool may drop.
        """
        await self._carry_out("unlock", "unlocking", self._unlock(permit, confirmed=confirmed))

    async def release(self, permit: MotionPermit) -> None:
        """Open the gripper, if there is one; raises DriverError and ActionError."""
        await self._carry_out("release", "the release", self._release(permit))

    def stop(self) -> str | None:
        """End the action under way, but not the fingers that it moves; return its command's name, or None."""
        if self._task is None or not self._task.cancel():
            return None
        return self._task.get_name()

    async def _carry_out(self, command: str, name: str, act: Coroutine[Any, Any, None]) -> None:
        task = self._task = asyncio.create_task(act, name=command)
        # After the caller is cancelled, a failure has no receiver.
        task.add_done_callback(lambda done: done.cancelled() or done.exception())
        await asyncio.wait([task])
        if task.cancelled():
            raise ActionError(f"{name} was stopped; send `{command}` again")
        task.result()

    async def _unlock(self, permit: MotionPermit, *, confirmed: bool) -> None:
        permit.begin()
        raise_if_refused(await self.robot.send(Unlock()))
        gripper = self.fingers.gripper
        if gripper is None:
            return
        try:
            # An activation opens and closes the fingers.
            with self.fingers.moving(permit.begin) as begin:
                await gripper.unlock(begin, confirmed=confirmed)
        except (ActionError, DriverError) as error:
            raise ActionError(
                f"the robot is unlocked and may move again, and the gripper is not ready: {error}"
            ) from error

    async def _release(self, permit: MotionPermit) -> None:
        gripper = self.fingers.gripper
        if gripper is None:
            return
        with self.fingers.moving(permit.begin) as begin:
            await gripper.open_by_operator(begin)
