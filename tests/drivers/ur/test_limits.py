"""Limits: commands stay within them, and an arm that follows stays within its range."""

import dataclasses
import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from shearloop.drivers.ur.limits import clip_linear, clip_stop, clip_wrist, line_violation, violation
from shearloop.drivers.ur.messages import MoveLinear, RtdeSample, Stop, WristSpeed
from shearloop.drivers.ur.poses import ONLY_TURNS_M, is_close, turn_between
from shearloop.drivers.ur.settings import InstalledTool, WristAccelerationBound, WristSpeedBound
from tests.drivers.ur.handler_bench import AT_REST, LIMITS, POSE, SETTINGS, enabled

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
    # A wrist that is to stand brakes at the inner acceleration at least, which slows no motion.
    brakes = asked.rad_per_s == 0 and asked.acceleration_rad_per_s2 < LIMITS.wrist_acceleration_rad_per_s2.inner
    assert bool(reasons) == (sent != asked and not brakes)
    inner_end = 2.0 - 0.1
    if abs(now.wrist_rad) >= inner_end:
        assert sent.rad_per_s * now.wrist_rad <= 1e-12, "only back inside"
    if math.hypot(*now.wrench[:3]) >= LIMITS.force_n.hard or math.hypot(*now.wrench[3:]) >= LIMITS.torque_nm.hard:
        assert sent.rad_per_s == 0


@given(
    st.lists(st.tuples(commands, st.integers(1, 60)), min_size=1, max_size=12), st.floats(-1.9, 1.9), st.integers(0, 3)
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
def test_a_linear_move_keeps_its_end_and_reports_a_slower_speed(asked):
    sent, reasons = clip_linear(asked, asked.pose, LIMITS)
    assert sent.pose == asked.pose
    assert sent.speed_m_per_s <= LIMITS.linear_speed_m_per_s.inner
    assert sent.acceleration_m_per_s2 <= LIMITS.linear_acceleration_m_per_s2.inner
    before = (asked.speed_m_per_s, asked.acceleration_m_per_s2)
    after = (sent.speed_m_per_s, sent.acceleration_m_per_s2)
    changes = sum(a != b for a, b in zip(before, after, strict=True))
    assert len(reasons) == changes


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2), st.floats(-1e300, 1e300) | st.floats(-1, 1))
@example(2, 488.0)
@example(0, 1e300)
def test_a_linear_move_that_ends_outside_the_workspace_is_refused_and_moves_nothing(axis, value):
    bench, box = enabled(), LIMITS.workspace
    pose = tuple(value if index == axis else here for index, here in enumerate(POSE))
    inside = box.lower_m[axis] + box.margin_m <= value <= box.upper_m[axis] - box.margin_m
    reply = bench.ask(MoveLinear(pose, 0.1, 0.1))
    assert reply.accepted == inside
    assert inside or f"{'xyz'[axis]} = {value:g} m, outside the robot's workspace" in reply.refusal
    assert inside or bench.state.motion == "idle"
    assert not inside or reply.sent.pose == pose


def six(index: int, value: float) -> tuple[float, ...]:
    """Return zeros with one value."""
    return tuple(value if index == number else 0.0 for number in range(6))


JOINTS, BOX = LIMITS.joints, LIMITS.workspace
# Each measured value: the words of its message, the changes of the sample, and its hard limit.
MEASURED: list[tuple[str, Callable[[float], dict[str, object]], float]] = [
    *((f"Joint {n + 1} is at", lambda v, n=n: {"q_rad": six(n, v)}, JOINTS.upper_rad[n]) for n in range(6)),
    *((f"Joint {n + 1} is at", lambda v, n=n: {"q_rad": six(n, -v)}, -JOINTS.lower_rad[n]) for n in range(6)),
    *((f"at {'xyz'[n]} =", lambda v, n=n: {"tcp_pose": six(n, v)}, BOX.upper_m[n]) for n in range(3)),
    *((f"at {'xyz'[n]} =", lambda v, n=n: {"tcp_pose": six(n, -v)}, -BOX.lower_m[n]) for n in range(3)),
    *((f"Joint {n + 1} speed", lambda v, n=n: {"qd_rad_per_s": six(n, v)}, LIMITS.wrist_speed_rad_per_s.hard)
      for n in range(5)),
    ("Wrist speed", lambda v: {"qd_rad_per_s": six(5, -v)}, LIMITS.wrist_speed_rad_per_s.hard),
    *(("Tool speed", lambda v, n=n: {"tcp_speed": six(n, v)}, LIMITS.linear_speed_m_per_s.hard) for n in range(3)),
    *(("Force", lambda v, n=n: {"wrench": six(n, -v)}, LIMITS.force_n.hard) for n in range(3)),
    *(("Torque", lambda v, n=n: {"wrench": six(n, v)}, LIMITS.torque_nm.hard) for n in range(3, 6)),
]  # fmt: skip


