import math
import re
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shearloop.daemon.control.identification import ToolModel
from shearloop.daemon.control.margins import (
    MAX_GAIN,
    LoopModel,
    characteristic_polynomial,
    gain_for_noise,
    gain_limit,
    integral_gain,
    is_stable,
    loop_model,
    margin_refusal,
    margins,
    noise_share,
    pulse_response,
    with_gain,
    wrist_response,
)
from shearloop.daemon.control.torque_controller import ControllerSettings
from shearloop.daemon.loop_config import LoopConfig

from .conftest import DEFAULTS

# A wrist that arrives within one command period, seen at one instant: an integrator with whole delays.
INTEGRATOR = partial(
    LoopModel, sample_period_s=1.0, window_s=0.0, actuation_s=0.0, wrist_bandwidth_per_s=125.0, compensated=False
)
EIT = LoopModel(
    sample_period_s=0.5412,
    window_s=0.5412,
    age_s=0.34,
    actuation_s=0.02,
    wrist_bandwidth_per_s=4.0,
    kp=0.06,
    ki=0.00036,
)


@pytest.mark.parametrize("delay", [1, 2, 3, 5, 8])
def test_an_integrator_with_a_delay_has_the_textbook_limit(delay):
    """1/(z − 1)·z^−(d−1): on the unit circle z^(d−1)·(z − 1) = −k where k = 2·sin(π/(2(2d − 1)))."""
    model = INTEGRATOR(age_s=delay - 0.5, kp=0.1)
    expected = 2.0 * math.sin(math.pi / (2.0 * (2.0 * delay - 1.0)))
    assert gain_limit(model) == pytest.approx(expected, rel=2e-4)
    has = margins(model)
    assert has.gain == pytest.approx(expected / 0.1, rel=1e-3)
    # |k/(z−1)| = 1 where 2·sin(ω/2) = k; the phase there is −π/2 − ω/2 of the integrator, and −(d−1)·ω of the delay.
    omega = 2.0 * math.asin(0.05)
    assert has.phase_deg == pytest.approx(math.degrees(math.pi / 2 - omega * (delay - 0.5)), abs=0.05)


def test_the_delay_margin_is_where_the_next_whole_delay_becomes_unstable():
    """With gain 0.7 the limit is passed between two and three delays, where the correction falls on the frame."""
    has = margins(INTEGRATOR(age_s=0.5, kp=0.7))
    # Half a period of age is used; the third whole delay begins 1.5 periods later (less half a command period).
    assert has.delay_s == pytest.approx(1.5 - 0.004, abs=0.002)


@pytest.mark.parametrize("age_s", [0.34, 1.0, 2.7])
def test_with_an_exact_model_the_compensated_loop_does_not_depend_on_the_delay(age_s):
    model = replace(EIT, age_s=age_s, ki=0.0)
    assert gain_limit(model) == pytest.approx(2.0, rel=1e-3)
    np.testing.assert_allclose(characteristic_polynomial(model), [1.0, model.kp - 1.0], atol=1e-9)


@pytest.mark.parametrize("age_s", [0.34, 1.0, 2.7])
@pytest.mark.parametrize("ratio", [0.5, 1.9])
def test_up_to_twice_the_stiffness_no_delay_makes_a_gain_below_one_unstable(age_s, ratio):
    """|1 − ρ|·|F| < 1 with |F| ≤ 1 for kp ≤ 1, the small-gain theorem: what the internal-model form is for."""
    assert gain_limit(replace(EIT, age_s=age_s, ki=0.0, stiffness_ratio=ratio)) >= 1.0


def test_the_wrist_closes_in_as_the_exponential_that_its_bandwidth_names():
    angle = wrist_response(1e-4, 4.0, 0.0)
    np.testing.assert_allclose(angle, 1.0 - np.exp(-4.0 * np.arange(angle.size) * 1e-4), atol=2e-4)


