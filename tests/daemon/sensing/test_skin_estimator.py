"""From resistances to shear force: every bad input is either refused with its reason or stated in the interval."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path
from random import Random

import numpy as np
import pytest

from shearloop.daemon.sensing.skin_estimator import SkinEstimator, SkinReading
from shearloop.drivers.shear_skin.skin import SkinFault, SkinSample
from shearloop.emulators.synthetic_skin import CONTACT_N_PER_MM, REST_OHM, SyntheticSkin
from shearloop.estimation.skin.calibration import SkinCalibration, load_calibration
from shearloop.estimation.skin.calibration_fit import CalibrationTable, fit_calibration
from shearloop.estimation.skin.membrane import Direction
from shearloop.studies.skin.characterisation import loop

NOISE = 1e-4
PERIOD_NS = 100_000_000


@pytest.fixture(scope="module")
def calibration() -> SkinCalibration:
    return load_calibration(Path(__file__).parents[3] / "config" / "calibrations" / "skin_demo.yaml")


def calibration_table(skin: SyntheticSkin, noise: float) -> CalibrationTable:
    """Return a bench's recording: loops to 1.2 and 5 N, each after two rows at rest; `noise` of one resistance."""
    random, rows = Random(1), []

    def record(shear_n: float, normal_n: float) -> None:
        skin.normal_n = normal_n
        skin.push(shear_n)
        skin.rest(1.0)
        r1, r2 = (ohm * (1.0 + random.gauss(0.0, noise)) for ohm in skin.resistances_ohm())
        rows.append((r1, r2, shear_n, normal_n))

    for normal_n, amplitude_n in product((0.5, 1.0, 2.0), (1.2, 5.0)):
        record(0.0, 0.0)
        record(0.0, 0.0)
        for shear_n in loop(amplitude_n).tolist():
            record(shear_n, normal_n)
    return CalibrationTable(*np.array(rows).T)


class Bench:
    """A skin that is pushed, and an estimator that sees it ten times a second."""

    def __init__(self, calibration: SkinCalibration, seed: int = 0) -> None:
        self.skin = SyntheticSkin(seed=seed)
        self.estimator = SkinEstimator(calibration, normal_n=1.0, zero_samples=20)
        self.spoil: Callable[[float, float, float], tuple[float, float]] = lambda r1, r2, _: (r1, r2)
        self._random = Random(seed)
        self.number = 0
        self.skin.normal_n = 0.0

    @property
    def time_s(self) -> float:
        return self.number / 10

    def sample(self, **changes: object) -> SkinSample:
        self.number += 1
        r1, r2 = self.spoil(*self.skin.resistances_ohm(), self.time_s)
        r1, r2 = (r * (1 + self._random.gauss(0, NOISE)) for r in (r1, r2))
        t_ns = self.number * PERIOD_NS
        values = {"r1_ohm": r1, "r2_ohm": r2, "t_mid_ns": t_ns, "t_arrival_ns": t_ns, "seq": self.number}
        return SkinSample(**{**values, **changes})

    def at(self, shear_n: float, normal_n: float = 1.0) -> SkinReading:
        self.skin.normal_n = normal_n
        self.skin.push(shear_n)
        return self.estimator.update(self.sample())

    def zeroed(self) -> "Bench":
        for _ in range(20):
            self.at(0.0, 0.0)
        assert self.estimator.zero is not None
        return self

    def to(self, shear_n: float, n_per_s: float = 0.5) -> Iterator[SkinReading]:
        begin_n = self.skin.shear_n
        steps = max(round(abs(shear_n - begin_n) / n_per_s * 10), 1)
        for step in range(1, steps + 1):
            yield self.at(begin_n + (shear_n - begin_n) * step / steps)

    def push(self, shear_n: float) -> SkinReading:
        return list(self.to(shear_n))[-1]


@pytest.fixture
def bench(calibration) -> Bench:
    """A skin with its zero."""
    return Bench(calibration).zeroed()


@pytest.mark.parametrize("slack_ratio", [-0.45, -0.15, 0.18])
def test_a_gauge_at_any_depth_is_believed_once_it_is_calibrated(slack_ratio):
    """The inner face, 26 µm off mid-thickness and the outer face: the slack side bends, and its fibres differ."""
    calibrated = fit_calibration(calibration_table(SyntheticSkin(slack_ratio=slack_ratio, seed=7), NOISE))
    assert calibrated.slack_ratio == pytest.approx(slack_ratio, abs=0.005)
    bench = Bench(calibrated)
    bench.skin.slack_ratio = slack_ratio
    bench.zeroed()
    for shear_n in (4.0, -4.0):
        readings = list(bench.to(shear_n))
        assert all(reading.valid for reading in readings)
        assert holds(readings[-1], shear_n)