@settings(max_examples=3, deadline=None)
@pytest.mark.parametrize("command", [WristSpeed(0.3, 4.0), MoveLinear(POSE, 0.1, 0.1)], ids=["twist", "line"])
@pytest.mark.parametrize(("named", "changes", "hard"), MEASURED)
@given(share=st.floats(1.001, 100.0))
def test_measured_value_beyond_its_hard_limit_stops_every_motion(command, named, changes, hard, share):
    bench = enabled()
    assert bench.ask(command).accepted
    bench.run(20)
    moving = bench.state.motion
    bench.arm.be(**changes(max(share * hard, hard + 1e-6)))
    bench.run(1)
    assert bench.state.motion == "stopping" != moving
    assert named in bench.state.end_reason
    assert named in bench.ask(command).refusal


@settings(max_examples=20, deadline=None)
@pytest.mark.parametrize(
    ("named", "command", "changes", "bound"),
    [
        ("Wrist acceleration", WristSpeed(0.3, 4.0), "qd_rad_per_s", LIMITS.wrist_acceleration_rad_per_s2),
        ("Tool acceleration", WristSpeed(0.3, 4.0), "tcp_speed", LIMITS.linear_acceleration_m_per_s2),
        ("Tool acceleration", MoveLinear(POSE, 0.1, 0.1), "tcp_speed", LIMITS.linear_acceleration_m_per_s2),
    ],
)
@given(share=st.floats(0.01, 0.99) | st.floats(1.01, 2.0), index=st.integers(0, 2))
def test_measured_acceleration_beyond_its_hard_limit_stops_the_motion(named, command, changes, bound, share, index):
    bench = enabled()
    assert bench.ask(command).accepted
    for cycle in range(8):
        speed = share * bound.hard * CYCLE_S * cycle
        bench.arm.be(**{changes: six(5 if changes == "qd_rad_per_s" else index, speed)})
        bench.run(1)
    assert (named in bench.state.end_reason) == (share > 1)


def test_a_stop_may_brake_harder_than_a_motion_may_accelerate():
    bench = enabled()
    assert bench.ask(WristSpeed(0.3, 4.0)).accepted
    bench.run(20)
    assert bench.ask(Stop(4.0)).accepted
    for speed in (0.1, 0.0, 0.0, 0.0):
        bench.arm.be(tcp_speed=six(0, speed))
        bench.run(1)
    bench.run_until(lambda state: state.motion == "idle")
    assert bench.ask(MoveLinear(POSE, 0.1, 0.1)).accepted
    bench.run(10)
    assert bench.state.motion == "linear"


@pytest.mark.parametrize(
    ("configured", "reported", "differs"),
    [
        ({}, {}, ""),
        ({}, {"payload_kg": math.nan, "tcp_offset": (math.nan,) * 6}, ""),
        ({"payload_kg": 1.0, "payload_cog_m": (0.0, 0.0, 0.06), "tcp_offset": (0.0,) * 6}, {}, ""),
        ({"payload_kg": 1.0}, {"payload_kg": 1.009}, ""),
        ({"payload_kg": 1.0}, {"payload_kg": 1.02}, "payload_kg 1.02, the robot's settings have 1:"),
        ({"payload_kg": 0.0}, {"payload_kg": math.nan}, "does not report payload_kg, and the robot's settings have 0:"),
        ({"reported": False}, {"payload_kg": math.nan, "payload_cog_m": (math.nan,) * 3}, ""),
        ({"reported": False}, {}, "reports its payload, and the robot's settings say that it does not"),
        ({"payload_cog_m": (0.0, 0.0, 0.06)}, {"payload_cog_m": (0.0, 0.002, 0.06)}, "payload_cog_m 0, 0.002, 0.06"),
        ({"tcp_offset": (0.0, 0.0, 0.15, 0.0, 0.0, 0.0)}, {}, "tcp_offset 0, 0, 0, 0, 0, 0"),
        ({"tcp_offset": (0.0,) * 6}, {"tcp_offset": (0.0, 0.0, 0.0, 0.01, 0.0, 0.0)}, "tcp_offset"),
    ],
)
def test_tool_must_be_as_configured(configured, reported, differs):
    found = violation(
        dataclasses.replace(AT_REST, **reported), dataclasses.replace(SETTINGS, tool=InstalledTool(**configured))
    )
    assert differs in found if differs else not found


