"""A stop, and the grip, outlive the process: after a crash, a power cut or a restart nothing has been forgotten."""

import asyncio
import json
import os
import threading
from collections.abc import Iterator, MutableMapping
from dataclasses import asdict, replace
from datetime import datetime
from types import SimpleNamespace
from typing import Any

import pytest
from structlog.testing import capture_logs

from shearloop.daemon import rig_memory
from shearloop.daemon.clock import Clock
from shearloop.daemon.control.control_loop import ControlLoop, End
from shearloop.daemon.control.experiment import ExperimentPhase
from shearloop.daemon.control.experiment_schema import ExperimentFile
from shearloop.daemon.control.faults import Fault, FaultCode, Response
from shearloop.daemon.control.grip import FOLLOWED_MM, NO_GRIP, SAME_WIDTH_MM, Grip
from shearloop.daemon.control.inputs import GripperStatus
from shearloop.daemon.control.operator_view import release_question
from shearloop.daemon.control.wrench import wrench_source
from shearloop.daemon.operator_questions import activation_note
from shearloop.daemon.rig_memory import Remembered, RigMemory, read_memories, read_memory, write_memory
from shearloop.drivers.load_cell import LoadCalibration, LoadCell
from shearloop.drivers.ur.client import UrRobot
from shearloop.drivers.ur.command_handler import BEING_MADE_READY
from shearloop.drivers.ur.motion import NOT_OURS
from shearloop.tools.left_tool import left_tool
from tests.daemon.control.loop_rig import CONFIG, EIT, FILES, GRIP, Rig, memory_of, new_loop, phase, started, stop
from tests.drivers.ur.handler_bench import SETTINGS, HandlerBench
from tests.fixtures.daemons import DEADLINE_S


@pytest.fixture
def logged() -> Iterator[list[MutableMapping[str, Any]]]:
    """The lines of the log."""
    with capture_logs() as lines:
        yield lines


WAIT = {"do": "wait", "wait_s": 60}


def refusal(rig: Rig) -> str:
    file = ExperimentFile.model_validate({"name": "next", "steps": [WAIT]})
    return rig.control_loop.start(file, rig.t_ns) or ""


def after_restart(before: Rig) -> Rig:
    """Return the rig with the loop of a new process, which finds what the old one has written."""
    write_memory(FILES.state, Remembered.of(before.control_loop))
    after = Rig(new_loop())
    memory_of(after.control_loop)
    after.wrist_rad, after.force_n, after.width_mm = before.wrist_rad, before.force_n, before.width_mm
    after.run(0.6)
    return after


def test_after_a_crash_nothing_moves_and_the_state_names_the_gripped_tool():
    rig = started(Rig(new_loop()), GRIP, WAIT)
    rig.run(2)
    after = after_restart(rig)
    after.run(2)
    assert after.begun == []
    assert after.speed == 0.0
    assert "while 'test' was under way" in refusal(after)
    reasons = " ".join(after.control_loop.status.decision.reasons)
    assert f"{FaultCode.TOOL_GRIPPED.value.kind}: its fingers hold something 30.0 mm wide, with at most 60 N" in reasons
    after.control_loop.acknowledge()
    after.run(1)
    assert (after.begun, after.speed) == ([], 0.0), "an acknowledgement moves nothing"


@pytest.mark.parametrize("kind", ["operator", "fault"])
def test_a_stop_is_remembered_until_it_is_acknowledged(kind):
    rig = started(Rig(new_loop()), GRIP, WAIT)
    rig.run(2)
    if kind == "operator":
        stop(rig)
    else:
        rig.control_loop.on_fault(FaultCode.PROTECTIVE_STOP, "it met something")
    rig.run(0.1)
    after = after_restart(rig)
    assert (FaultCode.OPERATOR_STOP if kind == "operator" else FaultCode.PROTECTIVE_STOP).value.kind in refusal(after)
    after.control_loop.acknowledge()
    again = after_restart(after)
    assert refusal(again) == ""


SLIDER = "The speed slider is at 50 %: set it to 100 % at the bottom of the teach pendant's screen."
PAYLOAD = "The controller has a payload of 1.5 kg, and the settings say 1 kg."
STOPPED_S = datetime(2026, 11, 30, 12, 3).timestamp()


