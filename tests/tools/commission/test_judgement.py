"""What the stages make of their measurements: each fault fails its own line, and no other."""

import contextlib
import dataclasses
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml

from shearloop.bank.channels import PAPER_TABLE
from shearloop.daemon.config import load_daemon_config
from shearloop.daemon.supplied_values import NOTHING_SUPPLIED
from shearloop.drivers.eit_kit import Frame
from shearloop.drivers.load_cell import LoadSample
from shearloop.drivers.robotiq.width_fit import fit_width
from shearloop.drivers.shear_skin.skin import SkinFault, SkinSample
from shearloop.drivers.ur.limits import slowed_by
from shearloop.drivers.ur.messages import RtdeOutputs
from shearloop.drivers.ur.settings import ForceBound, InstalledTool
from shearloop.emulators.synthetic_skin import SyntheticSkin
from shearloop.estimation.skin.calibration import load_calibration
from shearloop.tools.arm_models import Arm
from shearloop.tools.commission import boards, tool, wrench
from shearloop.tools.commission.boards import judge_frames, judge_load
from shearloop.tools.commission.bounds import LARGEST_RAD, LARGEST_RAD_PER_S, bounded
from shearloop.tools.commission.curves import middle_s, step_s
from shearloop.tools.commission.gripper import judge_widths
from shearloop.tools.commission.hand_stops import HandStop, hand_speeds, judge_hand_stops
from shearloop.tools.commission.limits import EMULATED, REAL, REHEARSED
from shearloop.tools.commission.motion import SIGMAS, Turn, judge_noise, judge_slider
from shearloop.tools.commission.observer import Seen
from shearloop.tools.commission.rtde import judge_clock, judge_samples
from shearloop.tools.commission.skin import judge_pressed, judge_skin, why_not_timed
from shearloop.tools.commission.stops import Stop, judge_stops, rising_speeds
from shearloop.tools.commission.tap import (
    frame_step_s,
    judge_clocks,
    load_step_s,
    robot_step_s,
    skin_step_s,
    why_hidden,
)
from shearloop.tools.commission.tool import Held, covered_nm, judge_scales, judge_signs, judge_twists, raised_line
from shearloop.tools.commission.watchdog_worker import for_watchdog_alone
from shearloop.tools.commission.wrench import (
    LARGEST_KG,
    Reading,
    judge_mass,
    judge_rest,
    largest_mass_kg,
    least_mass_kg,
)
from tests.drivers.ur.robots import DELIVERED
from tests.emulators.test_cb3 import SETTINGS as CB3

SIX = (0.0,) * 6
AT_REST = RtdeOutputs(0.0, SIX, SIX, SIX, SIX, SIX, 7, 1, 2, 1.0, 1.0, 1, 0, 0.002, 1.0, (0.0, 0.0, 0.0), SIX)
PERIOD_S = 0.008
RANDOM = np.random.default_rng(3)


@pytest.fixture(autouse=True)
def _same_noise():
    """Begin each test with the same noise, whichever tests ran before it."""
    RANDOM.bit_generator.state = np.random.default_rng(3).bit_generator.state


def failed(lines) -> list[str]:
    return [line.what for line in lines if line.verdict == "failed"]


