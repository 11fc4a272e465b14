"""The tasks of one fingertip and of a pair: order, tares, and errors of the session."""

import asyncio
import threading
from collections.abc import AsyncGenerator, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from structlog.testing import capture_logs

from shearloop.bank.channels import PAPER_TABLE
from shearloop.bank.errors import CalibrationError
from shearloop.daemon.clock import Clock
from shearloop.daemon.commands import Commands
from shearloop.daemon.config import FingertipConfig
from shearloop.daemon.control.finger_motion import FingerMotion
from shearloop.daemon.messaging.command_server import CommandRefusedError
from shearloop.daemon.messaging.messages import Message
from shearloop.daemon.sensing.fingertip_boards import BoardTask, CombinedTask, DeadElectrodes
from shearloop.daemon.sensing.fingertip_task import FingertipTask, tactile_frame
from shearloop.daemon.sensing.frame_pairing import FramePairing
from shearloop.daemon.sensing.session_inputs import session_inputs
from shearloop.daemon.sensing.sessions import COMBINED
from shearloop.daemon.supervisor import HealthReporter, Supervisor
from shearloop.daemon.torques import TorqueSample
from shearloop.drivers.defaults import FRAME_PERIOD_S
from shearloop.drivers.eit_kit import Frame
from shearloop.drivers.robotiq.messages import ActivationStatus, GripperState, ObjectStatus, fault_of
from shearloop.drivers.serial_sensor import InputKind, RawEvent
from shearloop.errors import ActionError
from shearloop.estimation import Estimate, Measured, Session, TactileFrame
from shearloop.tools.recordings.before_frame import before_frame
from tests.running import running

MS = 1_000_000
PERIOD_S = 0.54
PERIOD_NS = 540 * MS
NONE = np.zeros(896, dtype=np.bool_)


def keeping(raw: list[RawEvent]) -> Any:
    """Return a recorder that keeps what comes before each frame, in the form of a recording."""
    return SimpleNamespace(record_before=lambda *what: raw.extend(session_inputs(*what)))


class RecordingPublisher:
    """Keeps topic, source and frame of every message."""

    def __init__(self, enough: int = 0) -> None:
        self._enough = enough
        self.messages: list[tuple[str, str, int]] = []
        self.enough = asyncio.Event()

    def publish(self, message: Message) -> None:
        self.messages.append((message.topic, message.source, message.frame))
        if len(self.messages) == self._enough:
            self.enough.set()

    def has_subscriber(self, _topic: str) -> bool:
        return False

    def numbers(self, topic: str, source: str) -> list[int]:
        return [number for *found, number in self.messages if found == [topic, source]]


def note_of(source: str, *, tool_known: bool) -> str:
    return "" if tool_known else f"the tool of {source} is not known"


class FakeSession:
    """Estimates nothing; frame `fails` raises, frame `waits` waits for `go_on`. Keeps the frames after tares.

    Like a search of a bank, an estimate runs in a thread if a frame waits.
    """

    taring = False
    reason = "nothing"
    why_no_torque = ""
    calibration = SimpleNamespace(sides=("right", "left"), table=PAPER_TABLE, tool_note=note_of)
    fixed: Mapping[str, object] = MappingProxyType({})

    def __init__(self, fails: int = -1, waits: int = -1) -> None:
        self.fails, self.waits = fails, waits
        self.begun, self.go_on = threading.Event(), threading.Event()
        self.search = None if waits < 0 else self
        self.tared_before: list[int] = []
        self._tared = False

    prepare = Session.prepare

    def is_old(self, _frame: TactileFrame) -> bool:
        return False

    def tare(self) -> None:
        self._tared = True

    def estimate(self, frame: TactileFrame) -> Estimate:
        number = round(frame.channels[0, 0])
        if number == self.fails:
            raise ZeroDivisionError("nothing to divide")
        if number == self.waits:
            self.begun.set()
            assert self.go_on.wait(60.0)
        if self._tared:
            self.tared_before.append(number)
        self._tared = False
        return Estimate(valid=False, reasons=(self.reason,))