class StandingClock(Clock):
    """Reads one Unix time."""

    def __init__(self, unix_s: float) -> None:
        super().__init__()
        self._unix_s = unix_s

    def unix_s(self, _t_mono_ns: int) -> float:
        return self._unix_s


@pytest.mark.parametrize("now", ["", SLIDER, PAYLOAD])
async def test_a_remembered_stop_says_when_it_was_and_a_present_cause_that_it_is(now):
    rig = started(Rig(new_loop()), WAIT)
    rig.run(1)
    memory = memory_of(rig.control_loop, clock=StandingClock(STOPPED_S))
    await memory.save_present()
    rig.arm = replace(rig.arm, blocked=SLIDER)
    rig.run(1)
    assert rig.control_loop.status.decision.reasons[0].startswith(
        "the robot does not move: The speed slider is at 50 %"
    )
    await memory.save_present()
    # The time is the stop's, also after two restarts.
    for later_s in (3600.0, 86400.0):
        after = Rig(new_loop())
        memory = memory_of(after.control_loop, clock=StandingClock(STOPPED_S + later_s))
        before_states = refusal(after)
        assert before_states.startswith("stopped at 2026-11-30 12:03: the robot does not move: The speed slider")
        after.arm = replace(after.arm, blocked=now)
        after.run(0.6)
        await memory.save_present()
    if now:
        assert refusal(after).startswith(f"the robot does not move: {now.removesuffix('.')}. Clear the cause and send")
    else:
        over = "stopped at 2026-11-30 12:03, over by now: the robot does not move: The speed slider is at 50 %"
        assert refusal(after).startswith(over)
        assert refusal(after).endswith("Look at the rig, then send `shearloop command unlock`.")
        assert after.control_loop.status.decision.reasons[0].startswith(over)
    named = [cause for cause in (SLIDER, PAYLOAD) if cause in refusal(after)]
    assert named == [now or SLIDER], "one reply does not name two"
    after.control_loop.acknowledge()
    after.run(0.1)
    await memory.save_present()
    assert read_memory(FILES.state).stopped_s is None


def test_a_cause_that_is_over_is_told_so_and_what_is_wrong_now_beside_it():
    rig = started(Rig(new_loop()), WAIT)
    rig.run(1)
    rig.arm = replace(rig.arm, blocked=SLIDER)
    rig.run(1)
    rig.arm = replace(rig.arm, blocked="")
    rig.control_loop.on_recording_error("the disk is full")
    rig.step()
    assert refusal(rig) == (
        f"over by now: the robot does not move: {SLIDER} Look at the rig, then send `shearloop command unlock`. "
        "Also: the recording cannot be written: the disk is full."
    )
    # What is wrong now comes first, and it is all that the robot says: nobody knows whether the slider is back.
    rig.arm = replace(rig.arm, emergency_stop=True)
    rig.step()
    assert refusal(rig).startswith(FaultCode.EMERGENCY_STOP.value.kind)
    assert "; the robot does not move: The speed slider" in refusal(rig)
    rig.silent.add("arm")
    for _ in range(100):
        rig.step()
    assert refusal(rig).startswith(FaultCode.STATE_STALE.value.kind)
    assert "over by now" not in refusal(rig)


def test_the_force_of_a_grip_is_remembered_while_the_fingers_close():
    rig = started(Rig(new_loop()), {"do": "release"}, GRIP, WAIT)
    while rig.control_loop.experiment.step_number < 2:
        rig.step()
    rig.step()
    # The process is killed, and the fingers close all the same.
    rig.force_n = 60.0
    after = after_restart(rig)
    assert "with at most 60 N unless it was gripped again before this daemon began" in release_question(
        after.control_loop.operator
    )


def test_a_stop_that_released_does_not_release_again_in_the_next_process():
    rig = Rig(new_loop())
    Remembered(stop=((FaultCode.TORQUE_LIMIT.name, "right measured 0.9 N·m"),)).restore(rig.control_loop)
    rig.force_n = 60.0
    for _ in range(20):
        rig.step()
        assert rig.orders != End(release=True)
    assert rig.control_loop.status.decision.response is Response.STOP_AND_KEEP_GRIP


