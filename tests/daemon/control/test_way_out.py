"""The way out: a gripped tool can be released by an explicit command; and nothing is tared, or torn, that is held."""

import asyncio
import os
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from benchmarks.call_counts import loaded_by_run
from shearloop.daemon.commands import Commands
from shearloop.daemon.control.control_loop import ControlLoop
from shearloop.daemon.control.experiment import ExperimentPhase, TrackTorque
from shearloop.daemon.control.experiment_check import check_steps
from shearloop.daemon.control.experiment_schema import ExperimentFile
from shearloop.daemon.control.faults import Fault, FaultCode
from shearloop.daemon.control.loop_runner import UNSEEN_S
from shearloop.daemon.control.operator_view import release_question
from shearloop.daemon.control.plan import plan_of
from shearloop.daemon.control.state_publisher import loop_state
from shearloop.daemon.control.wrench import wrench_source
from shearloop.daemon.experiment_files import ReadExperiment
from shearloop.daemon.loop_config import LoopConfig
from shearloop.daemon.messaging.command_server import CommandRefusedError
from shearloop.daemon.messaging.stop_client import nothing_moved
from shearloop.daemon.operator_questions import held_note
from shearloop.daemon.rig import Rig as RigOfDaemon
from shearloop.daemon.rig_memory import NoMemory
from shearloop.daemon.running_rig import RunningRig
from shearloop.daemon.torques import LARGEST_DRIFT_NM, WRENCH, TorqueSample
from shearloop.drivers.errors import DriverError
from shearloop.drivers.robotiq.models import MODELS
from shearloop.estimation import Measured
from tests.daemon.control.cell import TWIST, Cell, driven, experiment
from tests.daemon.control.loop_rig import CONFIG, EIT, GRIP, LOAD, Rig, new_loop, phase, started, stop
from tests.drivers.ur.handler_bench import CYCLE_NS, SETTINGS
from tests.fixtures.daemons import bound_handlers, of_now

WAIT = {"do": "wait", "wait_s": 60}
TURN = {"do": "twist", "angles_rad": [0.1]}
RUNNING_RIG = RunningRig(instance="a1")
THIS_DAEMON = {"process": os.getpid(), "instance": "a1"}


@asynccontextmanager
async def with_gripper(*steps: dict[str, Any]) -> AsyncIterator[Cell]:
    loop = ControlLoop(LoopConfig(), {WRENCH: wrench_source(SETTINGS.rate_hz)}, ("robot", "gripper"))
    async with driven(cell=Cell(loop)) as cell:
        if steps:
            await cell.start(*steps)
        yield cell


async def released(cell: Cell) -> str | None:
    releasing = asyncio.create_task(cell.runner.release())
    while not releasing.done():
        await cell.cycles(1)
    return releasing.result()


def emergency_stop(cell: Cell) -> None:
    cell.robot.bench.arm.be(safety_mode=7, robot_mode=3)


@pytest.mark.parametrize(
    "befalls", [None, emergency_stop, Cell.exceed_torque, lambda cell: cell.runner.stop(also_idle=True)]
)
async def test_a_tool_is_released_after_any_stop_and_without_an_experiment(befalls):
    async with with_gripper() as cell:
        if befalls is not None:
            befalls(cell)
        await cell.cycles(10)
        assert "its fingers hold something 30.0 mm wide, with an unknown force" in release_question(
            cell.control_loop.operator
        )
        assert await released(cell) is None
        assert cell.gripper.asked == ["open"]


@pytest.mark.long
async def test_a_way_out_loads_nothing_that_an_upgrade_in_place_has_replaced(monkeypatch):
    with_the_rig = set(loaded_by_run(robot=True).modules)
    for name in list(sys.modules):
        if name.startswith("shearloop.") and name not in with_the_rig and not name.startswith("shearloop.emulators"):
            # An import of it fails.
            monkeypatch.setitem(sys.modules, name, None)
    async with with_gripper() as cell:
        commands = commands_of(cell)
        cell.runner.stop(also_idle=True)
        await cell.cycles(3)
        assert await unlocked(cell, commands["unlock"]) == {}
        asked = await commands["release"]({"ask": True})
        answered = asyncio.create_task(commands["release"]({"confirmed": True, "digest": asked["digest"]}))
        await cell.cycles(10)
        assert await answered == {}
        assert cell.gripper.asked == ["open"]


async def test_a_release_whose_question_has_changed_opens_nothing():
    """The gripper closes on a tool between the question and its answer."""
    async with with_gripper() as cell:
        cell.holding = False
        await cell.cycles(5)
        release = commands_of(cell)["release"]
        asked = await release({"ask": True})
        assert "the gripper reports no object, and its fingers are 140 mm apart" in asked["question"]
        cell.holding = True
        await cell.cycles(5)
        with pytest.raises(CommandRefusedError, match=r"changed since the question.* hold something") as refused:
            await release({"confirmed": True, "digest": asked["digest"]})
        assert cell.gripper.asked == []
        answered = asyncio.create_task(release({"confirmed": True, "digest": refused.value.facts["digest"]}))
        await cell.cycles(10)
        assert await answered == {}
        assert cell.gripper.asked == ["open"]


