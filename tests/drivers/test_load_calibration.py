"""The guided calibration: finds the truth it was fed with, and refuses every signal that is not fit."""

from collections.abc import Callable, Iterable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shearloop.drivers import load_calibration
from shearloop.drivers.errors import DeviceCalibrationError
from shearloop.drivers.load_calibration import STANDARD_GRAVITY, LoadCalibrator
from shearloop.drivers.load_cell import COUNTS_MAX, LoadCalibration, LoadParser, LoadSample

STEP = load_calibration.SKIP_SAMPLES + load_calibration.SAMPLES_PER_STEP


def samples(raws: Iterable[float]) -> list[LoadSample]:
    """Return what the parser makes of lines with these decimals, after the first line that may be torn."""
    parser = LoadParser(load_calibration.UNCALIBRATED)
    return parser.feed(b"0\n" + b"".join(b"%.6f\n" % raw for raw in raws), 0)[1:]


def noisy(level: float, std: float = 200.0, seed: int = 0) -> list[LoadSample]:
    return samples(level + std * np.random.default_rng(seed).standard_normal(STEP))


def calibrate(calibrator: LoadCalibrator, signal: Callable[[float], list[LoadSample]]) -> None:
    for mass_g in (0.0, *calibrator.masses_g):
        calibrator.start_step()
        assert [calibrator.feed(sample) for sample in signal(mass_g)].index(True) == STEP - 1


@given(
    tare_counts=st.floats(-1e6, 1e6),
    counts_per_g=st.floats(300, 2000),
    wiring=st.sampled_from([-1, 1]),
    sign=st.sampled_from([-1, 1]),
    masses_g=st.lists(st.sampled_from([50.0, 100.0, 200.0, 500.0, 1000.0]), min_size=1, unique=True),
)
def test_it_finds_the_tare_and_the_scale_of_the_signal(tare_counts, counts_per_g, wiring, sign, masses_g):
    calibrator = LoadCalibrator(masses_g, sign=sign)
    calibrate(calibrator, lambda mass_g: noisy(tare_counts + wiring * counts_per_g * mass_g, seed=int(mass_g)))
    result = calibrator.result()
    # The means of 30 readings scatter by 200 / √30 counts; five times that.
    tolerance = 5 * 200 / 30**0.5 / (counts_per_g * max(masses_g))
    for mass_g in masses_g:
        raw = tare_counts + wiring * counts_per_g * mass_g
        torque_nm = sign * mass_g * 1e-3 * STANDARD_GRAVITY * 0.035
        full_nm = max(masses_g) * 1e-3 * STANDARD_GRAVITY * 0.035
        assert result.calibration.torque_nm(raw) == pytest.approx(torque_nm, abs=2 * tolerance * full_nm)
    assert result.residual_nm <= tolerance * max(masses_g) * 1e-3 * STANDARD_GRAVITY * 0.035


def test_a_board_that_sends_newton_metres_is_calibrated_the_same_way():
    calibrator = LoadCalibrator([100.0])
    calibrate(
        calibrator,
        lambda mass_g: samples(
            1e-3 * mass_g * STANDARD_GRAVITY * 0.035 + 2e-5 * np.random.default_rng(1).standard_normal(STEP)
        ),
    )
    assert calibrator.result().calibration.nm_per_count == pytest.approx(1.0, rel=1e-3)


def step(calibrator: LoadCalibrator, signal: Iterable[LoadSample]) -> bool:
    """Return whether these samples are enough for the next step."""
    calibrator.start_step()
    return any(calibrator.feed(sample) for sample in signal)


def refused(calibrator: LoadCalibrator, signal: list[LoadSample]) -> str:
    with pytest.raises(DeviceCalibrationError) as error:
        step(calibrator, signal)
    return str(error.value)


def after_empty(masses_g: list[float]) -> LoadCalibrator:
    calibrator = LoadCalibrator(masses_g)
    assert step(calibrator, noisy(8000.0))
    return calibrator


def test_a_saturated_signal_is_refused_and_the_step_asked_for_again():
    calibrator = after_empty([100.0])
    asked = calibrator.prompt
    assert "end of its range" in refused(calibrator, [*noisy(8000.0)[:-1], *samples([COUNTS_MAX])])
    assert calibrator.prompt == asked
    assert step(calibrator, noisy(50_000.0))
    assert calibrator.finished


@pytest.mark.parametrize(
    ("after_rest", "signal", "reason"),
    [
        (False, samples([1234.0] * STEP), "never that still"),
        (False, noisy(8000.0, std=20_000.0), "more than 5000"),
        (True, noisy(8100.0, seed=1), "did not change with 100 g"),
        (True, noisy(12_000.0, seed=1), "use a larger one"),
    ],
)
def test_a_signal_that_is_not_fit_is_refused(after_rest, signal, reason):
    assert reason in refused(after_empty([100.0]) if after_rest else LoadCalibrator([100.0]), signal)


def test_masses_off_the_line_or_in_the_wrong_order_are_refused():
    bent = LoadCalibrator([100.0, 200.0])
    calibrate(bent, lambda mass_g: noisy(420 * mass_g * (0.8 if mass_g == 200 else 1.0)))
    with pytest.raises(DeviceCalibrationError, match="straight line"):
        bent.result()
    swapped = LoadCalibrator([100.0, 200.0])
    assert step(swapped, noisy(0.0))
    assert step(swapped, noisy(84_000.0))
    assert "order given" in refused(swapped, noisy(42_000.0))


def test_too_many_corrupted_values_are_refused_and_few_are_left_out():
    raws = 8000 + 100 * np.random.default_rng(2).standard_normal(STEP)
    parser = LoadParser(LoadCalibration(tare_counts=0, scale_n_per_count=1e-5))
    raws[20] = 9e12
    few = parser.feed(b"0\n" + b"".join(b"%.0f\n" % raw for raw in raws), 0)[1:]
    calibrator = LoadCalibrator([100.0])
    assert step(calibrator, few)
    assert calibrator.levels[0].n == load_calibration.SAMPLES_PER_STEP - 1
    raws[20:25] = 9e12
    parser.restart()
    many = parser.feed(b"0\n" + b"".join(b"%.0f\n" % raw for raw in raws), 0)[1:]
    assert "Only 25 of the 30" in refused(LoadCalibrator([100.0]), many)


def test_samples_between_the_steps_count_for_nothing():
    calibrator = after_empty([100.0])
    assert not any(calibrator.feed(sample) for sample in noisy(1e6))
    assert len(calibrator.levels) == 1
    with pytest.raises(DeviceCalibrationError, match="1 steps"):
        calibrator.result()


@pytest.mark.parametrize("masses_g", [[], [0.0], [-5.0], [float("nan")], [float("inf")], [100.0, 100.0]])
def test_masses_that_no_line_goes_through_are_refused(masses_g):
    with pytest.raises(DeviceCalibrationError, match="mass"):
        LoadCalibrator(masses_g)
