from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from shearloop.bank.eit.channels import CHANNEL_TABLE_HASH
from shearloop.bank.eit.polynomial import Polynomial
from shearloop.bank.errors import CalibrationError
from shearloop.bank.estimation import Calibration

BANK = "ab" * 32
SIGMA, K = np.linspace(1.2, 1.9, 30), np.linspace(3.4, 3.8, 12)
NOISE = np.random.default_rng(1)
TORQUE = 0.4 - 0.1 * SIGMA - 0.05 * SIGMA**2 + NOISE.normal(0, 0.003, 30)
DIAMETER = 250 - 60 * K + NOISE.normal(0, 1.0, 12)
CALIBRATION = Calibration.fit(BANK, "made up", torque=(SIGMA, TORQUE), diameter=(K, DIAMETER))


def test_a_curve_without_noise_is_found_exactly() -> None:
    fit = Polynomial.fit(SIGMA, 0.4 - 0.1 * SIGMA - 0.05 * SIGMA**2, 2)
    assert fit.residual_std < 1e-15
    for sigma in (1.2, 1.55, 2.5):
        value, low, high = fit.interval(sigma)
        assert value == pytest.approx(0.4 - 0.1 * sigma - 0.05 * sigma**2, abs=1e-13)
        assert (low, high) == pytest.approx((value, value), abs=1e-13)


def test_the_interval_of_a_mean_is_the_textbook_one() -> None:
    # A polynomial of degree 0: mean ± t s √(1 + 1/n), t of 4 degrees of freedom being 2.7764.
    fit = Polynomial.fit(np.arange(5.0), np.array([1.0, 2.0, 3.0, 4.0, 5.0]), 0)
    half = 2.776445105 * np.sqrt(2.5) * np.sqrt(1.2)
    assert fit.interval(100.0) == pytest.approx((3.0, 3.0 - half, 3.0 + half))


def test_the_interval_of_a_line_is_the_textbook_one() -> None:
    x, y = np.array([1.0, 2.0, 4.0, 7.0]), np.array([2.0, 3.0, 3.0, 9.0])
    slope = ((x - 3.5) * (y - 4.25)).sum() / ((x - 3.5) ** 2).sum()
    std = np.sqrt(((y - 4.25 - slope * (x - 3.5)) ** 2).sum() / 2)
    half = 4.302652730 * std * np.sqrt(1 + 1 / 4 + (6.0 - 3.5) ** 2 / ((x - 3.5) ** 2).sum())
    value = 4.25 + slope * 2.5
    assert Polynomial.fit(x, y, 1).interval(6.0) == pytest.approx((value, value - half, value + half))


def test_95_of_100_new_measurements_fall_into_the_interval() -> None:
    generator = np.random.default_rng(7)
    inside = 0
    for _ in range(2000):
        x = generator.uniform(1, 2, 13)
        y = 3 * x**2 + generator.normal(0, 0.2, 13)
        *known, new = zip(x, y, strict=True)
        _, low, high = Polynomial.fit(*map(np.array, zip(*known, strict=True)), 2).interval(new[0])
        inside += bool(low <= new[1] <= high)
    # The binomial standard deviation is 0.5 %.
    assert inside / 2000 == pytest.approx(0.95, abs=0.015)


@pytest.mark.parametrize(
    ("x", "y", "says"),
    [
        ([1.0, 2.0, 3.0], [1.0, 2.0, 3.0], "3 measurements at 3 distinct places do not determine .* degree 2"),
        ([1.0, 1.0, 2.0, 2.0], [1.0, 2.0, 3.0, 4.0], "4 measurements at 2 distinct places"),
        ([1.0, 2.0, 3.0, np.nan], [1.0, 2.0, 3.0, 4.0], "as many finite x as y"),
        ([1.0, 2.0, 3.0], [1.0, 2.0, 3.0, 4.0], "as many finite x as y"),
    ],
)
def test_points_that_do_not_determine_a_curve_are_refused(x: list[float], y: list[float], says: str) -> None:
    with pytest.raises(CalibrationError, match=says):
        Polynomial.fit(np.array(x), np.array(y), 2)


def test_torque_and_diameter_come_with_intervals() -> None:
    torque, diameter = CALIBRATION.torque(1.5), CALIBRATION.diameter(3.6)
    assert torque.low < torque.value < torque.high
    assert torque.value == pytest.approx(0.4 - 0.15 - 0.1125, abs=0.003)
    assert diameter.value == pytest.approx(34, abs=1.5)
    value, low, high = diameter
    assert high - value == pytest.approx(value - low)


