import math
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shearloop.emulators.scene import Joint, Twin, TwinSettings, TwinState

DT_S = 0.008
FIRM_N = 40.0
STIFF = 0.8 * 20.0 / 20.8  # gel and joint in series


def sweep(twin: Twin, stop_rad: float, speed_rad_per_s: float = 0.2, start_rad: float = 0.0) -> list[TwinState]:
    steps = max(1, round(abs(stop_rad - start_rad) / speed_rad_per_s / DT_S))
    return [twin.step(DT_S, start_rad + (stop_rad - start_rad) * n / steps, FIRM_N) for n in range(steps + 1)]


def test_a_quick_twist_is_a_spring_that_relaxes_to_its_share_with_its_time_constant():
    twin = Twin()
    twin.step(DT_S, 0.0, FIRM_N)
    first = twin.step(1e-6, 0.1, FIRM_N).torque_nm
    assert first == pytest.approx(STIFF * 0.1, rel=1e-6)
    states = [twin.step(0.1, 0.1, FIRM_N) for _ in range(4000)]
    # In series with a joint of finite stiffness the end is softer than the gel's own share by that compliance.
    relaxed = 0.1 / (1 / (0.8 * (1 - 0.08)) + 1 / 20.0)
    assert states[-1].torque_nm == pytest.approx(relaxed, rel=1e-3)
    assert all(later.torque_nm <= sooner.torque_nm for sooner, later in pairwise(states))
    at_time_constant = (states[200].torque_nm - relaxed) / (first - relaxed)
    assert at_time_constant == pytest.approx(math.exp(-1), abs=0.05)


def test_the_grip_slips_at_the_torque_that_its_force_bears():
    twin = Twin()
    for n in range(500):
        twin.step(DT_S, 0.002 * n, 10.0)
    assert twin.state.torque_nm == pytest.approx(0.012 * 10.0, rel=1e-6)
    assert twin.state.slipped_rad > 0.5


def test_conductivity_lags_behind_a_reversal_by_the_width_of_the_band():
    twin = Twin(TwinSettings(relaxation_s=1e9, joint_stiffness_nm_per_rad=1e9))
    up = sweep(twin, 0.1)[-1]
    down = sweep(twin, 0.05, start_rad=0.1)[-1]
    assert up.torque_nm - up.shear_torque_nm == pytest.approx(0.8 * 0.002, rel=1e-3)
    assert down.torque_nm - down.shear_torque_nm == pytest.approx(-0.8 * 0.002, rel=1e-3)


def test_a_seized_screw_breaks_loose_and_turns_at_a_lower_torque():
    twin = Twin(TwinSettings(joint=Joint.SEIZED))
    torques = [state.torque_nm for state in sweep(twin, 0.6)]
    assert max(torques) == pytest.approx(0.18, abs=0.005)
    assert torques[-1] == pytest.approx(0.06, abs=1e-6)
    assert twin.state.tool_angle_rad > 0.3


def test_a_screw_tightens_clockwise():
    tight = Twin(TwinSettings(joint=Joint.TIGHTENING))
    torques = [-state.torque_nm for state in sweep(tight, -1.5)]
    assert torques[-1] > torques[len(torques) // 2] > 0.1


@pytest.mark.parametrize(("joint", "at_rad", "again_rad"), [(Joint.LEVER, 0.1, 0.1), (Joint.TIGHTENING, -1.0, 0.0)])
def test_opening_the_gripper_lets_the_torque_go_for_good(joint, at_rad, again_rad):
    twin = Twin(TwinSettings(joint=joint))
    sweep(twin, at_rad)
    assert twin.step(DT_S, at_rad, 0.0) == TwinState(tool_angle_rad=twin.state.tool_angle_rad)
    assert twin.step(DT_S, again_rad, FIRM_N).torque_nm == pytest.approx(0.0, abs=1e-12)


@given(
    st.sampled_from(Joint),
    st.lists(st.tuples(st.floats(-3, 3), st.floats(0, 60), st.floats(0.001, 5)), min_size=1, max_size=30),
)
def test_the_torque_never_exceeds_what_the_grip_bears(joint, moves):
    twin = Twin(TwinSettings(joint=joint))
    for wrist_rad, force_n, dt_s in moves:
        state = twin.step(dt_s, wrist_rad, force_n)
        assert math.isfinite(state.torque_nm)
        assert abs(state.torque_nm) <= 0.012 * force_n + 1e-6
        assert state.gripped == (force_n > 0)
