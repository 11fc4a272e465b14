"""An emulated rig survives a busy computer; a real one keeps its deadlines."""

import socket

import pytest
import yaml

from shearloop.daemon import rig
from shearloop.daemon.config import load_daemon_config
from shearloop.daemon.control.experiment_schema import ExperimentLimits
from shearloop.daemon.control.fault_detection import Watched, detect_faults
from shearloop.daemon.control.faults import Fault, FaultCode, Response
from shearloop.daemon.control.inputs import ArmStatus, GripperStatus, LatestInputs
from shearloop.daemon.control.safety import SafetyMonitor
from shearloop.daemon.loop_config import LoopConfig
from shearloop.daemon.patience import EMULATED_PATIENCE, patience_of
from shearloop.daemon.rig import make_loop, open_settings
from shearloop.daemon.torques import TorqueSource
from shearloop.drivers.errors import DeviceLostError
from shearloop.errors import UserError
from tests.fixtures.daemons import robot_at

SECOND = 1_000_000_000
EIT = TorqueSource(name="right", period_s=0.5412)


def codes(patience: float, **changes: object) -> set[FaultCode]:
    """Return what is found of states that are half a second old."""
    arm, gripper = ArmStatus(0.0, 0), GripperStatus(0, 20.0, holding=False, moving=False)
    inputs = LatestInputs(10.0, arm=arm, gripper=gripper, **changes)
    required = ("robot", "gripper")
    watched = Watched(driving=EIT, supervising=(), config=LoopConfig(), required=required, patience=patience)
    return {fault.code for fault in detect_faults(inputs, watched, ExperimentLimits(), None, SECOND // 2)}


@pytest.mark.parametrize(("late_s", "code"), [(0.2, FaultCode.LOOP_LATE), (0.5, FaultCode.DAEMON_PAUSED)])
def test_a_busy_computer_is_no_fault_of_an_emulated_rig_alone(late_s, code):
    assert codes(1.0, late_s=late_s) == {FaultCode.STATE_STALE, code}
    assert codes(EMULATED_PATIENCE, late_s=late_s) == set()


@pytest.mark.parametrize(("patience", "response"), [(1.0, Response.STOP_AND_KEEP_GRIP), (10.0, Response.HOLD)])
def test_a_hold_of_an_emulated_rig_may_last_longer(patience, response):
    gate, stale = SafetyMonitor(patience), Fault(FaultCode.STATE_STALE, "the gripper")
    for second in range(4):
        decision = gate.judge([stale], second * SECOND)
    assert decision.response is response


@pytest.mark.usefixtures("ur_rtde")
def test_only_an_emulated_rig_has_longer_deadlines(tmp_path):
    robot_at("127.0.0.1", tmp_path)
    content = {"fingertips": {"right": {"device": {"path": str(tmp_path / "right")}}}, "robot": "ur.yaml"}
    found = {}
    for emulated in (False, True):
        (tmp_path / "rig.yaml").write_text(
            yaml.safe_dump({**content, "emulated": emulated, "load_cell": {"device": {"path": "load"}}})
        )
        config = load_daemon_config(tmp_path / "rig.yaml")
        settings = open_settings(config)
        loop = make_loop(config, settings, {"right": EIT}, {})
        found[emulated] = settings.command_timeout_s, settings.state_timeout_s, loop.wrist.source.fresh_s
        # The watchdog is the last resort, after the deadlines have stopped the wrist.
        assert settings.standstill_s < 1 / settings.watchdog_hz
    assert found == {False: (0.1, 0.25, pytest.approx(2.5 * 0.5412)), True: (1.0, 5.0, 5.0)}
    robot_at("192.168.1.10", tmp_path)
    with pytest.raises(UserError, match="is not this computer"):
        open_settings(load_daemon_config(tmp_path / "rig.yaml"))


@pytest.mark.parametrize(("emulated", "deadline"), [(False, "0.01 s"), (True, "0.1 s")])
async def test_the_gripper_of_an_emulated_rig_may_answer_later(emulated, deadline, tmp_path, monkeypatch):
    monkeypatch.setattr(rig, "REPLY_DEADLINE_S", 0.01)
    # The kernel accepts the connection, and no one answers.
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        content = {
            "gripper": {"model": "2F-140", "socket": {"host": "127.0.0.1", "port": port}},
            "emulated": emulated,
            "load_cell": {"device": {"path": "load"}},
        }
        (tmp_path / "rig.yaml").write_text(yaml.safe_dump({**content, "robot": "ur.yaml"}))
        robot_at("127.0.0.1", tmp_path)
        config = load_daemon_config(tmp_path / "rig.yaml")
        client = rig.make_gripper_client(config.gripper, patience_of(config))
        await client.connect()
        with pytest.raises(DeviceLostError, match=f"within {deadline}"):
            await client.read()
        await client.close()