class Taring(FakeSession):
    """Never has all frames of a tare."""

    taring, given_up = True, 0

    def give_up_tare(self) -> None:
        self.given_up += 1
        self.taring = False


class FixedClock(Clock):
    """A clock that the test sets."""

    t_ns = 10_000 * MS

    def now_ns(self) -> int:
        return self.t_ns


class Board:
    """Sends four frames, some in each read."""

    def __init__(self, in_one_read: int = 1) -> None:
        self._in_one_read = in_one_read

    async def batches(self) -> AsyncGenerator[list[Frame]]:
        for first in range(0, 4, self._in_one_read):
            yield [frame(first + number) for number in range(self._in_one_read)]
            await asyncio.sleep(0)
        await asyncio.Event().wait()


def frame(number: int, arrives_ns: int | None = None) -> Frame:
    """Return a frame that was acquired in one period, sent in 80 ms, and arrived; its channels hold its number."""
    arrival_ns = number * PERIOD_NS if arrives_ns is None else arrives_ns
    mid_ns = arrival_ns - 80 * MS - PERIOD_NS // 2
    times = {"t_begin_ns": mid_ns - PERIOD_NS // 2, "t_mid_ns": mid_ns, "t_arrival_ns": arrival_ns}
    flags = {"saturated": NONE, "dead": NONE, "repeated": False}
    return Frame(channels=np.full(896, float(number)), raw=np.zeros(1024), seq=number, **times, **flags)


def estimates(
    name: str, publisher: RecordingPublisher, session: FakeSession, clock: Clock | None = None, **options: Any
) -> FingertipTask:
    return FingertipTask(name, session, publisher, clock or Clock(), **options)


def tare_in(event: RawEvent) -> tuple[int, str]:
    """Return the frame of a recorded tare, and whether it begins or is given up before it."""
    number, before = before_frame(event)
    assert before.begins_tare is not before.gives_up_tare
    return number, "begins" if before.begins_tare else "given up"


def gripper_state(t_ns: int, status: ObjectStatus) -> GripperState:
    return GripperState(t_ns, 100, 20.0, 0.5, status, ActivationStatus.ACTIVE, None, fault_of(0))


def resting_gripper() -> SimpleNamespace:
    diameters = SimpleNamespace(update=lambda *_: None)
    return SimpleNamespace(held_tool=lambda _: None, moved_between=lambda *_: False, diameters=diameters)


def pairs(publisher: RecordingPublisher) -> CombinedTask:
    pairing = FramePairing(("right", "left"), PERIOD_S)
    return CombinedTask(COMBINED, FakeSession(), publisher, Clock(), period_s=PERIOD_S, pairing=pairing, boards={})


def fingertip(
    publisher: RecordingPublisher, session: FakeSession, combined: CombinedTask | None = None, in_one_read: int = 1
) -> BoardTask:
    return BoardTask("right", session, publisher, Clock(), board=Board(in_one_read), combined=combined)


async def test_each_frame_is_estimated_and_then_published_in_order():
    publisher = RecordingPublisher(8)
    async with running(fingertip(publisher, FakeSession()).run()):
        await publisher.enough.wait()
    expected = [(topic, "right", number) for number in range(4) for topic in ("eit.estimate", "eit.frame")]
    assert publisher.messages == expected


async def test_the_loop_gets_the_reason_why_a_valid_estimate_has_no_torque():
    class DiameterAlone(FakeSession):
        why_no_torque = "there is no torque without the tool's diameter"

        def estimate(self, _frame: TactileFrame) -> Estimate:
            return Estimate(valid=True, diameter_mm=20.0, diameter_low_mm=18.0, diameter_high_mm=22.0)

    heard: list[TorqueSample] = []
    loop = SimpleNamespace(on_torque=heard.append, stated_tool_mm=None)
    await estimates("right", RecordingPublisher(), DiameterAlone(), loop=loop).process(frame(0))
    assert [(one.torque_nm, one.reason) for one in heard] == [(None, "there is no torque without the tool's diameter")]


async def test_a_torque_notes_that_the_tool_is_not_known_until_an_experiment_states_it():
    class Torque(FakeSession):
        def set_tool(self, tool: Measured | None) -> None:
            pass

        def estimate(self, _frame: TactileFrame) -> Estimate:
            return Estimate(valid=True, torque_nm=0.1, torque_low_nm=0.0, torque_high_nm=0.2)

    heard: list[TorqueSample] = []
    loop = SimpleNamespace(on_torque=heard.append, stated_tool_mm=None)
    task = estimates("right", RecordingPublisher(), Torque(), loop=loop)
    for number, stated_mm in enumerate((None, 20.0, 20.0, None)):
        loop.stated_tool_mm = stated_mm
        await task.process(frame(number))
    unknown = "the tool of right is not known"
    assert [one.note for one in heard] == [unknown, "", "", unknown]


async def test_the_tool_that_an_experiment_states_is_known_before_a_frame_and_recorded_once():
    tools: list[Measured | None] = []

    class Noting(FakeSession):
        def set_tool(self, tool: Measured | None) -> None:
            tools.append(tool)

    recorded: list[RawEvent] = []
    inputs = keeping(recorded)
    loop = SimpleNamespace(on_torque=lambda _: None, stated_tool_mm=None)
    gripper = resting_gripper()
    gripper.is_holding = True
    task = estimates("right", RecordingPublisher(), Noting(), loop=loop, gripper=gripper, inputs=inputs)
    await task.process(frame(0))
    loop.stated_tool_mm = 40.0
    await task.process(frame(1))
    await task.process(frame(2))
    gripper.held_tool = lambda _: Measured(40.5, 0.5)
    await task.process(frame(3))
    assert tools == [Measured(40.0, 0.0), Measured(40.0, 0.0)], "what it states is exact"
    assert [event.data for event in recorded] == [b"1 stated 40.0", b"3 40.5 0.5 stated 40.0"]


async def test_an_error_of_the_estimator_ends_the_task():
    with pytest.raises(ZeroDivisionError):
        await fingertip(RecordingPublisher(), FakeSession(fails=0)).run()


async def test_pairs_are_estimated_in_order_by_the_first_fingertip_that_is_free():
    publisher, slow = RecordingPublisher(), FakeSession(waits=0)
    combined = pairs(publisher)
    async with running(fingertip(publisher, slow, combined, in_one_read=2).run()):
        await asyncio.to_thread(slow.begun.wait)
        combined.add("left", [frame(1)])
        await combined.process_pairs()
        assert publisher.numbers("eit.estimate", COMBINED) == [1], "its partner has arrived in the same read"
        slow.go_on.set()


def no_partner(frames: str) -> str:
    return f"{frames}, without a frame of the other fingertip at that time: no combined estimate"


async def test_frames_without_a_partner_are_counted_and_logged():
    combined = pairs(RecordingPublisher())
    with capture_logs() as logs:
        # The left board begins two frames later, and loses three frames.
        for number in range(10):
            combined.add("right", [frame(number)])
            if number not in (0, 1, 5, 6, 8):
                combined.add("left", [frame(number)])
            await combined.process_pairs()
    assert combined.count == 5
    assert combined.diagnostics()["unpaired"] == {"right": 5, "left": 0}
    assert [one["event"] for one in logs] == [no_partner("2 frames of right"), no_partner("1 frame of right")]


async def test_a_board_that_stays_silent_is_named_until_the_next_pair():
    combined = pairs(RecordingPublisher())
    for side in ("right", "left"):
        combined.add(side, [frame(0)])
    await combined.process_pairs()
    with capture_logs() as logs:
        combined.add("right", [frame(number) for number in range(1, 21)])
    assert [one["event"] for one in logs] == [no_partner("1 frame of right")], "the row is logged once"
    assert combined.diagnostics()["error"] == no_partner("12 frames of right")
    combined.add("left", [frame(20)])
    assert combined.diagnostics()["error"] == ""


class Reads:
    """A board whose reads complete these frames; `ended` is set after the last."""

    parser = None

    def __init__(self, *reads: list[Frame]) -> None:
        self._reads = reads
        self.ended = asyncio.Event()

    async def batches(self) -> AsyncGenerator[list[Frame]]:
        for frames in self._reads:
            yield frames
        self.ended.set()
        await asyncio.Event().wait()


class Inputs:
    """The recorder of one source, in a file that began in the middle of a run; it adds itself to a state as `of`."""

    def __init__(self, states: list[dict[str, Any]]) -> None:
        self.wants_state = True
        self._states = states

    def record_state(self, state: Mapping[str, object], _fixed: object, _t_ns: int) -> None:
        self.wants_state = False
        self._states.append({**state, "of": self})

    def record_before(self, *_what: object) -> None:
        pass


async def test_a_busy_fingertip_keeps_no_other_state_from_a_recording():
    states = list[dict[str, Any]]()
    publisher, slow, combined = RecordingPublisher(3), FakeSession(waits=0), pairs(RecordingPublisher())
    right, left, both = Inputs(states), Inputs(states), Inputs(states)
    combined.inputs = both
    combined.boards = {name: SimpleNamespace(inputs=own) for name, own in (("right", right), ("left", left))}
    # A read that completes no frame comes before the first one that a file has.
    busy = BoardTask("right", slow, publisher, Clock(), inputs=right, board=Reads([frame(0)], []), combined=combined)
    idle = BoardTask("left", FakeSession(), publisher, Clock(), inputs=left, board=Reads([]), combined=combined)
    async with running(busy.run()):
        await asyncio.to_thread(slow.begun.wait)
        async with running(idle.run()):
            await idle.board.ended.wait()
        assert [one["of"] for one in states] == [left], "a pair needs the states of both boards"
        slow.go_on.set()
        await busy.board.ended.wait()
    assert [one["of"] for one in states] == [left, right, both]


async def test_pairs_that_wait_are_a_part_of_the_state():
    states = list[dict[str, Any]]()
    combined = pairs(RecordingPublisher())
    combined.inputs = Inputs(states)
    for number in range(2):
        for side in ("right", "left"):
            combined.add(side, [frame(number)])
    combined.record_own_state()
    (state,) = states
    assert [[one.seq for one in pair] for pair in state["pairs"]] == [[0, 0], [1, 1]]
    # None is recorded while an estimate is made; the next one is after it.
    combined.inputs = Inputs(states)
    combined.session = slow = FakeSession(waits=0)
    async with running(combined.process_pairs()) as (processing,):
        await asyncio.to_thread(slow.begun.wait)
        combined.record_own_state()
        assert len(states) == 1
        slow.go_on.set()
        await processing
    assert len(states) == 2


@pytest.mark.parametrize("since_ms", [1, 100, 540, 621])
async def test_a_tare_begins_with_the_first_frame_acquired_after_it(since_ms):
    clock, session, raw = FixedClock(), FakeSession(), list[RawEvent]()
    task = estimates("right", RecordingPublisher(), session, clock, inputs=keeping(raw))
    asked_ns = clock.t_ns
    task.tare()
    for seq in range(5):
        clock.t_ns = asked_ns + since_ms * MS + seq * PERIOD_NS
        await task.process(frame(seq, clock.t_ns))
    (first,) = session.tared_before
    began_ns = asked_ns + since_ms * MS + first * PERIOD_NS - PERIOD_NS - 80 * MS
    assert asked_ns <= began_ns < asked_ns + PERIOD_NS, "no later frame is skipped"
    assert [(one.kind, one.data) for one in raw] == [(InputKind.TARE, str(first).encode())], "as a replay finds it"


async def test_a_gain_that_no_twist_shows_is_left_with_the_reason():
    class Untwisted(FakeSession):
        grip_t_s = np.zeros(0)

        def adapt(self, torque_nm: np.ndarray) -> None:
            raise CalibrationError(f"no twist in {len(torque_nm)} frames")

    publisher = RecordingPublisher()
    task = estimates("right", publisher, Untwisted())
    adapting = asyncio.create_task(task.adapt("load_cell"))
    await asyncio.sleep(0)
    await task.process(frame(1))
    with pytest.raises(ActionError, match="right against load_cell: no twist in 0 frames"):
        await adapting
    assert publisher.messages == [("eit.estimate", "right", 1)]


async def test_the_gain_is_corrected_after_the_tare_and_the_tool_before_a_frame():
    applied: list[str] = []

    class Ordered(FakeSession):
        grip_t_s = np.zeros(0)

        def tare(self) -> None:
            applied.append("tare")

        def set_tool(self, _tool: Measured | None) -> None:
            applied.append("tool")

        def adapt(self, _torque_nm: np.ndarray) -> None:
            applied.append("gain")
            raise CalibrationError("no twist")

    gripper = resting_gripper()
    gripper.held_tool, gripper.is_holding = (lambda _: Measured(20.0, 0.5)), False
    clock = FixedClock()
    task = estimates("right", RecordingPublisher(), Ordered(), clock, gripper=gripper)
    task.tare()
    adapting = asyncio.create_task(task.adapt("load_cell"))
    await asyncio.sleep(0)
    await task.process(frame(1, clock.t_ns + 2 * PERIOD_NS))
    assert applied == ["tare", "tool", "gain"]
    with pytest.raises(ActionError):
        await adapting


async def test_a_correction_that_crashes_fails_its_step_and_not_the_fingertip():
    class Crashing(FakeSession):
        grip_t_s = np.zeros(0)

        def adapt(self, _torque_nm: np.ndarray) -> None:
            raise np.linalg.LinAlgError("singular matrix")

    publisher = RecordingPublisher()
    task = estimates("right", publisher, Crashing())
    adapting = asyncio.create_task(task.adapt("load_cell"))
    await asyncio.sleep(0)
    await task.process(frame(1))
    with pytest.raises(np.linalg.LinAlgError):
        await adapting
    assert publisher.messages == [("eit.estimate", "right", 1)]


async def test_a_pair_with_one_earlier_frame_is_not_part_of_the_tare():
    clock, session = FixedClock(), FakeSession()
    task = estimates(COMBINED, RecordingPublisher(), session, clock)
    task.tare()
    for seq in range(3):
        arrives_ns = clock.t_ns + 630 * MS + seq * PERIOD_NS
        await task.process(frame(seq, arrives_ns), frame(seq, arrives_ns - 200 * MS))
    assert session.tared_before == [1]


async def test_a_second_tare_replaces_the_first():
    clock, session = FixedClock(), FakeSession()
    task = estimates("right", RecordingPublisher(), session, clock)
    for seq in range(5):
        if seq < 2:
            task.tare()
        clock.t_ns += PERIOD_NS
        await task.process(frame(seq, clock.t_ns))
    assert session.tared_before == [2]


async def test_waiting_for_a_tare_ends_when_it_is_complete():
    clock, session = FixedClock(), FakeSession()
    task = estimates("right", RecordingPublisher(), session, clock)
    async with running(task.tare_and_wait(60.0)) as (waiting,):
        await asyncio.sleep(0)
        await task.process(frame(0, clock.t_ns))
        await asyncio.sleep(0)
        assert not waiting.done(), "this frame was acquired before the tare"
        await task.process(frame(1, clock.t_ns + 2 * PERIOD_NS))
        await waiting


async def test_tare_that_times_out_says_why_its_frames_were_refused():
    clock, session = FixedClock(), Taring()
    task = estimates("right", RecordingPublisher(), session, clock)
    async with running(task.tare_and_wait(0.2)) as (waiting,):
        await asyncio.sleep(0)
        for seq, reason in enumerate(("3 channels jumped", "nothing", "5 channels jumped", "7 channels jumped"), 2):
            session.reason = reason
            # Each began soon after the tare was asked for.
            await task.process(frame(seq, clock.t_ns + (620 + seq) * MS))
        error = await waiting
    said = "the idle frame of right could not be taken within 0.2 s"
    assert error == f"{said}: 3 frames: … channels jumped, 1 frame: nothing"
    async with running(task.tare_and_wait(0.01)) as (waiting,):
        assert (await waiting).endswith("no frame came")
    await task.process(frame(9, clock.t_ns + 9 * PERIOD_NS))
    assert session.tared_before == [2], "a later frame may be of a gripped tool"


async def test_a_wait_for_a_tare_that_ends_without_one_leaves_a_later_tare():
    clock, session = FixedClock(), FakeSession()
    task = estimates("right", RecordingPublisher(), session, clock)
    async with running(task.tare_and_wait(0.01)) as (waiting,):
        await asyncio.sleep(0)
        task.tare()
        assert (await waiting).endswith("no frame came")
    await task.process(frame(0, clock.t_ns + 2 * PERIOD_NS))
    assert session.tared_before == [0]


async def test_a_session_that_begins_with_an_idle_frame_takes_none_after_a_tare_that_no_frame_came_for(log):
    """The paper's method takes its first frames for idle; these come after the time of a tare, and could be loaded."""
    clock, session, raw = FixedClock(), Taring(), list[RawEvent]()
    task = estimates("right", RecordingPublisher(), session, clock, inputs=keeping(raw))
    task.tare()
    clock.t_ns += round(task.longest_tare_s * 1e9) + 1
    for number in (0, 1):
        await task.process(frame(number, clock.t_ns + PERIOD_NS + 80 * MS))
    assert session.given_up == 1
    assert [tare_in(one) for one in raw] == [(0, "given up")], "as a replay finds it"
    assert log.said == ["the idle frame of right was not taken: no frame came in time"]


async def test_a_tare_of_a_fingertip_that_is_not_there_is_not_taken_at_the_load_of_a_later_hour(log):
    clock, session, raw = FixedClock(), FakeSession(), list[RawEvent]()
    task = estimates("right", RecordingPublisher(), session, clock, inputs=keeping(raw))
    task.tare()
    assert task.taring
    clock.t_ns += round(task.longest_tare_s * 1e9) + 1
    assert not task.taring
    # It is plugged in, with a tool in the fingers.
    await task.process(frame(0, clock.t_ns + PERIOD_NS + 80 * MS))
    assert session.tared_before == []
    assert log.said == ["the idle frame of right was not taken: no frame came in time"]
    assert raw == []


async def test_a_tare_that_lost_its_board_on_the_way_gives_no_estimate_until_the_next(log):
    clock, session, raw = FixedClock(), Taring(), list[RawEvent]()
    task = estimates("right", RecordingPublisher(), session, clock, inputs=keeping(raw))
    task.tare()
    await task.process(frame(0, clock.t_ns + PERIOD_NS + 80 * MS))
    assert session.tared_before == [0]
    clock.t_ns += round(task.longest_tare_s * 1e9) + 1
    for number in (1, 2):
        await task.process(frame(number, clock.t_ns + PERIOD_NS + 80 * MS))
    assert session.given_up == 1
    assert [tare_in(one) for one in raw] == [(0, "begins"), (1, "given up")], "as a replay finds it"
    assert log.said == ["the idle frame of right was not taken: 1 frame: nothing"]


@dataclass
class Plug:
    """A board that sends nothing, plugged in or not."""

    connected: bool = True

    def diagnostics(self) -> dict[str, Any]:
        loss = "" if self.connected else "Its cable is out."
        return {"connected": self.connected, "last_loss": loss, "last_refusal": "", "measured_hz": None}


def two_and_both(right: Plug, left: Plug, clock: Clock) -> dict[str, FingertipTask]:
    """Return the tasks of two fingertips and of their pairs."""
    publisher, pairing = RecordingPublisher(), FramePairing(("right", "left"), PERIOD_S)
    boards = {"right": right, "left": left}
    both = CombinedTask(COMBINED, FakeSession(), publisher, clock, period_s=PERIOD_S, pairing=pairing, boards=boards)
    alone = {name: BoardTask(name, FakeSession(), publisher, clock, board=board) for name, board in boards.items()}
    return {**alone, COMBINED: both}


async def test_no_zero_of_both_fingertips_is_taken_without_one_of_them():
    right, left, clock = Plug(), Plug(connected=False), FixedClock()
    tasks = two_and_both(right, left, clock)
    health = HealthReporter(RecordingPublisher(), Supervisor(), clock, reporters=tasks)
    sensors = SimpleNamespace(tareable=tasks)
    tare = Commands(None, sensors, None, health, asyncio.Event(), lambda **_: None).handlers()["tare"]
    assert await tare({}) == {"taring": ["right"], "not_connected": ["left", COMBINED]}
    assert not tasks[COMBINED].taring, "a start waits for no zero that cannot be taken"
    assert tasks[COMBINED].diagnostics()["error"] == "without left there is no combined estimate"
    with pytest.raises(CommandRefusedError, match=r"^not connected: combined; connect it, then"):
        await tare({"source": COMBINED})
    right.connected = False
    with pytest.raises(CommandRefusedError, match=r"^not connected: right and left and combined; connect them, then"):
        await tare({})
    right.connected = left.connected = True
    assert await tare({}) == {"taring": ["right", "left", COMBINED]}


@pytest.mark.parametrize("name", ["right", COMBINED])
async def test_a_tare_that_no_frame_comes_for_ends_in_log_and_status(name, log):
    right, clock = Plug(), FixedClock()
    task = two_and_both(right, Plug(), clock)[name]
    task.tare()
    # It is unplugged on the way.
    right.connected = False
    assert "idle frame" not in task.diagnostics()["error"]
    clock.t_ns += round(task.longest_tare_s * 1e9) + 1
    why = f"the idle frame of {name} was not taken: no frame came in time"
    for _ in range(2):
        assert task.diagnostics()["error"].startswith(f"{why}; ")
    assert log.said == [why]
    task.tare()
    assert why not in task.diagnostics()["error"]


@pytest.mark.parametrize(("complete", "said"), [(False, [True]), (False, [False, True]), (True, [None, True])])
async def test_no_idle_frame_is_of_a_gripped_tool(complete, said, log):
    """The daemon was started again with a tool in the fingers: the paper's method takes its first frames for idle."""
    session, raw = Taring(), list[RawEvent]()
    gripper = resting_gripper()
    task = estimates("right", RecordingPublisher(), session, gripper=gripper, inputs=keeping(raw))
    for number, gripper.is_holding in enumerate([*said, True]):
        await task.process(frame(number))
        # It may have been completed before the gripper was connected.
        session.taring = session.taring and not complete
    assert session.given_up == 1
    assert [tare_in(one) for one in raw] == [(len(said) - 1, "given up")], "as a replay finds it"
    assert log.said == ["right has no idle frame: the gripper holds something"]


async def test_a_waiting_tare_fails_at_once_when_the_gripper_holds_something():
    clock, session = FixedClock(), Taring()
    held = resting_gripper()
    held.is_holding = False
    task = estimates("right", RecordingPublisher(), session, clock, gripper=held)
    async with running(task.tare_and_wait(60.0)) as (waiting,):
        await asyncio.sleep(0)
        await task.process(frame(0, clock.t_ns + 2 * PERIOD_NS))
        await asyncio.sleep(0)
        assert not waiting.done()
        held.is_holding = True
        await task.process(frame(1, clock.t_ns + 3 * PERIOD_NS))
        async with asyncio.timeout(10):
            assert await waiting == "right has no idle frame: the gripper holds something"
    assert session.given_up == 1
    assert not task.taring


@pytest.mark.parametrize(
    ("from_ms", "to_ms", "moved"),
    [(-700, -541, False), (-700, -539, True), (-300, -200, True), (-1, 500, True), (1, 500, False)],
)
async def test_a_frame_is_of_moving_fingers_if_they_moved_during_any_part_of_its_acquisition(from_ms, to_ms, moved):
    """Both fingertips' frames end at the same time, 80 ms before they arrive."""
    clock, raw, seen = FixedClock(), list[RawEvent](), list[bool]()
    motion, arrives_ns = FingerMotion(), clock.t_ns
    ended_ns = arrives_ns - 80 * MS
    for t_ms, status in ((from_ms - 50, "AT_TARGET"), (to_ms, "AT_TARGET")):
        if t_ms == to_ms:
            with motion.commanded(ended_ns + from_ms * MS):
                pass
        motion.take(gripper_state(ended_ns + t_ms * MS, ObjectStatus[status]))

    class Seeing(FakeSession):
        def estimate(self, frame: TactileFrame) -> Estimate:
            seen.append(frame.fingers_moved)
            return super().estimate(frame)

    gripper = resting_gripper()
    gripper.is_holding, gripper.moved_between = False, motion.moved_between
    inputs = keeping(raw)
    task = estimates(COMBINED, RecordingPublisher(), Seeing(), clock, gripper=gripper, inputs=inputs)
    await task.process(frame(7, arrives_ns), frame(7, arrives_ns))
    assert seen == [moved]
    assert [(one.kind, before_frame(one)[0]) for one in raw] == [(InputKind.MOVED, 7)] * moved


async def test_a_pair_is_of_moving_fingers_if_one_of_its_frames_is():
    clock, seen = FixedClock(), list[tuple[int, int]]()
    gripper = resting_gripper()
    gripper.is_holding, gripper.moved_between = False, lambda *interval: bool(seen.append(interval))
    task = estimates(COMBINED, RecordingPublisher(), FakeSession(), clock, gripper=gripper)
    await task.process(frame(3, clock.t_ns), frame(3, clock.t_ns - 200 * MS))
    ended_ns = clock.t_ns - 80 * MS
    assert seen == [(ended_ns - 200 * MS - PERIOD_NS, ended_ns)]


async def test_an_idle_frame_outlives_the_grip_after_it():
    session = Taring()
    gripper = resting_gripper()
    task = estimates("right", RecordingPublisher(), session, gripper=gripper)
    for number, gripper.is_holding in enumerate([False, False, True, True]):
        await task.process(frame(number))
        session.taring = False
    assert session.given_up == 0


def test_the_configured_frame_period_is_the_boards():
    assert FingertipConfig.model_fields["frame_period_s"].default == FRAME_PERIOD_S


def test_health_and_log_name_the_electrode_whose_channels_are_dead(log):
    own, electrode = DeadElectrodes(), (PAPER_TABLE.electrodes == 5).any(axis=1)
    for dead in (NONE, electrode, NONE, electrode):
        own.update("right", PAPER_TABLE, dead)
        assert bool(own.sentence) == bool(dead.any())
    assert "56 channels of electrode 5 (pin 6)" in own.sentence
    assert log.said == [own.sentence]
    own.update("right", PAPER_TABLE, np.arange(896) == 500)
    assert own.sentence == ""


@pytest.mark.parametrize("period_s", [0.1, PERIOD_S, 1.4, 3.0])
def test_a_frame_that_is_read_at_once_has_waited_half_a_period_whatever_its_board(period_s):
    """A slow board's frames do not wait behind newer ones, although the configured period is shorter."""
    end_ns = round(10e9)
    times = {"t_begin_ns": end_ns - round(period_s * 1e9), "t_mid_ns": end_ns - round(period_s * 0.5e9)}
    read = replace(frame(1), **times, t_arrival_ns=end_ns)
    assert tactile_frame((read,)).read_after_periods == pytest.approx(0.5)
    late = replace(read, t_arrival_ns=end_ns + round(period_s * 1e9))
    assert tactile_frame((read, late)).read_after_periods == pytest.approx(1.5)
