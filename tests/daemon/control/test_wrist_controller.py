"""The wrist's speed for a set point, and its approach to an angle."""

from collections.abc import Callable
from concurrent.futures import Future

import pytest

from shearloop.daemon.control.control_loop import ControlLoop
from shearloop.daemon.control.experiment import MoveToAngle, TrackTorque
from shearloop.daemon.control.identification import ToolModel
from shearloop.daemon.control.margins import JudgedGain
from shearloop.daemon.control.wrench import wrench_source
from shearloop.daemon.control.wrist_controller import WristController
from shearloop.daemon.loop_config import LoopConfig
from shearloop.daemon.torques import WRENCH, TorqueSample, TorqueSource
from tests.daemon.control.cell import Cell, driven
from tests.drivers.ur.handler_bench import CYCLE_NS, SETTINGS

CONFIG = LoopConfig()
# A tenth of what the wrist resolves.
CLOSE_RAD = 2e-5
# Without anything under way: what is sent shows in the angle at once.
AT_ONCE = LoopConfig(actuation_s=0.0)


def wrist(config: LoopConfig = AT_ONCE) -> WristController:
    return WristController(TorqueSource(name="load_cell", period_s=0.1), config)


def test_a_wrist_that_stands_sets_out_for_however_little():
    turn = wrist().turn(MoveToAngle(0.1 * CLOSE_RAD, 0.2), 10**9, 0.0)
    assert turn.speed_rad_per_s == pytest.approx(0.1 * CLOSE_RAD * CONFIG.angle_bandwidth_per_s)


def test_a_held_angle_is_kept():
    one, angle_rad, errors_rad = wrist(), 0.0, []
    for cycle in range(1000):
        speed = one.turn(MoveToAngle(0.15, 0.2), 10**9 + cycle * CYCLE_NS, angle_rad).speed_rad_per_s
        one.sent(speed)
        angle_rad += speed * CYCLE_NS / 1e9
        errors_rad.append(abs(angle_rad - 0.15))
    # From two seconds after the arrival on.
    assert max(errors_rad[375:]) < 1.1 * CLOSE_RAD


@pytest.mark.long
@pytest.mark.parametrize("allowed_rad_per_s", [1e-5, 4e-5, 1e-3, 0.2])
@pytest.mark.parametrize("bandwidth_per_s", [0.02, 5.0, 40.0])
def test_however_slow_it_turns_to_an_angle_and_back_and_stays_there(allowed_rad_per_s, bandwidth_per_s):
    one, angle_rad, t_ns = wrist(AT_ONCE.model_copy(update={"angle_bandwidth_per_s": bandwidth_per_s})), 0.0, 10**9
    way_rad = 200 * CYCLE_NS / 1e9 * allowed_rad_per_s
    # As long as the way takes, and as its last part does at this bandwidth.
    cycles = round(300 + 12.0 / bandwidth_per_s / (CYCLE_NS / 1e9))
    for goal_rad in (way_rad, -way_rad):
        for _ in range(2 * cycles):
            speed = one.turn(MoveToAngle(goal_rad, allowed_rad_per_s), t_ns, angle_rad).speed_rad_per_s
            assert abs(speed) <= allowed_rad_per_s
            one.sent(speed)
            angle_rad += speed * CYCLE_NS / 1e9
            t_ns += CYCLE_NS
        assert angle_rad == pytest.approx(goal_rad, abs=1.5 * CLOSE_RAD)


FASTEST_PER_S = next(
    float(each.le) for each in LoopConfig.model_fields["angle_bandwidth_per_s"].metadata if hasattr(each, "le")
)


