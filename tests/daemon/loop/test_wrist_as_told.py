"""The wrist closes in on an angle, decided upon at each of the robot's states."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import cast

import pytest

from shearloop.daemon.control.control_loop import ControlLoop
from shearloop.daemon.control.device_commands import VelocityCommandSender
from shearloop.daemon.control.loop_inputs import TorqueSource
from shearloop.daemon.control.settings import LoopConfig
from shearloop.daemon.control.step_runner import MoveToAngle
from shearloop.daemon.control.wrist_controller import WristController
from shearloop.drivers.ur.client import UrRobot
from shearloop.drivers.ur.messages import Command, CommandReply
from tests.drivers.ur.flight import SETTINGS, flying

FASTEST_PER_S = next(
    float(each.le) for each in LoopConfig.model_fields["angle_bandwidth_per_s"].metadata if hasattr(each, "le")
)


def errors_rad(angle_rad: float, bandwidth_per_s: float, cycles: int = 500) -> list[float]:
    """Return how far from the angle the wrist is in each cycle."""
    flight = flying()
    config = LoopConfig(angle_bandwidth_per_s=bandwidth_per_s)
    wrist = WristController(TorqueSource(name="load_cell", period_s=0.1), config)
    replies: list[Callable[[], None]] = []

    def send_nowait(command: Command, answered: Callable[[CommandReply], None]) -> None:
        reply = flight.ask(command)
        assert reply.accepted
        # It comes with the next state that is told.
        replies.append(lambda: answered(reply))

    robot = SimpleNamespace(settings=SETTINGS, state=None, send_nowait=send_nowait)
    brain = SimpleNamespace(on_speed_sent=wrist.on_speed_sent, on_command_refused=pytest.fail)
    commands = VelocityCommandSender(cast(UrRobot, robot), cast(ControlLoop, brain), 4.0, pytest.fail)
    origin_rad, errors = flight.state.wrist_rad, []
    for _ in range(cycles):
        flight.fly(1)
        state = flight.state
        errors.append(state.wrist_rad - origin_rad - angle_rad)
        robot.state = state
        while replies:
            replies.pop()()
        turn = wrist.turn(MoveToAngle(angle_rad, 0.5), flight.now_ns, state.wrist_rad, origin_rad)
        commands.turn(turn.speed_rad_per_s)
    return errors


@pytest.mark.parametrize("angle_rad", [0.01, 0.03, 0.1])
@pytest.mark.parametrize("bandwidth_per_s", [5.0, FASTEST_PER_S])
def test_wrist_comes_to_rest_at_an_angle_however_fast_it_may_be_asked_to(
    angle_rad: float, bandwidth_per_s: float
) -> None:
    assert max(map(abs, errors_rad(angle_rad, bandwidth_per_s)[-150:])) < 1e-4