def test_an_actuation_delay_shifts_the_wrist_by_whole_and_broken_periods():
    for delay_s in (0.008, 0.02, 0.0293):
        late = wrist_response(0.008, 0.05, delay_s)
        times = np.arange(5, 30) * 0.008
        # So slow a wrist turns at a constant speed at first.
        np.testing.assert_allclose(late[5:30], 0.05 * (times - delay_s), rtol=1e-2)


def test_a_wrist_that_cannot_settle_is_refused():
    with pytest.raises(ValueError, match="does not settle"):
        wrist_response(0.008, 20.0, 0.2)
    with pytest.raises(ValueError, match="cannot be the mean"):
        pulse_response(replace(EIT, age_s=0.1))


def test_what_the_windows_see_adds_up_to_the_whole_correction():
    seen = pulse_response(EIT)
    assert seen[0] == 0.0
    assert seen.sum() == pytest.approx(1.0, abs=1e-8)
    # By hand, for a wrist that jumps: the window 0.27 s either way of 0.5412 s, from 0.34 + 0.004 s on.
    jump = pulse_response(replace(EIT, wrist_bandwidth_per_s=125.0, actuation_s=0.0))
    assert jump[1] == pytest.approx((1.5 * 0.5412 - 0.34 - 0.004 - 0.004) / 0.5412, abs=1e-3)


@given(
    age=st.floats(0.28, 2.0),
    ratio=st.floats(0.4, 2.5),
    lag=st.floats(0.0, 0.5),
    kp=st.floats(0.02, 0.4),
    compensated=st.booleans(),
)
@settings(max_examples=25, deadline=None)
def test_at_the_gain_and_delay_margins_the_loop_is_just_stable(age, ratio, lag, kp, compensated):
    """The margins come from frequency response and search, the stability from the roots: they must agree."""
    model = replace(
        EIT, age_s=age, stiffness_ratio=ratio, lag_error_s=lag, kp=kp, ki=0.1 * kp * kp, compensated=compensated
    )
    has = margins(model)
    if not is_stable(model):
        assert (has.gain, has.phase_deg, has.delay_s) == (0.0, 0.0, 0.0)
        return
    if math.isfinite(has.gain):
        assert is_stable(replace(model, stiffness_ratio=ratio * has.gain * 0.999))
        assert not is_stable(replace(model, stiffness_ratio=ratio * has.gain * 1.001))
    if math.isfinite(has.delay_s):
        assert is_stable(replace(model, lag_error_s=lag + has.delay_s * 0.998))
        assert not is_stable(replace(model, lag_error_s=lag + has.delay_s * 1.002 + 1e-4))
    assert is_stable(with_gain(model, 0.5 * kp)) or not is_stable(model)


@pytest.mark.parametrize("model", [EIT, replace(EIT, compensated=False, age_s=1.2), replace(EIT, stiffness_ratio=2.2)])
def test_the_gain_limit_agrees_with_a_simulation_of_the_loop(model):
    """Brute force: the difference equations run for 3000 measurements, a twentieth below and above the boundary."""
    limit = gain_limit(model)
    for factor, dies_out in ((0.95, True), (1.05, False)):
        tried = with_gain(model, limit * factor)
        seen = pulse_response(tried)
        offsets, integral = [0.0] * seen.size, 0.0
        for number in range(3000):
            mean = -float(seen[1:] @ np.array(offsets[: -seen.size : -1]))
            torque = tried.stiffness_ratio * mean + (1.0 if number < 2 else 0.0)
            excess = torque - mean - offsets[-1] if tried.compensated else torque
            integral += tried.ki * excess
            offsets.append(offsets[-1] + tried.kp * excess + integral)
            if abs(offsets[-1]) > 1e6:
                break
        assert (max(map(abs, offsets[-50:])) < 1e-3) is dies_out


FOUND = ToolModel(
    stiffness_nm_per_rad=0.25,
    stiffness_std=0.01,
    lag_s=0.0,
    lag_std_s=0.03,
    age_s=0.34,
    actuation_s=0.02,
    noise_nm=0.012,
    sample_period_s=0.5,
    angle_rad=0.0,
    torque_nm=0.0,
    torque_std_nm=0.004,
)
SETTINGS = ControllerSettings(**DEFAULTS)


