"""The load cell's parser: any bytes in any slices, flags instead of silence, and the paper's real corrupted values."""

from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.io import loadmat

from shearloop.drivers import load_cell
from shearloop.drivers.calibration_files import load_device_calibration, save_calibration
from shearloop.drivers.defaults import LOAD_CELL_RATE_HZ
from shearloop.drivers.errors import DeviceCalibrationError
from shearloop.drivers.load_cell import (
    COUNTS_FOR_TORQUES,
    COUNTS_MAX,
    COUNTS_MIN,
    COUNTS_REASON,
    STUCK_AFTER,
    TORQUES_FOR_COUNTS,
    LoadCalibration,
    LoadParser,
)
from shearloop.drivers.refused_lines import refusal_of
from shearloop.drivers.serial_sensor import InputKind, RawEvent
from tests.slices import slices

PERIOD_NS = round(1e9 / LOAD_CELL_RATE_HZ)
TORQUE_LINES = LoadCalibration.of_torque_lines()
STREAMS = {
    "glitch_20241202_173837/load.mat": "plotthis3",
    "20241202_153632/load.mat": "plotthis3",
    "2024-12-03_16-09/device3.mat": "Load_Data",
    **{f"cylinders/{mm}mm_1_truth.mat": "plotthis_truth" for mm in (10, 20, 30, 40)},
}


def spikes(torques_nm: list[float]) -> list[bool]:
    """Return which of the values, one a period, are flagged as spikes."""
    # The first line after opening is no level. Lines of one length are a period apart.
    lines = [f"{one:+026.12f}" for one in (0.0, *torques_nm)]
    return [one.spike for one in feed_lines(LoadParser(TORQUE_LINES), lines)][1:]


def feed_lines(parser: LoadParser, lines: list[str]) -> list[load_cell.LoadSample]:
    samples = []
    for n, line in enumerate(lines):
        samples += parser.feed(f"{line}\r\n".encode(), n * PERIOD_NS)
    return samples


def recorded(shared: Path, name: str) -> list[tuple[int, float]]:
    rows = loadmat(shared / "recordings/streams" / name)[STREAMS[name]]
    return [(round((datenum - rows[0, 0]) * 86400e9), value) for datenum, value in rows.tolist()]


@pytest.mark.parametrize("name", STREAMS)
def test_the_two_real_corrupted_values_are_flagged_and_nothing_else(shared, name):
    parser = LoadParser(TORQUE_LINES)
    rows = recorded(shared, name)
    samples = [sample for t_ns, value in rows for sample in parser.feed(f"{value:.12f}\r\n".encode(), t_ns)]
    assert len(samples) == len(rows)
    assert not parser.errors
    spikes = [sample.raw for sample in samples if sample.spike]
    assert spikes == ([996.0, 38399996.0] if name.startswith("glitch") else [])
    # The first line may lack its beginning.
    assert [not one.trusted for one in samples] == [True, *(one.spike for one in samples[1:])]


def test_torque_lines_keep_their_values_and_counts_become_torque():
    (_, sample) = feed_lines(LoadParser(TORQUE_LINES), ["0.000000", "0.059796800613"])
    assert sample.torque_nm == pytest.approx(0.059796800613, rel=1e-12)
    counts = LoadCalibration(tare_counts=8000, scale_n_per_count=1e-5, lever_arm_m=0.035, sign=-1)
    (_, sample) = feed_lines(LoadParser(counts), ["8000", "108000"])
    assert sample.torque_nm == pytest.approx(-1.0 * 0.035)


@given(
    st.lists(st.one_of(st.binary(max_size=60), st.decimals(-9e6, 9e6, places=3).map(lambda d: f"{d}\r\n".encode()))),
    st.lists(st.integers(0, 10_000), max_size=100),
)
def test_the_slices_in_which_bytes_come_change_nothing(pieces, cuts):
    data = b"\n" + b"".join(pieces)
    whole, sliced = LoadParser(TORQUE_LINES), LoadParser(TORQUE_LINES)
    expected = whole.feed(data, 0)
    got = [sample for part in slices(data, cuts) for sample in sliced.feed(part, 0)]
    assert [(s.raw, s.saturated, s.partial) for s in got] == [(s.raw, s.saturated, s.partial) for s in expected]
    assert sliced.errors == whole.errors
    # Every line but the first is either a sample or a counted refusal; only an unfinished one is neither.
    unfinished_but_refused = len(data) - data.rfind(b"\n") - 1 > load_cell.MAX_LINE_BYTES
    assert len(expected) + sum(whole.errors.values()) == data.count(b"\n") - 1 + unfinished_but_refused


NOT_DECIMAL = ("nan", "inf", "ovf", "1e5", "0x10", "1 2", "1.", ".5", "--1", "٣", "9" * 20)