@pytest.mark.parametrize("exchanged", [{"others_requests": 2}, {"requested_counts": 120}])
async def test_a_release_of_another_tool_than_the_one_in_the_question_opens_nothing(exchanged):
    async with with_gripper() as cell:
        cell.hand = {"holding": True}
        await cell.cycles(5)
        release = commands_of(cell)["release"]
        asked = await release({"ask": True})
        cell.hand = {"holding": True, **exchanged}
        await cell.cycles(5)
        with pytest.raises(CommandRefusedError, match="changed since the question"):
            await release({"confirmed": True, "digest": asked["digest"]})
        assert cell.gripper.asked == []


@pytest.mark.parametrize("between", ["an operator's stop", "a stop by a fault", "another process"])
async def test_a_release_of_another_moment_than_its_question_opens_nothing(between):
    async with with_gripper() as cell:
        cell.hand = {"holding": True}
        await cell.cycles(5)
        asking = commands_of(cell)["release"]
        asked = await asking({"ask": True})
        if between == "an operator's stop":
            cell.runner.stop(also_idle=True)
        elif between == "a stop by a fault":
            cell.control_loop.safety.stop(Fault(FaultCode.PROTECTIVE_STOP, "it met something"))
        await cell.cycles(5)
        cell.control_loop.acknowledge()
        answering = commands_of(cell, "b2")["release"] if between == "another process" else asking
        with pytest.raises(CommandRefusedError, match="changed since the question") as refused:
            await answering({"confirmed": True, "digest": asked["digest"]})
        assert cell.gripper.asked == []
        # The question that comes with the refusal can be confirmed at once.
        answered = asyncio.create_task(answering({"confirmed": True, "digest": refused.value.facts["digest"]}))
        await cell.cycles(10)
        assert await answered == {}


def rig_of(cell: Cell, files: Any = None, instance: str = "a1") -> RigOfDaemon:
    return RigOfDaemon(
        cell.control_loop, cell.runner, {}, files, None, instance, memory=NoMemory(), commissioning=SimpleNamespace()
    )


def commands_of(cell: Cell, instance: str = "a1") -> Any:
    return commands_with(rig_of(cell, instance=instance))


def commands_with(rig: RigOfDaemon, sensors: dict[str, Any] | None = None) -> Any:
    health = SimpleNamespace(tasks=dict)
    sensed = SimpleNamespace(tareable=sensors)
    return bound_handlers(
        Commands(rig, sensed, None, health, asyncio.Event(), rig.tare_refusal, running_rig=RUNNING_RIG)
    )


@pytest.mark.parametrize("hand", [{"holding": True}, {"uncertain": True}, {"unfelt": True}, {"moving": True}])
@pytest.mark.parametrize("befalls", [None, emergency_stop])
async def test_an_unlock_that_would_drop_a_tool_asks_before_anything_is_unlocked(hand, befalls):
    async with with_gripper() as cell:
        cell.hand = {"holding": False, "fault": "The motor drew too much current.", **hand}
        if befalls is not None:
            befalls(cell)
        await cell.cycles(10)
        unlock, sent = commands_of(cell)["unlock"], len(cell.robot.commands)
        with pytest.raises(
            CommandRefusedError, match=r"a tool in it drops; .* 30\.0 mm .*`shearloop command unlock --yes`"
        ) as refused:
            await unlock({})
        assert "Unlock? After its fault" in refused.value.facts["question"]
        with pytest.raises(CommandRefusedError, match="changed since the question"):
            await unlock({"confirmed": True, "digest": "of another question"})
        assert (len(cell.robot.commands), cell.gripper.asked) == (sent, [])
        cell.robot.bench.arm.be(safety_mode=1, robot_mode=7)
        answered = asyncio.create_task(unlock({"confirmed": True, "digest": refused.value.facts["digest"]}))
        while not answered.done():
            await cell.cycles(1)
        assert answered.result() == {}
        assert cell.gripper.asked == ["activate"]


@pytest.mark.parametrize("hand", [{"holding": True}, {"holding": False, "fault": "The motor drew too much current."}])
async def test_an_unlock_that_drops_nothing_asks_nothing(hand):
    async with with_gripper() as cell:
        cell.hand = hand
        await cell.cycles(10)
        answered = asyncio.create_task(commands_of(cell)["unlock"]({}))
        while not answered.done():
            await cell.cycles(1)
        assert answered.result() == {}


async def unlocked(cell: Cell, unlock: Any, **arguments: Any) -> dict[str, Any]:
    answered = asyncio.create_task(unlock(arguments))
    while not answered.done():
        await cell.cycles(1)
    return answered.result()


async def test_an_unlock_acknowledges_the_stop_that_was_shown_and_no_other():
    """A second person presses STOP just before the unlock of the first one arrives, and a third one after that."""
    async with with_gripper() as cell:
        rig = rig_of(cell)
        unlock = commands_with(rig)["unlock"]
        cell.runner.stop(also_idle=True)
        await cell.cycles(3)
        shown = rig.state()
        assert (shown["stop"], shown["stop_causes"]) == (1, "the operator stopped it: nothing was under way")
        cell.runner.stop(also_idle=True)
        sent = len(cell.robot.commands)
        with pytest.raises(
            CommandRefusedError, match="the stop that waits is not the one that was shown: the oper"
        ) as one:
            await unlocked(cell, unlock, stop=shown["stop"])
        assert one.value.facts["question"].startswith("Unlock? The stop that waits is not the one that was shown: the")
        cell.runner.stop(also_idle=True)
        with pytest.raises(CommandRefusedError, match="the stop that waits is not the one") as two:
            await unlocked(cell, unlock, stop=shown["stop"], digest=one.value.facts["digest"])
        assert (cell.control_loop.safety.stop_number, len(cell.robot.commands)) == (3, sent)
        # The question that comes with the refusal can be confirmed at once.
        digest = two.value.facts["digest"]
        assert await unlocked(cell, unlock, stop=shown["stop"], digest=digest, confirmed=True) == {}
        assert cell.control_loop.safety.waiting is None