def test_the_angle_of_a_grip_is_remembered_and_forgotten_with_the_grip():
    rig = started(Rig(new_loop()), GRIP, {"do": "wait", "wait_s": 0.1})
    rig.run(5)
    gripped_rad = rig.wrist_rad
    after = after_restart(rig)
    assert after.control_loop.tool.grip == Grip(pytest.approx(gripped_rad), 60.0, 30.0)
    after.force_n = 0.0
    after.run(0.1)
    assert not after.control_loop.tool.grip.known


@pytest.mark.parametrize("then", ["nothing", "released", "exchanged"])
def test_the_stated_diameter_is_kept_with_the_grip_and_forgotten_with_it(then):
    rig = started(Rig(new_loop()), GRIP, {"do": "wait", "wait_s": 0.1}, tool_mm=20.0)
    rig.run(5)
    assert "with a stated diameter of 20 mm" in left_tool(Remembered.of(rig.control_loop))
    after = after_restart(rig)
    if then == "released":
        after.force_n = 0.0
    elif then == "exchanged":
        after.width_mm = 60.0
    after.run(0.1)
    assert after.control_loop.stated_tool_mm == (20.0 if then == "nothing" else None)


def test_a_tool_that_was_exchanged_beside_the_daemon_is_not_the_stated_one():
    rig = started(Rig(new_loop()), GRIP, {"do": "wait", "wait_s": 0.1}, tool_mm=20.0)
    rig.run(5)
    rig.step()
    assert rig.control_loop.stated_tool_mm == 20.0
    rig.hand = replace(rig.hand, others_requests=1)
    rig.step()
    assert rig.control_loop.stated_tool_mm is None


def load_cell(scale_n_per_count: float = 0.001) -> LoadCell:
    return LoadCell(SimpleNamespace(), LoadCalibration(tare_counts=8000.0, scale_n_per_count=scale_n_per_count))


class Restarted:
    """A rig whose daemon ended with a tool of 30 mm gripped at 60 N, and began again; the gripper is not heard yet."""

    WRENCH_ZERO = (0.0, 1.0, 0.0, 0.0, 0.0, -0.11)

    def __init__(self, before: Rig) -> None:
        grip = before.control_loop.tool.grip
        state = Remembered(load_zero=8321.5, load_nm_per_count=load_cell().calibration.nm_per_count)
        write_memory(FILES.state, replace(state, **asdict(grip), wrench_zero=self.WRENCH_ZERO))
        self.rig = after = Rig(new_loop())
        self.cell, self.robot = load_cell(), UrRobot(SETTINGS)
        self.memory = memory_of(after.control_loop, self.cell, self.robot)
        after.wrist_rad, after.force_n, after.width_mm = before.wrist_rad, before.force_n, before.width_mm
        after.hand = before.hand

    @property
    def zeros(self) -> tuple[float, float]:
        """Of the load cell in counts, and of the wrench about the wrist in N·m."""
        return self.cell.calibration.tare_counts, self.robot.wrench_zero[5]

    @property
    def told(self) -> str:
        return " ".join(self.rig.control_loop.status.decision.reasons)


KEPT, TAKEN_BACK = (8321.5, -0.11), (8000.0, 0.0)


@pytest.fixture
def restarted() -> Restarted:
    before = Rig(new_loop())
    before.hand = replace(before.hand, requested_counts=183)
    started(before, GRIP, {"do": "wait", "wait_s": 0.1})
    before.run(5)
    return Restarted(before)


def exchange(rig: Rig, how: str) -> None:
    """Change what the gripper has, as the pendant does while no daemon runs."""
    match how:
        case "another width":
            rig.width_mm = 40.1
        case "another request":
            rig.hand = replace(rig.hand, requested_counts=255)
        case "nothing held":
            rig.force_n = 0.0
        case "activated again":
            rig.force_n, rig.width_mm = 0.0, 140.0
            rig.hand = replace(rig.hand, uncertain=True, requested_counts=0)


