"""The times of a stop: a standstill follows the command, and a late reply is awaited."""

from types import SimpleNamespace
from typing import cast

import pytest

from shearloop.daemon.control.faults import Response
from shearloop.daemon.control.safety import SafetyDecision
from shearloop.daemon.control.stop_timeline import LONGEST_NS, REPLY_NS, StopTimeline
from shearloop.drivers.ur.messages import RobotState

MS = 1_000_000


def state(at_ms: float, *, rests: bool, blocked: str = "") -> RobotState:
    """Return a state that was measured at this time."""
    return cast(RobotState, SimpleNamespace(measured_ns=round(at_ms * MS), rests=rests, blocked=blocked))


def begun() -> StopTimeline:
    timeline = StopTimeline()
    timeline.begin(1, "test", "why", SafetyDecision(Response.STOP_AND_KEEP_GRIP), 10 * MS)
    return timeline


def test_a_standstill_before_the_command_is_not_the_stops():
    timeline = begun()
    assert timeline.update(state(12, rests=True), 12 * MS) is None
    timeline.on_sent(20 * MS)
    assert timeline.update(state(18, rests=True), 21 * MS) is None
    stop = timeline.update(state(28, rests=True), 29 * MS)
    assert (stop.sent_after_s, stop.stands_after_s) == (pytest.approx(0.010), pytest.approx(0.018))
    assert not timeline.pending


def test_a_reply_after_the_standstill_is_awaited_and_no_reply_is_not_awaited_for_ever():
    timeline = begun()
    assert timeline.update(state(30, rests=True), 30 * MS) is None
    stop = timeline.update(state(600, rests=True), 11 * MS + REPLY_NS)
    assert (stop.sent_after_s, stop.stands_after_s) == (None, pytest.approx(0.020))


def test_a_refusal_is_an_answer_and_comes_with_the_first_state_of_the_block():
    timeline = begun()
    assert timeline.update(state(11, rests=False, blocked="protective stop"), 12 * MS) is None
    timeline.on_refused("nothing can be sent")
    assert timeline.update(state(19, rests=False, blocked="protective stop"), 20 * MS) is None
    stop = timeline.update(state(27, rests=True, blocked="protective stop"), 28 * MS)
    assert (stop.refusal, stop.sent_after_s) == ("nothing can be sent", None)
    assert (stop.blocked_after_s, stop.stands_after_s) == (pytest.approx(0.001), pytest.approx(0.017))


def test_an_arm_that_moves_again_does_not_stand():
    timeline = begun()
    timeline.on_sent(11 * MS)
    assert timeline.update(state(20, rests=False), 20 * MS) is None
    stop = timeline.update(state(40, rests=False), 11 * MS + LONGEST_NS)
    assert (stop.sent_after_s, stop.stands_after_s) == (pytest.approx(0.001), None)