@pytest.mark.parametrize("named", [{}, {"stop": 1}])
async def test_an_unlock_of_the_stop_that_waits_or_of_whatever_waits_asks_nothing(named):
    async with with_gripper() as cell:
        cell.runner.stop(also_idle=True)
        await cell.cycles(3)
        assert await unlocked(cell, commands_of(cell)["unlock"], **named) == {}
        assert cell.control_loop.safety.waiting is None
        # Another person has acknowledged it meanwhile.
        assert await unlocked(cell, commands_of(cell)["unlock"], stop=1) == {}


async def test_a_stop_during_an_unlocking_is_not_acknowledged_by_it():
    async with with_gripper() as cell:
        cell.runner.stop(also_idle=True)
        await cell.cycles(3)
        cell.gripper.there.clear()
        unlocking = asyncio.create_task(commands_of(cell)["unlock"]({"stop": 1}))
        await cell.cycles(5)
        emergency_stop(cell)
        await cell.cycles(5)
        cell.gripper.there.set()
        await cell.cycles(3)
        with pytest.raises(CommandRefusedError, match=r"but there was another stop; .* emergency stop is pressed"):
            await unlocking
        assert cell.control_loop.safety.stop_number == 2


async def test_no_release_while_the_wrist_moves_or_an_experiment_runs():
    async with with_gripper({**TWIST, "angles_rad": [3.0]}) as cell:
        await cell.cycles(60)
        assert cell.state.motion != "idle"
        assert "is moving" in (cell.runner.release_refusal() or "")
        cell.runner.stop()
        while cell.state.motion != "idle" or not cell.state.rests:
            assert "is moving" in (await released(cell) or "")
            await cell.cycles(1)
        await cell.cycles(5)
        assert await released(cell) is None
    async with with_gripper(WAIT) as cell:
        assert await released(cell) == "the experiment 'test' is running; stop it first"
        assert cell.gripper.asked == []


async def test_a_stop_ends_a_release_and_halts_the_fingers():
    async with with_gripper() as cell:
        cell.gripper.there.clear()
        releasing = asyncio.create_task(cell.runner.release())
        await cell.cycles(5)
        assert "wait for the end" in (await cell.runner.start(experiment(WAIT)) or "")
        assert cell.runner.stop() == "release"
        await cell.cycles(5)
        assert await releasing == "the release was stopped; send `release` again"
        assert cell.gripper.asked == ["open", "halt"]


async def test_a_release_that_failed_says_why():
    async with with_gripper() as cell:
        cell.gripper.error = DriverError("the gripper does not answer")
        assert await released(cell) == "the gripper does not answer"


def held(**sense: bool) -> Rig:
    rig = Rig(new_loop())
    rig.hand, rig.force_n = replace(rig.hand, **sense), 0.0 if sense else 60.0
    rig.run(0.6)
    return rig


def test_no_tare_while_something_is_held():
    rig = held()
    refusal = rig.control_loop.operator.tare_refusal(confirmed=True) or ""
    assert "its fingers hold something" in refusal
    assert "shearloop command release" in refusal


@pytest.mark.parametrize("gripped", [True, False])
def test_after_a_grip_fingers_that_were_halted_may_still_hold_the_tool(gripped):
    rig = started(Rig(new_loop()), *[GRIP] * gripped, WAIT)
    rig.run(3)
    stop(rig)
    rig.force_n, rig.hand = 0.0, replace(rig.hand, uncertain=True)
    rig.run(0.6)
    said = rig.control_loop.tool.gripped_tool
    assert ("does not know whether it holds a tool" in said) if gripped else said is None


@pytest.mark.parametrize(
    ("before", "step", "said"),
    [
        ((), {"do": "release"}, None),
        ((), {**GRIP, "expect_object": False}, FaultCode.TOOL_MAY_BE_GRIPPED),
        ((GRIP,), {"do": "release"}, FaultCode.TOOL_MAY_BE_GRIPPED),
    ],
)
def test_a_stop_on_the_way_of_the_fingers_says_what_may_be_in_them(before, step, said):
    """Fingers that held nothing as they began to open cannot have gripped a tool."""
    rig = started(Rig(new_loop()), *before, step, WAIT)
    while not rig.pending or len(rig.begun) <= len(before):
        rig.step()
    rig.hand, rig.force_n = replace(rig.hand, moving=True), 0.0
    rig.step()
    stop(rig)
    rig.hand = replace(rig.hand, moving=False, uncertain=True)
    rig.run(0.1)
    rig.step()
    codes = {fault.code for fault in rig.control_loop.status.decision.reported}
    assert codes & {FaultCode.TOOL_GRIPPED, FaultCode.TOOL_MAY_BE_GRIPPED} == ({said} if said else set())