def test_values_that_are_no_numbers_stop():
    assert violation(AT_REST, SETTINGS) == ""
    assert "no numbers" in violation(reading(force_n=math.nan), SETTINGS)
    assert "no numbers" in violation(dataclasses.replace(AT_REST, tcp_speed=six(0, math.nan)), SETTINGS)


@pytest.mark.parametrize(
    ("changes", "limit"), [({"tcp_pose": six(0, 9.0)}, "workspace"), ({"q_rad": six(2, -9.0)}, "joints")]
)
def test_an_arm_outside_its_limits_is_moved_back_by_hand_or_its_limits_are_corrected(changes, limit):
    found = violation(dataclasses.replace(AT_REST, **changes), SETTINGS)
    assert f"move the arm back with freedrive at the teach pendant, or correct `limits.{limit}`" in found


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


rotation_vectors = st.tuples(*[st.floats(-math.pi, math.pi)] * 3)


@given(rotation_vectors, rotation_vectors)
def test_the_turn_between_two_poses(one, other):
    turn = Rotation.from_rotvec(one).inv() * Rotation.from_rotvec(other)
    assert turn_between((0.0, 0.0, 0.0, *one), (1.0, 2.0, 3.0, *other)) == pytest.approx(turn.magnitude(), abs=1e-6)


@pytest.mark.parametrize(
    ("way_m", "turn_rad"), [(0.001, 1.5), (0.01, 1.5), (0.1, 0.1), (0.1, 0.0), (0.0, 1.0), (1e-16, 1.0), (1e-7, 1.0)]
)
def test_a_straight_move_turns_the_tool_no_faster_than_the_wrist_may(way_m, turn_rad):
    """The speed of one that only turns, but for rounding, is in rad/s."""
    here = (0.4, 0.1, 0.0, math.pi, 0.0, 0.0)
    turned = (Rotation.from_rotvec(here[3:]) * Rotation.from_rotvec((0.0, 0.0, turn_rad))).as_rotvec()
    asked = MoveLinear((0.4, 0.1, way_m, *map(float, turned)), 0.05, 0.3)
    sent, reasons = clip_linear(asked, here, LIMITS)
    rad_per_m = turn_rad / way_m if way_m > ONLY_TURNS_M else 1.0
    assert rad_per_m * sent.speed_m_per_s <= LIMITS.wrist_speed_rad_per_s.inner + 1e-9
    assert rad_per_m * sent.acceleration_m_per_s2 <= LIMITS.wrist_acceleration_rad_per_s2.inner + 1e-9
    assert any("the tool turns" in reason for reason in reasons) is (sent.speed_m_per_s < 0.05)
    assert (sent.speed_m_per_s < 0.05) is (turn_rad == 1.5)


@pytest.mark.parametrize("way_m", [0.0, 1e-7])
def test_a_move_that_only_turns_the_tool_is_as_slow_as_the_wrist(way_m):
    limits = dataclasses.replace(
        LIMITS,
        wrist_speed_rad_per_s=WristSpeedBound(0.02, 0.35),
        wrist_acceleration_rad_per_s2=WristAccelerationBound(0.1, 8.0),
    )
    asked = MoveLinear((0.4, 0.1, way_m, math.pi / 2, 0.0, 0.0), 0.1, 0.5)
    sent, _ = clip_linear(asked, (0.4, 0.1, 0.0, math.pi, 0.0, 0.0), limits)
    assert (sent.speed_m_per_s, sent.acceleration_m_per_s2) == (0.02, 0.1)
