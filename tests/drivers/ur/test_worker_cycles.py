"""The worker's cycles in their own time."""

from itertools import pairwise

import pytest

from shearloop.drivers.ur import worker
from shearloop.drivers.ur.messages import Disconnect, Enable, RtdeSample, WristSpeed
from tests.drivers.ur.process import TimedArm


def test_each_state_is_sent_and_the_robot_kept_awake_in_each_cycle(timed):
    run = timed((0.405, Disconnect()))
    assert [state.cycle for state in run.states] == [0, 0, 1, 1, 2, 2, *range(3, 52)]
    assert run.arm.read_s[:51] == pytest.approx([0.008 * cycle for cycle in range(51)])
    sent = [call for call in run.arm.calls if call != "send_heartbeat"]
    assert sent == ["clear_command", "upload", "arm_watchdog", "end_program"]
    assert len(run.arm.calls) - len(sent) == 49


def test_late_cycle_starts_at_once_and_missed_ones_are_skipped(timed):
    class Slow(TimedArm):
        def read(self) -> RtdeSample:
            if len(self.read_s) == 10:
                worker.time.sleep(0.0441)
            return super().read()

    run = timed((0.3, Disconnect()), arm=Slow())
    assert run.arm.read_s[9:13] == pytest.approx([0.072, 0.1241, 0.1241, 0.1321])
    assert [state.cycle for state in run.states[12:16]] == [9, 10, 11, 12]


def test_command_is_sent_on_arrival_and_in_each_cycle(timed):
    sent_s: list[float] = []

    class Turned(TimedArm):
        def wrist(self, command: WristSpeed, left_s: float) -> bool:
            sent_s.append(worker.time.monotonic() - 1000.0)
            return super().wrist(command, left_s)

    timed((0.1, Enable()), (0.203, WristSpeed(0.1, 4.0)), (0.3, Disconnect()), arm=Turned())
    assert sent_s[:4] == pytest.approx([0.203, 0.208, 0.216, 0.224])
    assert max(later - earlier for earlier, later in pairwise(sent_s)) < 0.0081


def test_wrist_stands_soon_after_the_pipe_has_died(timed, daemon):
    class Left(TimedArm):
        def read(self) -> RtdeSample:
            if worker.time.monotonic() > 1000.3:
                daemon.hang_up()
            return super().read()

    run = timed((0.1, Enable()), (0.25, WristSpeed(0.5, 4.0)), (2.0, Disconnect()), arm=Left())
    assert run.arm.calls.count("wrist") > 10
    assert run.arm.reading.rests
    assert run.arm.read_s[-1] < 0.3 + 0.2
    assert run.arm.calls[-1] == "end_program"


@pytest.mark.parametrize("stopped_s", [0.2001, 0.2005, 0.2079])
def test_protective_stop_seen_late_is_reported_as_such(timed, stopped_s):
    class Late(TimedArm):
        def wrist(self, command: WristSpeed, left_s: float) -> bool:
            self.accepts = worker.time.monotonic() < 1000.0 + stopped_s
            return super().wrist(command, left_s)

        def read(self) -> RtdeSample:
            if worker.time.monotonic() > 1000.003 + stopped_s and self.reading.safety_mode == 1:
                self.protective_stop()
            return super().read()

    speeds = [(0.1005 + 0.008 * number, WristSpeed(0.1, 4.0)) for number in range(20)]
    run = timed((0.1, Enable()), *speeds, (0.3, Disconnect()), arm=Late())
    assert {state.blocked[:15] for state in run.states if state.cycle > 15} == {"", "Protective stop"}
    assert {state.motion for state in run.states if state.blocked} == {"idle"}
