import numpy as np
import pytest

from shearloop.bank.eit import channels


def test_the_table_has_896_channels_and_128_zero_slots() -> None:
    assert channels.CHANNELS.shape == (channels.N_CHANNELS, 4)
    assert channels.ZERO_SLOTS.sum() == 128


def test_no_channel_measures_on_a_driven_electrode() -> None:
    for sink, source, positive, negative in channels.CHANNELS:
        assert {sink, source}.isdisjoint({positive, negative})
        assert source == (sink + 16) % 32
        assert negative == (positive + 1) % 32


def test_a_line_and_its_channels_are_one_another() -> None:
    frame = np.arange(1.0, channels.N_CHANNELS + 1)
    line = channels.line_of_channels(frame)
    assert (line[channels.ZERO_SLOTS] == 0).all()
    np.testing.assert_array_equal(channels.channels_of_line(line), frame)
    assert line[:3].tolist() == [0.0, 1.0, 2.0], "injection 0: the pair 0-1 touches the driven electrode 0"


def test_smoothing_keeps_what_is_constant_and_spreads_a_peak_over_nine_channels() -> None:
    peak = np.zeros((2, 896))
    peak[0] = 3.0
    peak[1, 100] = 1.0
    smooth = channels.smoothed_along_channels(peak)
    np.testing.assert_allclose(smooth[0], 3.0)
    assert np.flatnonzero(smooth[1]).tolist() == list(range(96, 105))
    assert smooth[1].sum() == pytest.approx(1.0)
    assert smooth[1, 101] / smooth[1, 100] == pytest.approx(np.exp(-0.5 / 1.8**2))