@pytest.mark.parametrize("tared", [True, False])
def test_the_log_calls_a_zero_kept_only_where_it_was_taken(tared, restarted, logged):
    stored = read_memory(FILES.state)
    write_memory(FILES.state, replace(stored, wrench_tared=tared))
    rig = restarted.rig
    again = Rig(new_loop())
    again.wrist_rad, again.force_n, again.width_mm, again.hand = rig.wrist_rad, rig.force_n, rig.width_mm, rig.hand
    memory_of(again.control_loop, load_cell(), UrRobot(SETTINGS))
    again.run(0.1)
    (kept,) = (line["of"] for line in logged if line["event"] == "the zeros of the present tool are kept")
    unknown = [line for line in logged if "the wrench has no known zero" in line["event"]]
    assert (kept, len(unknown)) == ((["load_cell", "wrench"], 0) if tared else (["load_cell"], 1))
    assert again.control_loop.has_zero("wrench") is tared


@pytest.mark.parametrize("how", ["another width", "another request", "nothing held", "activated again"])
def test_a_grip_that_changed_while_no_daemon_ran_is_one_that_nobody_knows(how, restarted, logged):
    rig = restarted.rig
    exchange(rig, how)
    assert restarted.zeros == KEPT, "until the gripper answers, nobody knows of another grip"
    rig.run(0.1)
    assert not rig.control_loop.tool.grip.known
    assert restarted.zeros == TAKEN_BACK
    (warning,) = (line for line in logged if line["log_level"] == "warning")
    assert "does not have the grip of the last daemon" in warning["event"]
    if rig.force_n:
        assert "with an unknown force" in release_question(rig.control_loop.operator)
        assert FaultCode.GRIP_UNKNOWN.value.kind in restarted.told
    else:
        assert FaultCode.GRIP_UNKNOWN.value.kind not in restarted.told


def test_a_load_cell_that_was_tared_since_the_restart_keeps_that_zero(restarted):
    restarted.cell.tare(7000.0)
    exchange(restarted.rig, "nothing held")
    restarted.rig.run(0.1)
    assert restarted.zeros == (7000.0, 0.0)


def test_a_grip_of_unknown_force_may_hold_until_the_gripper_answers():
    loop = new_loop()
    Remembered(wrench_zero=Restarted.WRENCH_ZERO).restore(loop)
    assert loop.tool.may_hold()


def test_a_twist_of_a_tool_that_was_exchanged_begins_where_the_wrist_is(restarted):
    rig = restarted.rig
    rig.wrist_rad += 0.2
    exchange(rig, "another width")
    rig.run(0.1)
    started(rig, {"do": "twist", "angles_rad": [0.1], "hold_s": 0.1, "return_to_start": False})
    was_rad = rig.wrist_rad
    rig.run(20)
    assert phase(rig) is ExperimentPhase.DONE
    assert rig.wrist_rad == pytest.approx(was_rad + 0.1, abs=0.01)


def test_a_wrist_that_was_turned_by_hand_keeps_the_angle_of_its_grip(restarted):
    rig, gripped_rad = restarted.rig, restarted.rig.control_loop.tool.grip.origin_rad
    rig.wrist_rad += 0.2
    rig.run(0.1)
    assert rig.control_loop.tool.grip.origin_rad == gripped_rad
    assert restarted.zeros == KEPT


def test_fingers_that_move_at_the_restart_are_judged_once_they_stand(restarted):
    rig = restarted.rig
    exchange(rig, "another request")
    rig.force_n = 0.0
    rig.hand = replace(rig.hand, moving=True)
    rig.run(0.6)
    assert restarted.zeros == KEPT
    next_file = ExperimentFile.model_validate({"name": "next", "steps": [WAIT]})
    assert "the fingers move, and an earlier daemon had gripped" in (rig.control_loop.start(next_file, rig.t_ns) or "")
    rig.force_n = 60.0
    rig.hand = replace(rig.hand, moving=False)
    rig.run(0.1)
    assert restarted.zeros == TAKEN_BACK


