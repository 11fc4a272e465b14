"""The pipe of the robot's own process: what waits for what, what is dropped, and what is bounded."""

import pytest

from shearloop.drivers.ur import worker as child
from shearloop.drivers.ur.messages import CommandReply, Stop, WristSpeed
from shearloop.drivers.ur.pace import Pace
from tests.drivers.ur.flight import SETTINGS, Flight, flying
from tests.drivers.ur.process import Daemon


def test_state_that_finds_others_waiting_is_not_sent_and_says_so(daemon: Daemon) -> None:
    state = Flight().state
    assert daemon.pipe.send_latest(state)
    while not daemon.pipe._unsent:
        daemon.pipe.send(state)
    assert not daemon.pipe.send_latest(state)
    daemon.hear()
    assert daemon.pipe.send_latest(state)


def test_refused_wrist_speed_is_answered_at_once_one_that_is_taken_with_the_next_state(daemon: Daemon) -> None:
    flight, pace = flying(), Pace(SETTINGS, 0.0)
    daemon.say(WristSpeed(0.1, 4.0))
    child._obey(daemon.pipe, flight.pilot, pace, flight.state)
    with pytest.raises(BlockingIOError):
        daemon.hear()
    daemon.say(WristSpeed(0.1, -4.0))
    child._obey(daemon.pipe, flight.pilot, pace, flight.state)
    assert [message.accepted for _, message in daemon.hear() if isinstance(message, CommandReply)] == [True, False]


def test_reply_to_a_wrist_speed_comes_with_the_next_state_in_one_piece(daemon: Daemon) -> None:
    pipe, state = daemon.pipe, Flight().state
    pipe.hold(CommandReply(sent=WristSpeed(0.1, 4.0)), 1)
    with pytest.raises(BlockingIOError):
        daemon.hear()
    pipe.send_latest(state)
    assert daemon.hear() == [(1, CommandReply(sent=WristSpeed(0.1, 4.0))), (0, state)]


def test_what_was_held_back_comes_before_what_is_sent_at_once(daemon: Daemon) -> None:
    daemon.pipe.hold(CommandReply(sent=WristSpeed(0.1, 4.0)), 1)
    daemon.pipe.send(CommandReply(sent=Stop(4.0)), 2)
    assert [number for number, _ in daemon.hear()] == [1, 2]


def test_what_is_held_back_from_a_daemon_that_reads_nothing_has_a_bound(daemon: Daemon) -> None:
    pipe, state = daemon.pipe, Flight().state
    for _ in range(10_000):
        pipe.hold(CommandReply(), 1)
        pipe.send_latest(state)
        if not pipe.open:
            return
    raise AssertionError("it grows and grows")
