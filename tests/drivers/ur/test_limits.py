"""Limits: commands stay within them, and an arm that follows stays within its range."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from shearloop.drivers.ur.messages import MoveLinear, RtdeSample, WristSpeed
from shearloop.drivers.ur.motion import clip_linear, clip_stop, clip_wrist, is_close, line_violation, violation
from tests.drivers.ur.flight import AT_REST, LIMITS, SETTINGS

CYCLE_S = 0.008


def reading(wrist_rad: float = 0.0, speed: float = 0.0, force_n: float = 0.0, torque_nm: float = 0.0) -> RtdeSample:
    return dataclasses.replace(
        AT_REST,
        q_rad=(*AT_REST.q_rad[:5], wrist_rad),
        qd_rad_per_s=(0.0, 0.0, 0.0, 0.0, 0.0, speed),
        wrench=(force_n, 0.0, 0.0, 0.0, torque_nm, 0.0),
    )


anything = st.floats(-1e9, 1e9)
above_0 = st.floats(1e-6, 1e9)
commands = st.builds(WristSpeed, anything | st.floats(-2, 2), above_0 | st.floats(0.01, 8))
readings = st.builds(reading, st.floats(-2.5, 2.5), st.floats(-1.5, 1.5), st.floats(0, 100), st.floats(0, 10))


@given(commands, readings)
def test_wrist_command_is_within_the_limits_and_reports_clipping(asked, now):
    sent, reasons = clip_wrist(asked, now, SETTINGS)
    assert abs(sent.rad_per_s) <= min(LIMITS.wrist_speed_rad_per_s.inner, abs(asked.rad_per_s))
    assert sent.rad_per_s * asked.rad_per_s >= 0
    assert 0 < sent.acceleration_rad_per_s2 <= LIMITS.wrist_acceleration_rad_per_s2.inner
    assert bool(reasons) == (sent != asked)
    inner_end = 2.0 - 0.1
    if abs(now.wrist_rad) >= inner_end:
        assert sent.rad_per_s * now.wrist_rad <= 1e-12, "only back inside"
    if math.hypot(*now.wrench[:3]) >= LIMITS.force_n.hard or math.hypot(*now.wrench[3:]) >= LIMITS.torque_nm.hard:
        assert sent.rad_per_s == 0


@settings(deadline=None)
@given(
    st.lists(st.tuples(commands, st.integers(1, 60)), min_size=1, max_size=12),
    st.floats(-1.9, 1.9),
    st.integers(0, 3),
)
@example([(WristSpeed(1e9, 0.01), 400), (WristSpeed(-0.01, 1e-6), 60)], 1.0, 3)
@example([(WristSpeed(0.8, 4.0), 60), (WristSpeed(0.79, 1e-6), 60), (WristSpeed(0.0, 1e-6), 60)], 1.7, 3)
def test_arm_that_follows_stays_within_its_inner_range(asked, begin_rad, cycles_late):
    """The arm follows as with speedJ; commands take effect some cycles late."""
    wrist_rad, speed = begin_rad, 0.0
    under_way = [WristSpeed(0.0, 4.0)] * cycles_late
    for command, cycles in asked:
        for _ in range(cycles):
            sent, _ = clip_wrist(command, reading(wrist_rad, speed), SETTINGS)
            under_way.append(sent)
            now = under_way.pop(0)
            step = now.acceleration_rad_per_s2 * CYCLE_S
            before, speed = speed, speed + min(max(now.rad_per_s - speed, -step), step)
            wrist_rad += 0.5 * (before + speed) * CYCLE_S
            assert abs(wrist_rad) <= 1.9 + 1e-9
            assert abs(speed) <= 0.8 + 1e-12


@given(above_0, st.floats(-1.9, 1.9), st.floats(-0.8, 0.8))
def test_stop_brakes_within_the_range(asked, wrist_rad, speed):
    room = 1.9 - abs(wrist_rad) if wrist_rad * speed > 0 else 1.9 + abs(wrist_rad)
    sent = clip_stop(asked, reading(wrist_rad, speed), SETTINGS)
    assert 0 < sent <= LIMITS.wrist_acceleration_rad_per_s2.hard
    if speed * speed / 2 / LIMITS.wrist_acceleration_rad_per_s2.inner + abs(speed) * SETTINGS.reaction_s < room:
        assert speed * speed / 2 / sent + abs(speed) * SETTINGS.reaction_s <= room + 1e-9


poses = st.tuples(*[anything] * 3, *[st.floats(-math.pi, math.pi)] * 3)


@given(st.builds(MoveLinear, poses, above_0, above_0))
def test_linear_move_ends_within_the_workspace_and_reports_clipping(asked):
    sent, reasons = clip_linear(asked, LIMITS)
    box = LIMITS.workspace
    for value, low, high in zip(sent.pose[:3], box.lower_m, box.upper_m, strict=True):
        assert low + box.margin_m <= value <= high - box.margin_m
    assert sent.pose[3:] == asked.pose[3:]
    assert sent.speed_m_per_s <= LIMITS.linear_speed_m_per_s.inner
    assert sent.acceleration_m_per_s2 <= LIMITS.linear_acceleration_m_per_s2.inner
    before = (*asked.pose, asked.speed_m_per_s, asked.acceleration_m_per_s2)
    after = (*sent.pose, sent.speed_m_per_s, sent.acceleration_m_per_s2)
    changes = sum(a != b for a, b in zip(before, after, strict=True))
    assert len(reasons) == changes


def test_every_hard_limit_is_named():
    assert violation(AT_REST, LIMITS) == ""
    assert "Joint 3" in violation(dataclasses.replace(AT_REST, q_rad=(0.0, 0.0, 3.01, 0.0, 0.0, 0.0)), LIMITS)
    assert "z = -0.010 m" in violation(dataclasses.replace(AT_REST, tcp_pose=(0.0, 0.0, -0.01, 0.0, 0.0, 0.0)), LIMITS)
    assert "Wrist speed" in violation(reading(speed=-1.01), LIMITS)
    assert "Force is 60.10 N" in violation(reading(force_n=60.1), LIMITS)
    assert "Torque" in violation(reading(torque_nm=6.1), LIMITS)
    assert "no numbers" in violation(reading(force_n=math.nan), LIMITS)


def test_linear_move_is_watched_at_the_inner_limits():
    assert line_violation(AT_REST, LIMITS) == ""
    assert "force" in line_violation(reading(force_n=41.0), LIMITS)
    towards = dataclasses.replace(
        AT_REST, q_rad=(0.0, 0.0, 2.85, 0.0, 0.0, 0.0), qd_rad_per_s=(0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
    )
    assert "joint 3" in line_violation(towards, LIMITS)
    away = dataclasses.replace(towards, qd_rad_per_s=(0.0, 0.0, -1.0, 0.0, 0.0, 0.0))
    assert line_violation(away, LIMITS) == ""


@given(st.tuples(*[st.floats(-1, 1)] * 3), st.floats(0, math.pi), st.tuples(*[st.floats(-9, 9)] * 3))
def test_torque_about_the_tool_axis_agrees_with_scipy(direction, angle, torque):
    length = math.hypot(*direction) or 1.0
    vector = np.array(direction) / length * angle
    now = dataclasses.replace(AT_REST, tcp_pose=(0.0, 0.0, 0.0, *vector.tolist()), wrench=(0.0, 0.0, 0.0, *torque))
    axis = Rotation.from_rotvec(vector).as_matrix()[:, 2]
    assert math.isclose(now.wrist_torque_nm, float(axis @ np.array(torque)), abs_tol=1e-9)


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [
        ((0.0, math.pi, 0.0), (0.0, -math.pi, 0.0), True),
        ((0.0, math.pi - 5e-4, 0.0), (0.0, -math.pi + 5e-4, 0.0), True),
        ((0.0, 0.0, 0.0), (0.0, 2 * math.pi, 0.0), True),
        ((0.0, math.pi, 0.0), (math.pi, 0.0, 0.0), False),
        ((0.0, 0.0, 0.0), (0.0, 0.003, 0.0), False),
    ],
)
def test_half_a_turn_is_the_same_either_way(one, other, same):
    assert is_close((0.4, 0.1, 0.3, *one), (0.4, 0.1, 0.3, *other), 2e-3) is same
    assert not is_close((0.4, 0.1, 0.3, *one), (0.4, 0.103, 0.3, *other), 2e-3)


@given(st.tuples(*[st.floats(-1, 1)] * 3), st.floats(1e-3, math.pi), st.tuples(*[st.floats(-2e-3, 2e-3)] * 3))
def test_closeness_agrees_with_scipy(direction, angle, turned):
    one = np.array(direction) / (math.hypot(*direction) or 1.0) * angle
    rotation = Rotation.from_rotvec(turned) * Rotation.from_rotvec(one)
    close = is_close((0.0, 0.0, 0.0, *one.tolist()), (0.0, 0.0, 0.0, *rotation.as_rotvec().tolist()), 2e-3)
    # At half a turn a rotation vector changes up to 1.6 times as much as the rotation.
    apart_rad = math.hypot(*turned)
    assert close or apart_rad > 2e-3 / 1.6
    assert not close or apart_rad < 2.001e-3
