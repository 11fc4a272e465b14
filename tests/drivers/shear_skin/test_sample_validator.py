"""What two voltages and a source say of two gauges; every fault by its own name."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shearloop.drivers.shear_skin.instruments import PairParser, SourceReading, Voltages
from shearloop.drivers.shear_skin.skin import SampleAverager, SampleValidator, SkinFault, SkinSample

CURRENT_A, SOURCE_S, DAQ_S = 5e-3, 0.5, 0.1
GOOD = SourceReading(0, output_on=True, voltage_v=0.252, current_a=CURRENT_A)


def judge() -> SampleValidator:
    return SampleValidator(CURRENT_A, SOURCE_S, DAQ_S)


def voltages(v1_v: float, v2_v: float, number: int = 0, **more: bool | int) -> Voltages:
    t_ns = number * 100_000_000
    return Voltages(v1_v, v2_v, t_ns, t_ns, **more)


def said(v1_v: float, v2_v: float, source: SourceReading | None = GOOD, **more: bool) -> SkinSample:
    return judge().sample(voltages(v1_v, v2_v, **more), source)


STUCK_OPEN = SourceReading(0, output_on=True, voltage_v=1.0, current_a=1e-9, compliance=True)


@pytest.mark.parametrize(
    ("v1_v", "v2_v", "source", "faults"),
    [
        (0.123, 0.126, None, [SkinFault.SOURCE_STARTING]),
        (0.0, 0.0, SourceReading(0, output_on=False), [SkinFault.SOURCE_OFF]),
        (1.0, 0.0, STUCK_OPEN, [SkinFault.COMPLIANCE, SkinFault.OPEN_1]),
        (0.0, 1.0, STUCK_OPEN, [SkinFault.COMPLIANCE, SkinFault.OPEN_2]),
        (0.0, 0.0, STUCK_OPEN, [SkinFault.COMPLIANCE]),
        # Half a second before the source says so, the voltages do.
        (1.0, 0.0, GOOD, [SkinFault.OPEN_1]),
        (0.126, 0.0001, GOOD, [SkinFault.SHORT_2]),
        (-0.123, 0.126, GOOD, [SkinFault.REVERSED_1]),
        (0.123, -0.126, GOOD, [SkinFault.REVERSED_2]),
        (0.123, 0.3, GOOD, [SkinFault.IMPLAUSIBLE_2]),
        (0.123, 0.180, GOOD, [SkinFault.SUM]),
        (0.123, 0.126, SourceReading(0, True, 0.252, 4.8e-3), [SkinFault.CURRENT]),
    ],
)
def test_each_fault_has_its_name_and_leaves_no_resistance(v1_v, v2_v, source, faults):
    sample = said(v1_v, v2_v, source)
    assert list(sample.faults) == faults
    assert sample.r1_ohm is None
    assert sample.r2_ohm is None


def test_beyond_the_range_is_open_only_where_nothing_is_across_the_other_gauge():
    assert list(said(9.9e37, 0.126, over_1=True).faults) == [SkinFault.OVERRANGE_1]
    assert list(said(0.512, 0.0, STUCK_OPEN, over_1=True).faults) == [SkinFault.COMPLIANCE, SkinFault.OPEN_1]


def test_readings_are_averaged_in_blocks_that_faults_pauses_and_tares_begin_anew():
    validator, averager = judge(), SampleAverager(3)

    def add(v1_v: float, number: int, missed: int = 0) -> SkinSample | None:
        return averager.add(validator.sample(voltages(v1_v, 0.1265, number, missed=missed), GOOD))

    assert [add(v1_v, number) for number, v1_v in enumerate((0.122, 0.123))] == [None, None]
    mean = add(0.124, 2)
    assert (mean.r1_ohm, mean.r2_ohm) == pytest.approx((24.6, 25.3))
    assert (mean.t_mid_ns, mean.t_arrival_ns, mean.seq, mean.missed) == (100_000_000, 200_000_000, 0, 0)
    assert add(0.123, 3) is None
    faulty = add(-0.123, 4)
    assert (faulty.r1_ohm, faulty.seq, faulty.missed) == (None, 1, 0), "3 was dropped and is not missing"
    assert faulty.faults == (SkinFault.REVERSED_1,)
    assert [add(0.123, 5), add(0.123, 8, 2), add(0.123, 9)] == [None] * 3, "two readings are missing before 8"
    after = add(0.126, 10)
    assert (after.seq, after.missed, after.paused) == (2, 2, True)
    assert after.r1_ohm == pytest.approx(24.8)
    assert add(0.123, 11) is None
    averager.restart()
    assert [add(0.126, 12), add(0.126, 13)] == [None, None]
    tared = add(0.126, 14)
    assert (tared.r1_ohm, tared.missed, tared.paused) == (pytest.approx(25.2), 0, False)
    assert validator.missed == mean.missed + faulty.missed + after.missed + tared.missed


def test_a_missing_reading_drops_no_others():
    validator, averager = judge(), SampleAverager(4)
    samples = [validator.sample(voltages(0.123, 0.126, n, missed=int(n == 3)), GOOD) for n in (0, 1, 3, 4)]
    *none, whole = map(averager.add, samples)
    assert none == [None] * 3
    assert (whole.missed, whole.paused, whole.t_mid_ns) == (1, False, 2 * 10**8)


@pytest.mark.parametrize("averaged", [1, 10])
def test_a_process_that_stands_still_for_less_than_a_period_loses_no_reading_and_no_average(averaged):
    parser, validator, averager = PairParser(1 / DAQ_S), judge(), SampleAverager(averaged)
    found = []
    for number in range(400):
        sent_ns = round((10 + number) * 1e9 * DAQ_S)
        late_ns = 85_000_000 if number % 7 == 3 else 0
        source = replace(GOOD, t_ns=sent_ns - 10**8)
        readings = parser.feed(f"0.1230{number % 10},0.126{number % 7}\n".encode(), sent_ns + late_ns)
        found += [averager.add(validator.sample(reading, source)) for reading in readings]
    samples = [sample for sample in found if sample is not None]
    assert sum(sample.missed for sample in samples) == validator.missed == 0
    times_ns = np.array([sample.t_mid_ns for sample in samples])
    assert np.diff(times_ns) == pytest.approx(averaged * 1e9 * DAQ_S, rel=1e-6)
    assert len(samples) == 399 // averaged, "the first line may lack its beginning"


def test_a_source_that_falls_silent_is_lost_after_two_seconds():
    one = judge()
    assert not one.sample(voltages(0.123, 0.126, 20), GOOD).faults
    assert list(one.sample(voltages(0.124, 0.126, 21), GOOD).faults) == [SkinFault.SOURCE_LOST]
    assert one.faults == {"source_lost": 1}


def test_a_source_is_starting_for_two_seconds_and_that_is_no_error():
    one = judge()
    assert one.sample(voltages(0.0, 0.0, 7), None).faults == (SkinFault.SOURCE_STARTING,)
    assert one.sample(voltages(0.0, 0.0, 27), None).faults == (SkinFault.SOURCE_STARTING,)
    assert not one.faults
    assert one.sample(voltages(0.0, 0.0, 28), None).faults == (SkinFault.SOURCE_LOST,)
    assert one.faults == {"source_lost": 1}


def test_a_late_reading_of_a_board_is_none_missing_and_each_count_is_passed_on_once():
    one, found = judge(), []
    for number, (late_s, missed) in enumerate([(0.0, 0), (0.085, 0), (0.0, 0), (0.3, 2), (0.3, 0)]):
        t_ns = round(1e9 * (DAQ_S * number + late_s))
        found.append(one.sample(Voltages(0.123 + 1e-6 * number, 0.126, t_ns, t_ns, missed=missed), GOOD))
    assert [sample.missed for sample in found] == [0, 0, 0, 2, 0]
    assert [sample.paused for sample in found] == [False, False, False, True, False]
    assert one.missed == 2


@given(st.lists(st.tuples(st.integers(0, 4), st.floats(0.0, 0.99)), min_size=1, max_size=60))
def test_a_scanner_that_is_asked_late_misses_nothing_and_skipped_polls_are_counted(polls):
    one, slot = judge(), 0
    for number, (skipped, late) in enumerate([(0, 0.0), *polls, (0, 0.0)]):
        slot += 1 + skipped
        t_ns = 10**9 + slot * 10**8 + round(late * 10**8)
        one.sample(Voltages(0.123 + 1e-6 * number, 0.126, t_ns, t_ns, t_asked_ns=t_ns), GOOD)
    assert one.missed == sum(skipped for skipped, _ in polls)


def test_a_jump_is_a_disturbance_until_it_stays():
    one = judge()
    path = [0.123, 0.123, 0.19, 0.1231, 0.17, 0.17, 0.17, 0.17]
    trusted = []
    for number, v1_v in enumerate(path):
        source = SourceReading(0, True, v1_v + 0.126, CURRENT_A)
        trusted.append(not one.sample(voltages(v1_v, 0.126, number), source).faults)
    assert trusted == [True, True, False, True, False, False, True, True]


def test_voltages_from_before_the_current_flowed_are_not_called_a_short():
    one = judge()
    on = replace(GOOD, t_ns=2 * 10**8)
    assert one.sample(voltages(0.0, 0.0, 1), on).faults == (SkinFault.SOURCE_STARTING,)
    assert not one.sample(voltages(0.123, 0.126, 2), on).faults
    off = SourceReading(3 * 10**8, output_on=False)
    assert one.sample(voltages(0.0, 0.0, 3), off).faults == (SkinFault.SOURCE_OFF,)
    on = replace(GOOD, t_ns=5 * 10**8)
    assert one.sample(voltages(0.0, 0.0, 4), on).faults == (SkinFault.SOURCE_OFF,)
    assert one.sample(voltages(0.0, 0.0, 6), on).faults == (SkinFault.SHORT_1, SkinFault.SHORT_2)


def test_a_converter_that_stands_still_is_reported_for_its_gauge():
    one = judge()
    sources = [replace(GOOD, t_ns=n * 10**8) for n in range(60)]
    samples = [one.sample(voltages(0.123, 0.126 + 1e-6 * (n % 2), n), source) for n, source in enumerate(sources)]
    assert not samples[40].faults
    assert list(samples[59].faults) == [SkinFault.STUCK_1]


ANY = st.floats(-2, 2) | st.just(9.9e37)


@given(
    st.lists(st.tuples(ANY, ANY, st.integers(1, 4)), max_size=30),
    st.sampled_from([None, GOOD, STUCK_OPEN, SourceReading(0, output_on=False)]),
)
def test_whatever_comes_a_trusted_sample_has_two_resistances_that_a_gauge_can_have(sequence, source):
    one, number = judge(), 0
    for v1_v, v2_v, step in sequence:
        number += step
        reading = source and replace(source, t_ns=number * 10**8)
        sample = one.sample(voltages(v1_v, v2_v, number, over_1=v1_v > 1, over_2=v2_v > 1), reading)
        assert (not sample.faults) == (sample.r1_ohm is not None) == (sample.r2_ohm is not None)
        for ohm in (sample.r1_ohm, sample.r2_ohm):
            assert ohm is None or (ohm * 1.01 >= 15 and ohm <= 50.5 and math.isfinite(ohm))
