"""A gripper that stands: how it is asked, and that nothing old is told as new."""

import asyncio
import contextlib
from collections.abc import AsyncIterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from shearloop.drivers.robotiq.gripper import RobotiqGripper
from shearloop.drivers.robotiq.messages import (
    ActivationStatus,
    GripperCommand,
    GripperMove,
    GripperState,
    ObjectStatus,
    Readout,
    Request,
)
from tests.drivers.robotiq.gripper_rig import CALIBRATION, STEP_S, WAYS, Rig, a_rig


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
        if isinstance(request, GripperMove):
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
        assert client.asked == ["whole", "write", "whole", "whole"]


@contextlib.asynccontextmanager
async def holding(way: str, tmp_path: Path) -> AsyncIterator[tuple[Rig, AsyncIterator[GripperState]]]:
    """Return a rig whose gripper holds an object and stands, with time stopped, and its states."""
    async with a_rig(way, tmp_path) as rig, contextlib.aclosing(rig.driver.states()) as states, asyncio.timeout(20):
        await anext(states)
        await rig.driver.activate()
        rig.object_mm = 20.0
        await rig.driver.finish(await rig.driver.move(GripperCommand(0.0)))
        rig.stopped = True
        # The first of them is asked for as a whole, and the next in part.
        while (await anext(states)).object is not ObjectStatus.CONTACT_CLOSING or rig.driver._polls % 5:
            pass
        yield rig, states


@WAYS
@pytest.mark.parametrize("asked", [{"gto": False}, {"pos": 250}], ids=["halted", "sent further"])
async def test_what_another_master_asks_of_a_gripper_that_stands_is_seen_at_the_next_poll(
    way: str, tmp_path: Path, asked: dict[str, Any]
) -> None:
    """It holds as before, which is what position and object tell; but whether it does is no longer what we asked."""
    async with holding(way, tmp_path) as (rig, states):
        for name, wanted in asked.items():
            setattr(rig.model.command, name, wanted)
        rig.model.step(STEP_S)
        assert rig.model.obj == ObjectStatus.CONTACT_CLOSING
        assert (await anext(states)).diameter_mm is None


@WAYS
async def test_the_age_of_a_current_is_told(way: str, tmp_path: Path) -> None:
    async with holding(way, tmp_path) as (rig, states):
        whole = await anext(states)
        for polls in range(12):
            rig.t_s += 0.1
            # As of a motor that warms up.
            rig.model._current += 1
            state = await anext(states)
            assert state.t_ns - whole.t_ns == pytest.approx((polls + 1) * 1e8, abs=1e3)
            behind = round((state.t_ns - state.current_t_ns) / 1e8)
            assert state.current_ma == 10.0 * (rig.model.current - behind)
            assert 0 <= behind <= (4 if way == "socket" else 0)
