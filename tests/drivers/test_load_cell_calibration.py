"""The calibration: finds the truth it was fed with, and refuses every signal that is not fit."""

from collections.abc import Callable, Iterable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shearloop.drivers import load_cell_calibration
from shearloop.drivers.errors import DeviceCalibrationError
from shearloop.drivers.load_cell import COUNTS_MAX, COUNTS_MIN, LoadParser, LoadSample
from shearloop.drivers.load_cell_calibration import (
    STANDARD_GRAVITY,
    Level,
    check_levels,
    check_masses,
    fit_levels,
    measure_level,
)

STEP = load_cell_calibration.SKIP_SAMPLES + load_cell_calibration.SAMPLES_PER_STEP


def samples(raws: Iterable[float]) -> list[LoadSample]:
    """Return what the parser makes of lines with these decimals, after the first line that may be torn."""
    parser = LoadParser(load_cell_calibration.UNCALIBRATED)
    return parser.feed(b"0\n" + b"".join(b"%.6f\n" % raw for raw in raws), 0)[1:]


def noisy(level: float, std: float = 200.0, seed: int = 0) -> list[LoadSample]:
    return samples(level + std * np.random.default_rng(seed).standard_normal(STEP))


def measured(masses_g: list[float], signal: Callable[[float], list[LoadSample]]) -> list[Level]:
    """Return the levels of rest and of the masses, checked as they are measured."""
    levels: list[Level] = []
    for mass_g in (0.0, *masses_g):
        levels.append(measure_level(signal(mass_g), mass_g))
        check_levels(levels)
    return levels


@given(
    tare_counts=st.floats(-1e6, 1e6),
    counts_per_g=st.floats(300, 2000),
    wiring=st.sampled_from([-1, 1]),
    sign=st.sampled_from([-1, 1]),
    masses_g=st.lists(st.sampled_from([50.0, 100.0, 200.0, 500.0, 1000.0]), min_size=1, unique=True),
)
def test_it_finds_the_tare_and_the_scale_of_the_signal(tare_counts, counts_per_g, wiring, sign, masses_g):
    levels = measured(masses_g, lambda mass_g: noisy(tare_counts + wiring * counts_per_g * mass_g, seed=int(mass_g)))
    result = fit_levels(levels, sign=sign)
    # The means of 30 readings scatter by 200 / √30 counts; five times that.
    tolerance = 5 * 200 / 30**0.5 / (counts_per_g * max(masses_g))
    for mass_g in masses_g:
        raw = tare_counts + wiring * counts_per_g * mass_g
        torque_nm = sign * mass_g * 1e-3 * STANDARD_GRAVITY * 0.035
        full_nm = max(masses_g) * 1e-3 * STANDARD_GRAVITY * 0.035
        assert result.calibration.torque_nm(raw) == pytest.approx(torque_nm, abs=2 * tolerance * full_nm)
    assert result.residual_nm <= tolerance * max(masses_g) * 1e-3 * STANDARD_GRAVITY * 0.035


def test_a_board_that_sends_newton_metres_is_calibrated_the_same_way():
    noise_nm = 2e-5 * np.random.default_rng(1).standard_normal(STEP)
    levels = measured([100.0], lambda mass_g: samples(1e-3 * mass_g * STANDARD_GRAVITY * 0.035 + noise_nm))
    assert fit_levels(levels).calibration.nm_per_count == pytest.approx(1.0, rel=1e-3)


@pytest.mark.parametrize(
    ("rest", "signal", "reason"),
    [
        ([*noisy(8000.0)[:-4], *samples([COUNTS_MAX] * 4)], [], "end of its range"),
        ([*samples([1234.0] * (STEP - 1)), *samples([COUNTS_MAX])], [], "never that still"),
        (samples([1234.0] * STEP), [], "never that still"),
        (noisy(8000.0, std=20_000.0), [], "more than 5000"),
        (noisy(8000.0), noisy(8100.0, seed=1), "did not change with 100 g"),
        (noisy(8000.0), noisy(12_000.0, seed=1), "use a larger one"),
    ],
)
def test_a_signal_that_is_not_fit_is_refused(rest, signal, reason):
    with pytest.raises(DeviceCalibrationError, match=reason):
        measured([100.0], lambda mass_g: signal if mass_g else rest)


