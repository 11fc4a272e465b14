"""How a gripper that stands is asked."""

import contextlib
from dataclasses import replace

from drivers.robotiq.gripper import RobotiqGripper
from drivers.robotiq.messages import (
    ActivationStatus,
    GoTo,
    GripperCommand,
    ObjectStatus,
    Readout,
    Request,
)
from tests.drivers.robotiq.gripper_rig import CALIBRATION


class Counted:
    """A gripper that stands at its target, and how it was asked."""

    name = "here"

    def __init__(self) -> None:
        self.asked: list[str] = []
        self.readout = Readout(True, True, ActivationStatus.ACTIVE, ObjectStatus.AT_TARGET, 0, 100, 100, 0)

    async def connect(self) -> None: ...

    async def close(self) -> None: ...

    async def read(self) -> Readout:
        self.asked.append("whole")
        return self.readout

    async def read_again(self, before: Readout) -> Readout:
        assert before == self.readout
        self.asked.append("again")
        return self.readout

    async def write(self, request: Request) -> None:
        self.asked.append("write")
        if isinstance(request, GoTo):
            self.readout = replace(self.readout, pre=request.position, obj=ObjectStatus.MOVING)


async def test_a_gripper_that_stands_is_asked_as_a_whole_every_fifth_time_and_after_each_request() -> None:
    client = Counted()
    gripper = RobotiqGripper(client, CALIBRATION, poll_s=0.0)
    async with contextlib.aclosing(gripper.states()) as states:
        for _ in range(12):
            await anext(states)
        assert "".join(one[0] for one in client.asked) == "wwaaawaaaawa"
        client.asked.clear()
        await gripper.move(GripperCommand(50.0))
        for _ in range(3):
            await anext(states)
        assert client.asked == ["whole", "write", "whole", "whole", "whole"], "it moves"
        client.readout = replace(client.readout, obj=ObjectStatus.AT_TARGET)
        client.asked.clear()
        await anext(states)
        await gripper.halt()
        await anext(states)
        assert client.asked == ["whole", "write", "whole"]