@pytest.mark.parametrize(
    ("line", "kind"), [("", "empty"), ("9" * 40, "too long"), *((line, "not a number") for line in NOT_DECIMAL)]
)
def test_a_line_that_is_no_decimal_is_refused_by_kind(line, kind):
    parser = LoadParser(TORQUE_LINES)
    assert len(feed_lines(parser, ["0", line])) == 1
    assert parser.errors == {kind: 1}


def test_the_ends_of_the_converters_range_are_flagged_and_their_neighbours_are_not():
    parser = LoadParser(LoadCalibration(tare_counts=0, scale_n_per_count=1e-6))
    samples = feed_lines(
        parser, [str(n) for n in (COUNTS_MAX - 1, COUNTS_MAX - 1, COUNTS_MAX, COUNTS_MIN, COUNTS_MIN + 1)]
    )
    assert [s.saturated for s in samples] == [False, False, True, True, False]


def test_a_converter_that_repeats_itself_is_flagged_until_it_moves():
    samples = feed_lines(LoadParser(TORQUE_LINES), ["0.01"] * (STUCK_AFTER + 2) + ["0.010001"])
    assert [s.stuck for s in samples] == [False] * (STUCK_AFTER - 1) + [True] * 3 + [False]


@pytest.mark.parametrize("rate_hz", [[], [1.0], [80.0]])
def test_lines_that_arrive_together_are_spread_and_found_stuck_by_the_boards_own_rate(rate_hz):
    (real_hz,) = rate_hz or [LOAD_CELL_RATE_HZ]
    period_ns = round(1e9 / real_hz)
    parser = LoadParser(TORQUE_LINES, *rate_hz)
    samples = parser.feed(b"0.1\n0.2\n0.3\n", 10 * period_ns) + parser.feed(b"0.1\n", 10 * period_ns + 1)
    assert [s.t_arrival_ns for s in samples[:3]] == [8 * period_ns, 9 * period_ns, 10 * period_ns]
    assert all(a.t_mid_ns < b.t_mid_ns for a, b in pairwise(samples)), "time never goes back"
    # The value is the mean of the period before its arrival, and four bytes took 0.35 ms to come.
    for sample in samples[:3]:
        assert sample.t_arrival_ns - sample.t_mid_ns == pytest.approx(period_ns / 2 + 0.35e6, abs=0.02e6)
    stuck = [s.stuck for s in feed_lines(LoadParser(TORQUE_LINES, *rate_hz), ["0.01"] * 200)]
    assert stuck.index(True) + 1 == max(STUCK_AFTER, round(STUCK_AFTER * real_hz / LOAD_CELL_RATE_HZ))


torques = st.floats(-1.7, 1.7)


@given(torques, torques, st.integers(3, 10))
def test_a_real_step_is_believed_after_three_agreeing_values(before, after, n):
    flags = spikes([before] * 5 + [after] * n)
    assert not any(flags[:5])
    step_nm = abs(after - before)
    assert flags[5] == (step_nm > 2.0 * PERIOD_NS * 1e-9) or step_nm == pytest.approx(2.0 * PERIOD_NS * 1e-9)
    assert not any(flags[7:])


@given(st.lists(st.floats(-0.15, 0.15), min_size=3, max_size=60), st.data())
def test_one_corrupted_value_in_a_moving_signal_is_flagged_alone(steps, data):
    level, values = 0.0, []
    for step in steps:
        level = min(max(level + step, -1.0), 1.0)
        values.append(level)
    where = data.draw(st.integers(1, len(values) - 1))
    values[where] = values[where - 1] + data.draw(st.sampled_from([-1, 1])) * data.draw(st.floats(0.2, 1e9))
    assert [k for k, spike in enumerate(spikes(values)) if spike] == [where]


def test_after_a_gap_the_rig_may_have_moved_further():
    parser = LoadParser(TORQUE_LINES)
    assert not any(one.spike for one in [*feed_lines(parser, ["0.0", "0.0"]), *parser.feed(b"1.5\n", 10**9)])


@pytest.mark.parametrize("rate_hz", [1.0, 10.9, 80.0])
def test_a_spike_is_what_the_rig_cannot_do_within_the_boards_own_period(rate_hz):
    within_nm = load_cell.SLEW_NM_PER_S / rate_hz
    for share, spike in ((0.9, False), (1.1, True)):
        parser, torque_nm = LoadParser(TORQUE_LINES, rate_hz), min(share * within_nm, 1.74)
        lines = [f"{value:.4f}\n".encode() for value in (0.0, 0.0, torque_nm)]
        samples = [one for n, line in enumerate(lines) for one in parser.feed(line, round(n * 1e9 / rate_hz))]
        assert samples[-1].spike == (spike and rate_hz > 2.0), "within a second it may reach all that the cell bears"


