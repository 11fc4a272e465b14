"""Figure 3: linear regression on the best channels, and the mean voltage of a recorded twist."""

import numpy as np
import pytest

from shearloop.studies.reproduce.analysis import place_in_series
from shearloop.studies.reproduce.dataset import ChannelRegression, read_twists, regress_on_channels
from shearloop.tools.recordings.matlab_import import Slices, read_torque_slices


def test_the_channels_that_follow_the_torque_come_first_and_are_enough():
    rng = np.random.default_rng(0)
    torque = np.tile(np.linspace(0.01, 0.1, 10), 4)
    differences = rng.normal(0.0, 1.0, (40, 896))
    differences[:, [700, 5]] = 20 * torque[:, None] + rng.normal(0.0, 1e-3, (40, 2))
    differences[:, 3] = 0.0
    slices = Slices(differences, torque, np.arange(40), np.full(40, np.nan))
    parts = np.repeat(np.arange(4), 10)
    for found in regress_on_channels(slices, parts):
        assert found.counts[[0, -1]].tolist() == [1, 896]
        assert found.r[0] > 0.9999
        assert found.r2[1] > 0.9999
    # By hand: with one channel, leaving out each part, by numpy's own line.
    predicted = np.empty(40)
    for part in range(4):
        out = parts == part
        best = max((5, 700), key=lambda c: abs(np.corrcoef(differences[:, c], torque)[0, 1]))
        predicted[out] = np.polyval(np.polyfit(differences[~out, best], torque[~out], 1), differences[out, best])
    by_hand = 1 - ((predicted - torque) ** 2).sum() / ((torque - torque.mean()) ** 2).sum()
    assert regress_on_channels(slices, parts)[0].r2[0] == pytest.approx(by_hand, abs=1e-12)


def test_counts_reaching_returns_the_first_and_the_lasting_channel_count():
    counts = np.array([1, 2, 3, 4, 5])
    found = ChannelRegression("", counts, counts / 10.0, np.array([0.1, 0.9, 0.2, 0.95, 1.0]))
    assert found.counts_reaching(0.8) == (2, 4)
    assert found.r_share_at(3) == pytest.approx(0.6)
    assert ChannelRegression("", counts, counts / 10.0, -counts / 1.0).counts_reaching(0.8) is None
    assert ChannelRegression("", counts, counts / 10.0, counts * 0 + 1.0).counts_reaching(0.8) == (1, 1)


def test_272_recorded_channels_are_better_than_all_and_fewer_are_enough(shared):
    slices = read_torque_slices(shared / "recordings" / "torque_slices")
    series = place_in_series(slices.torque_nm)
    assert series is not None
    by_all, by_fitted = regress_on_channels(slices, series[1])
    # Measured: 1.029, and 2 to 42 or 5 to 50 channels.
    assert by_all.r_share_at(272) == pytest.approx(1.029, abs=0.005)
    first, always = by_fitted.counts_reaching(0.8)
    assert first < 15
    assert 40 < always < 60


def test_grip_and_twist_lower_the_mean_voltage(shared):
    notes: list[str] = []
    twists = read_twists(shared / "recordings", notes)
    assert twists is not None
    assert notes == []
    idle, gripped, twisted = (twists.mean_v[twists.phase == one].mean() for one in range(3))
    assert idle > 1.03 * gripped
    assert gripped > twisted
    largest = np.nanmax(np.abs(twists.torque_nm))
    assert np.abs(twists.torque_nm[twists.phase == 2]).min() > 0.1 * largest
    assert np.abs(twists.torque_nm[twists.phase == 1]).max() <= 0.1 * largest


def test_what_is_missing_or_unusable_is_noted(tmp_path):
    notes: list[str] = []
    assert read_twists(tmp_path, notes) is None
    (tmp_path / "streams" / "one").mkdir(parents=True)
    (tmp_path / "streams" / "one" / "right.mat").write_bytes(b"MATLAB 5.0 cut")
    assert read_twists(tmp_path, notes) is None
    assert notes[0] == notes[2]
    assert "truncated or damaged" in notes[1]