def test_outside_of_the_calibrated_range_a_reason_is_given() -> None:
    assert CALIBRATION.out_of_range(3.6, 1.5) == ()
    assert CALIBRATION.out_of_range(K[0], SIGMA[-1]) == ()
    assert CALIBRATION.out_of_range(3.2, 2.0) == (
        "sigma = 2 cm is outside of 1.2 to 1.9 cm, where torque was calibrated",
        "k = 3.2 cm is outside of 3.4 to 3.8 cm, where diameter was calibrated",
    )
    assert len(CALIBRATION.out_of_range(np.nan, np.nan)) == 2


def test_one_of_the_fits_may_be_missing() -> None:
    torque_only = Calibration.fit(BANK, "torque only", torque=(SIGMA, TORQUE))
    assert torque_only.out_of_range(99.0, 1.5) == ()
    with pytest.raises(CalibrationError, match="no fit for diameter"):
        torque_only.diameter(3.6)
    with pytest.raises(CalibrationError, match="no fit for torque"):
        Calibration.fit(BANK, "diameter only", diameter=(K, DIAMETER)).torque(1.5)
    with pytest.raises(CalibrationError, match="of torque, of diameter, or of both"):
        Calibration.fit(BANK, "nothing")


@pytest.mark.parametrize("lacking", [{}, {"torque_fit": None}, {"diameter_fit": None}])
def test_a_saved_calibration_is_loaded_as_it_was_and_has_the_same_bytes_each_time(
    tmp_path: Path, lacking: dict[str, None]
) -> None:
    calibration = replace(CALIBRATION, **lacking, source="ünï: # 'quotes'\nand lines")
    paths = [tmp_path / "a.yaml", tmp_path / "b.yaml"]
    for path in paths:
        calibration.save(path)
    assert paths[0].read_bytes() == paths[1].read_bytes()
    assert Calibration.load(paths[0], bank_identity=BANK) == calibration
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.yaml", "b.yaml"]


def test_the_file_can_be_read_by_people(tmp_path: Path) -> None:
    CALIBRATION.save(tmp_path / "calibration.yaml")
    read = yaml.safe_load((tmp_path / "calibration.yaml").read_text())
    assert read["bank_identity"] == BANK
    assert read["channel_table_hash"] == CHANNEL_TABLE_HASH
    assert (read["torque"]["n"], read["torque"]["x_low"], read["torque"]["x_high"]) == (30, 1.2, 1.9)
    assert read["diameter"]["residual_std"] == pytest.approx(1.0, rel=0.6)


@given(st.data())
@settings(max_examples=60, deadline=None)
def test_a_truncated_or_changed_file_is_refused_or_says_the_same(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    path = tmp_path_factory.mktemp("calibration") / "calibration.yaml"
    CALIBRATION.save(path)
    content = bytearray(path.read_bytes())
    if data.draw(st.booleans()):
        path.write_bytes(content[: data.draw(st.integers(0, len(content) - 2))])
        with pytest.raises(CalibrationError, match=str(path)):
            Calibration.load(path)
        return
    content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(content)
    try:
        assert Calibration.load(path) == CALIBRATION
    except CalibrationError as error:
        assert str(path) in str(error)  # noqa: PT017 - either outcome is right


def test_foreign_and_stale_files_are_refused_with_the_cure(tmp_path: Path) -> None:
    path = tmp_path / "calibration.yaml"
    CALIBRATION.save(path)
    with pytest.raises(CalibrationError, match="made with the bank abababababab…, expected cdcdcdcdcdcd…; calibrate"):
        Calibration.load(path, bank_identity="cd" * 32)
    replace(CALIBRATION, channel_table_hash="0" * 64).save(path)
    with pytest.raises(CalibrationError, match="made with the channel table 000000000000…"):
        Calibration.load(path)
    for content, says in (
        ("a: [", "this is not YAML"),
        ("", "this is not a calibration"),
        ("- 1\n- 2\n", "this is not a calibration"),
        ("kind: shearloop calibration\nformat_version: 2\n", "format version 2, expected 1"),
        ("kind: shearloop calibration\nformat_version: 1\n", "truncated or was edited"),
    ):
        path.write_text(content)
        with pytest.raises(CalibrationError, match=says):
            Calibration.load(path)
    with pytest.raises(CalibrationError, match="cannot be read: No such file"):
        Calibration.load(tmp_path / "absent.yaml")


def test_a_calibration_that_cannot_be_written_leaves_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / "calibration.yaml"
    CALIBRATION.save(path)
    (tmp_path / "calibration.yaml.tmp").mkdir()
    with pytest.raises(CalibrationError, match="cannot be written: Is a directory"):
        replace(CALIBRATION, source="other").save(path)
    assert Calibration.load(path) == CALIBRATION
