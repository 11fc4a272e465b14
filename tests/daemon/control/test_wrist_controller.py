"""The wrist's speed for a set point, and its approach to an angle."""

import asyncio
from types import SimpleNamespace

import pytest

from shearloop.daemon.clock import Clock
from shearloop.daemon.control.experiment import MoveToAngle, TrackTorque
from shearloop.daemon.control.identification import ToolModel
from shearloop.daemon.control.loop_inputs import LoopConfig, TorqueSample, TorqueSource
from shearloop.daemon.control.loop_runner import CommandSender
from shearloop.daemon.control.stop_timeline import StopTimeline
from shearloop.daemon.control.wrist_controller import WristController
from shearloop.drivers.ur.messages import Command, CommandReply
from tests.drivers.ur.flight import SETTINGS, flying

CYCLE_NS = 8_000_000
CONFIG = LoopConfig()
# A tenth of what the wrist resolves.
CLOSE_RAD = 2e-5
# Without anything under way: what is sent shows in the angle at once.
AT_ONCE = LoopConfig(actuation_s=0.0)


def wrist(config: LoopConfig = AT_ONCE) -> WristController:
    return WristController(TorqueSource(name="load_cell", period_s=0.1), config)


def test_a_wrist_that_stands_sets_out_for_however_little():
    turn = wrist().turn(MoveToAngle(0.1 * CLOSE_RAD, 0.2), 10**9, 0.0, 0.0)
    assert turn.speed_rad_per_s == pytest.approx(0.1 * CLOSE_RAD * CONFIG.angle_bandwidth_per_s)


def test_a_held_angle_is_kept():
    one, angle_rad, errors_rad = wrist(), 0.0, []
    for cycle in range(1000):
        speed = one.turn(MoveToAngle(0.15, 0.2), 10**9 + cycle * CYCLE_NS, angle_rad, 0.0).speed_rad_per_s
        one.on_speed_sent(speed)
        angle_rad += speed * CYCLE_NS / 1e9
        errors_rad.append(abs(angle_rad - 0.15))
    # From two seconds after the arrival on.
    assert max(errors_rad[375:]) < 1.1 * CLOSE_RAD


@pytest.mark.parametrize("allowed_rad_per_s", [1e-5, 4e-5, 1e-3, 0.2])
@pytest.mark.parametrize("bandwidth_per_s", [0.02, 5.0, 40.0])
def test_however_slow_it_turns_to_an_angle_and_back_and_stays_there(allowed_rad_per_s, bandwidth_per_s):
    one, angle_rad, t_ns = wrist(AT_ONCE.model_copy(update={"angle_bandwidth_per_s": bandwidth_per_s})), 0.0, 10**9
    way_rad = 200 * CYCLE_NS / 1e9 * allowed_rad_per_s
    # As long as the way takes, and as its last part does at this bandwidth.
    cycles = round(300 + 12.0 / bandwidth_per_s / (CYCLE_NS / 1e9))
    for goal_rad in (way_rad, -way_rad):
        for _ in range(2 * cycles):
            speed = one.turn(MoveToAngle(goal_rad, allowed_rad_per_s), t_ns, angle_rad, 0.0).speed_rad_per_s
            assert abs(speed) <= allowed_rad_per_s
            one.on_speed_sent(speed)
            angle_rad += speed * CYCLE_NS / 1e9
            t_ns += CYCLE_NS
        assert angle_rad == pytest.approx(goal_rad, abs=1.5 * CLOSE_RAD)


FASTEST_PER_S = next(
    float(each.le) for each in LoopConfig.model_fields["angle_bandwidth_per_s"].metadata if hasattr(each, "le")
)


async def errors_rad(angle_rad: float, bandwidth_per_s: float, cycles: int = 500) -> list[float]:
    """Return how far from the angle the wrist is in each cycle."""
    flight = flying()
    config = LoopConfig(angle_bandwidth_per_s=bandwidth_per_s)
    wrist = WristController(TorqueSource(name="load_cell", period_s=0.1), config)
    replies: list[tuple[asyncio.Future[CommandReply], CommandReply]] = []

    def send(command: Command) -> asyncio.Future[CommandReply]:
        reply = flight.ask(command)
        assert reply.accepted
        # It comes with the next state.
        replies.append((asyncio.get_running_loop().create_future(), reply))
        return replies[-1][0]

    robot = SimpleNamespace(settings=SETTINGS, state=None, send=send)
    brain = SimpleNamespace(on_speed_sent=wrist.on_speed_sent, on_fault=pytest.fail, config=config)
    commands = CommandSender(robot, brain, StopTimeline(), Clock())
    origin_rad, errors = flight.state.wrist_rad, []
    for _ in range(cycles):
        flight.fly(1)
        state = flight.state
        errors.append(state.wrist_rad - origin_rad - angle_rad)
        robot.state = state
        while replies:
            replied, reply = replies.pop()
            replied.set_result(reply)
        await asyncio.sleep(0)
        turn = wrist.turn(MoveToAngle(angle_rad, 0.5), flight.now_ns, state.wrist_rad, origin_rad)
        commands.turn(turn.speed_rad_per_s, 0)
    return errors


@pytest.mark.parametrize("angle_rad", [0.01, 0.03, 0.1])
@pytest.mark.parametrize("bandwidth_per_s", [5.0, FASTEST_PER_S])
async def test_wrist_comes_to_rest_at_an_angle_however_fast_it_may_be_asked_to(angle_rad, bandwidth_per_s):
    assert max(map(abs, (await errors_rad(angle_rad, bandwidth_per_s))[-150:])) < 1e-4


def test_each_torque_has_its_own_ramp_and_limit():
    one = wrist()
    one.tool = ToolModel(
        stiffness_nm_per_rad=0.2, stiffness_std=0.002, lag_s=0.0, lag_std_s=0.01, age_s=0.05, actuation_s=0.02,
        noise_nm=0.001, sample_period_s=0.1, angle_rad=0.0, torque_nm=0.0, torque_std_nm=0.0005,
    )  # fmt: skip
    assert one.close_loop(TrackTorque(0.1, 0.5), 10**9, 0.0, torque_limit_nm=0.15) is None
    assert one.close_loop(TrackTorque(0.3, 0.01), 10**9, 0.0, torque_limit_nm=0.5) is None
    angle_rad = 0.0
    for cycle in range(1, 500):
        t_ns = 10**9 + cycle * CYCLE_NS
        one.on_torque(TorqueSample("load_cell", 0.2 * angle_rad, "", t_ns - CYCLE_NS // 2, t_ns))
        speed = one.turn(TrackTorque(0.3, 0.01), t_ns, angle_rad, 0.0).speed_rad_per_s
        one.on_speed_sent(speed)
        angle_rad += speed * CYCLE_NS / 1e9
    assert 0.2 * angle_rad == pytest.approx(0.01 * 500 * CYCLE_NS / 1e9, rel=0.15)
