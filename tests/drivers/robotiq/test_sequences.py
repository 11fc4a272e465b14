"""Activation and motion with made-up readouts and times."""

from collections.abc import Callable
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shearloop.drivers.robotiq import gripper as gripper_module
from shearloop.drivers.robotiq import messages
from shearloop.drivers.robotiq.gripper import PAUSE_NS, RobotiqGripper, object_status
from tests.drivers.robotiq.gripper_rig import CALIBRATION

S = 10**9
RESET = messages.Readout(False, False, messages.ActivationStatus.RESET, messages.ObjectStatus.MOVING, 0, 0, 3, 0)
ACTIVATING = replace(RESET, act=True, sta=messages.ActivationStatus.ACTIVATING, flt=5)
ACTIVE = messages.Readout(True, True, messages.ActivationStatus.ACTIVE, messages.ObjectStatus.AT_TARGET, 0, 50, 50, 0)
GO = messages.GripperMove(100, 255, 0)


class Client:
    """Returns the readouts in turn, then the last one for ever. Each look at its clock advances it."""

    name = "here"

    def __init__(self, *readouts: messages.Readout) -> None:
        self.readouts = list(readouts)
        self.requests: list[tuple[messages.Request, int]] = []
        self.now_ns = 0

    def monotonic_ns(self) -> int:
        self.now_ns += S // 10
        return self.now_ns

    async def connect(self) -> None: ...

    async def close(self) -> None: ...

    async def read(self, **_: bool) -> messages.Readout:
        return self.readouts.pop(0) if len(self.readouts) > 1 else self.readouts[0]

    async def write(self, request: messages.Request) -> None:
        self.requests.append((request, self.now_ns))


Connect = Callable[[Client], RobotiqGripper]


@pytest.fixture
def connect(monkeypatch) -> Connect:
    """Return a gripper behind a client, in the client's time."""

    def gripper(client: Client) -> RobotiqGripper:
        monkeypatch.setattr(gripper_module, "time", client)
        return RobotiqGripper(client, CALIBRATION, poll_s=0.0)

    return gripper


async def test_activation_is_a_reset_a_pause_and_a_rising_edge(connect):
    # Silent during the pause is no obstacle, and the old active state is not the new one.
    client = Client(ACTIVE, ACTIVE, *[RESET] * 6, replace(ACTIVATING, flt=9), ACTIVATING, ACTIVE)
    state = await connect(client).activate(operator_confirmed=True)
    assert state.activation is messages.ActivationStatus.ACTIVE
    (reset, reset_ns), (activate, activate_ns) = client.requests
    assert (reset, activate) == (messages.GripperAction.RESET, messages.GripperAction.ACTIVATE)
    assert activate_ns - reset_ns >= PAUSE_NS
    assert client.readouts == [ACTIVE]


@pytest.mark.parametrize(
    ("readouts", "failure"),
    [
        ((ACTIVE,), "does not take the reset"),
        ((ACTIVE, *[RESET] * 6, replace(ACTIVATING, flt=13)), "clear what blocks"),
        ((ACTIVE, *[RESET] * 6, ACTIVATING), "does not end"),
    ],
)
async def test_activation_that_hangs_or_fails_is_reported(connect, readouts, failure):
    with pytest.raises(messages.GripperFaultError, match=failure):
        await connect(Client(*readouts)).activate(operator_confirmed=True)


@given(st.sampled_from([status for status in messages.ObjectStatus if status >= 0]), st.integers(0, 255), st.booleans())
def test_object_status_counts_only_for_the_last_target(obj, pre, gto):
    readout = replace(ACTIVE, obj=obj, pre=pre, gto=gto)
    believed = object_status(readout, GO)
    assert believed is (obj if gto and pre == GO.position else messages.ObjectStatus.MOVING)
    assert object_status(readout, None) is (obj if gto else messages.ObjectStatus.UNKNOWN)


@pytest.mark.parametrize(
    "sta", [one for one in messages.ActivationStatus if one is not messages.ActivationStatus.ACTIVE]
)
def test_inactive_gripper_holds_nothing(sta):
    """After a power failure the fingers stay in place without force."""
    held = replace(ACTIVE, obj=messages.ObjectStatus.CONTACT_CLOSING, pre=GO.position, gto=True)
    for last in (GO, None):
        assert object_status(held, last) is messages.ObjectStatus.CONTACT_CLOSING
        assert object_status(replace(held, sta=sta), last) is messages.ObjectStatus.UNKNOWN


@pytest.mark.parametrize("obj", [messages.ObjectStatus.CONTACT_CLOSING, messages.ObjectStatus.AT_TARGET])
async def test_motion_ends_at_its_target_or_on_an_object(connect, obj):
    client = Client(ACTIVE)
    gripper = connect(client)
    sent = await gripper.move(messages.GripperCommand(50.0))
    taken_up = replace(ACTIVE, pre=sent.position)
    client.readouts = [ACTIVE, replace(taken_up, obj=messages.ObjectStatus.MOVING), replace(taken_up, obj=obj), RESET]
    assert (await gripper.finish(sent)).object is obj
    assert client.readouts == [RESET]


@pytest.mark.parametrize(
    ("readout", "failure"),
    [
        (ACTIVE, "does not finish"),
        (replace(ACTIVE, flt=8), "too hot"),
        (replace(ACTIVE, flt=14), "too much current"),
        (RESET, "has to be activated"),
        (ACTIVATING, "still activating"),
    ],
)
async def test_motion_without_an_end_is_reported(connect, readout, failure):
    client = Client(ACTIVE)
    gripper = connect(client)
    sent = await gripper.move(messages.GripperCommand(50.0))
    client.readouts = [readout]
    with pytest.raises(messages.GripperFaultError, match=failure):
        await gripper.finish(sent)
