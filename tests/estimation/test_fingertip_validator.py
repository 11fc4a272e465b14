from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shearloop.bank.errors import CalibrationError
from shearloop.estimation.fingertip_validator import _JUMP_NOISES, _JUMP_V, MIN_NOISE_V, FingertipSet, compare_frames
from shearloop.estimation.grips import segment_grip
from shearloop.estimation.validator_fit import GripParts, channel_noise, fit_validator
from tests.estimation.conftest import twisting

ALL = np.ones((1, 896), dtype=bool)


def guard_of(series, layer=0):
    idle, gripped, released = segment_grip(series)
    return fit_validator("right", GripParts(*(series.channels[part, layer] for part in (idle, gripped, released))))


def test_grip_and_release_are_found_in_a_recording(recorded):
    idle, gripped, released = segment_grip(recorded)
    t = recorded.t_s
    assert 15 < t[idle][-1] <= 20
    assert 20 <= t[gripped][0] < 24
    assert 136 < t[gripped][-1] <= 140.5
    assert 140 < t[released][0] < 144


def test_noise_is_what_is_fast():
    series = twisting(noise_v=0.004)
    np.testing.assert_allclose(channel_noise(series.channels[50:250, 0]), 0.004, rtol=0.35)
    still = np.ones((20, 896))
    still[:, 5:] += np.random.default_rng(0).normal(0, 1e-5, (20, 891))
    assert np.isinf(channel_noise(still)[:5]).all()
    np.testing.assert_allclose(channel_noise(still)[5:], MIN_NOISE_V)


@pytest.mark.parametrize("gain", [0.85, 1.0, 1.2])
def test_a_fingertip_is_known_under_any_gain(recorded, gain):
    guards = FingertipSet((guard_of(recorded),))
    assert all(guards.check(gain * frame[None], ALL)[0] == [""] for frame in recorded.channels[::20, 0])
    assert all(guards.check(gain * frame[None], ALL)[0] != [""] for frame in recorded.channels[::20, 1])


def lost_channels(side, frame, usable):
    """Return the channels that are off by more than six tenths from the idle and from the gripped frame."""
    off = usable.copy()
    for known in (side.idle, side.gripped):
        judged = usable & (known > 0.03)
        expected = np.median(frame[judged] / known[judged]) * known
        off &= judged & (np.abs(frame - expected) > 0.6 * expected)
    return off


def test_each_side_is_compared_with_its_own_fingertip_whatever_the_other_says(recorded):
    """Side by side they are what each is by itself: why, which channels are lost, and jumps."""
    random = np.random.default_rng(3)
    sides = [guard_of(recorded, layer) for layer in (0, 1)]
    both, alone = FingertipSet(tuple(sides)), [FingertipSet((side,)) for side in sides]
    before = recorded.channels[100]
    said = set()
    for number, frame in enumerate(recorded.channels[::10].copy()):
        usable = random.random((2, 896)) > (0.0, 0.02, 0.1)[number % 3]
        frame[0, 100:128] *= 0.1
        frame[1] = frame[1, ::-1] if number % 4 == 0 else frame[1]
        frame[:, :40] += 0.05 * random.random()
        why, lost = both.check(frame, usable)
        jumps = both.jumping_fractions(frame, before, usable)
        for layer, (one, side) in enumerate(zip(alone, sides, strict=True)):
            own = slice(layer, layer + 1)
            own_why, own_lost = one.check(frame[own], usable[own])
            assert own_why == why[own]
            np.testing.assert_array_equal(own_lost, lost[own])
            np.testing.assert_array_equal(lost[layer], lost_channels(side, frame[layer], usable[layer]))
            assert one.jumping_fractions(frame[own], before[own], usable[own]) == jumps[own]
            moved = np.abs(frame[layer] - before[layer])[usable[layer]]
            limit = np.maximum(_JUMP_NOISES * np.sqrt(2.0) * side.noise, _JUMP_V)[usable[layer]]
            assert jumps[layer] == np.mean(moved > limit)
            said.add((layer, bool(why[layer]), bool(own_lost.any())))
        before = frame
    assert said >= {(0, False, True), (1, False, False), (1, True, True)}, "all of it was seen"


def test_grip_is_about_one_gripped_and_zero_idle(recorded):
    guard = guard_of(recorded)
    scores = np.array([guard.grip_score(frame, guard.idle) for frame in recorded.channels[:, 0]])
    gripped = (recorded.t_s > 24) & (recorded.t_s < 139)
    idle = (recorded.t_s < 19) | (recorded.t_s > 143)
    assert scores[gripped].min() > guard.grip_threshold > scores[idle].max()


def test_a_release_is_known_by_its_step_where_none_was_calibrated(recorded):
    idle, gripped, released = segment_grip(recorded)
    frames = recorded.channels[:, 0]
    guard = fit_validator("right", GripParts(frames[idle], frames[gripped], frames[:0]))
    assert np.isfinite(guard.step_limit)
    opening, closing = int(released.start), int(gripped.start)
    assert guard.released(frames[opening + 2], frames[opening - 6], guard.idle) is True
    assert guard.released(frames[closing + 2], frames[closing - 8], guard.idle) is False
    assert all(guard.released(frames[i], frames[i - 4], guard.idle) is None for i in range(60, 240))


def test_too_little_is_said_to_be(recorded):
    frames = recorded.channels[:, 0]
    with pytest.raises(CalibrationError, match="2 idle and 200 gripped frames are too few"):
        fit_validator("right", GripParts(frames[:2], frames[50:250], frames[:0]))
    with pytest.raises(CalibrationError, match="look like idle"):
        fit_validator("right", GripParts(frames[:12], frames[6:34], frames[:0]))
    for series, reason in (
        (replace(recorded, torque_nm=0.0 * recorded.torque_nm), "is 0 at all of these frames; record twists"),
        (replace(recorded, torque_t_s=recorded.torque_t_s + 1e4), "no torque is known for these frames"),
        (
            replace(recorded, torque_t_s=recorded.torque_t_s + 1e4, left_out=("9 frames, repeated by the board",)),
            "no torque is known for these frames, and left out: 9 frames, repeated by the board; record",
        ),
        (recorded.between(0, 0), "holds no frames of right and left together; record some frames"),
    ):
        with pytest.raises(CalibrationError, match=reason):
            segment_grip(series)


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.4, 0.75, 0.76, 1.0]))
def test_gain_and_deviation_are_medians_of_the_channels_that_are_compared(seed, left_out):
    random = np.random.default_rng(seed)
    known, usable = random.uniform(0.0, 0.3, (2, 896)), random.random(896) >= left_out
    frame = random.uniform(0.5, 2.0) * known[0] + random.normal(0, 0.02, 896)
    gains, off_from_each, deviations = compare_frames(frame, known, usable)
    for one, gain, deviation, channels in zip(known, gains, deviations, off_from_each, strict=True):
        judged = usable & (one > 0.03)
        if not judged.any():
            assert np.isnan(gain)
            assert deviation == np.inf
            assert np.isnan(channels).all()
            continue
        assert gain == np.median(frame[judged] / one[judged]), "to the bit"
        off = np.abs(frame[judged] / gain - one[judged]) / one[judged]
        np.testing.assert_array_equal(channels[judged], off)
        assert np.isnan(channels[~judged]).all()
        assert deviation == (np.median(off) if np.count_nonzero(judged) >= 224 else np.inf)