def test_a_soft_tool_that_gives_way_slowly_is_the_same(restarted):
    rig = restarted.rig
    rig.width_mm -= SAME_WIDTH_MM - 0.1
    rig.run(0.1)
    assert (restarted.zeros, rig.control_loop.tool.grip.force_n) == (KEPT, 60.0)
    for _ in range(10):
        rig.width_mm -= FOLLOWED_MM + 0.1
        rig.run(0.1)
    assert rig.control_loop.tool.grip.force_n == 60.0
    assert rig.control_loop.tool.grip.width_mm == rig.width_mm


@pytest.mark.parametrize("steps", [[GRIP], [{"do": "release"}, GRIP]])
def test_the_operator_is_warned_before_a_gripper_that_lost_its_power_is_activated(steps, restarted):
    """Its next motion activates it, which opens and closes the fingers."""
    rig = restarted.rig
    rig.force_n = 0.0
    rig.hand = replace(rig.hand, uncertain=True, inactive=True, requested_counts=0)
    rig.run(0.6)
    file = ExperimentFile.model_validate({"name": "next", "steps": steps})
    assert "Before step 1 the gripper is activated" in activation_note(rig.control_loop.operator, file)
    refused = rig.control_loop.start(file, rig.t_ns)
    if len(steps) == 2:
        assert refused.startswith(
            "step 1 (release) opens the gripper, and a tool in it drops; the gripper does not know"
        )
        refused = rig.control_loop.start(file, rig.t_ns, confirmed=True)
        assert refused is None
    else:
        assert "release --yes`, or put a `release` before it" in refused
    assert "it is activated first" in release_question(rig.control_loop.operator)


def test_a_tool_that_was_exchanged_while_the_gripper_was_away_is_another_one(restarted):
    rig = restarted.rig
    rig.run(0.1)
    rig.silent.add("hand")
    rig.run(1)
    exchange(rig, "another width")
    rig.silent.clear()
    rig.run(0.1)
    assert not rig.control_loop.tool.grip.known
    assert FaultCode.GRIP_UNKNOWN.value.kind in restarted.told
    rig.force_n = 0.0
    rig.run(0.1)
    assert FaultCode.GRIP_UNKNOWN.value.kind not in restarted.told
    # Another tool, in a grip of the pendant: it is as unknown as the one before.
    rig.force_n = 60.0
    rig.run(0.1)
    assert FaultCode.GRIP_UNKNOWN.value.kind in restarted.told


async def test_the_load_cells_zero_is_kept_with_the_grip_that_forbids_another_one():
    rig = started(Rig(new_loop()), GRIP, WAIT)
    cell = load_cell()
    memory = memory_of(rig.control_loop, cell)
    cell.tare(8321.5)
    rig.control_loop.on_zero("load_cell")
    rig.run(2)
    await memory.save_present()

    after, calibrated_anew = load_cell(), load_cell(scale_n_per_count=0.002)
    again = memory_of(new_loop(), after)
    memory_of(new_loop(), calibrated_anew)
    assert after.calibration.tare_counts == 8321.5
    assert calibrated_anew.calibration.tare_counts == 8000.0
    # Until the gripper answers, nobody knows of another zero.
    await again.save_present()
    assert read_memory(FILES.state).load_zero == 8321.5

    rig.force_n = 0.0
    stop(rig)
    rig.run(0.6)
    await memory.save_present()
    memory_of(new_loop(), free := load_cell())
    assert free.calibration.tare_counts == 8000.0


async def test_the_wrench_keeps_its_zero_with_the_grip():
    zero = (0.0, 1.0, 0.0, 0.0, 0.0, -0.11)
    rig = started(Rig(new_loop()), GRIP, WAIT)
    before, after, free = UrRobot(SETTINGS), UrRobot(SETTINGS), UrRobot(SETTINGS)
    memory = memory_of(rig.control_loop, robot=before)
    before.restore_wrench_zero(zero)
    rig.run(2)
    await memory.save_present()
    memory_of(new_loop(), robot=after)
    assert after.wrench_zero == zero
    rig.force_n = 0.0
    stop(rig)
    rig.run(0.6)
    await memory.save_present()
    memory_of(new_loop(), robot=free)
    assert free.wrench_zero == (0.0,) * 6


