"""What one compiled call says of a frame, against what NumPy says of it in many."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shearloop.bank.eit import compiled
from shearloop.bank.eit.channels import N_CHANNELS
from shearloop.bank.estimation.fingertip_validator import unsaturated
from shearloop.bank.estimation.session_state import SessionState
from shearloop.bank.estimation.validity import JUMP_V, Guards
from shearloop.bank.estimation.values import BoolArray, FloatArray, everywhere
from tests.bank.estimators.odd_frames import BY_NUMPY, ODD, spoilt

pytestmark = pytest.mark.skipif(not compiled.IS_COMPILED, reason="nothing is compiled")


@pytest.fixture(scope="module")
def guards(fused_calibration) -> Guards:
    return Guards(fused_calibration.guards, fused_calibration.motion)


def jumping(guards: Guards, frame: FloatArray, usable: BoolArray, before: FloatArray) -> list[float] | None:
    """Return the shares of channels that jump of a frame that is looked at in a few calls."""
    look = guards.views.look(frame, usable, np.zeros(frame.shape, dtype=np.bool_), before)
    return None if look is None else look.jumping_shares


@settings(deadline=None, max_examples=200)
@given(
    st.sampled_from([*ODD, "shuffled", "clipped"]),
    st.sampled_from([0, 0, 1, 8, 9, 200, 448, 449, N_CHANNELS]),
    st.sampled_from([0.0, 0.003, 0.05, 0.3]),
    st.floats(0.05, 20.0),
    st.integers(0, 2**32 - 1),
)
def test_a_frame_is_ordinary_where_nothing_is_found_against_it(guards, recorded, kind, n, noise, gain, seed) -> None:
    random = np.random.default_rng(seed)
    number = random.integers(1, len(recorded.t_s))
    before = gain * recorded.channels[number - 1]
    frame = gain * recorded.channels[number] * (1 + random.normal(0, noise, before.shape))
    frame = spoilt(frame, kind, n, random)
    usable = np.ones(frame.shape, dtype=np.bool_)
    found = jumping(guards, frame, usable, before)
    if not np.isfinite(frame).all():
        assert found is None
        return
    with BY_NUMPY, np.errstate(all="ignore"):
        why, lost = guards.seen(frame, usable)
        at_rail = not everywhere(unsaturated(frame, usable))
        shares = guards.jumping_shares(frame, before, usable)
    if any(why) or lost.any() or at_rail:
        assert found is None
    else:
        assert found == shares
    for odd in (0, -1):
        usable.ravel()[odd] = False
        assert jumping(guards, frame, usable, before) is None
        usable.ravel()[odd] = True


def test_of_a_frame_as_far_off_as_may_be_one_channel_decides(fused_calibration) -> None:
    """With more than half of the channels near both of the two in the middle are; with half of them the mean may be."""
    sides = tuple(replace(guard, gripped=2.0 * guard.idle) for guard in fused_calibration.guards)
    guards, usable = Guards(sides), np.ones((2, N_CHANNELS), dtype=np.bool_)
    for n_near in (447, 448, 449):
        frame = guards.idle.copy()
        # Some above and some below, so that the gain in common stays what it is.
        frame[0, n_near::2] *= 1.2
        frame[0, n_near + 1 :: 2] *= 0.8
        assert bool(guards.seen(frame, usable)[0][0]) == (n_near < 448)
        assert (jumping(guards, frame, usable, frame) is None) == (n_near < 449)


def test_a_frame_like_either_of_the_two_is_known_and_lost_is_what_is_off_from_both(fused_calibration) -> None:
    usable, first = np.ones((1, N_CHANNELS), dtype=np.bool_), fused_calibration.guards[0]
    others = Guards((replace(first, gripped=first.idle[::-1].copy()),))
    for frame in (others.idle, others.gripped):
        assert jumping(others, frame, usable, frame) == [0.0]
    gripped = first.idle.copy()
    gripped[7] *= 3.0
    guards, lost = Guards((replace(first, gripped=gripped),)), 0.3 * first.idle[None]
    assert jumping(guards, guards.idle, usable, guards.idle) == [0.0]
    assert jumping(guards, guards.gripped, usable, guards.idle) == [1 / N_CHANNELS]
    frame = np.where(np.arange(N_CHANNELS) == 7, lost, guards.idle)
    assert jumping(guards, frame, usable, frame) is None


@pytest.mark.parametrize("at_rail", [8, 9])
def test_a_frame_at_a_rail_is_not_ordinary(guards, recorded, at_rail) -> None:
    frame = spoilt(recorded.channels[50], "clipped", at_rail, np.random.default_rng(0))
    found = jumping(guards, frame, np.ones(frame.shape, dtype=np.bool_), frame)
    assert (found is None) == (at_rail == 9)


def test_a_rail_is_looked_for_where_channels_are_told_to_be_usable_lost_or_not(guards) -> None:
    odd, nothing = np.zeros((2, N_CHANNELS), dtype=np.bool_), np.zeros((2, N_CHANNELS), dtype=np.bool_)
    odd[0, 100:109] = True
    # Far from what they should read, and no two of them alike; then all of them at the rail.
    apart, at_rail = (np.where(odd, high_v, guards.idle) for high_v in (4.0 + np.arange(N_CHANNELS) / 100, 9.0))
    for told, lost, is_ordinary in ((~odd, nothing, True), (~nothing, odd, False)):
        for _ in range(2):
            guards.views.prepare(told, lost)
        assert guards.views.look(apart, told, lost, guards.idle) is not None
        assert (guards.views.look(at_rail, told, lost, guards.idle) is not None) == is_ordinary


def test_a_channel_that_moves_just_as_far_as_is_explained_does_not_jump(fused_calibration) -> None:
    first = fused_calibration.guards[0]
    # Too low to be compared, so that it may read anything; of little noise, so that its limit is the least there is.
    idle, gripped, noise = (np.array([low, *one[1:]]) for low, one in (
        (0.01, first.idle), (0.01, first.gripped), (1e-4, first.noise)
    ))  # fmt: skip
    guards, usable = Guards((replace(first, idle=idle, gripped=gripped, noise=noise),)), np.ones((1, N_CHANNELS), bool)
    before, frame = idle[None].copy(), idle[None].copy()
    before[0, 0] = 0.0
    for moved_v, share in ((JUMP_V, 0.0), (np.nextafter(JUMP_V, 1.0), 1 / N_CHANNELS)):
        frame[0, 0] = moved_v
        assert guards.jumping_shares(frame, before, usable) == [share]
        assert jumping(guards, frame, usable, before) == [share]


@settings(deadline=None, max_examples=200)
@given(st.sampled_from([*ODD, "shuffled"]), st.sampled_from([0, 1, 9, N_CHANNELS]), st.integers(0, 2**32 - 1))
def test_a_frame_is_placed_as_by_numpy_but_for_rounding(fused_calibration, recorded, kind, n, seed) -> None:
    """Differences to the bit; sums are taken in another order."""
    random = np.random.default_rng(seed)
    frame = spoilt(recorded.channels[random.integers(len(recorded.t_s))], kind, n, random)
    idle = np.array([guard.idle for guard in fused_calibration.guards]) * random.uniform(0.8, 1.2)
    gains = random.uniform(0.5, 2.0, (len(frame), 1))
    memories = [SessionState(fused_calibration.guards, fused_calibration.motion)]
    with BY_NUMPY:
        memories.append(SessionState(fused_calibration.guards, fused_calibration.motion))
    for memory in memories:
        memory._baselines, memory._gains = idle, gains
    usable = np.ones(frame.shape, dtype=np.bool_)
    with np.errstate(all="ignore"):
        one, other = (memory._placed(frame, usable) for memory in memories)
        assert memories[0]._guards.views.place(frame, usable, idle, gains) is not None
        np.testing.assert_array_equal(one.difference, other.difference)
        directions = fused_calibration.motion.directions
        weights = np.array([guard.grip_weights for guard in fused_calibration.guards])
        terms = (
            (one.grips, other.grips, np.abs((frame - idle) / (idle + 0.01) * weights).sum(axis=-1)),
            (one.place, other.place, np.abs((frame / gains)[:, None] * directions).sum(axis=-1).ravel()),
            (one.from_idle, other.from_idle, np.abs(one.difference[:, None] * directions).sum(axis=-1).ravel()),
        )
        for values, expected, sizes in terms:
            sound = np.isfinite(sizes)
            np.testing.assert_array_equal(sound, np.isfinite(values))
            assert (np.abs(np.array(values) - expected) <= 1e-13 * sizes)[sound].all()
    usable[1, 5] = False
    assert memories[0]._guards.views.place(frame, usable, idle, gains) is None


def test_what_is_no_frame_of_these_fingertips_goes_the_long_way(guards) -> None:
    frame, usable, gains = guards.idle, np.ones((2, N_CHANNELS), dtype=np.bool_), np.ones((2, 1))
    assert jumping(guards, frame, usable, frame) == [0.0, 0.0]
    assert guards.views.place(frame, usable, frame, gains) is not None
    for other in (frame.astype(np.float32), frame[:1], frame.repeat(2, axis=1)[:, ::2], frame.astype(np.int64)):
        assert jumping(guards, other, usable, frame) is None
        assert jumping(guards, frame, usable, other) is None
        assert guards.views.place(frame, usable, other, gains) is None
    assert jumping(guards, frame, usable[:1], frame) is None
    assert guards.views.place(frame, usable, frame, gains[:1]) is None
