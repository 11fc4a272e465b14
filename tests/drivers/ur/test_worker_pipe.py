"""The pipe of the robot's own process: what waits for what, what is dropped, and what is bounded."""

from shearloop.drivers.ur import worker
from shearloop.drivers.ur.messages import CommandReply, WristSpeed
from tests.drivers.ur.flight import Flight, flying
from tests.drivers.ur.process import Daemon


def test_state_is_dropped_while_others_are_unsent(daemon: Daemon) -> None:
    state = Flight().state
    while not daemon.pipe._unsent:
        daemon.pipe.send(state)
    unsent = daemon.pipe._unsent
    daemon.pipe.send_latest(state)
    assert daemon.pipe._unsent == unsent
    daemon.hear()
    daemon.pipe.send_latest(state)
    assert not daemon.pipe._unsent


def test_each_command_is_answered_at_once(daemon: Daemon) -> None:
    flight = flying()
    for acceleration, accepted in ((4.0, True), (-4.0, False)):
        daemon.say(WristSpeed(0.1, acceleration))
        worker._handle_commands(daemon.pipe, flight.handler, flight.state)
        assert [message.accepted for _, message in daemon.hear() if isinstance(message, CommandReply)] == [accepted]


def test_unsent_output_is_bounded(daemon: Daemon) -> None:
    state = Flight().state
    for _ in range(10_000):
        daemon.pipe.send(state)
        if not daemon.pipe.open:
            return
    raise AssertionError("it grows and grows")