@pytest.mark.parametrize(
    "content",
    [
        *("", "[]", "{}", '{"version": 0, "stop": []}', '{"version": 1, "stop": 3}', "\x00"),
        *('{"version": 1, "wrench_zero": [1, 2, 3, 4, 5]}', '{"version": 1, "wrench_zero": [0, 0, 0, 0, 0, NaN]}'),
        *(
            '{"version": 1, "load_zero": "much"}',
            '{"version": 1, "origin_rad": Infinity}',
            '{"version": 1, "other": 1}',
            '{"version": 1, "stopped_s": NaN}',
            '{"version": 1, "stopped_s": -1, "running": "test"}',
            '{"version": 1, "stopped_s": 1e18, "running": "test"}',
            "[" * 60_000,
        ),
    ],
)
def test_a_state_that_cannot_be_read_counts_as_a_stop(content, tmp_path):
    path = tmp_path / "robot.json"
    path.write_text(content)
    remembered = read_memory(path)
    ((code, detail),) = remembered.stop
    assert code == "DAEMON_ENDED"
    assert str(path) in detail
    (fault,) = remembered.faults
    assert fault.code is FaultCode.DAEMON_ENDED


def test_a_pipe_in_the_place_of_the_state_counts_as_a_stop_and_keeps_nobody_waiting(tmp_path):
    path = tmp_path / "robot.json"
    os.mkfifo(path)
    assert "it is a device or a pipe" in read_memory(path).stop[0][1]
    with pytest.raises(OSError, match="a device or a pipe"):
        write_memory(path, Remembered())


def test_a_fault_of_another_version_is_a_stop_all_the_same():
    loop = new_loop()
    Remembered(stop=(("NO_SUCH_FAULT", "it was hot"),)).restore(loop)
    assert loop.safety.waiting.faults == (Fault(FaultCode.DAEMON_ENDED, "it was hot"),)


async def test_nothing_starts_where_a_stop_could_not_be_remembered(tmp_path, monkeypatch):
    memory = memory_of(new_loop())
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "file"))
    assert "cannot be kept" in (await memory.begins("test") or "")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    assert await memory.begins("test") is None
    assert json.loads(FILES.state.read_text())["running"] == "test"


async def test_an_experiment_that_begins_stays_on_the_disk_until_the_loop_has_it(monkeypatch):
    memory = memory_of(new_loop())
    assert await memory.begins("test") is None
    saved: list[Remembered] = []
    twice = asyncio.Event()
    save = memory.save

    async def note(state: Remembered) -> None:
        await save(state)
        saved.append(state)
        if len(saved) == 2:
            twice.set()

    monkeypatch.setattr(RigMemory, "save", lambda _, state: note(state))
    monkeypatch.setattr("shearloop.daemon.rig_memory.FOLLOWS_S", 0.0)
    following = asyncio.create_task(memory.run())
    await twice.wait()
    following.cancel()
    await asyncio.gather(following, return_exceptions=True)
    assert read_memory(FILES.state).running == "test"


def test_an_unknown_grip_is_still_unknown_after_a_restart():
    rig = Rig(new_loop())
    rig.force_n, rig.width_mm = 60.0, 30.0
    rig.run(0.1)
    # A turn gives it an angle, which is remembered.
    started(rig, {"do": "twist", "angles_rad": [0.05], "hold_s": 0.1}, torque_source="load_cell")
    rig.run(20)
    rig.run(0.1)
    assert Remembered.of(rig.control_loop).origin_rad is not None
    for one in (rig, after_restart(rig)):
        faults = [fault.sentence for fault in one.control_loop.status.decision.faults]
        said = "the gripper holds something in a grip that is not known: no experiment of this rig has closed"
        assert any(sentence.startswith(said) for sentence in faults)


def why_no_turn(rig: Rig) -> str:
    """Return why a twist by the load cell cannot start."""
    content = {"name": "one", "torque_source": "load_cell", "steps": [{"do": "twist", "angles_rad": [0.1]}]}
    said = rig.control_loop.start(ExperimentFile.model_validate(content), rig.t_ns) or ""
    rig.control_loop.stop(Fault(FaultCode.OPERATOR_STOP, ""))
    rig.control_loop.acknowledge()
    return said