def test_a_slack_gauge_beyond_the_calibrated_ratio_is_refused(calibration):
    bench = Bench(calibration)
    bench.skin.slack_ratio = -0.45
    assert "shorter than any load makes it" in bench.zeroed().push(4.0).reasons[0]


def holds(reading: SkinReading, shear_n: float) -> bool:
    interval = reading.interval
    return interval is not None and interval.low_n <= shear_n <= interval.high_n


def test_the_demo_s_calibration_is_that_of_the_emulated_skin(calibration):
    anew = fit_calibration(calibration_table(SyntheticSkin(seed=7), NOISE))
    assert anew.friction == pytest.approx(calibration.friction, abs=1e-3)
    assert anew.slope_per_n == pytest.approx(calibration.slope_per_n, rel=2e-3)
    assert anew.rest_ohm == pytest.approx(REST_OHM, rel=1e-3)
    assert anew.slack_ratio == pytest.approx(calibration.slack_ratio, abs=1e-3)
    assert anew.gauge_depth_mm == pytest.approx(0.0, abs=5e-3)


def test_the_zero_comes_first_and_then_every_sample_is_a_force(calibration):
    bench = Bench(calibration)
    said = [bench.at(0.0, 0.0) for _ in range(20)]
    assert said[0].reasons == ("taking the zero, 1 of 20",)
    assert not any(reading.valid for reading in said[:19])
    assert said[19].valid
    readings = list(bench.to(1.0))
    assert all(reading.valid for reading in readings)
    assert readings[-1].shear_n == pytest.approx(1.0, abs=0.02)
    assert readings[-1].direction is Direction.LOADING
    assert not readings[-1].interval.in_deadband
    assert bench.push(-1.0).shear_n == pytest.approx(-1.0, abs=0.02)


def test_normal_force_alone_is_no_shear(bench):
    readings = [bench.at(0.0, normal_n) for normal_n in (0.0, 1.0, 2.0, 2.0, 2.0, 2.0)]
    assert all(holds(reading, 0.0) for reading in readings)
    assert all(abs(reading.shear_n or 0.0) < 0.01 for reading in readings)
    assert readings[-1].interval.in_deadband


@pytest.mark.parametrize(
    "fault", [SkinFault.OPEN_1, SkinFault.SHORT_2, SkinFault.REVERSED_1, SkinFault.COMPLIANCE, SkinFault.SOURCE_LOST]
)
def test_what_the_driver_refuses_is_no_force_and_the_next_good_sample_is_one(bench, fault):
    bench.push(0.8)
    refused = bench.estimator.update(bench.sample(r1_ohm=None, r2_ohm=None, faults=(fault,)))
    assert refused.reasons == (str(fault),)
    assert refused.shear_n is None
    assert refused.interval is None
    again = bench.at(0.8)
    assert again.valid
    assert again.direction is Direction.UNKNOWN
    assert holds(again, 0.8)


@pytest.mark.parametrize("gap", [{"missed": 3}, {"paused": True}])
def test_across_missing_samples_and_a_pause_the_direction_is_not_assumed(bench, gap):
    assert bench.push(0.8).direction is Direction.LOADING
    bench.skin.push(0.7)
    reading = bench.estimator.update(bench.sample(**gap))
    assert reading.direction is Direction.UNKNOWN
    assert holds(reading, 0.7)


def test_a_zero_under_load_is_refused_until_the_load_is_off(bench):
    bench.push(0.8)
    bench.estimator.tare()
    readings = [bench.at(0.8) for _ in range(25)]
    assert "would look like that" in readings[-1].reasons[0]
    assert bench.estimator.zero is None
    assert bench.estimator.refused
    bench.push(0.0)
    for _ in range(40):
        reading = bench.at(0.0, 0.0)
    assert reading.valid
    assert not bench.estimator.refused


@pytest.mark.parametrize("refused", [False, True])
def test_a_zero_that_is_not_taken_in_time_is_not_taken_at_the_load_of_a_later_hour(bench, refused):
    asked_ns, n_early = bench.number * PERIOD_NS, 30 if refused else 10
    bench.estimator.tare(asked_ns, asked_ns + n_early * PERIOD_NS)
    for _ in range(n_early):
        # A load refuses the zero.
        assert not bench.estimator.given_up
        bench.at(0.8 if refused else 0.0)
    for _ in range(30):
        # This load is too small to refuse one.
        (reason,) = bench.at(0.1).reasons
        assert reason.startswith("no zero: ")
        assert ("would look like that" in reason) is refused
    assert bench.estimator.zero is None
    bench.estimator.tare()
    assert bench.zeroed().estimator.zero is not None