def test_the_first_samples_of_a_step_do_not_count():
    settling = samples([1e6] * load_cell_calibration.SKIP_SAMPLES)
    assert measure_level([*settling, *noisy(8000.0)[-30:]], 0.0) == measure_level(noisy(8000.0), 0.0)


def test_masses_off_the_line_or_in_the_wrong_order_are_refused():
    bent = measured([100.0, 200.0], lambda mass_g: noisy(420 * mass_g * (0.8 if mass_g == 200 else 1.0)))
    with pytest.raises(DeviceCalibrationError, match="straight line"):
        fit_levels(bent)
    with pytest.raises(DeviceCalibrationError, match="order given"):
        measured([100.0, 200.0], lambda mass_g: noisy({0.0: 0.0, 100.0: 84_000.0, 200.0: 42_000.0}[mass_g]))


def test_too_many_corrupted_values_are_refused_and_few_are_left_out():
    raws = 8000 + 100 * np.random.default_rng(2).standard_normal(STEP)
    raws[20] = 9e12
    assert measure_level(samples(raws), 0.0).n == load_cell_calibration.SAMPLES_PER_STEP - 1
    raws[20:25] = 9e12
    with pytest.raises(DeviceCalibrationError, match="Only 25 of the 30"):
        measure_level(samples(raws), 0.0)


@pytest.mark.parametrize("corrupted", [COUNTS_MAX, COUNTS_MIN, 0.0, 38399996.0, 16.0])
@pytest.mark.parametrize("often", [1, 3])
def test_corrupted_readings_are_left_out_of_the_mean_and_counted(corrupted, often):
    raws = 81_250 + 120 * np.random.default_rng(3).standard_normal(STEP)
    expected = measure_level(samples(raws), 0.0)
    assert (expected.n, expected.dropped) == (30, 0)
    spoilt = raws.copy()
    spoilt[-10 : -10 + often] = corrupted
    level = measure_level(samples(spoilt), 0.0)
    assert (level.n, level.dropped) == (30 - often, often)
    assert level.mean == pytest.approx(expected.mean, abs=3 * 120 / 30**0.5)
    assert level.std == pytest.approx(120, rel=0.4)
    spoilt[-12:-6] = corrupted
    with pytest.raises(DeviceCalibrationError, match=r"Only 24 of the 30|end of its range"):
        measure_level(samples(spoilt), 0.0)


@given(st.integers(0, 1000), st.sampled_from(["noise", "rounded", "swinging"]))
def test_no_reading_of_an_intact_signal_is_left_out(seed, kind):
    random = np.random.default_rng(seed)
    signals = {
        "noise": 81_250 + 120 * random.standard_normal(STEP),
        "rounded": np.round(0.09 + 0.004 * random.standard_normal(STEP), 2),
        "swinging": 81_250 + 4000 * np.sin(np.arange(STEP)),
    }
    # Nine in ten the same are a still converter.
    if np.unique(signals[kind][-30:], return_counts=True)[1].max() < 27:
        assert measure_level(samples(signals[kind]), 0.0).n == 30


@pytest.mark.parametrize(("masses_g", "meant"), [([0.1], "Did you mean 100, 0.1 kg in g?"), ([100.0, 2e5], "200000 g")])
def test_masses_in_another_unit_are_refused(masses_g, meant):
    with pytest.raises(DeviceCalibrationError, match="give masses of 1 to 20000 g") as refused:
        check_masses(masses_g)
    assert meant in str(refused.value)


@pytest.mark.parametrize("masses_g", [[], [0.0], [-5.0], [float("nan")], [float("inf")], [100.0, 100.0]])
def test_masses_that_no_line_goes_through_are_refused(masses_g):
    with pytest.raises(DeviceCalibrationError, match="mass"):
        check_masses(masses_g)