@pytest.mark.parametrize("sense", [{"uncertain": True}, {"unfelt": True}, {"moving": True}])
def test_a_tare_with_an_uncertain_gripper_has_to_be_confirmed(sense):
    rig = held(**sense)
    refusal = rig.control_loop.operator.tare_refusal() or ""
    assert "does not know whether it holds a tool" in refusal
    assert "`shearloop command release --yes`" in refusal
    assert "tare again" not in refusal, "no load is the cause"
    assert rig.control_loop.operator.tare_refusal(confirmed=True) is None


@pytest.mark.parametrize(("torque_nm", "refused"), [(2 * LARGEST_DRIFT_NM, True), (0.5 * LARGEST_DRIFT_NM, False)])
def test_a_tare_under_load_has_to_be_confirmed(torque_nm, refused):
    loop = ControlLoop(LoopConfig(), {"load_cell": LOAD}, ("robot",))
    loop.on_torque(TorqueSample("load_cell", torque_nm, "", 0, 0))
    assert ("load_cell measures +0.100 N·m" in (loop.operator.tare_refusal() or "")) is refused
    assert loop.operator.tare_refusal(confirmed=True) is None


def test_a_load_that_is_too_large_for_a_torque_becomes_no_zero_by_a_step_or_a_command():
    loop = ControlLoop(LoopConfig(), {"load_cell": LOAD}, ("robot",))
    loop.on_torque(TorqueSample("load_cell", None, "it is saturated", 0, 0, load="its range has ended"))
    loaded = "load_cell is loaded: its range has ended, which would become the zero; take the load off"
    assert loop.operator.why_no_tare_step().startswith(loaded)
    assert loop.operator.tare_refusal().startswith(loaded)
    assert loop.operator.tare_refusal(confirmed=True) is None


@pytest.mark.parametrize("load", [{"torque_nm": 0.1}, {"torque_nm": None, "loading": "+0.30 N"}])
@pytest.mark.parametrize("no_zero", ["", "its range has ended"])
def test_a_confirmation_is_advised_only_where_the_load_may_be_drift(load, no_zero):
    """A confirmed tare gives up the good zero, and under such a load there is no new one."""
    loop = ControlLoop(LoopConfig(), {"load_cell": LOAD}, ("robot",))
    loop.on_torque(TorqueSample("skin", reason="", t_mid_ns=0, t_ns=0, load=no_zero, **load))
    measured = "skin measures +0.100 N·m" if load["torque_nm"] else "skin measures +0.30 N"
    for refusal in (loop.operator.why_no_tare_step(), loop.operator.tare_refusal()):
        assert refusal.startswith(f"{measured}, which would become the zero; take the load off")
        assert ("--yes" in refusal) is (not no_zero)


def test_a_running_experiment_refuses_a_tare():
    rig = started(Rig(new_loop()), WAIT)
    assert "is running" in (rig.control_loop.operator.tare_refusal(confirmed=True) or "")


def test_a_tare_step_with_a_held_tool_is_refused():
    file = ExperimentFile.model_validate({"name": "test", "steps": [GRIP, {"do": "tare"}]})
    assert "tare would make the gripped tool's torque the zero" in dict(check_steps(file))["steps", 1]
    rig = held()
    started(rig, {"do": "tare"})
    rig.run(1)
    assert phase(rig) is ExperimentPhase.STOPPED
    assert "step 1 (tare) cannot be done: its fingers hold" in rig.control_loop.experiment.stop_reason
    assert rig.begun == []


async def test_no_start_while_a_zero_is_taken():
    """Its first step could grip a tool, whose torque becomes the zero."""
    async with with_gripper() as cell:
        cell.sensors |= {name: SimpleNamespace(taring=name == "right") for name in ("load_cell", "right")}
        refusal = "a zero is being taken (right), with nothing gripped; start again when it is done"
        assert cell.runner.start_refusal() == refusal
        cell.sensors["right"].taring = False
        assert cell.runner.start_refusal() is None
        # A step of the experiment that runs takes one too.
        await cell.start(WAIT)
        cell.sensors["right"].taring = True
        assert cell.runner.start_refusal() == "the experiment 'test' is running; stop it first"


async def test_a_full_disk_is_said_before_the_start():
    async with with_gripper() as cell:
        cell.control_loop.on_recording_error("/data: No space left on device")
        assert "No space left on device" in (cell.runner.start_refusal() or "")
        cell.control_loop.on_recording_error("")
        assert cell.runner.start_refusal() is None


class Tared:
    """A sensor whose zero takes long."""

    taring = False

    def tare(self, **_: bool) -> None:
        self.taring = True


class OneFile:
    """The experiments of a rig, of which one is read once the test lets it."""

    gripper = robot = None

    def __init__(self) -> None:
        self.asked, self.answers = asyncio.Event(), asyncio.Event()

    async def read(self, path: Path) -> ReadExperiment:
        self.asked.set()
        await self.answers.wait()
        return ReadExperiment(path, experiment({"do": "grip", "width_mm": 10.0}, WAIT), b"grip")


