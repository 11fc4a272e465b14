"""The brain when all is well: whole experiments, and what an operator may ask of one."""

import numpy as np
import pytest

from shearloop.daemon.control.step_runner import ExperimentPhase, GripTo, MoveTo, Tare
from tests.daemon.loop.rig import GRIP, TICK_S, Rig, new_loop, phase, started


@pytest.mark.parametrize("drive", ["right", "load_cell"])
def test_the_loop_grips_identifies_holds_a_torque_and_lets_go(drive: str) -> None:
    rig = started(
        Rig(new_loop()),
        {"do": "approach", "pose_m_rad": [0.4, 0, 0.3, 0, 3.1, 0]},
        GRIP,
        {"do": "tare"},
        {"do": "identify"},
        {"do": "hold_torque", "torque_nm": 0.1, "hold_s": 20},
        {"do": "release"},
        torque_source=drive,
    )
    rig.run(200)
    assert rig.control_loop.experiment is not None
    assert phase(rig) is ExperimentPhase.DONE, rig.control_loop.experiment.stop_reason
    assert [type(action) for action in rig.begun] == [MoveTo, GripTo, Tare, GripTo]
    held = np.array(rig.true_nm)[-round(15 / TICK_S) - 110 : -110]
    assert held.mean() == pytest.approx(0.1, abs=0.008)
    assert held.std() < 0.006


def test_a_set_point_without_identification_is_refused_with_the_cure() -> None:
    rig = started(Rig(new_loop()), GRIP, {"do": "hold_torque", "torque_nm": 0.1})
    rig.run(20)
    assert phase(rig) is ExperimentPhase.STOPPED
    assert rig.control_loop.experiment is not None
    assert "put an `identify` step before" in rig.control_loop.experiment.stop_reason


def test_a_pause_is_refused_with_the_reason() -> None:
    rig = started(Rig(new_loop()), {"do": "wait", "wait_s": 60})
    rig.step()
    assert rig.control_loop.pause() is None
    assert "paused already" in (rig.control_loop.pause() or "")
    assert rig.control_loop.resume() is None
    rig.control_loop.stop("the operator said so")
    assert rig.control_loop.pause() == "no experiment is running"
