"""What the loop publishes and logs of its states: every experiment's begin and end, and each change once."""

import asyncio
from types import SimpleNamespace

import pytest
from structlog.testing import capture_logs

from shearloop.daemon.control.control_loop import ControlLoop
from shearloop.daemon.control.faults import FaultCode
from shearloop.daemon.control.inputs import GripperStatus
from shearloop.daemon.control.wrench import wrench_source
from shearloop.daemon.loop_config import LoopConfig
from shearloop.daemon.messaging.messages import RobotStateMessage, wire_map
from shearloop.daemon.run_summary import RunSummary
from shearloop.daemon.torques import WRENCH
from tests.daemon.control.cell import GRIP, MOVE, TWIST, Cell, driven
from tests.drivers.ur.handler_bench import CYCLE_NS, SETTINGS


class DoubtfulCell(Cell):
    """A rig whose gripper does not know whether it holds a tool, and may fall silent."""

    def __init__(self) -> None:
        sources = {WRENCH: wrench_source(SETTINGS.rate_hz)}
        super().__init__(ControlLoop(LoopConfig(), sources, ("robot", "gripper")))
        self.silent = False

    def sense(self) -> None:
        if not self.silent:
            now_ns = self.robot.bench.now_ns
            status = GripperStatus(now_ns, 63.5, holding=False, moving=False, uncertain=True)
            self.control_loop.on_gripper(status)


@pytest.mark.parametrize(
    ("kind", "step"), [(DoubtfulCell, {"do": "tare"}), (Cell, {"do": "hold_torque", "torque_nm": 0.05})]
)
async def test_an_experiment_that_fails_in_its_first_decision_ended_by_a_fault(kind, step):
    summary = RunSummary()
    async with driven(cell=kind()) as cell:
        for _ in range(2):
            await cell.start(step)
            await cell.until_ended(5)
            for message in cell.published.messages:
                summary(message.topic, wire_map(message, 0.0, 0))
            cell.published.messages.clear()
            assert not summary.ended_as_asked
            assert "STOPPED before its end" in summary.text
            assert f"step 1 of 1  {step['do']}" in summary.text
            assert await cell.runner.unlock() is None
            await cell.cycles(5)


async def test_a_state_of_the_robot_has_the_time_of_its_measurement():
    age_ns, read_ns = 30_000_000, []
    async with driven() as cell:
        cell.robot.bench.arm.be(age_ns=age_ns)
        for _ in range(10):
            await cell.cycles(1)
            read_ns.append(cell.state.read_ns)
        *_, message = (one for one in cell.published.messages if isinstance(one, RobotStateMessage))
    assert message.age_s == age_ns / 1e9
    assert message.t_mono_ns + age_ns in read_ns


async def every_second_state_is_new(cell: Cell, cycles: int) -> None:
    """Let the controller send 62 states a second where 125 are configured."""
    for number in range(cycles):
        cell.robot.bench.arm.be(age_ns=CYCLE_NS * (number % 2))
        await cell.cycles(1)


def states_of(cell: Cell) -> list[RobotStateMessage]:
    return [one for one in cell.published.messages if isinstance(one, RobotStateMessage)]


async def test_states_that_are_too_few_give_no_torque_which_is_said_and_holds_the_wrist():
    async with driven() as cell:
        assert states_of(cell)[-1].wrist_torque_valid
        await cell.start(TWIST)
        await every_second_state_is_new(cell, 140)
        state = states_of(cell)[-1]
        assert (state.wrist_torque_nm, state.wrist_torque_valid) == (None, False)
        assert "12 of the robot's states came in 0.19 s" in state.wrist_torque_reason
        assert cell.published.faults == [FaultCode.WRENCH_UNKNOWN.text]
        assert state.wrist_torque_reason in cell.published.reasons
        assert cell.state.wrist_speed_rad_per_s == 0.0
        health = cell.robot.diagnostics()
        assert (health["rate_hz"], health["expected_hz"]) == (pytest.approx(62.5, rel=0.1), 125.0)
        assert "the robot's states come at" in health["error"]