async def test_no_zero_is_taken_while_an_experiment_starts():
    """The file of the start is read and the arm is enabled for seconds; its first step could grip a tool."""
    async with with_gripper() as cell:
        cell.holding = False
        await cell.cycles(5)
        files, cell.sensors["load_cell"] = OneFile(), Tared()
        commands = commands_with(rig_of(cell, files), cell.sensors)
        starting = asyncio.create_task(commands["start"]({"experiment": "/rig/grip.yaml"}))
        await files.asked.wait()
        for confirmed in (False, True):
            with pytest.raises(CommandRefusedError, match=r"grip\.yaml is being started; wait until it has begun"):
                await commands["tare"]({"confirmed": confirmed})
        files.answers.set()
        while not starting.done():
            await cell.cycles(1)
        assert starting.result() == {"experiment": "/rig/grip.yaml", "run": 1}
        assert not cell.sensors["load_cell"].taring


async def test_no_experiment_begins_while_a_zero_is_taken_that_came_during_its_start():
    async with with_gripper() as cell:
        cell.holding = False
        cell.sensors["load_cell"] = Tared()
        await cell.cycles(5)
        starting = asyncio.create_task(cell.runner.start(experiment({"do": "grip", "width_mm": 10.0}, WAIT)))
        # The arm is being enabled.
        await asyncio.sleep(0)
        cell.sensors["load_cell"].tare()
        await cell.cycles(10)
        assert "a zero is being taken (load_cell)" in (starting.result() or "")
        assert (cell.control_loop.running_experiment, cell.gripper.asked) == (None, [])


class OnLever(Rig):
    """A rig where something leans on the load cell's lever, and on nothing else."""

    lever_nm = 0.0

    def sense(self, torque_nm: float) -> None:
        # The fingertip's torque is of the gel.
        super().sense(torque_nm + self.lever_nm)


def test_a_tare_step_under_load_is_refused():
    rig = OnLever(new_loop())
    rig.lever_nm = 0.074
    started(rig, {"do": "tare"}, GRIP, {"do": "hold_torque", "torque_nm": 0.06, "hold_s": 1.0})
    rig.run(1)
    assert phase(rig) is ExperimentPhase.STOPPED
    reason = rig.control_loop.experiment.stop_reason
    assert "step 1 (tare) cannot be done: load_cell measures +0.07" in reason
    assert "which would become the zero; take the load off" in reason
    assert rig.begun == []
    # The same rig without it.
    rig.lever_nm = 0.0
    rig.control_loop.acknowledge()
    started(rig, {"do": "tare"})
    rig.run(2)
    assert phase(rig) is ExperimentPhase.DONE


@pytest.mark.parametrize("from_s", [0.0, 2.5])
def test_no_torque_is_done_while_fingertip_and_load_cell_disagree(from_s):
    """A load that came after the tare, before or in the step: the loop holds, and then stops; it never says done."""
    config = LoopConfig(disagreement_nm=0.1, max_innovation_nm=1.0)
    loop = ControlLoop(config, {"right": EIT, "load_cell": LOAD}, ("gripper", "right"))
    rig = OnLever(loop, noise_nm=0.001)
    hold = {"do": "hold_torque", "torque_nm": 0.06, "hold_s": 3.0}
    started(rig, GRIP, {"do": "identify"}, hold, torque_source="load_cell")
    while loop.experiment.running and not isinstance(loop.experiment.command.wrist, TrackTorque):
        rig.step()
    assert loop.experiment.running, loop.experiment.stop_reason
    rig.run(from_s)
    rig.lever_nm = -0.2
    rig.run(200)
    assert phase(rig) is ExperimentPhase.STOPPED
    assert FaultCode.TORQUES_DISAGREE in [fault.code for fault in loop.safety.waiting.faults]


def test_the_angle_since_the_grip_belongs_to_the_grip():
    """Each start counted anew: three runs turned the tool by three times the limit."""
    rig = started(Rig(new_loop()), GRIP, WAIT)
    rig.run(2)
    gripped_rad = rig.wrist_rad
    stop(rig)
    rig.wrist_rad += 0.5
    rig.run(0.1)
    rig.control_loop.acknowledge()
    started(rig, WAIT, limits={"angle_rad": 0.3})
    rig.run(0.1)
    turned = f"turned by {rig.wrist_rad - gripped_rad:+.3f} rad since the grip, the limit is 0.3 rad"
    assert turned in rig.control_loop.experiment.stop_reason
    rig.step()
    assert rig.control_loop.status.decision.reasons[-1].startswith(f"{FaultCode.TOOL_GRIPPED.value.kind}: its fingers")


def test_a_new_grip_has_an_angle_of_its_own():
    rig = started(Rig(new_loop()), GRIP, {"do": "release"})
    rig.meets = False
    rig.run(10)
    assert phase(rig) is ExperimentPhase.DONE
    rig.force_n = 0.0
    rig.run(0.1)
    rig.wrist_rad += 0.5
    rig.run(0.1)
    started(rig, {"do": "release"}, GRIP, {"do": "wait", "wait_s": 1}, limits={"angle_rad": 0.3})
    rig.run(20)
    assert phase(rig) is ExperimentPhase.DONE, rig.control_loop.experiment.stop_reason