def samples(seconds: float, late_s: float = 0.0, **changed) -> list[Seen]:
    """Return samples of an arm that stands; `late_s` is a pause in the middle."""
    found = []
    for number in range(round(seconds / PERIOD_S)):
        t_s = number * PERIOD_S
        arrived_s = t_s + (late_s if number == round(seconds / PERIOD_S) // 2 else 0.0)
        outputs = dataclasses.replace(AT_REST, timestamp_s=t_s, script_ticks=round(t_s / 0.002), **changed)
        found.append(Seen(round(t_s * 1e9), round(arrived_s * 1e9), outputs))
    return found


@pytest.mark.parametrize(
    ("seen", "lines"),
    [
        (samples(4.0), []),
        ([seen for number, seen in enumerate(samples(4.0)) if number % 20], ["rate"]),
        (samples(4.0, late_s=0.05), ["largest gap"]),
    ],
)
def test_lost_and_late_states_fail_their_lines(seen, lines):
    assert failed(judge_samples(seen, DELIVERED.rate_hz, REAL)) == lines
    assert failed(judge_samples(seen, DELIVERED.rate_hz, EMULATED)) == []


@pytest.mark.parametrize(("rate", "lines"), [(1.0, []), (0.977, ["script's clock"]), (1.02, ["script's clock"])])
def test_a_clock_that_loses_cycles_fails(rate, lines):
    seen = [
        dataclasses.replace(
            one, outputs=dataclasses.replace(one.outputs, script_ticks=round(rate * one.outputs.script_ticks))
        )
        for one in samples(4.0)
    ]
    assert failed([judge_clock(seen)]) == lines


def test_a_clock_of_which_no_state_came_is_not_measured_and_not_one_that_stands():
    line = judge_clock([])
    assert line.verdict == "failed"
    assert line.count == 0
    assert "not measured: 0 states" in line.value


@pytest.mark.parametrize(("sigma", "lines"), [(0.0005, []), (0.003, ["velocity noise at rest"])])
def test_noise_that_looks_like_motion_fails(sigma, lines):
    seen = [
        dataclasses.replace(
            one, outputs=dataclasses.replace(one.outputs, qd_rad_per_s=tuple(RANDOM.normal(0.0, sigma, 6)))
        )
        for one in samples(8.0)
    ]
    line, found = judge_noise(seen, DELIVERED.rest_rad_per_s)
    assert failed([line]) == lines
    assert found == pytest.approx(sigma, rel=0.2)
    assert f"{SIGMAS:g} σ" in line.value


def test_a_turn_has_its_delay_speed_and_acceleration():
    speeds = [0.0] * 3 + [0.05, 0.1, 0.15] + [0.2] * 100 + [0.15, 0.1, 0.05, 0.0]
    seen = [
        Seen(
            round(number * PERIOD_S * 1e9),
            0,
            dataclasses.replace(AT_REST, timestamp_s=number * PERIOD_S, qd_rad_per_s=(*SIX[:5], speed)),
        )
        for number, speed in enumerate(speeds)
    ]
    turn = Turn(0, 0.2, seen)
    assert turn.delay_s(0.004) == pytest.approx(3 * PERIOD_S)
    assert np.mean(turn.cruise()) == pytest.approx(1.0)
    assert turn.largest_acceleration() == pytest.approx(0.2 / 0.04, rel=0.01)
    assert Turn(0, 0.2, seen[:2]).delay_s(0.004) == math.inf


HALVED = dataclasses.replace(AT_REST, speed_slider=0.5)


@pytest.mark.parametrize(
    ("slider", "refusal", "verdict"),
    [
        (0.5, slowed_by(HALVED).sentence, "passed"),
        (0.5, "", "failed"),
        (0.5, "The program was ended at the pendant, where the speed slider is.", "failed"),
        (1.0, slowed_by(HALVED).sentence, "failed"),
    ],
)
def test_a_motion_at_half_slider_is_refused_for_the_slider(slider, refusal, verdict):
    """Another refusal may have the word too."""
    assert judge_slider(refusal, dataclasses.replace(AT_REST, speed_slider=slider)).verdict == verdict


GOOD = Stop("worker killed", 0.15, 0.02, 1, "")


@pytest.mark.parametrize(
    ("stop", "lines"),
    [
        (GOOD, []),
        (dataclasses.replace(GOOD, time_s=0.21), ["time to rest at 0.2 rad/s"]),
        (dataclasses.replace(GOOD, safety_mode=3), ["safety mode after stops at 0.2 rad/s"]),
        (dataclasses.replace(GOOD, refusal="no"), ["recovery at 0.2 rad/s"]),
    ],
)
def test_one_bad_stop_fails_its_line(stop, lines):
    assert failed(judge_stops([GOOD, stop], "at 0.2 rad/s", "rad", REAL.rest_s(DELIVERED))) == lines


def test_a_rehearsed_stop_is_no_measurement():
    """The arm turned on to the end of its way: nothing of its times and ways is of a layer."""
    slow = dataclasses.replace(GOOD, time_s=1.088, way=0.1964)
    lines = judge_stops([slow], "at 0.2 rad/s", "rad", EMULATED.rest_s(DELIVERED), rehearsed=True)
    timed = [line for line in lines if "time to rest" in line.what or "worker killed" in line.what]
    assert [(line.verdict, line.value) for line in timed] == [("noted", REHEARSED)] * 2
    line = judge_hand_stops("emergency stop", [HAND], 1, 3.0, rehearsed=True)
    assert REHEARSED in line.value
    assert "0.0200 rad" not in line.value


@pytest.mark.parametrize(
    ("rad_per_s", "stopped"),
    [(0.51, 0.5), (0.495, 0.5), (0.47, 0.47), (0.45, 0.45), (0.449, 0.44), (0.29, 0.29), (0.03, 0.03)],
)
def test_a_stop_by_hand_counts_for_the_speed_that_it_stopped(rad_per_s, stopped):
    assert dataclasses.replace(HAND, rad_per_s=rad_per_s).stopped_rad_per_s(0.01) == stopped


HAND = HandStop(0.5, 0.47, 0.05, 0.02, 1)


@pytest.mark.parametrize(
    ("stop", "asked", "verdict"),
    [
        (HAND, 2, "passed"),
        (HAND, 3, "failed"),
        (dataclasses.replace(HAND, time_s=0.21), 2, "failed"),
        (dataclasses.replace(HAND, time_s=math.inf, rad=math.inf), 2, "failed"),
        (dataclasses.replace(HAND, time_s=None, rad=0.09), 2, "passed"),
        (dataclasses.replace(HAND, time_s=None, rad=0.11), 2, "failed"),
        (dataclasses.replace(HAND, refusal="no"), 2, "failed"),
        (dataclasses.replace(HAND, safety_mode=7), 2, "passed"),
    ],
)
def test_a_stop_by_hand_is_judged_by_time_angle_and_recovery(stop, asked, verdict):
    line = judge_hand_stops("emergency stop", [HAND, stop], asked, REAL.rest_s(DELIVERED))
    assert (line.verdict, line.count) == (verdict, 2)


def test_a_line_on_stops_by_hand_has_time_angle_mode_recovery_and_count():
    stops = [dataclasses.replace(HAND, asked_rad_per_s=0.05, time_s=0.03), dataclasses.replace(HAND, safety_mode=7)]
    line = judge_hand_stops("emergency stop", stops, 2, 0.2)
    for part in ("0.030 to 0.050 s", "0.0200 rad", "0.47 rad/s", "robot emergency stop", "recovery 2 of 2"):
        assert part in line.value
    assert judge_hand_stops("cable pulled", [], 5, 0.2, "never").value == "never"


@pytest.mark.parametrize(
    ("passed", "count", "speeds"),
    [
        ((0.05, 0.2, 0.5), 5, [0.05, 0.2, 0.5, 0.5, 0.5]),
        ((0.05, 0.2, 0.45), 2, [0.05, 0.2]),
        ((0.2,), 3, [0.2, 0.2, 0.2]),
    ],
)
def test_stops_by_hand_come_once_at_each_speed_and_then_at_the_largest(passed, count, speeds):
    assert hand_speeds(passed, count) == speeds


READING = Reading(SIX, 0.5, 0.02, 0.001)


@pytest.mark.parametrize(
    ("reading", "lines"),
    [
        (READING, []),
        (dataclasses.replace(READING, mean=(8.0, *SIX[1:])), ["force at rest"]),
        (dataclasses.replace(READING, force_sigma_n=9.0), ["force: 5 σ + bias"]),
        (dataclasses.replace(READING, mean=(*SIX[:5], 0.3)), ["torque at rest"]),
    ],
)
def test_a_wrench_without_a_load_fails_its_line(reading, lines):
    assert failed(judge_rest([READING, reading], DELIVERED)) == lines


@pytest.mark.parametrize(("force_n", "lines"), [(-19.6, []), (-12.0, ["hung mass"])])
def test_a_hung_mass_is_weighed(force_n, lines):
    after = dataclasses.replace(READING, mean=(0.0, 0.0, force_n, 0.0, 0.0, 0.0))
    assert failed([judge_mass(READING, after, 2.0, DELIVERED)]) == lines


def test_a_mass_that_is_hung_is_bounded_by_the_arm_and_by_the_limit_that_stops_it():
    careful = dataclasses.replace(DELIVERED.limits, force_n=ForceBound(20.0, 30.0))
    largest_kg, because = largest_mass_kg(dataclasses.replace(DELIVERED, limits=careful), 1.0, Arm("UR5", (5.0,)))
    assert largest_kg == pytest.approx((30.0 - 3.5) / 9.81, abs=0.1)
    assert "limits.force_n.hard stops the arm at 30 N" in because
    assert largest_mass_kg(DELIVERED, 4.5, Arm("UR5", (5.0,))) == (
        0.5,
        "this UR5 is rated for 5 kg, and its payload is 4.5 kg",
    )
    wide = dataclasses.replace(CB3.limits, force_n=ForceBound(120.0, 150.0))
    settings = dataclasses.replace(CB3, limits=wide)
    assert largest_mass_kg(settings, 1.0, Arm("UR10", (10.0,)))[0] == LARGEST_KG
    assert largest_mass_kg(settings, 1.0, Arm("UR3", (3.0,)))[0] == 2.0, "less than a CB3 shows"
    assert largest_mass_kg(settings, 2.5)[0] == 0.5, "an unknown arm may be the smallest one"
    assert largest_mass_kg(settings, 4.0, Arm("UR3", (3.0,)))[0] == 0.0
    newer_kg, because = largest_mass_kg(settings, 9.0, Arm("UR10", (10.0, 12.5)))
    assert (newer_kg, because.partition(",")[0]) == (1.0, "a UR10 of an earlier year is rated for 10 kg")


def test_a_stage_without_a_mass_that_may_hang_says_what_stays_unmeasured():
    context: Any = SimpleNamespace(
        settings=dataclasses.replace(CB3, tool=InstalledTool(payload_kg=1.25)),
        config=SimpleNamespace(emulated=False),
        rig=SimpleNamespace(arm=lambda: Arm("UR3", (3.0,))),
    )
    line = wrench.hung_mass(context)
    assert (line.verdict, "at most 1.7 kg may hang" in line.value) == ("noted", True)
    assert "The scale of the wrench's force stays unmeasured" in line.value


@pytest.mark.parametrize("settings", [DELIVERED, CB3], ids=["e-series", "cb3"])
def test_a_wrench_that_reads_nothing_fails_with_every_mass_that_may_be_hung(settings):
    least_kg = least_mass_kg(settings)
    assert least_kg < LARGEST_KG
    assert failed([judge_mass(READING, READING, least_kg, settings)]) == ["hung mass"]


def frames(period_s: float = 0.5, dead: int | None = None, noise_v: float = 0.001) -> list[Frame]:
    found = []
    for number in range(20):
        channels = 0.5 + RANDOM.normal(0.0, noise_v, 8)
        is_dead = np.array([position == dead for position in range(8)])
        t_ns = round(number * period_s * 1e9)
        found.append(
            Frame(
                channels=channels, raw=channels, t_begin_ns=t_ns, t_mid_ns=t_ns, t_arrival_ns=t_ns, seq=number,
                saturated=is_dead & False, dead=is_dead, repeated=False,
            )
        )  # fmt: skip
    return found


@pytest.mark.parametrize(
    ("seen", "lines"),
    [
        (frames(), []),
        (frames(period_s=0.6), ["rate of right"]),
        (frames(noise_v=0.05), ["noise of right"]),
        (frames(dead=3), ["dead channels of right"]),
    ],
)
def test_a_board_fails_its_line(seen, lines):
    assert failed(judge_frames("right", seen, 0.5)) == lines


def loads(torque_nm: float, noise_nm: float = 0.0005, rate_hz: float = 10.0) -> list[LoadSample]:
    return [
        LoadSample(0.0, torque_nm + noise_nm * RANDOM.normal(), round(n / rate_hz * 1e9), round(n / rate_hz * 1e9))
        for n in range(40)
    ]


@pytest.mark.parametrize(
    ("rest", "loaded", "lines"),
    [
        (loads(0.01), loads(0.11), []),
        (loads(0.01), loads(-0.09), []),
        (loads(0.01), loads(0.115), ["scale of the load cell"]),
        (loads(0.01, rate_hz=12.0), loads(0.11), ["rate of the load cell"]),
        (loads(0.01, noise_nm=0.004), loads(0.11), ["noise of the load cell"]),
    ],
)
def test_the_load_cell_fails_its_line(rest, loaded, lines):
    assert failed(judge_load(rest, loaded, 0.1, 10.0)) == lines


@pytest.mark.parametrize(
    ("after", "said", "lines"),
    [
        (Held(0.08, 0.05, 0.05), "counterclockwise", []),
        (Held(0.08, -0.05, 0.05), "counterclockwise", ["sign of the load cell"]),
        (Held(0.08, 0.05, -0.05), "counterclockwise", ["sign of the wrench"]),
        (Held(-0.08, 0.05, 0.05), "counterclockwise", ["sign of the wrist"]),
        (Held(0.08, 0.05, 0.05), "clockwise", ["sign of the command"]),
        (Held(0.08, 0.05, 0.05, {"right": 0.04}), "counterclockwise", []),
        (Held(0.08, 0.05, 0.05, {"right": -0.04}), "counterclockwise", ["sign of the estimate of right"]),
        (Held(0.08, 0.05, 0.05, {"right": None}), "counterclockwise", ["sign of the estimate of right"]),
    ],
)
def test_each_flipped_sign_fails_its_line(after, said, lines):
    assert failed(judge_signs(Held(0.0, 0.0, 0.0, dict.fromkeys(after.tactile_nm, 0.0)), after, said, 0.8)) == lines


@pytest.mark.parametrize("way", [1, -1])
def test_a_device_that_shows_no_change_has_no_sign(way):
    said = "counterclockwise" if way == 1 else "clockwise"
    before, dead = Held(0.0, 0.0, 0.0), Held(0.08 * way, 0.0, 0.05 * way)
    assert failed(judge_signs(before, dead, said, 0.8, way=way)) == ["sign of the load cell"]


def test_a_change_within_the_noise_or_far_below_the_springs_torque_has_no_sign():
    """Such a device is dead: its readings show less than the twist, by chance in the right direction."""
    before = Held(0.0, 0.0, 0.0, {"right": 0.0, "left": 0.0})
    dead = Held(0.08, 1e-6, 0.05, {"right": 1e-5, "left": 0.05})
    signs = ["sign of the load cell", "sign of the estimate of right"]
    assert failed(judge_signs(before, dead, "counterclockwise", 0.8)) == signs
    assert failed(judge_signs(before, Held(1e-4, 0.05, 0.05), "counterclockwise", 0.8)) == ["sign of the wrist"]
    after = Held(0.08, 0.05, 0.05, {"right": 0.04, "left": 0.04}, {"right": 0.008, "left": 0.006})
    noisy = dataclasses.replace(before, errors_nm={"right": 0.008, "left": 0.006})
    (line,) = [line for line in judge_signs(noisy, after, "counterclockwise", 0.8) if line.verdict == "failed"]
    assert (line.what, line.value) == ("sign of the estimate of right", "no change beyond 0.045 N·m")


def test_a_wrench_whose_noise_hides_the_twist_is_not_measured():
    errors_nm = {"wrench": 0.02}
    before, after = Held(0.0, 0.0, 0.0, errors_nm=errors_nm), Held(0.08, 0.05, -0.05, errors_nm=errors_nm)
    lines = judge_signs(before, after, "counterclockwise", 0.8)
    assert failed(lines) == []
    assert [line.verdict for line in lines if line.what == "sign of the wrench"] == ["noted"]


def test_emulated_frames_that_a_calibration_refuses_fail_nothing():
    before = Held(0.0, 0.0, 0.0, {"right": 0.0})
    lines = judge_signs(before, Held(0.08, 0.05, 0.05, {"right": None}), "counterclockwise", 0.8, emulated=True)
    assert failed(lines) == []
    assert [line.value for line in lines if "right" in line.what] == ["not measured: no estimate in the grip"]


def test_a_wrench_that_is_known_to_more_than_the_twist_shows_no_sign():
    before = Held(0.0, 0.0, 0.0)
    lines = judge_signs(before, Held(0.08, 0.05, -3.0), "counterclockwise", 0.8, 5.0)
    assert failed(lines) == []
    assert [line.value for line in lines if line.what == "sign of the wrench"] == [
        "not measured: the robot's wrench is known to 5 N·m, and the twist is smaller"
    ]
    assert failed(judge_signs(before, Held(0.08, 6.0, -6.0), "counterclockwise", 0.8, 5.0)) == ["sign of the wrench"]


def held(stiffness: float, left_nm: float = 0.0) -> list[Held]:
    angles = [0.0, *(0.08 * (-1) ** number for number in range(10)), 0.0]
    found = [Held(angle, stiffness * angle, 0.0) for angle in angles]
    return [*found[:-1], dataclasses.replace(found[-1], load_nm=left_nm)]


@pytest.mark.parametrize(
    ("turned", "lines"), [(held(0.8), []), (held(0.7), ["stiffness"]), (held(0.8, left_nm=0.02), ["slip in the grip"])]
)
def test_a_wrong_spring_and_a_slipping_grip_fail_their_lines(turned, lines):
    assert failed(judge_twists(turned, 0.8)) == lines


def one_way(direction: int) -> list[Held]:
    """Return the measurements of a load cell whose lever presses one way only, on a spring of 0.8 N·m/rad."""
    return [dataclasses.replace(one, load_nm=max(0.0, one.load_nm * direction) * direction) for one in held(0.8)]


@pytest.mark.parametrize(("way", "direction"), [(1, "counterclockwise"), (-1, "clockwise")])
def test_a_lever_that_presses_one_way_is_judged_in_that_direction(way, direction):
    assert failed(judge_twists(one_way(way), 0.8, way)) == []
    unknown = judge_twists(one_way(way), 0.8)
    assert failed(unknown) == ["stiffness"], "it would show half of the stiffness"
    assert f"write `load_cell.direction: {direction}`" in unknown[0].value
    assert "load_cell.direction" not in judge_twists(held(0.8), 0.8)[0].value


def test_a_turn_that_a_one_way_load_cell_measures_may_be_clockwise():
    before, after = Held(0.0, 0.0, 0.0), Held(-0.08, -0.05, -0.05)
    assert failed(judge_signs(before, after, "clockwise", 0.8, 0.0, -1)) == []
    assert failed(judge_signs(before, after, "counterclockwise", 0.8, 0.0, -1)) == ["sign of the command"]


def felt(scale: float | None) -> list[Held]:
    """Return the measurements of a fingertip with this scale at the first twists, and of a right wrench."""
    found = [dataclasses.replace(one, wrench_nm=one.load_nm) for one in held(0.8)]
    tactile = [{"right": None if scale is None else scale * one.load_nm + 0.01} for one in found[:3]]
    return [*(dataclasses.replace(one, tactile_nm=own) for one, own in zip(found, tactile, strict=False)), *found[3:]]


@pytest.mark.parametrize(("scale", "right"), [(1.1, ["wrench", "right"]), (1.4, ["wrench"]), (None, ["wrench"])])
def test_the_sources_with_the_right_scale_are_named_and_a_wrong_one_fails_nothing(scale, right):
    lines, found = judge_scales(felt(scale))
    assert (found, failed(lines)) == (right, [])
    assert judge_scales(felt(1.0), wrench_noise_nm=5.0)[1] == ["right"], "the wrench of a CB3 is an estimate"


def test_the_stage_says_which_torque_is_raised_and_of_what():
    assert "up to 0.540 N·m of load_cell and right; any other source 0.3 N·m" in raised_line(0.54, ["right"]).value
    assert "not raised: the twists reached 0.064 N·m" in raised_line(0.064, []).value
    one_way = raised_line(0.54, ["right"], "clockwise").value
    assert "up to 0.540 N·m of load_cell and right, clockwise alone; else 0.3 N·m" in one_way


def test_the_covered_torque_was_reached_in_each_direction_that_is_raised():
    slipped = [dataclasses.replace(one, load_nm=max(one.load_nm, -0.02)) for one in held(0.8)]
    assert (covered_nm(slipped), covered_nm(slipped, 1)) == (pytest.approx(0.02), pytest.approx(0.064))
    pressed = [
        dataclasses.replace(one, load_nm=-one.load_nm * 2 if one.wrist_rad < 0 else one.load_nm) for one in held(0.8)
    ]
    assert covered_nm(pressed, 1) == pytest.approx(0.064), "what a lever reads in the other direction is no measurement"
    assert covered_nm(held(0.8)[:2] + held(0.8)[-1:]) == 0.0, "one twist covers one direction"


@pytest.mark.parametrize("period_s", [0.008, 0.09, 0.3])
def test_the_middle_of_a_rise_does_not_depend_on_the_rate(period_s):
    """A ramp from 0.5 to 1.3 s, as a board sees it that averages over each of its periods."""
    fine_s = np.arange(0.0, 3.0, 1e-3)
    ramp = np.clip((fine_s - 0.5) / 0.8, 0.0, 1.0)
    middles_s = np.arange(0.5 * period_s, 2.9, period_s)
    means = [ramp[np.abs(fine_s - middle) <= 0.5 * period_s].mean() for middle in middles_s]
    curve = [(round(middle * 1e9), 0.05 * mean) for middle, mean in zip(middles_s, means, strict=True)]
    assert middle_s(curve, curve[0][1], curve[-1][1]) == pytest.approx(0.9, abs=0.01)


def pressed(period_s: float, at_s: float, noise_nm: float) -> list[tuple[int, float]]:
    """Return a curve of means over each period, of a torque that rises by 0.1 N·m within 0.1 s about a moment."""
    fine_s = np.arange(0.0, 6.0, 1e-3)
    torque_nm = 0.1 * np.clip((fine_s - at_s) / 0.1 + 0.5, 0.0, 1.0)
    ends = np.arange(period_s, 6.0, period_s)
    means = [torque_nm[(fine_s >= end - period_s) & (fine_s < end)].mean() for end in ends]
    return [
        (round(1e9 * (end - 0.5 * period_s)), mean + RANDOM.normal(0.0, noise_nm))
        for end, mean in zip(ends, means, strict=True)
    ]


@pytest.mark.parametrize(("period_s", "noise_nm"), [(0.008, 0.03), (0.09, 0.001), (0.02, 0.005)])
@pytest.mark.parametrize("at_s", [2.0, 3.03, 4.2])
def test_the_moment_of_a_press_is_found_to_a_fraction_of_the_limit(period_s, noise_nm, at_s):
    assert step_s(pressed(period_s, at_s, noise_nm), 0.6) == pytest.approx(at_s, abs=0.03)


@pytest.mark.parametrize("rise_s", [0.05, 0.15, 0.3])
def test_a_press_is_seen_in_the_noise_of_a_real_wrench(rise_s):
    """Uniform errors of ± 0.2 N·m about three axes at 125 Hz, as the UR5e's data sheet has its precision."""
    errors_s = []
    for _ in range(40):
        at_s = RANDOM.uniform(3.5, 4.5)
        times_s = np.arange(0.0, 8.0, 0.008)
        press_nm = 0.2 * np.clip((times_s - at_s) / rise_s + 0.5, 0.0, 1.0)
        noisy_nm = press_nm + RANDOM.uniform(-1.0, 1.0, len(times_s)) * 0.2 / math.sqrt(3)
        found_s = step_s([(round(1e9 * t_s), nm) for t_s, nm in zip(times_s, noisy_nm, strict=True)], 0.6)
        errors_s.append(found_s - at_s)
    assert np.std(errors_s) < 0.03
    assert np.quantile(np.abs(errors_s), 0.9) < REAL.clocks_s


def wrenches(press_nm: float, period_s: float) -> list[Seen]:
    """Return states with the noise of a UR5e's data sheet, and a press in their middle, at 2 s."""
    found = []
    for number in range(round(4.0 / period_s)):
        t_s = number * period_s
        pressed_nm = press_nm * min(max((t_s - 2.0) / 0.1 + 0.5, 0.0), 1.0)
        wrench = (*SIX[:5], pressed_nm + RANDOM.uniform(-1.0, 1.0) * 0.2 / math.sqrt(3))
        found.append(Seen(round(1e9 * t_s), round(1e9 * t_s), dataclasses.replace(AT_REST, wrench=wrench)))
    return found


@pytest.mark.parametrize(
    ("press_nm", "period_s", "hidden"),
    [(0.2, 0.008, False), (0.04, 0.008, True), (0.08, 0.008, True), (0.08, 0.002, False)],
)
def test_a_press_that_the_noise_of_the_wrench_hides_is_no_measure_of_a_clock(press_nm, period_s, hidden):
    """Where it is not hidden the moments are within the limit."""
    presses = [wrenches(press_nm, period_s) for _ in range(10)]
    assert [bool(why_hidden(states, 2.0)) for states in presses] == [hidden] * 10
    errors_s = [abs(robot_step_s(states) - 2.0) for states in presses]
    assert (max(errors_s) > REAL.clocks_s) == hidden


def test_noise_is_no_press():
    curve = [(number * 8_000_000, RANDOM.normal(0.0, 0.02)) for number in range(700)]
    assert step_s(curve, 0.6) is None
    assert load_step_s(loads(0.0)) is None
    assert frame_step_s(frames_pressed(None), PAPER_TABLE) is None


def frames_pressed(at_s: float | None) -> list[Frame]:
    """Return frames whose channels, each at its injection's time, change when the tool is pressed."""
    period_s, channels = 0.54, PAPER_TABLE.electrodes[:, 0]
    change_v = RANDOM.normal(0.0, 0.0015, len(channels))
    fractions = (channels + 0.5) / PAPER_TABLE.n_electrodes
    found = []
    for number in range(16):
        begin_s = number * period_s
        after = np.zeros(len(channels)) if at_s is None else begin_s + period_s * fractions >= at_s
        volts = 0.13 + RANDOM.normal(0.0, 0.002, len(channels)) + after * change_v
        begin_ns, mid_ns, end_ns = (round(1e9 * (begin_s + part * period_s)) for part in (0.0, 0.5, 1.0))
        none = np.zeros(len(channels), np.bool_)
        found.append(Frame(volts, volts, begin_ns, mid_ns, end_ns, number, none, none, repeated=False))
    return found


@pytest.mark.parametrize("at_s", [3.9, 4.1, 4.32, 4.6])
def test_a_frame_shows_within_which_injection_the_tool_was_pressed(at_s):
    assert frame_step_s(frames_pressed(at_s), PAPER_TABLE) == pytest.approx(at_s, abs=0.03)


@pytest.mark.parametrize(
    ("right_s", "load_s", "lines"),
    [
        (5.04, 5.3, []),
        (4.96, 4.97, []),
        (5.06, 5.3, ["clock of right"]),
        (4.94, 5.3, ["clock of right"]),
        (None, 5.3, ["clock of right"]),
        (5.0, 5.5, ["lag of the load cell"]),
        (5.0, 4.9, ["lag of the load cell"]),
        (5.0, None, ["lag of the load cell"]),
    ],
)
def test_a_late_device_fails_its_line(right_s, load_s, lines):
    assert failed(judge_clocks(("the robot's wrench", 5.0), {"right": right_s}, load_s, 10.0)) == lines


def test_a_press_that_the_reference_does_not_see_fails_every_clock():
    lines = judge_clocks(("the robot's wrench", None), {"right": 5.0}, 5.0, 10.0)
    assert failed(lines) == ["clock of right", "lag of the load cell"]
    assert "the press is not seen by the robot's wrench" in lines[0].value


@pytest.mark.parametrize(("settings", "seen"), [(CB3, False), (DELIVERED, True)], ids=["cb3", "e-series"])
def test_a_load_cell_alone_beside_a_cb3_has_no_lag_to_judge(monkeypatch, settings, seen):
    """Nothing sees the press: its wrench is too noisy, and there is no fingertip."""
    asked: list[str] = []
    cell = SimpleNamespace(take=lambda count, _: loads(0.1 if len(asked) > 1 else 0.0)[:count])
    context: Any = SimpleNamespace(
        config=SimpleNamespace(fingertips={}, load_cell=SimpleNamespace(rate_hz=10.9), gripper=None, skin=None),
        settings=settings,
        limits=REAL,
        operator=SimpleNamespace(
            act=lambda text, *_: asked.append(text), number=lambda text, *_: asked.append(text) or 0.1
        ),
        rig=SimpleNamespace(load_cell=lambda: contextlib.nullcontext(cell)),
    )
    monkeypatch.setattr(boards, "_clocks", lambda *_: judge_clocks(("the robot's wrench", 5.0), {}, 5.2, 10.9))
    (lag,) = (line for line in boards.measure(context).lines if line.what == "lag of the load cell")
    assert (lag.verdict, "not measured" in lag.value) == (("passed", False) if seen else ("noted", True))


CALIBRATION = load_calibration(Path("config/calibrations/skin_demo.yaml"))
SKIN_PERIOD_S = 0.1


def skin_readings(
    pressed_n: float = 0.0, at_s: float = 4.0, noises: tuple[float, float] = (1e-4, 1e-4), **changes: Any
) -> list[SkinSample]:
    """Return readings of an emulated skin for 8 s, each a mean over its period; a press rises within 0.2 s."""
    skin, found = SyntheticSkin(), []
    for number in range(80):
        pairs = []
        for part in (np.arange(10) + 0.5) / 10:
            skin.push(pressed_n * min(max((SKIN_PERIOD_S * (number + part) - at_s) / 0.2 + 0.5, 0.0), 1.0))
            pairs.append(skin.resistances_ohm())
        r1_ohm, r2_ohm = np.mean(pairs, axis=0) * (1.0 + RANDOM.normal(0.0, noises))
        mid_ns, end_ns = (round(1e9 * SKIN_PERIOD_S * (number + part)) for part in (0.5, 1.0))
        found.append(dataclasses.replace(SkinSample(r1_ohm, r2_ohm, mid_ns, end_ns, number), **changes))
    return found


def exchanged(readings: list[SkinSample]) -> list[SkinSample]:
    return [dataclasses.replace(one, r1_ohm=one.r2_ohm, r2_ohm=one.r1_ohm) for one in readings]


@pytest.mark.parametrize(
    ("readings", "rate_hz", "lines"),
    [
        (skin_readings(), 10.0, []),
        (skin_readings(), 12.0, ["rate of the skin"]),
        (skin_readings(noises=(0.01, 1e-4)), 10.0, ["noise of the skin's gauge 1"]),
        (skin_readings(noises=(1e-4, 0.01)), 10.0, ["noise of the skin's gauge 2"]),
        (skin_readings(r1_ohm=None, r2_ohm=None, faults=(SkinFault.STUCK_2,)), 10.0, ["faults of the skin"]),
        (exchanged(skin_readings()), 10.0, ["order of the skin's gauges"]),
    ],
)
def test_the_skin_fails_its_line(readings, rate_hz, lines):
    assert failed(judge_skin(readings, rate_hz, CALIBRATION)) == lines


def test_gauges_that_are_alike_show_no_order():
    alike = CALIBRATION.model_copy(update={"rest_ohm": (25.0, 25.1)})
    (line,) = (line for line in judge_skin(skin_readings(), 10.0, alike) if "order" in line.what)
    assert (line.verdict, "not measured" in line.value) == ("noted", True)


@pytest.mark.parametrize("at_s", [3.0, 4.03, 5.08])
@pytest.mark.parametrize("pressed_n", [2.5, -0.2])
def test_a_skin_shows_the_moment_of_a_press(pressed_n, at_s):
    assert skin_step_s(skin_readings(pressed_n, at_s)) == pytest.approx(at_s, abs=0.02)


def test_a_skin_that_nothing_presses_shows_no_moment():
    assert skin_step_s(skin_readings()) is None
    assert skin_step_s(skin_readings(r1_ohm=None, r2_ohm=None)) is None


@pytest.mark.parametrize(("pressed_n", "constant"), [(2.8, 1), (2.8, 2), (-2.8, 1), (-2.8, 2)])
def test_a_gauge_that_a_press_does_not_change_fails_its_line(pressed_n, constant):
    intact = skin_readings(pressed_n)
    dead = [dataclasses.replace(one, **{f"r{constant}_ohm": 25.0}) for one in intact]
    assert failed([judge_pressed(intact, 4.0, CALIBRATION)]) == []
    assert failed([judge_pressed(dead, 4.0, CALIBRATION)]) == ["skin's gauges under the press"]
    assert skin_step_s(dead) == pytest.approx(4.0, abs=0.02), "the clock has a line of its own"


def test_a_skin_with_a_fault_or_slow_readings_shows_no_moment():
    assert why_not_timed(skin_readings(), 10.0) == ""
    assert why_not_timed(skin_readings(faults=(SkinFault.OPEN_1,)), 10.0) == "the skin has a fault"
    assert why_not_timed(skin_readings(), 4.0) == "readings 0.25 s apart do not show a moment to 50 ms"


def reads(readings: list) -> Any:
    return contextlib.nullcontext(SimpleNamespace(take=lambda count, _: readings[:count], wait_for=lambda *_: None))


SKIN_CONFIG = SimpleNamespace(
    daq=SimpleNamespace(rate_hz=10.0), calibration=Path("config/calibrations/skin_demo.yaml"), normal_n=1.0
)
RIGHT = {"right": SimpleNamespace(frame_period_s=0.5)}


@pytest.mark.parametrize(
    ("settings", "fingertips", "skin", "asked"),
    [
        (DELIVERED, RIGHT, None, ["clock of right"]),
        (DELIVERED, {}, SKIN_CONFIG, ["clock of the skin"]),
        (CB3, RIGHT, SKIN_CONFIG, ["clock of right", "clock of the skin"]),
        (CB3, RIGHT, None, []),
        (CB3, {}, SKIN_CONFIG, []),
    ],
)
def test_a_press_is_asked_for_where_two_clocks_show_it(monkeypatch, settings, fingertips, skin, asked):
    """Of a CB3 no clock of its own shows the press; the device that is alone there has a line that says so."""
    context: Any = SimpleNamespace(
        config=SimpleNamespace(fingertips=fingertips, load_cell=None, gripper=None, skin=skin),
        settings=settings,
        limits=REAL,
        counts=SimpleNamespace(frames=18),
        operator=SimpleNamespace(act=lambda *_: None),
        rig=SimpleNamespace(fingertip=lambda _: reads(frames()), skin=lambda: reads(skin_readings())),
    )
    pressed: list[str] = []
    monkeypatch.setattr(boards, "_clocks", lambda _, seen_by: pressed.extend(seen_by.lines) or [])
    lines = boards.measure(context).lines
    assert pressed == asked
    clocks = [line for line in lines if line.what.startswith("clock of")]
    assert [line.verdict for line in clocks] == ([] if asked else ["noted"])
    assert all("is too noisy" in line.value for line in clocks)


def test_five_gauges_make_a_table_of_widths():
    gauges = [(10.0 + 40.0 * number, 100.0 - 20.0 * number) for number in range(5)]
    line, supplied = judge_widths(gauges, SimpleNamespace(model="2F-140"))
    assert (failed([line]), len(supplied.widths)) == ([], 5)
    line, supplied = judge_widths([*gauges[:2], (90.0, 66.0), *gauges[3:]], SimpleNamespace(model="2F-140"))
    assert (failed([line]), supplied.widths) == (["widths"], None)


def test_a_gauge_is_judged_by_the_table_of_the_others():
    """One that is 1.6 mm off draws its own table along, so that this table is only 0.9 mm off there."""
    gauges = [(10.0 + 40.0 * number, 100.0 - 20.0 * number) for number in range(5)]
    gauges[2] = (90.0, 61.6)
    own = fit_width(gauges, "2F-140")
    assert max(abs(own.width_mm(counts) - width_mm) for counts, width_mm in gauges) < 1.0
    line, supplied = judge_widths(gauges, SimpleNamespace(model="2F-140"))
    assert (failed([line]), supplied.widths) == (["widths"], None)
    assert line.value.startswith("1.6")


def test_two_widths_confirm_no_table():
    """Both may be mistyped alike."""
    gauges = [(10.0, 100.0), (10.0, 100.0), (170.0, 20.0), (170.0, 20.0), (170.0, 20.0)]
    line, supplied = judge_widths(gauges, SimpleNamespace(model="2F-140"))
    assert (failed([line]), supplied.widths) == (["widths"], None)
    assert "fewer than 3 different widths" in line.value


def test_the_robot_itself_bounds_every_motion():
    limits = bounded(dataclasses.replace(DELIVERED), 1.0).limits
    margin = limits.joints.margin_rad
    assert limits.joints.lower_rad[5] + margin == pytest.approx(1.0 - LARGEST_RAD)
    assert limits.joints.upper_rad[5] - margin == pytest.approx(1.0 + LARGEST_RAD)
    assert limits.joints.upper_rad[:5] == DELIVERED.limits.joints.upper_rad[:5]
    assert limits.wrist_speed_rad_per_s.inner <= LARGEST_RAD_PER_S
    assert limits.linear_speed_m_per_s.inner == 0.05


def test_a_straight_move_that_the_watchdog_alone_ends_keeps_the_rigs_watchdog_and_limits():
    alone = for_watchdog_alone(DELIVERED)
    assert alone.watchdog_hz == DELIVERED.watchdog_hz
    assert alone.lease_s > 2.0 / DELIVERED.watchdog_hz
    assert (alone.limits, alone.command_timeout_s) == (DELIVERED.limits, DELIVERED.command_timeout_s)


def test_what_a_rig_without_the_papers_boards_cannot_measure_is_noted_and_raises_no_torque(tmp_path):
    path = tmp_path / "rig.yaml"
    source, daq = {"serial": {"serial_number": "1"}}, {"adc": {"device": {"serial_number": "2"}}}
    skin = {"source": source, "daq": daq, "calibration": "skin.yaml"}
    gripper = {"model": "Hand-E", "socket": {"host": "192.168.1.10"}}
    path.write_text(yaml.safe_dump({"skin": skin, "robot": "ur.yaml", "gripper": gripper}))
    context = SimpleNamespace(config=load_daemon_config(path))
    of_boards, of_tool = boards.unmeasured(context.config), tool.measure(context)
    assert [line.what for line in of_boards] == ["fingertips", "load cell", "clock of the gripper"]
    assert [line.what for line in of_tool.lines] == ["tool and spring"]
    assert {line.verdict for line in (*of_boards, *of_tool.lines)} == {"noted"}
    assert of_tool.supplies == NOTHING_SUPPLIED


@pytest.mark.parametrize(
    ("fastest", "tested"),
    [(0.2, [0.05, 0.2]), (0.45, [0.05, 0.2, 0.45]), (0.5, [0.05, 0.2, 0.5]), (1.0, [0.05, 0.2, 0.5]), (0.03, [0.03])],
)
def test_stops_are_tested_up_to_the_robots_own_limit(fastest, tested):
    assert rising_speeds((0.05, 0.2, 0.5), fastest) == tested