def test_a_zero_that_was_taken_is_not_given_up(bench):
    bench.estimator.give_up_zero()
    assert bench.at(0.0).valid


def test_a_sample_that_was_under_way_when_a_zero_was_asked_for_is_not_of_it(bench):
    asked_ns = round(bench.time_s * 1e9) + 3 * PERIOD_NS // 4
    bench.estimator.tare(asked_ns)
    reasons = []
    for _ in range(3):
        sample = bench.sample()
        known_ns = sample.t_mid_ns + PERIOD_NS // 2
        reasons += bench.estimator.update(replace(sample, t_arrival_ns=known_ns)).reasons
    assert reasons == ["measured before the zero was asked for", "taking the zero, 1 of 20", "taking the zero, 2 of 20"]


@pytest.mark.parametrize("shear_n", [0.1, -0.15])
def test_a_zero_under_a_small_load_is_stated_in_the_interval(calibration, shear_n):
    bench = Bench(calibration)
    for _ in range(20):
        bench.at(shear_n)
    for _ in range(10):
        assert holds(bench.at(shear_n), shear_n)
    unloaded = bench.push(0.0)
    assert holds(unloaded, 0.0)
    assert holds(bench.push(0.8), 0.8)


def test_an_unnoticed_zero_under_load_is_reported_when_the_load_goes(calibration):
    """The calibration's rest is that of this very load, so that the zero itself cannot be refused."""
    stretched = REST_OHM[0] * (1 + 0.088 * 0.8), REST_OHM[1]
    bench = Bench(calibration.model_copy(update={"rest_ohm": stretched}))
    bench.skin.normal_n = 1.0
    for _ in range(20):
        bench.at(0.84)
    assert bench.estimator.zero is not None
    reasons = bench.push(0.0).reasons
    assert "the zero was taken under load" in reasons[0]
    assert "gauge 1 reads" in reasons[0]


def test_gauges_that_are_swapped_after_the_zero_are_not_believed(bench):
    bench.spoil = lambda r1, r2, _: (r2, r1)
    (reason,) = bench.at(0.0).reasons
    assert "the wires of the gauges are swapped; exchange them" in reason
    assert "tare" not in reason, "it would cost the zero"
    bench.spoil = lambda r1, r2, _: (r1, r2)
    assert bench.at(0.0).valid


@pytest.mark.parametrize("slack_ratio", [-0.45, -0.15, 0.18])
def test_no_load_is_taken_for_swapped_gauges(slack_ratio):
    bench = Bench(fit_calibration(calibration_table(SyntheticSkin(slack_ratio=slack_ratio, seed=7), NOISE)))
    bench.skin.slack_ratio = slack_ratio
    bench.zeroed()
    assert all(reading.valid for shear_n in (4.0, -4.0) for reading in bench.to(shear_n))


@pytest.mark.parametrize("gauge", [1, 2])
def test_a_gauge_that_is_too_short_is_not_taken_for_swapped_gauges_where_both_are_alike(calibration, gauge):
    bench = Bench(calibration.model_copy(update={"rest_ohm": (25.0, 25.0)}))
    shorter = {gauge: 0.97}
    bench.spoil = lambda *_: (25.0, 25.0)
    bench.zeroed()
    bench.spoil = lambda *_: (25.0 * shorter.get(1, 1.0), 25.0 * shorter.get(2, 1.0))
    assert f"gauge {gauge} reads" in bench.at(0.0).reasons[0]


@pytest.mark.parametrize(
    ("shear_n", "is_load"), [(0.0, False), (0.1, False), (0.4, True), (-0.4, True), (4.0, True), (6.0, True)]
)
def test_what_would_be_refused_as_a_zero_is_known_as_a_load_with_and_without_a_force(bench, shear_n, is_load):
    reading, sample = bench.push(shear_n), bench.sample()
    assert reading.valid is (shear_n < 6.0)
    why = bench.estimator.why_not_at_rest(sample)
    assert ("would look like that" in why) is is_load
    assert bool(why) is is_load
    bench.estimator.tare()
    for _ in range(25):
        bench.at(shear_n)
    assert (bench.estimator.zero is None) is is_load


def test_a_sample_without_resistances_is_no_known_load(bench):
    assert not bench.estimator.why_not_at_rest(bench.sample(r1_ohm=None, r2_ohm=None, faults=(SkinFault.OPEN_1,)))