async def restarted_with_a_tool(*, tared: bool) -> tuple[Rig, LoadCell, RigMemory]:
    """Return a rig whose tool the pendant gripped before the daemon was restarted; the gripper is not heard yet."""
    before, cell = Rig(new_loop(needs_zero=True)), load_cell()
    if tared:
        cell.tare(8321.5)
        before.control_loop.on_zero("load_cell")
    before.force_n = 60.0
    before.run(0.6)
    await memory_of(before.control_loop, cell).save_present()
    after, cell = Rig(new_loop(needs_zero=True)), load_cell()
    return after, cell, memory_of(after.control_loop, cell)


@pytest.mark.parametrize("tared", [False, True])
async def test_only_a_zero_that_somebody_took_is_known_after_a_restart(tared):
    """The pendant has gripped the tool: a zero that is the calibration's own is none of this rig's."""
    after, cell, memory = await restarted_with_a_tool(tared=tared)
    # Until the fingers rest, nobody knows whether it is the same grip.
    after.hand, still = replace(after.hand, moving=True), after.hand
    after.run(0.6)
    assert "no zero of the load_cell" in why_no_turn(after)
    await memory.save_present()
    after.hand, after.force_n = still, 60.0
    after.run(0.1)
    assert (why_no_turn(after) == "") is tared
    assert cell.calibration.tare_counts == (8321.5 if tared else 8000.0)


@pytest.mark.parametrize("befalls", ["nothing", "unplugged", "asked for again"])
async def test_a_restored_zero_that_was_lost_since_is_none(befalls):
    after, _, memory = await restarted_with_a_tool(tared=True)
    if befalls == "unplugged":
        after.control_loop.on_link("load_cell", "it was unplugged", up=False)
        after.control_loop.on_link("load_cell", "", up=True)
    elif befalls == "asked for again":
        after.control_loop.on_zero("load_cell", known=False)
    after.force_n = 60.0
    after.run(0.6)
    assert (why_no_turn(after) == "") is (befalls == "nothing")
    await memory.save_present()
    assert (read_memory(FILES.state).load_zero == 8321.5) is (befalls == "nothing")


async def test_a_zero_of_the_wrench_that_goes_with_the_robots_process_is_logged_once_and_named_after_a_restart(logged):
    lost = "the zero of the wrench is lost with the connection to the robot, or with the process that drives it"
    before = Rig(ControlLoop(CONFIG, {"right": EIT, "wrench": wrench_source(125.0)}, ("gripper", "right")))
    before.control_loop.on_zero("wrench")
    before.force_n = 60.0
    before.run(0.6)
    memory = memory_of(before.control_loop, robot=UrRobot(SETTINGS))
    await memory.save_present()
    assert not [line for line in logged if lost in line["event"]]
    before.control_loop.on_link("robot", "its process was killed", up=False)
    before.control_loop.on_link("robot", "", up=True)
    for _ in range(2):
        await memory.save_present()
    assert len([line for line in logged if lost in line["event"]]) == 1
    after = Rig(ControlLoop(CONFIG, {"right": EIT, "wrench": wrench_source(125.0)}, ("gripper", "right")))
    memory_of(after.control_loop, robot=UrRobot(SETTINGS))
    after.force_n = 60.0
    after.run(0.6)
    (unknown,) = (line for line in logged if "the wrench has no known zero" in line["event"])
    assert "the connection to the robot or its process was lost" in unknown["reason"]


async def test_only_a_wrench_that_somebody_tared_has_a_known_zero_after_a_restart():
    for tared in (False, True):
        before = Rig(ControlLoop(CONFIG, {"right": EIT, "wrench": wrench_source(125.0)}, ("gripper", "right")))
        if tared:
            before.control_loop.on_zero("wrench")
        before.force_n = 60.0
        before.run(0.6)
        robot = UrRobot(SETTINGS)
        robot.restore_wrench_zero((0.0, 1.0, 0.0, 0.0, 0.0, -0.11))
        await memory_of(before.control_loop, robot=robot).save_present()
        after = Rig(ControlLoop(CONFIG, {"right": EIT, "wrench": wrench_source(125.0)}, ("gripper", "right")))
        again = UrRobot(SETTINGS)
        memory_of(after.control_loop, robot=again)
        after.force_n = 60.0
        after.run(0.6)
        assert again.wrench_zero[5] == -0.11, "what it reads goes on as before"
        assert after.control_loop.has_zero("wrench") is tared


