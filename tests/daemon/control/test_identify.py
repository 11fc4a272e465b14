import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shearloop.daemon.control.experiment_schema import IdentifyStep
from shearloop.daemon.control.identification import (
    ExciteSettings,
    IdentifyError,
    NotYetKnownError,
    Record,
    StiffnessExcitation,
    identify,
)
from shearloop.daemon.control.wrist_controller import WristController
from shearloop.daemon.loop_config import LoopConfig
from shearloop.daemon.torques import TorqueSource

WINDOW_S = 0.5412


def record_of(
    stiffness: float = 0.25,
    lag_s: float = 0.0,
    noise_nm: float = 0.012,
    seed: int = 1,
    amplitude: float = 0.4,
    cycles: int = 7,
    first_s: float = 1.5,
    **changes: Any,
) -> Record:
    """Return a record whose truth is known in closed form: the wrist follows a raised cosine, 7 s a cycle."""
    rate = 2.0 * math.pi / 7.0
    angle_t_s = np.arange(0.0, 7.0 * cycles, 0.008)
    angle_rad = 0.5 * amplitude * (1.0 - np.cos(rate * angle_t_s))
    t_mid_s = np.arange(first_s, 7.0 * cycles - 0.5, WINDOW_S)
    # The mean over a window of a cosine is the cosine times sinc.
    share = np.sinc(rate * WINDOW_S / 2.0 / math.pi)
    torque = stiffness * 0.5 * amplitude * (1.0 - share * np.cos(rate * (t_mid_s - lag_s)))
    torque += np.random.default_rng(seed).normal(0.0, noise_nm, torque.size)
    values: dict[str, Any] = {
        "angle_t_s": angle_t_s,
        "angle_rad": angle_rad,
        "sent_rad_per_s": np.zeros_like(angle_rad),
        "t_mid_s": t_mid_s,
        "t_s": t_mid_s + 0.33,
        "torque_nm": torque,
    }
    return Record(**(values | changes))


@given(st.floats(0.05, 2.0), st.floats(-0.2, 0.7))
@settings(max_examples=15, deadline=None)
def test_without_noise_stiffness_and_lag_are_exact(stiffness, lag_s):
    found = identify(record_of(stiffness, lag_s, noise_nm=1e-9), WINDOW_S)
    assert found.stiffness_nm_per_rad == pytest.approx(stiffness, rel=1e-3)
    assert found.lag_s == pytest.approx(lag_s, abs=2e-3)
    assert found.age_s == pytest.approx(0.33)
    assert found.sample_period_s == pytest.approx(WINDOW_S)
    assert found.torque_nm == pytest.approx(0.0, abs=2e-3 * stiffness)


def overlapping(seed: int, state_noise_nm: float = 0.07) -> Record:
    """Return a record of the wrench: 25 means a second over 0.192 s each, of 125 noisy states a second."""
    rate, state_s, states = 2.0 * math.pi / 7.0, 0.008, 24
    angle_t_s = np.arange(0.0, 28.0, state_s)
    angle_rad = 0.2 * (1.0 - np.cos(rate * angle_t_s))
    noisy_nm = 0.25 * angle_rad + np.random.default_rng(seed).normal(0.0, state_noise_nm, angle_rad.size)
    means_nm = np.convolve(noisy_nm, np.ones(states) / states, mode="valid")[::5]
    t_mid_s = np.convolve(angle_t_s, np.ones(states) / states, mode="valid")[::5]
    return Record(
        angle_t_s=angle_t_s, angle_rad=angle_rad, sent_rad_per_s=np.zeros_like(angle_rad),
        t_mid_s=t_mid_s, t_s=t_mid_s + 0.1, torque_nm=means_nm,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("record", "window_s", "lag_s", "noise_nm"),
    [
        (lambda seed: record_of(lag_s=0.1, seed=seed), WINDOW_S, 0.1, 0.012),
        # Neighbours share most of their states: their noise seemed half as large, and the rest passed for slip or play.
        (overlapping, 0.192, 0.0, 0.07 / math.sqrt(24)),
    ],
    ids=["frames", "means that overlap"],
)
def test_the_standard_deviations_are_what_repetition_shows(record, window_s, lag_s, noise_nm):
    found = [identify(record(seed), window_s) for seed in range(40)]
    for name, truth, std in (
        ("stiffness_nm_per_rad", 0.25, "stiffness_std"),
        ("lag_s", lag_s, "lag_std_s"),
        ("torque_nm", 0.0, "torque_std_nm"),
    ):
        errors = np.array([getattr(one, name) - truth for one in found])
        claimed = float(np.mean([getattr(one, std) for one in found]))
        assert float(np.sqrt(np.mean(errors**2))) == pytest.approx(claimed, rel=0.35), name
        assert abs(float(errors.mean())) < 4.0 * claimed / math.sqrt(len(found))
    assert float(np.mean([one.noise_nm for one in found])) == pytest.approx(noise_nm, rel=0.1)


def test_a_lag_within_its_noise_counts_as_none():
    found = identify(record_of(lag_s=0.0), WINDOW_S)
    assert abs(found.lag_s) > 0.0
    assert found.significant_lag_s == 0.0
    assert identify(record_of(lag_s=-0.3), WINDOW_S).significant_lag_s == 0.0
    assert identify(record_of(lag_s=0.5), WINDOW_S).significant_lag_s == pytest.approx(0.5, abs=0.15)


