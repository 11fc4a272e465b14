"""Activation and motion with made-up readouts and times."""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shearloop.drivers.robotiq import gripper as gripper_module
from shearloop.drivers.robotiq import messages
from shearloop.drivers.robotiq.gripper import PAUSE_NS, RobotiqGripper
from shearloop.drivers.robotiq.requests import ECHOED_WITHIN_NS, RequestWatch
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

    async def write(self, request: messages.Request, check: Callable[[], None]) -> None:
        check()
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


async def test_a_reset_that_is_not_taken_at_once_is_repeated(connect):
    client = Client(*[ACTIVE] * 8, *[RESET] * 12, ACTIVATING, ACTIVE)
    await connect(client).activate(operator_confirmed=True)
    requests = [request for request, _ in client.requests]
    assert requests[-1] is messages.GripperAction.ACTIVATE
    assert set(requests[:-1]) == {messages.GripperAction.RESET}
    times_ns = [t_ns for _, t_ns in client.requests]
    assert len(requests) > 2
    assert min(later - earlier for earlier, later in pairwise(times_ns)) >= PAUSE_NS


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


OBJECTS = st.sampled_from([status for status in messages.ObjectStatus if status >= 0])
TAKEN_UP = replace(ACTIVE, pre=GO.position)


def watching(*readouts: messages.Readout, sent: messages.GripperMove | None = GO) -> RequestWatch:
    """Return a watch over a move and the readouts after it, with 0.1 s between them."""
    watch = RequestWatch()
    if sent is not None:
        watch.on_move(sent, 0)
    for number, readout in enumerate(readouts, 1):
        watch.take(readout, number * S // 10)
    return watch


@given(OBJECTS, st.integers(0, 255), st.booleans())
def test_object_status_counts_only_for_the_last_target(obj, pre, gto):
    readout = replace(ACTIVE, obj=obj, pre=pre, gto=gto)
    believed = watching(readout).object_status(readout)
    assert believed is (obj if gto and pre == GO.position else messages.ObjectStatus.MOVING)
    assert watching(readout, sent=None).object_status(readout) is (obj if gto else messages.ObjectStatus.UNKNOWN)


@given(OBJECTS, st.integers(0, 255), st.booleans())
def test_once_a_move_is_taken_up_the_object_status_counts_for_whoever_moves_the_fingers(obj, pre, gto):
    readout = replace(ACTIVE, obj=obj, pre=pre, gto=gto)
    watch = watching(ACTIVE, TAKEN_UP, readout)
    assert watch.object_status(readout) is (obj if gto else messages.ObjectStatus.UNKNOWN)
    assert watch.others == (pre != GO.position)
    assert watch.overtaken == (pre != GO.position)
    # The next move of our own is awaited again, and nobody else's.
    watch.on_move(replace(GO, position=(pre + 1) % 256), S)
    assert watch.object_status(readout) is messages.ObjectStatus.MOVING
    watch.take(readout, S + S // 10)
    assert watch.others == (pre != GO.position)
    assert not watch.overtaken


def test_a_move_that_is_never_taken_up_leaves_the_object_status_to_the_gripper():
    """Another program's request right behind it: ours is never echoed."""
    held = replace(ACTIVE, obj=messages.ObjectStatus.CONTACT_CLOSING)
    watch = watching(held)
    assert watch.object_status(held) is messages.ObjectStatus.MOVING
    watch.take(held, ECHOED_WITHIN_NS + 1)
    assert watch.object_status(held) is messages.ObjectStatus.CONTACT_CLOSING
    assert watch.others == 0
    # A late echo, as after a pause of this process, is nobody else's.
    watch.take(TAKEN_UP, ECHOED_WITHIN_NS + 2)
    assert watch.others == 0
    watch.take(held, ECHOED_WITHIN_NS + 3)
    assert watch.others == 1


def test_a_request_of_our_own_that_changes_the_echo_is_nobody_elses():
    watch = watching(ACTIVE, TAKEN_UP)
    watch.on_action(S)
    watch.take(TAKEN_UP, S + 1)
    watch.take(ACTIVE, S + 2)
    watch.take(RESET, 5 * S)
    watch.take(replace(ACTIVE, pre=3), 6 * S)
    assert watch.others == 0
    watch.on_connection()
    watch.take(replace(ACTIVE, pre=3), 7 * S)
    assert watch.others == 0
    watch.on_connection()
    watch.take(replace(ACTIVE, pre=7), 8 * S)
    assert watch.others == 1, "while the connection was lost"


@pytest.mark.parametrize(
    "sta", [one for one in messages.ActivationStatus if one is not messages.ActivationStatus.ACTIVE]
)
def test_inactive_gripper_holds_nothing(sta):
    """After a power failure the fingers stay in place without force."""
    held = replace(ACTIVE, obj=messages.ObjectStatus.CONTACT_CLOSING, pre=GO.position, gto=True)
    for sent in (GO, None):
        watch = watching(held, sent=sent)
        assert watch.object_status(held) is messages.ObjectStatus.CONTACT_CLOSING
        assert watch.object_status(replace(held, sta=sta)) is messages.ObjectStatus.UNKNOWN


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


async def test_a_position_that_wavers_does_not_count_as_an_opening(connect):
    """Closed to its target, the fingers may hold a tool of that width."""
    closed = [replace(ACTIVE, pos=pos) for pos in (3, 90, 150, 149, 151, 150, 149)]
    driver = connect(Client(*closed))
    states = [await driver.connect(), *[await driver.read() for _ in closed[1:]]]
    assert [state.opened for state in states] == [None, *[False] * 6]
    driver.client.readouts = [replace(ACTIVE, pos=100)]
    assert (await driver.read()).opened


@pytest.mark.parametrize(
    ("positions", "opened"),
    [((200, 150, 102, 100, 103), False), ((100, 148, 150, 150, 146), True), ((3, 90, 88, 89), False)],
    ids=["a closing by three counts", "an opening by four", "a wavering one"],
)
async def test_the_direction_of_the_latest_motion_is_known_to_some_counts(connect, positions, opened):
    driver = connect(Client(*(replace(ACTIVE, pos=pos) for pos in positions)))
    state = await driver.connect()
    for _ in positions[1:]:
        state = await driver.read()
    assert state.opened is opened


async def test_a_closing_of_our_own_counts_from_its_request_on(connect):
    driver = connect(Client(replace(ACTIVE, pos=100), *[replace(ACTIVE, pos=50, pre=52)] * 3))
    await driver.connect()
    assert (await driver.read()).opened
    await driver.move(driver_command(driver, 52))
    assert not (await driver.read()).opened


def driver_command(driver: RobotiqGripper, position: int) -> messages.GripperCommand:
    """Return a command to a position in counts."""
    return messages.GripperCommand(driver.calibration.width_mm(position), 60.0, 20.0)