@pytest.mark.parametrize(("gauge", "per_s"), [(1, -2e-4), (2, 2e-4), (2, -2e-4)])
def test_a_gauge_that_drifts_where_it_shows_widens_the_interval_and_is_then_named(bench, gauge, per_s):
    begin_s = bench.time_s

    def drift(r1: float, r2: float, time_s: float) -> tuple[float, float]:
        factor = 1 + per_s * (time_s - begin_s)
        return (r1 * factor, r2) if gauge == 1 else (r1, r2 * factor)

    # Gauge 1 is slack at rest and under a negative force, gauge 2 under a positive one.
    shear_n = 0.0 if gauge == 1 or per_s < 0 else 0.5
    bench.push(shear_n)
    bench.spoil = drift
    readings = [bench.at(shear_n) for _ in range(1500)]
    valid = [reading for reading in readings if reading.valid]
    assert sum(holds(reading, shear_n) for reading in valid) >= 0.99 * len(valid)
    widths = [reading.interval.high_n - reading.interval.low_n for reading in valid if reading.interval is not None]
    assert widths[-1] > widths[20] + 0.2
    assert not readings[-1].valid
    assert "drifts" in readings[-1].reasons[0]


def test_the_paper_s_own_drift_stays_within_the_interval_for_an_hour(calibration):
    held = 0
    for seed in range(20):
        bench = Bench(calibration, seed).zeroed()
        bench.skin.rest(3600.0)
        bench.number += 36_000
        bench.push(0.15)
        held += holds(bench.at(0.15), 0.15)
    assert held >= 18


def test_a_force_beyond_the_curve_is_not_a_force(bench):
    assert bench.push(4.5).valid
    assert "beyond the calibrated curve" in bench.push(6.0).reasons[0]


@pytest.fixture(scope="module")
def one_sided() -> SkinCalibration:
    """Recorded with positive shear forces alone."""
    table = calibration_table(SyntheticSkin(seed=7), NOISE)
    kept = np.ones(len(table.shear_n), dtype=bool)
    # The loops begin with the positive half; the rest of a loading follows the first negative force.
    loading = np.cumsum((table.shear_n == 0) & (table.normal_n == 0))
    for number in set(loading.tolist()):
        rows = np.flatnonzero(loading == number)
        negative = np.flatnonzero(table.shear_n[rows] < -1e-9)
        kept[rows[negative[0] :] if negative.size else []] = False
    columns = (table.r1_ohm, table.r2_ohm, table.shear_n, table.normal_n)
    return fit_calibration(CalibrationTable(*(column[kept] for column in columns)))


def test_with_one_calibrated_side_a_skin_at_rest_is_valid_and_the_other_side_is_named(one_sided):
    assert one_sided.missing_side == "negative"
    bench = Bench(one_sided).zeroed()
    assert all(bench.at(0.0).valid for _ in range(20))
    for shear_n in (1.0, 0.0):
        readings = list(bench.to(shear_n))
        assert all(reading.valid for reading in readings)
        assert holds(readings[-1], shear_n)
    # What friction leaves after a load of the other sign, which is too small to be seen.
    assert all(reading.valid for reading in bench.to(-0.03))
    (reason,) = bench.push(-1.0).reasons
    assert reason.startswith("the shear force is negative, and the calibration has none of that sign; take load off")
    assert all(reading.valid for reading in list(bench.to(0.0))[-1:])
    assert "beyond the calibrated curve" in bench.push(6.0).reasons[0]


def test_a_calibration_of_both_sides_lacks_none(calibration):
    assert calibration.missing_side == ""


def test_turning_the_tool_stretches_contact_and_skin_in_series():
    skin = SyntheticSkin(normal_n=1.0)
    hold_n = skin.membrane.belt.friction
    sticking_rad = hold_n / (CONTACT_N_PER_MM * skin.radius_mm)
    assert skin.turn(0.5 * sticking_rad) == pytest.approx(0.5 * hold_n)
    loaded_n = skin.turn(0.05)
    pushed = SyntheticSkin(normal_n=1.0)
    pushed.push(loaded_n)
    slipped = pushed.membrane.turned_rad(pushed.state)
    outer_mm = skin.membrane.section.outer_radius_mm
    assert loaded_n / CONTACT_N_PER_MM + outer_mm * slipped == pytest.approx(0.05 * skin.radius_mm)
    assert slipped > 0.02
    assert skin.turn(0.05 - sticking_rad) == pytest.approx(loaded_n - hold_n), "stuck: only the contact gives way"
    assert skin.turn(0.05) == pytest.approx(loaded_n)
    assert skin.turn(-0.05) == pytest.approx(-loaded_n)
    assert skin.torque_nm == pytest.approx(-loaded_n * 0.015)
    assert abs(skin.turn(0.0)) <= hold_n, "back at the start friction keeps no more than it holds"