def test_the_question_before_a_turn_says_what_is_held():
    rig = held()
    twist = {"do": "twist", "angles_rad": [0.1]}
    file, after_release = (
        ExperimentFile.model_validate({"name": "test", "steps": steps})
        for steps in ([twist], [{"do": "release"}, twist])
    )
    note = held_note(rig.control_loop.operator, file)
    assert note.startswith(
        " At present its fingers hold something 140.0 mm wide, with an unknown force. The grip is not"
    )
    assert note.endswith("its angle counts from the start.")
    drops = (
        " Step 1 (release) opens the gripper, and a tool in it drops; its fingers hold something 140.0 mm wide, with an"
    )
    assert held_note(rig.control_loop.operator, after_release).startswith(drops)
    rig.force_n = 0.0
    rig.step()
    assert held_note(rig.control_loop.operator, file) == ""


OPENS = "(release) opens the gripper, and a tool in it drops; "


def grip_to(width_mm: float) -> dict[str, Any]:
    return {"do": "grip", "width_mm": width_mm}


@pytest.mark.parametrize(
    ("sense", "steps", "said"),
    [
        ({}, [{"do": "release"}], f"step 1 {OPENS}its fingers hold something 30.0 mm wide, with an unknown force"),
        ({}, [WAIT, {"do": "release"}], f"step 2 {OPENS}"),
        # The held tool is in the tighter grip too.
        ({}, [GRIP, TURN, {"do": "release"}], f"step 3 {OPENS}"),
        ({"uncertain": True}, [{"do": "release"}], f"step 1 {OPENS}the gripper does not know whether it holds a tool"),
        # The gripper's task refuses a grip that would open the fingers: no grip drops a tool.
        ({}, [grip_to(20.0), grip_to(15.0), grip_to(20.0)], None),
        ({"uncertain": True}, [grip_to(20.0), WAIT, grip_to(20.0), grip_to(10.0)], None),
        ({"uncertain": True}, [GRIP, WAIT], None),
        ({}, [GRIP, TURN], None),
        ({}, [TURN], None),
    ],
)
def test_no_start_lets_a_held_tool_go_without_a_confirmation(sense, steps, said):
    rig = held(**sense)
    rig.width_mm = 30.0
    rig.run(0.1)
    file = ExperimentFile.model_validate({"name": "test", "steps": steps, "limits": {"angle_rad": 1.0}})
    refused = rig.control_loop.start(file, rig.t_ns)
    if said is None:
        assert refused is None
        return
    assert refused.startswith(said)
    assert refused.endswith("; secure it, then send the same command with `--yes`")
    assert rig.control_loop.running_experiment is None
    assert rig.control_loop.start(file, rig.t_ns, confirmed=True) is None


@pytest.mark.parametrize("sense", [{}, {"uncertain": True}, {"unfelt": True}])
def test_a_grip_that_would_open_the_fingers_on_what_they_may_hold_is_refused_at_the_start(sense):
    """Also after a confirmation: the gripper's task refuses it in the middle of the experiment."""
    rig = held(**sense)
    rig.width_mm = 30.0
    rig.run(0.1)
    file = ExperimentFile.model_validate({"name": "test", "steps": [WAIT, grip_to(40.0)]})
    for confirmed in (False, True):
        refused = rig.control_loop.start(file, rig.t_ns, confirmed=confirmed)
        assert "step 2 (grip) to 40 mm would open them and drop it: put a `release` before it" in refused


@pytest.mark.parametrize("sense", [{"inactive": True}, {"inactive": True, "uncertain": True}, {"too_hot": True}])
@pytest.mark.parametrize("holds", [False, True])
def test_a_grip_that_needs_an_activation_is_refused_at_the_start(sense, holds):
    rig = held(**sense)
    rig.force_n = 60.0 if holds else 0.0
    rig.run(0.1)
    start = rig.control_loop.start
    file = ExperimentFile.model_validate({"name": "test", "steps": [GRIP]})
    assert "step 1 (grip)" in start(file, rig.t_ns, confirmed=True)
    after_release = ExperimentFile.model_validate({"name": "test", "steps": [{"do": "release"}, GRIP]})
    asked = start(after_release, rig.t_ns)
    if holds:
        assert asked.startswith(f"step 1 {OPENS}")
    else:
        assert asked is None


@pytest.mark.parametrize(
    ("widths_mm", "said"),
    [
        ((20.0, 15.0, 20.0), "grip to 20 mm would open the fingers, which step 2 closes to 15 mm; put a `release`"),
        ((20.0, 15.0, 15.0), None),
        ((20.0, None, 30.0), None),
    ],
)
def test_a_grip_that_is_wider_than_the_one_before_is_refused_by_the_plan(widths_mm, said):
    steps = [{"do": "release"} if width_mm is None else grip_to(width_mm) for width_mm in widths_mm]
    mistakes = check_steps(ExperimentFile.model_validate({"name": "test", "steps": steps}))
    assert [place for place, _ in mistakes] == ([("steps", 2)] if said else [])
    assert said is None or mistakes[0][1].startswith(said)


def test_a_start_with_empty_fingers_asks_nothing():
    rig = held()
    rig.force_n = 0.0
    rig.run(0.1)
    file = ExperimentFile.model_validate({"name": "test", "steps": [{"do": "release"}, GRIP, {"do": "release"}]})
    assert rig.control_loop.start(file, rig.t_ns) is None


