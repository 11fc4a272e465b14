import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shearloop.daemon.control.identification import ToolModel
from shearloop.daemon.control.margins import (
    MOST_GAIN,
    gain_for_noise,
    integral_gain,
    loop_model,
    margin_refusal,
    noise_share,
)
from shearloop.daemon.control.settings import ControllerSettings, LoopConfig

from .conftest import DEFAULTS

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
    measurements=60,
)
SETTINGS = ControllerSettings(**DEFAULTS)


@given(st.floats(0.01, 1.0))
def test_noise_of_a_pure_gain_has_its_closed_form(kp: float) -> None:
    assert noise_share(kp, 0.0) == pytest.approx((kp / (2.0 - kp)) ** 0.5, rel=1e-9)


def test_noise_with_an_integral_is_what_a_long_run_shows() -> None:
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


def test_the_gain_is_the_largest_that_the_noise_allows() -> None:
    kp = gain_for_noise(0.012, 0.002)
    assert noise_share(kp, integral_gain(kp)) * 0.012 <= 0.002
    assert noise_share(1.05 * kp, integral_gain(1.05 * kp)) * 0.012 > 0.002
    assert gain_for_noise(1e-6, 0.002) == MOST_GAIN


def test_a_sound_controller_is_not_refused() -> None:
    assert margin_refusal(SETTINGS, FOUND, LoopConfig()) is None


def test_a_refusal_names_a_gain_that_passes() -> None:
    wild = replace(SETTINGS, kp=1.5, ki=0.1)
    sentence = margin_refusal(wild, replace(FOUND, age_s=1.6, stiffness_nm_per_rad=0.4), LoopConfig())
    assert sentence is not None
    for part in ("kp 1.5", "gain margin", "phase margin", "delay margin", "0.4 N·m/rad", "1.60 s old", "required 2.00"):
        assert part in sentence
    cure = re.search(r"kp ([\d.]+) with ki ([\d.e-]+) would pass", sentence)
    assert cure is not None
    cured = replace(wild, kp=float(cure[1]) * 0.999, ki=float(cure[2]))
    assert margin_refusal(cured, replace(FOUND, age_s=1.6, stiffness_nm_per_rad=0.4), LoopConfig()) is None
    bolder = replace(wild, kp=float(cure[1]) * 1.05, ki=float(cure[2]) * 1.1)
    assert margin_refusal(bolder, replace(FOUND, age_s=1.6, stiffness_nm_per_rad=0.4), LoopConfig()) is not None


def test_where_no_gain_passes_the_sentence_says_so() -> None:
    sentence = margin_refusal(SETTINGS, FOUND, LoopConfig.model_construct(phase_margin_deg=170.0))
    assert sentence is not None
    assert "no gain would pass" in sentence


def test_the_model_takes_over_what_was_identified() -> None:
    model = loop_model(SETTINGS, replace(FOUND, stiffness_nm_per_rad=0.5, lag_s=0.2, actuation_s=float("nan")))
    assert model.stiffness_ratio == 2.0
    assert model.lag_error_s == pytest.approx(0.2)
    assert model.actuation_s == 0.008
    assert loop_model(SETTINGS, replace(FOUND, lag_s=0.01)).lag_error_s == 0.0
    # Nothing is known before its window has ended, whatever the fit says.
    assert loop_model(SETTINGS, replace(FOUND, lag_s=-0.4)).lag_error_s == pytest.approx(0.25 - 0.34)