async def test_a_torque_of_the_wrench_without_a_zero_is_not_valid():
    async with driven() as cell:
        cell.control_loop.on_zero(WRENCH, known=False)
        await cell.cycles(10)
        state = states_of(cell)[-1]
        assert (state.wrist_torque_nm, state.wrist_torque_valid) == (0.0, False)
        assert "no zero of the wrench is known" in state.wrist_torque_reason
        cell.control_loop.on_zero(WRENCH)
        await cell.cycles(10)
        assert (states_of(cell)[-1].wrist_torque_valid, states_of(cell)[-1].wrist_torque_reason) == (True, "")


async def test_a_driving_torque_without_a_zero_is_none():
    """A controller that starts its program zeroes its wrench under the tool: 0.02 N·m were shown for 0.09."""
    async with driven() as cell:
        await cell.start({"do": "wait", "wait_s": 5.0})
        for known in (True, False, True):
            cell.control_loop.on_zero(WRENCH, known=known)
            await cell.cycles(200)
            state = [one for one in cell.published.messages if one.topic == "loop.state"][-1]
            assert (state.torque_nm is not None) is known
            assert ("no zero of wrench is known" in state.torque_note) is not known


async def test_a_stop_is_logged_once_however_often_a_state_is_out_of_date():
    async with driven(cell=DoubtfulCell()) as cell:
        with capture_logs() as lines:
            await cell.start({"do": "tare"})
            await cell.until_ended(5)
            for _ in range(3):
                cell.silent = True
                await cell.cycles(40)
                assert FaultCode.STATE_STALE.text in cell.published.faults
                cell.silent = False
                await cell.cycles(40)
            assert await cell.runner.unlock() is None
            await cell.cycles(5)
    began, stopped, unlocked = (line for line in lines if line["event"] == "loop")
    assert (began["phase"], began["activity"]) == ("running", "taking the zero of every torque sensor")
    assert "step 1 (tare) cannot be done" in stopped["cause"]
    assert (unlocked["faults"], unlocked.get("cause"), unlocked.get("activity")) == ("none", None, None)


async def test_a_further_fault_is_logged_by_its_code_alone():
    async with driven(cell=DoubtfulCell()) as cell:
        await cell.start({"do": "tare"})
        await cell.until_ended(5)
        with capture_logs() as lines:
            cell.control_loop.on_link("gripper", "the cable is out", up=False)
            await cell.cycles(5)
    (line,) = (line for line in lines if line["event"] == "loop")
    assert line["faults"] == f"{FaultCode.STEP_FAILED.text}, {FaultCode.DEVICE_LOST.text}"
    assert "cause" not in line


@pytest.mark.parametrize(
    "step", [MOVE, GRIP, TWIST, {"do": "wait", "wait_s": 60}, {"do": "tare"}], ids=lambda one: one["do"]
)
async def test_a_persons_own_stop_is_no_error_and_its_line_begins_with_it(step):
    async with driven() as cell:
        # Neither a grip nor a zero ends by itself.
        cell.gripper.there.clear()
        cell.sensors["right"] = SimpleNamespace(taring=False, tare_and_wait=lambda _: asyncio.Event().wait())
        await cell.start(step)
        await cell.cycles(10)
        assert cell.control_loop.running_experiment is not None
        with capture_logs() as lines:
            assert cell.runner.stop() == "test"
            await cell.until_ended(50)
            await cell.cycles(50)
    assert [line for line in lines if line["log_level"] != "info"] == []
    (line,) = (line for line in lines if line["event"] == "loop")
    cause = FaultCode.OPERATOR_STOP.value.kind
    assert line["cause"].lower().startswith(cause.lower())
    assert "activity" not in line, "the cause is said once"