def test_a_tare_forgets_the_level_that_spikes_are_judged_by():
    parser = LoadParser(LoadCalibration(tare_counts=0, scale_n_per_count=1e-4))
    assert not feed_lines(parser, ["200000", "200000"])[-1].spike
    parser.handle(RawEvent(InputKind.TARE, 0, b"200000"))
    assert (sample := feed_lines(parser, ["200000"])[0]).trusted
    assert sample.torque_nm == 0


def test_a_calibration_survives_its_file(tmp_path):
    path = tmp_path / "load.yaml"
    calibration = LoadCalibration(tare_counts=-81234.5, scale_n_per_count=-2.3e-5, lever_arm_m=0.035, sign=-1)
    save_calibration(path, calibration)
    assert load_device_calibration(path, LoadCalibration) == calibration


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("tare_counts: 1\nscale_n_per_count: 2e-5\nlever_arm: 0.035\n", "lever_arm"),
        ("tare_counts: .nan\nscale_n_per_count: 2.0e-5\n", "tare_counts"),
        ("tare_counts: 1.0\nscale_n_per_count: 2.0e-5\nsign: 0\n", "sign"),
        ("tare_counts: 1.0\nscale_n_per_count: 2.0e-5\nlever_arm_m: -0.035\n", "lever_arm_m"),
        ("[1, 2", ":1:6: a list is not closed"),
        ("", "the calibration is empty"),
    ],
)
def test_a_calibration_file_that_is_wrong_is_refused_by_name_and_key(tmp_path, text, said):
    path = tmp_path / "load.yaml"
    path.write_text(text)
    with pytest.raises(DeviceCalibrationError, match=said) as refused:
        load_device_calibration(path, LoadCalibration)
    assert str(path) in str(refused.value)


def test_a_missing_calibration_file_says_how_to_make_one(tmp_path):
    with pytest.raises(DeviceCalibrationError, match="shearloop calibrate"):
        load_device_calibration(tmp_path / "none.yaml", LoadCalibration)
    with pytest.raises(DeviceCalibrationError, match="cannot be written"):
        save_calibration(tmp_path / "no/such/folder.yaml", TORQUE_LINES)


OF_COUNTS = LoadCalibration(tare_counts=81_250, scale_n_per_count=2.3e-5)
# As `calibrate load` finds it with a board that sends N·m, and one that sends grams.
OF_TORQUES = LoadCalibration(tare_counts=0.003, scale_n_per_count=1.02 / 0.035)
OF_GRAMS = LoadCalibration(tare_counts=12.0, scale_n_per_count=9.80665e-3)


@pytest.mark.parametrize(
    ("calibration", "lines", "why"),
    [
        (TORQUE_LINES, ["81250", "81310", "81190"], COUNTS_REASON),
        (TORQUE_LINES, ["81250.25", "81310.50", "81190.00"], COUNTS_REASON),
        (OF_TORQUES, ["81250", "81310", "81190"], COUNTS_FOR_TORQUES),
        (OF_GRAMS, ["-812500", "-812480", "-812475"], COUNTS_FOR_TORQUES),
        (OF_COUNTS, ["0.0123", "-0.0401", "0.0000"], TORQUES_FOR_COUNTS),
        (OF_COUNTS, ["0.00", "0.01", "0.00"], TORQUES_FOR_COUNTS),
        (OF_COUNTS, ["81250", "81310", "81190"], None),
        (OF_COUNTS, ["81250.00", "81310.12", "81190.50"], None),
        (OF_TORQUES, ["0.0123", "-0.0401", "0"], None),
        (OF_GRAMS, ["12.5", "13.25", "0.00"], None),
    ],
)
def test_a_line_of_another_unit_than_the_calibrations_is_no_torque(calibration, lines, why):
    # The first line after opening may lack its beginning.
    _, *samples = feed_lines(LoadParser(calibration), ["0", *lines])
    assert [one.other_unit for one in samples] == [why] * 3
    assert [one.trusted for one in samples] == [not why] * 3


def test_a_corrupted_torque_is_not_called_counts():
    # The paper's corrupted values have no decimal point.
    torques = feed_lines(LoadParser(TORQUE_LINES), ["0.0100", "0.0101", "38399996", "0.0102"])
    assert [one.other_unit for one in torques] == [None] * 4
    assert [one.spike for one in torques] == [False, False, True, False]


@pytest.mark.parametrize("line", ["0,091", "torque: 0.091", "nan", "", "9" * 40, "\xf8\x80"])
def test_the_last_refused_line_is_quoted_with_its_reason(line):
    parser = LoadParser(TORQUE_LINES)
    assert parser.refusal is None
    feed_lines(parser, ["0.1", "1.5.5", line])
    assert parser.refused == 2
    kind = "empty" if not line else "too long" if len(line) == 40 else "not a number"
    sent = line.encode() + b"\r" * (kind == "too long")
    assert parser.refusal == refusal_of(sent, kind, "load cell", in_a_row=1)