@pytest.mark.parametrize("sense", [{}, {"uncertain": True}])
def test_no_straight_move_begins_with_a_tool_that_is_or_may_be_gripped(sense):
    rig = held(**sense)
    move = {"do": "approach", "along_tool_m": 0.03}

    def refusal(*steps: dict[str, Any]) -> str | None:
        return rig.control_loop.start(ExperimentFile.model_validate({"name": "test", "steps": list(steps)}), rig.t_ns)

    said = refusal({"do": "wait", "wait_s": 1}, move) or ""
    assert said.endswith("put a `grip` or a `release` before step 2 (approach), which moves the arm")
    assert (refusal({"do": "release"}, move) or "").startswith(f"step 1 {OPENS}")


@pytest.mark.parametrize(
    ("steps", "said"),
    [
        ([WAIT], "no step moves anything"),
        ([{"do": "tare"}, {"do": "release"}], "step 2 of 2 (release), which opens the fingers to"),
        ([{"do": "approach", "along_tool_m": 0.03}], "the arm 30 mm along the tool, away from the robot, at 0.05 m/s"),
        ([{"do": "retreat", "pose_m_rad": [0.4, 0, 0.3, 0, 3.1, 0]}], "straight line to x 0.4, y 0, z 0.3 m at"),
        ([{"do": "turn_to", "angle_rad": 1.5}], "turns wrist 3 to 1.5 rad"),
        ([{"do": "identify"}], "turns the wrist to and fro by up to"),
        ([TWIST], "twists the wrist to 1 rad (57°) from the grip, first counterclockwise, holds each for 2 s"),
        ([GRIP], "closes the fingers to 10 mm, or onto a tool, at 60 mm/s with up to 60 N"),
        ([{"do": "hold_torque", "torque_nm": 0.1}], "turns the wrist until the torque is 0.1 N·m counterclockwise"),
        ([{"do": "hold_torque", "torque_nm": 0.1, "direction": "clockwise"}], "until the torque is 0.1 N·m clockwise"),
    ],
)
def test_first_motion_describes_the_first_step_that_moves_something(steps, said):
    assert said in plan_of(ExperimentFile.model_validate({"name": "test", "steps": steps})).first_motion


@pytest.mark.parametrize(
    ("step", "model", "opens"),
    [
        ({}, None, "140 mm"),
        ({}, "Hand-E", "50 mm"),
        ({}, "2F-85", "85 mm"),
        ({"width_mm": 60}, "Hand-E", "50 mm"),
        ({"width_mm": 30}, "Hand-E", "30 mm, or fully where they hold something about as wide or wider"),
    ],
)
def test_the_first_motion_opens_no_further_than_the_configured_gripper(step, model, opens):
    file = ExperimentFile.model_validate({"name": "test", "steps": [{"do": "release", **step}]})
    gripper = MODELS[model] if model is not None else None
    assert plan_of(file, gripper=gripper).first_motion.endswith(f"opens the fingers to {opens}: a held tool drops")


@pytest.mark.parametrize(
    ("step", "said"),
    [
        ({"do": "turn_to", "angle_rad": 1, "speed_rad_per_s": 3}, "at 0.8 rad/s"),
        ({"do": "turn_to", "angle_rad": 1, "speed_rad_per_s": 0.2}, "at 0.2 rad/s"),
        ({"do": "approach", "along_tool_m": 0.1, "speed_m_per_s": 0.5}, "at 0.1 m/s"),
    ],
)
def test_the_first_motion_has_the_speed_that_the_robots_limits_leave(step, said):
    file = ExperimentFile.model_validate({"name": "test", "steps": [step]})
    assert plan_of(file, SETTINGS.limits).first_motion.endswith(said)


def test_a_noisy_source_supervises_beyond_its_noise():
    """A CB3 estimates its wrench from the joints' currents."""
    noisy = wrench_source(125.0, noise_nm=5.0)
    loop = ControlLoop(CONFIG, {"right": EIT, WRENCH: noisy}, ("robot", "gripper"))
    rig = started(Rig(loop), GRIP, {"do": "wait", "wait_s": 60})
    rig.run(2)
    for torque_nm in (2.4, -4.9):
        loop.on_torque(TorqueSample(WRENCH, torque_nm, "", rig.t_ns, rig.t_ns))
        rig.step()
    assert phase(rig) is ExperimentPhase.RUNNING
    loop.on_torque(TorqueSample(WRENCH, 5.5, "", rig.t_ns, rig.t_ns))
    rig.step()
    (beyond, *_) = loop.status.decision.faults
    assert beyond.code is FaultCode.TORQUE_LIMIT
    assert "wrench measured +5.500 N·m, the limit is 0." in beyond.detail
    assert beyond.detail.endswith(" N·m and its noise 5 N·m")
    assert phase(rig) is ExperimentPhase.STOPPED


async def test_a_second_stop_keeps_the_daemon_that_can_open_the_gripper():
    async with with_gripper() as cell:
        await cell.cycles(1)
        ends = asyncio.Event()
        rig = SimpleNamespace(control_loop=cell.control_loop, runner=cell.runner)
        commands = Commands(rig, SimpleNamespace(), None, SimpleNamespace(), ends, None, running_rig=RUNNING_RIG)
        stop_command = commands.handlers()["stop"]
        for _ in range(2):
            reply = await stop_command(of_now())
        assert reply["held"] == "its fingers hold something 30.0 mm wide, with an unknown force"
        assert cell.control_loop.safety.waiting is not None, (
            "the next start waits for `unlock`, as after the page's stop"
        )
        cell.holding = False
        await cell.cycles(2)
        assert "ended" not in await stop_command({"command": "stop", "spare_deamon": True}), (
            "a misspelt word ends nothing"
        )
        assert await stop_command(of_now()) == {"ended": True, **THIS_DAEMON}