def test_missing_torques_are_left_out():
    record = record_of()
    torque = record.torque_nm.copy()
    torque[::4] = np.nan
    found = identify(record_of(torque_nm=torque), WINDOW_S)
    assert found.stiffness_nm_per_rad == pytest.approx(0.25, abs=0.04)


@pytest.mark.parametrize("delay_s", [0.0, 0.03, 0.12])
def test_the_actuation_delay_is_seen_from_what_was_sent(delay_s):
    record = record_of()
    rate = 2.0 * math.pi / 7.0
    sent = 0.2 * rate * np.sin(rate * (record.angle_t_s + 0.004 + delay_s))
    found = identify(record_of(sent_rad_per_s=sent), WINDOW_S)
    assert found.actuation_s == pytest.approx(delay_s, abs=0.003)


def test_a_record_too_short_or_too_small_asks_for_more():
    with pytest.raises(NotYetKnownError, match="12 are needed"):
        identify(record_of(cycles=1), WINDOW_S)
    with pytest.raises(NotYetKnownError, match="turn farther"):
        identify(record_of(amplitude=0.03), WINDOW_S)


def test_a_wrist_that_rests_and_a_reversed_sign_are_refused():
    with pytest.raises(IdentifyError, match="did not turn"):
        identify(record_of(angle_rad=np.full(record_of().angle_t_s.size, 0.2)), WINDOW_S)
    with pytest.raises(IdentifyError, match="sign of torque or wrist angle is wrong"):
        identify(record_of(stiffness=-0.25), WINDOW_S)


def test_a_tool_that_slipped_is_refused():
    record = record_of(first_s=0.3)
    slipped = record.torque_nm - 0.05 * (record.t_mid_s > 3.5)
    with pytest.raises(IdentifyError, match=r"0\.0[45]\d* N·m lower.*slipped in the grip"):
        identify(record_of(first_s=0.3, torque_nm=slipped), WINDOW_S)


def test_a_torque_that_is_no_springs_is_refused():
    record = record_of(noise_nm=0.002, amplitude=0.4)
    with pytest.raises(IdentifyError, match="unexplained"):
        identify(record_of(torque_nm=np.minimum(record.torque_nm, 0.03)), WINDOW_S)


# --- the step with its wrist programme

SETTINGS = ExciteSettings(amplitude_rad=0.4, torque_limit_nm=0.15, dwell_s=2.5, stiffness_share=0.05)
SOURCE = TorqueSource(name="right", period_s=0.5, window_s=0.5)


def step_on(stiffness: float, noise_nm: float, **changes: Any) -> tuple[StiffnessExcitation, list[float], list[float]]:
    """Run the step on a wrist that does what it is told at once; return it with all angles and speeds."""
    step = StiffnessExcitation(replace(SETTINGS, **changes), SOURCE, LoopConfig())
    rng, angle, angles, speeds, since = np.random.default_rng(3), 1.0, [], [], []
    for number in range(40_000):
        now_ns = 10**9 + number * 8_000_000
        speed = step.command(now_ns, angle)
        if step.done:
            break
        angles.append(angle)
        speeds.append(speed)
        since.append(stiffness * (angle - 1.0))
        if number % 62 == 61:
            torque = float(np.mean(since[-62:]) + rng.normal(0.0, noise_nm))
            step.measure(torque, now_ns - 31 * 8_000_000, now_ns)
        angle += 0.008 * speed
    return step, angles, speeds


def test_the_step_finds_the_tool_and_ends_where_it_began():
    step, angles, speeds = step_on(0.25, 0.008)
    assert step.result.stiffness_nm_per_rad == pytest.approx(0.25, abs=0.03)
    assert step.result.actuation_s == 0.0
    assert angles[-1] == pytest.approx(1.0, abs=0.003)
    assert max(angles) <= 1.4
    assert min(angles) >= 1.0 - 0.002
    assert max(map(abs, speeds)) <= 0.5
    gained = np.diff(np.abs(speeds))
    assert gained.max() <= 2.0 * 0.008 + 1e-9


@pytest.mark.parametrize("hold_s", [2.5, 0.8])
def test_the_step_rests_for_as_long_as_its_file_says(hold_s):
    """The first rest is twice as long."""
    wrist = WristController(SOURCE, LoopConfig())
    wrist.begin_identification(IdentifyStep(do="identify", hold_s=hold_s), 0.5)
    speeds = [wrist.excitation.command(number * 8_000_000, 0.0) for number in range(1000)]
    assert np.flatnonzero(speeds)[0] * 0.008 == pytest.approx(2.0 * hold_s, abs=0.02)


def test_the_first_swing_is_half_as_far_and_stops_at_the_torque_limit():
    step, angles, _ = step_on(2.0, 0.002)
    assert "0.15 N·m" in step.failure
    assert max(angles) <= 1.2
    assert step.command(10**12, 1.1) == 0.0


def test_the_step_gives_up_when_it_cannot_know_better():
    step, _, _ = step_on(0.25, 0.2, most_cycles=3, torque_limit_nm=1.0)
    assert step.result is None
    assert "turn farther" in step.failure


def test_torques_that_are_missing_or_out_of_order_do_not_reach_the_record():
    step = StiffnessExcitation(SETTINGS, SOURCE, LoopConfig())
    step.measure(0.1, 0, 1)
    step.command(0, 1.0)
    for torque, t_mid in ((None, 1), (0.05, 3), (0.05, 3), (0.05, 1)):
        step.measure(torque, t_mid, 10)
    assert step.record().torque_nm.tolist() == [0.05]
    assert step.record().angle_rad.tolist() == [1.0]