async def test_no_zero_is_taken_before_the_gripper_shows_what_it_holds():
    """Not even a confirmed one: an earlier daemon knows of a tool."""
    before = started(Rig(new_loop()), GRIP, WAIT)
    before.run(2)
    await memory_of(before.control_loop).save_present()
    after = Rig(new_loop())
    memory_of(after.control_loop)
    after.silent.add("hand")
    after.run(0.6)
    assert "the gripper has not answered yet" in (after.control_loop.operator.tare_refusal(confirmed=True) or "")
    # A stop keeps the daemon: without it, no command opens the fingers.
    assert "an earlier daemon had gripped a tool" in (after.control_loop.tool.gripped_tool or "")
    after.silent.clear()
    after.run(0.1)
    assert after.control_loop.tool.gripped_tool is None
    assert after.control_loop.operator.tare_refusal(confirmed=True) is None, "it holds nothing"


async def test_a_daemon_that_is_killed_while_a_program_starts_leaves_no_zero_of_the_wrench():
    """The controller zeroes it with the load as the program starts, and the worker answers later."""
    before = Rig(ControlLoop(CONFIG, {"right": EIT, "wrench": wrench_source(125.0)}, ("gripper", "right")))
    before.control_loop.on_zero("wrench")
    before.force_n = 60.0
    before.run(0.6)
    robot, ready = UrRobot(SETTINGS), HandlerBench().state
    memory = memory_of(before.control_loop, robot=robot)
    for recovering, program_running, blocked, tared in (
        (False, True, "", True),
        (True, False, BEING_MADE_READY, False),
        # A start that was given up; the program may have begun, and its state plays for a while.
        (False, False, NOT_OURS, False),
        (True, True, BEING_MADE_READY, False),
        (False, True, NOT_OURS, False),
        (False, True, "", True),
    ):
        runtime_state = 2 if program_running else 1
        state = replace(ready, recovering=recovering, runtime_state=runtime_state, blocked=blocked)
        robot.handle_message(0, state)
        await memory.save_present()
        assert read_memories(FILES).wrench_tared is tared


def test_an_unfelt_grip_is_another_one_after_another_request():
    """A grip that felt nothing has no width to compare."""
    grip = Grip(0.3, 60.0).followed(
        GripperStatus(0, 30.0, holding=False, moving=False, unfelt=True, requested_counts=140)
    )
    assert (grip.width_mm, grip.requested_counts) == (None, 140)
    same = GripperStatus(1, 30.0, holding=False, moving=False, unfelt=True, requested_counts=140)
    assert grip.why_another(same) == ""
    assert "it was asked for the position 60 since then" in grip.why_another(replace(same, requested_counts=60))
    felt = replace(grip, width_mm=30.0).followed(replace(same, width_mm=28.0))
    assert felt.width_mm == 28.0
    assert "its fingers are 80.0 mm apart" in felt.why_another(replace(same, width_mm=80.0))
    assert NO_GRIP.followed(same) == NO_GRIP, "fingers that stand somewhere are no grip"


async def test_a_write_that_is_cut_off_is_no_other_programs_for_the_next_one(monkeypatch):
    """A stop in the middle of the write of a new grip."""
    begun, may_end = threading.Event(), threading.Event()
    write = rig_memory.write_memory

    def slowly(*arguments: Any) -> None:
        begun.set()
        may_end.wait(DEADLINE_S)
        write(*arguments)

    memory = memory_of(new_loop())
    monkeypatch.setattr(rig_memory, "write_memory", slowly)
    first = asyncio.create_task(memory.save(Remembered(running="one")))
    await asyncio.to_thread(begun.wait, DEADLINE_S)
    first.cancel()
    await asyncio.gather(first, return_exceptions=True)
    second = asyncio.create_task(memory.save(Remembered()))
    await asyncio.sleep(0)
    may_end.set()
    await second
    assert memory.error == ""
    assert read_memory(FILES.state) == Remembered()
