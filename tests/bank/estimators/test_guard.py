import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bank.errors import CalibrationError
from bank.estimators.gripped import gripped_part
from bank.estimators.guard import LEAST_NOISE_V, SideGuard, _median, channel_noise

ALL = np.ones(896, dtype=bool)


def guard_of(series, layer=0):
    idle, gripped, released = gripped_part(series)
    return SideGuard.fit("right", tuple(series.channels[part, layer] for part in (idle, gripped, released)))


def test_grip_and_release_are_found_in_a_recording(recorded):
    idle, gripped, released = gripped_part(recorded)
    t = recorded.t_s
    assert 15 < t[idle][-1] <= 20
    assert 20 <= t[gripped][0] < 24
    assert 136 < t[gripped][-1] <= 140.5
    assert 140 < t[released][0] < 144


def test_noise_is_what_is_fast(twisting):
    series = twisting(noise_v=0.004)
    np.testing.assert_allclose(channel_noise(series.channels[50:250, 0]), 0.004, rtol=0.35)
    still = np.ones((20, 896))
    still[:, 5:] += np.random.default_rng(0).normal(0, 1e-5, (20, 891))
    assert np.isinf(channel_noise(still)[:5]).all()
    np.testing.assert_allclose(channel_noise(still)[5:], LEAST_NOISE_V)


@pytest.mark.parametrize("gain", [0.85, 1.0, 1.2])
def test_a_fingertip_is_known_under_any_gain(recorded, gain):
    guard = guard_of(recorded)
    assert all(guard.seen(gain * frame, ALL)[0] is None for frame in recorded.channels[::20, 0])
    assert all(guard.seen(gain * frame, ALL)[0] for frame in recorded.channels[::20, 1])


def test_grip_is_about_one_gripped_and_zero_idle(recorded):
    guard = guard_of(recorded)
    scores = np.array([guard.grip(frame, guard.idle) for frame in recorded.channels[:, 0]])
    gripped = (recorded.t_s > 24) & (recorded.t_s < 139)
    idle = (recorded.t_s < 19) | (recorded.t_s > 143)
    assert scores[gripped].min() > guard.grip_threshold > scores[idle].max()


def test_a_release_is_known_by_its_step_where_none_was_calibrated(recorded):
    idle, gripped, released = gripped_part(recorded)
    frames = recorded.channels[:, 0]
    guard = SideGuard.fit("right", (frames[idle], frames[gripped], frames[:0]))
    assert np.isfinite(guard.step_limit)
    opening, closing = int(released.start), int(gripped.start)
    assert guard.released(frames[opening + 2], frames[opening - 6], guard.idle) is True
    assert guard.released(frames[closing + 2], frames[closing - 8], guard.idle) is False
    assert all(guard.released(frames[i], frames[i - 4], guard.idle) is None for i in range(60, 240))


def test_too_little_is_said_to_be(recorded):
    frames = recorded.channels[:, 0]
    with pytest.raises(CalibrationError, match="2 idle and 200 gripped frames are too few"):
        SideGuard.fit("right", (frames[:2], frames[50:250], frames[:0]))
    with pytest.raises(CalibrationError, match="cannot be told from idle"):
        SideGuard.fit("right", (frames[:12], frames[6:34], frames[:0]))
    silent = type(recorded)(
        "raw", recorded.sides, recorded.t_s, recorded.channels, recorded.torque_t_s,
        np.zeros_like(recorded.torque_nm), recorded.diameter_mm,
    )  # fmt: skip
    with pytest.raises(CalibrationError, match="no torque to calibrate on"):
        gripped_part(silent)


@given(st.lists(st.floats(-1e3, 1e3), max_size=40))
def test_the_quick_median_is_the_median_to_the_bit(values: list[float]) -> None:
    assert _median(np.array(values)) == (np.median(values) if values else 0.0)