async def test_a_stop_just_after_an_experiment_has_ended_by_itself_does_not_end_the_daemon():
    """Who sent it had not seen the end, and would lose the daemon by a single stop."""
    async with driven({"do": "wait", "wait_s": 0.1}) as cell:
        await cell.until_done()
        stop_command = commands_of(cell)["stop"]
        assert await stop_command(of_now()) == {"stopped": "", "ended_by_itself": "test", **THIS_DAEMON}
        await cell.cycles(round(UNSEEN_S * 1e9 / CYCLE_NS) + 1)
        assert await stop_command(of_now()) == {"ended": True, **THIS_DAEMON}


async def test_a_stop_that_was_sent_while_the_daemon_stood_still_is_told_what_moved_then():
    """It was told that nothing was moving. A client without an answer sends it again."""
    async with driven(TWIST, cycles=50) as cell:
        for _ in range(3_000_000_000 // CYCLE_NS):
            cell.robot.cycle(read=False)
        await cell.cycles(1)
        stop_command = commands_of(cell)["stop"]
        for key in ("ended_by_itself", "stopped_before"):
            reply = await stop_command({"spare_daemon": True})
            assert (reply["stopped"], reply[key]) == ("", "test")
            paused = "'test' had just been stopped, because the daemon itself was not running: it stood still for 3.0 s"
            assert f"nothing moves any more: {paused}" in nothing_moved(reply)


async def test_a_stop_that_is_sent_again_is_told_what_the_first_one_stopped():
    async with driven(TWIST, cycles=50) as cell:
        stop_command = commands_of(cell)["stop"]
        assert (await stop_command({}))["stopped"] == "test"
        await cell.cycles(5)
        reply = await stop_command({"spare_daemon": True})
        assert (reply["stopped"], reply["stopped_before"]) == ("", "test")
        assert nothing_moved(reply) == "nothing moves any more: 'test' had just been stopped by an earlier stop"


@pytest.mark.parametrize("acknowledged", [False, True])
async def test_a_second_stop_of_an_operator_ends_the_daemon_at_once(acknowledged):
    async with driven({"do": "wait", "wait_s": 60}) as cell:
        cell.holding = False
        stop_command = commands_of(cell)["stop"]
        assert (await stop_command({}))["stopped"] == "test"
        await cell.cycles(5)
        if acknowledged:
            cell.control_loop.acknowledge()
        reply = await stop_command(of_now())
        assert reply == {"ended": True, "stopped_before": "test", **THIS_DAEMON}
        late = await stop_command({"until_ns": 1})
        assert (late["idle"], late["stopped_before"]) == (True, "test")


def test_a_stated_diameter_that_an_uncalibrated_gripper_does_not_fit_is_noted_while_its_tool_is_held():
    rig = Rig(new_loop())
    # Until the release, the tool of before is held.
    rig.force_n, rig.hand = 60.0, replace(rig.hand, unmeasured_mm=Measured(40.0, 9.0))
    started(rig, {"do": "release"}, GRIP, {"do": "wait", "wait_s": 0.5}, tool_mm=20.0)
    notes: dict[int, str] = {}
    while rig.control_loop.running_experiment is not None:
        rig.step()
        held = rig.force_n > 0
        rig.hand = replace(rig.hand, unmeasured_mm=Measured(40.0, 9.0) if held else None)
        notes[rig.control_loop.experiment.step_number] = loop_state(rig.control_loop, 0.0, rig.t_ns).torque_note
    assert "states a tool of 20 mm, and by the maker's figures the gripper's fingers are 40.0 mm apart" in notes[3]
    assert notes[1] == ""
    file = ExperimentFile.model_validate(
        {"name": "test", "tool_mm": 20.0, "steps": [{"do": "twist", "angles_rad": [1]}]}
    )
    assert "But the experiment states a tool of 20 mm" in held_note(rig.control_loop.operator, file)
    as_stated = file.model_copy(update={"tool_mm": 40.0})
    assert "states" not in held_note(rig.control_loop.operator, as_stated)


@pytest.mark.parametrize("released", [False, True])
def test_the_stated_diameter_counts_as_long_as_its_tool_may_be_held(released):
    """Another tool may be in the fingers, or clamped, after the release: nothing says which."""
    last = {"do": "release"} if released else {"do": "wait", "wait_s": 0.1}
    rig = started(Rig(new_loop()), GRIP, last, tool_mm=20.0)
    assert rig.control_loop.stated_tool_mm == 20.0
    rig.run(30.0)
    if released:
        rig.force_n = 0.0
    rig.step()
    rig.step()
    assert rig.control_loop.stated_tool_mm == (None if released else 20.0)
    # The next tool, by hand.
    rig.force_n = 20.0
    rig.step()
    assert rig.control_loop.stated_tool_mm == (None if released else 20.0)