@given(st.floats(0.01, 1.0))
def test_noise_of_a_pure_gain_has_its_closed_form(kp):
    assert noise_share(kp, 0.0) == pytest.approx((kp / (2.0 - kp)) ** 0.5, rel=1e-9)


def test_noise_with_an_integral_is_what_a_long_run_shows():
    kp, ki = 0.2, 0.02
    noise = np.random.default_rng(4).normal(size=200_000)
    offset = integral = 0.0
    offsets = []
    for value in noise:
        excess = value - offset
        integral += ki * excess
        offset += kp * excess + integral
        offsets.append(offset)
    assert float(np.std(offsets)) == pytest.approx(noise_share(kp, ki), rel=0.02)


def test_the_gain_is_the_largest_that_the_noise_allows():
    kp = gain_for_noise(0.012, 0.002)
    assert noise_share(kp, integral_gain(kp)) * 0.012 <= 0.002
    assert noise_share(1.05 * kp, integral_gain(1.05 * kp)) * 0.012 > 0.002
    assert gain_for_noise(1e-6, 0.002) == MAX_GAIN


def test_a_sound_controller_is_not_refused():
    assert margin_refusal(SETTINGS, FOUND, LoopConfig()) is None


def test_a_refusal_names_a_gain_that_passes():
    wild = replace(SETTINGS, kp=1.5, ki=0.1)
    sentence = margin_refusal(wild, replace(FOUND, age_s=1.6, stiffness_nm_per_rad=0.4), LoopConfig())
    for part in ("kp 1.5", "gain margin", "phase margin", "delay margin", "0.4 N·m/rad", "1.60 s old", "required 2.00"):
        assert part in sentence
    cure = re.search(r"kp ([\d.]+) with ki ([\d.e-]+) would pass", sentence)
    cured = replace(wild, kp=float(cure[1]) * 0.999, ki=float(cure[2]))
    assert margin_refusal(cured, replace(FOUND, age_s=1.6, stiffness_nm_per_rad=0.4), LoopConfig()) is None
    bolder = replace(wild, kp=float(cure[1]) * 1.05, ki=float(cure[2]) * 1.1)
    assert margin_refusal(bolder, replace(FOUND, age_s=1.6, stiffness_nm_per_rad=0.4), LoopConfig()) is not None


def test_where_no_gain_passes_the_sentence_says_so():
    sentence = margin_refusal(SETTINGS, FOUND, LoopConfig.model_construct(phase_margin_deg=170.0))
    assert "no gain would pass" in sentence


def test_torques_that_arrive_before_their_acquisition_can_have_ended_are_refused_with_the_key():
    """A board whose frames take less time than the configuration says."""
    sentence = margin_refusal(replace(SETTINGS, window_s=0.5408), replace(FOUND, age_s=0.12), LoopConfig())
    assert "its torques arrive 0.12 s after the middle of their acquisition, which is said to take 0.541 s" in sentence
    assert "`frame_period_s`" in sentence


def test_the_model_takes_over_what_was_identified():
    model = loop_model(SETTINGS, replace(FOUND, stiffness_nm_per_rad=0.5, lag_s=0.2))
    assert model.stiffness_ratio == 2.0
    assert model.lag_error_s == pytest.approx(0.2)
    assert loop_model(SETTINGS, replace(FOUND, lag_s=0.01)).lag_error_s == 0.0
    # Nothing is measured before its cause, whatever the fit says.
    assert loop_model(SETTINGS, replace(FOUND, lag_s=-0.4)).lag_error_s == 0.0


def test_a_negative_lag_refuses_no_controller():
    refused = margin_refusal(SETTINGS, replace(FOUND, lag_s=-0.09, lag_std_s=0.001), LoopConfig())
    assert refused == margin_refusal(SETTINGS, FOUND, LoopConfig())