@pytest.mark.parametrize("angle_rad", [0.01, 0.03, 0.1])
@pytest.mark.parametrize("bandwidth_per_s", [5.0, FASTEST_PER_S])
async def test_wrist_comes_to_rest_at_an_angle_however_fast_it_may_be_asked_to(angle_rad, bandwidth_per_s):
    config, sources = LoopConfig(angle_bandwidth_per_s=bandwidth_per_s), {WRENCH: wrench_source(SETTINGS.rate_hz)}
    twist = {"do": "twist", "angles_rad": [angle_rad], "speed_rad_per_s": 0.5, "hold_s": 60}
    async with driven(twist, cell=Cell(ControlLoop(config, sources, ("robot",))), cycles=350) as cell:
        for _ in range(150):
            await cell.cycles(1)
            assert cell.state.wrist_rad == pytest.approx(angle_rad, abs=1e-4)


TOOL = ToolModel(
    stiffness_nm_per_rad=0.2, stiffness_std=0.002, lag_s=0.0, lag_std_s=0.01, age_s=0.05, actuation_s=0.02,
    noise_nm=0.001, sample_period_s=0.1, angle_rad=0.0, torque_nm=0.0, torque_std_nm=0.0005,
)  # fmt: skip


def test_while_the_gain_is_checked_elsewhere_the_wrist_stands_and_then_the_loop_is_closed():
    checks: list[tuple[Callable[[], JudgedGain], Future[JudgedGain]]] = []

    def later(job: Callable[[], JudgedGain]) -> Future[JudgedGain]:
        checks.append((job, Future()))
        return checks[-1][1]

    one, goal = WristController(TorqueSource(name="load_cell", period_s=0.1), AT_ONCE, later), TrackTorque(0.1, 0.02)
    one.tool = TOOL
    for cycle in range(3):
        t_ns = 10**9 + cycle * CYCLE_NS
        assert one.close_loop(goal, t_ns, 0.0) is None
        assert one.tracked is None
        assert one.turn(goal, t_ns, 0.0).speed_rad_per_s == 0.0
    ((job, checked),) = checks
    checked.set_result(job())
    assert one.close_loop(goal, t_ns + CYCLE_NS, 0.0) is None
    assert one.tracked == goal
    one.reset()
    one.tool = TOOL
    assert one.close_loop(goal, t_ns + CYCLE_NS, 0.0) is None
    checks[1][1].set_result(JudgedGain(0.5, 0.0, "controller refused"))
    assert one.close_loop(goal, t_ns + CYCLE_NS, 0.0) == "controller refused"


def test_each_torque_has_its_own_ramp():
    one = wrist()
    one.tool = TOOL
    assert one.close_loop(TrackTorque(0.1, 0.5), 10**9, 0.0) is None
    assert one.close_loop(TrackTorque(0.3, 0.01), 10**9, 0.0) is None
    angle_rad = 0.0
    for cycle in range(1, 500):
        t_ns = 10**9 + cycle * CYCLE_NS
        one.on_torque(TorqueSample("load_cell", 0.2 * angle_rad, "", t_ns - CYCLE_NS // 2, t_ns))
        speed = one.turn(TrackTorque(0.3, 0.01), t_ns, angle_rad).speed_rad_per_s
        one.sent(speed)
        angle_rad += speed * CYCLE_NS / 1e9
    assert 0.2 * angle_rad == pytest.approx(0.01 * 500 * CYCLE_NS / 1e9, rel=0.15)


# A load cell after a `tighten`: the torque lags behind its stamps, and the noise alone would allow the greatest gain.
LAGGING = ToolModel(
    stiffness_nm_per_rad=0.768, stiffness_std=0.005, lag_s=0.06, lag_std_s=0.005, age_s=0.15, actuation_s=0.02,
    noise_nm=0.0011, sample_period_s=0.156, angle_rad=0.0, torque_nm=0.16, torque_std_nm=0.0005,
)  # fmt: skip


def test_the_automatic_gain_is_lowered_until_its_margins_pass_and_a_persons_is_refused():
    for kp in (None, 0.5):
        one = wrist(LoopConfig(kp=kp, gain_margin=4.0))
        one.tool = LAGGING
        refusal = one.close_loop(TrackTorque(0.05, 0.04), 10**9, 0.0)
        assert (refusal is None) == (kp is None), refusal
        if kp is None:
            assert one.controller.settings.kp == pytest.approx(0.4)
