"""The worker's cycles in their own time."""

from itertools import pairwise

import pytest

from shearloop.drivers.ur import worker
from shearloop.drivers.ur.messages import Disconnect, Enable, WristSpeed
from tests.drivers.ur.process import CyclingArm


@pytest.fixture
def arm() -> CyclingArm:
    """The arm of the worker."""
    return CyclingArm()


def test_each_state_is_sent_and_the_robot_kept_awake_in_each_cycle(timed, arm):
    run = timed(arm, (0.405, Disconnect()))
    assert [state.cycle for state in run.states] == [0, 0, 1, 1, 2, 2, *range(3, 52)]
    assert arm.read_s[:51] == pytest.approx([0.008 * cycle for cycle in range(51)])
    sent = [call for call in arm.calls if call != "send_heartbeat"]
    assert sent == ["clear_command", "upload", "arm_watchdog", "end_program"]
    assert len(arm.calls) - len(sent) == 49


def test_late_cycle_starts_at_once_and_missed_ones_are_skipped(timed, arm):
    run = timed(arm, (0.0799, lambda: worker.time.sleep(0.0442)), (0.3, Disconnect()))
    assert arm.read_s[9:13] == pytest.approx([0.072, 0.1241, 0.1241, 0.1321])
    assert [state.cycle for state in run.states[12:16]] == [9, 10, 11, 12]


def test_command_is_sent_on_arrival_and_in_each_cycle(timed, arm):
    timed(arm, (0.1, Enable()), (0.203, WristSpeed(0.1, 4.0)), (0.3, Disconnect()))
    assert arm.wrist_s[:4] == pytest.approx([0.203, 0.208, 0.216, 0.224])
    assert max(later - earlier for earlier, later in pairwise(arm.wrist_s)) < 0.0081


def test_wrist_stands_soon_after_the_pipe_has_died(timed, arm, daemon):
    timed(arm, (0.1, Enable()), (0.25, WristSpeed(0.5, 4.0)), (0.3, daemon.hang_up))
    assert arm.calls.count("wrist") > 10
    assert arm.reading.rests
    assert arm.read_s[-1] < 0.3 + 0.2
    assert arm.calls[-1] == "end_program"


# A command comes at `offset_s` after the beginning of a cycle; the sample shows the stop `lag_s` later.
@pytest.mark.parametrize("lag_s", [0.002, 0.0065])
@pytest.mark.parametrize("offset_s", [0.0005, 0.0035, 0.0072])
def test_protective_stop_seen_late_is_reported_as_such(timed, arm, offset_s, lag_s):
    speeds = [(0.104 + offset_s + 0.008 * number, WristSpeed(0.1, 4.0)) for number in range(20)]
    stopped_s = 0.2 + offset_s - 0.0001
    rejects = (stopped_s, lambda: setattr(arm, "accepts", False))
    run = timed(arm, (0.1, Enable()), *speeds, rejects, (stopped_s + lag_s, arm.protective_stop), (0.3, Disconnect()))
    assert {state.blocked[:15] for state in run.states if state.cycle > 15} == {"", "Protective stop"}
    assert {state.motion for state in run.states if state.blocked} == {"idle"}
