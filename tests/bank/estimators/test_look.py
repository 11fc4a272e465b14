"""What one compiled call says of a frame, against what NumPy says of it in many."""

from dataclasses import replace
from unittest import mock

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bank import compiled
from bank.channels import N_CHANNELS
from bank.estimators.guard import unsaturated
from bank.estimators.guards import JUMP_V, Guards
from bank.estimators.memory import Memory
from bank.estimators.values import FloatArray, FrameSeries, TactileFrame, everywhere

pytestmark = pytest.mark.skipif(not compiled.IS_COMPILED, reason="nothing is compiled")
# What a channel reads, or all of a side's.
ODD = {
    "nan": np.nan, "infinite": np.inf, "zero": 0.0, "subnormal": 5e-324, "negative": -0.2, "huge": 1e300,
    "tiny": 1e-300, "rail": 3.3,
}  # fmt: skip
BY_NUMPY = mock.patch.object(compiled, "IS_COMPILED", False)


@pytest.fixture(scope="module")
def guards(fused_calibration) -> Guards:
    return Guards(fused_calibration.guards, fused_calibration.motion.directions)


def spoilt(frame: FloatArray, kind: str, n: int, random: np.random.Generator) -> FloatArray:
    """Return a frame with n of the channels of one of its sides odd."""
    frame, odd = frame.copy(), random.permutation(N_CHANNELS)[:n]
    side = random.integers(len(frame))
    match kind:
        case "shuffled":
            frame[side, odd] = frame[side, np.roll(odd, 1)]
        case "clipped":
            frame[side] = np.minimum(frame[side], np.sort(frame[side])[-max(n, 1)])
        case _:
            frame[side, odd] = ODD[kind]
    return frame


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
    found = guards.jumping_if_ordinary(frame, usable, before)
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
        assert guards.jumping_if_ordinary(frame, usable, before) is None
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
        assert (guards.jumping_if_ordinary(frame, usable, frame) is None) == (n_near < 449)


def test_a_frame_like_either_of_the_two_is_known_and_lost_is_what_is_off_from_both(fused_calibration) -> None:
    usable, first = np.ones((1, N_CHANNELS), dtype=np.bool_), fused_calibration.guards[0]
    others = Guards((replace(first, gripped=first.idle[::-1].copy()),))
    for frame in (others.idle, others.gripped):
        assert others.jumping_if_ordinary(frame, usable, frame) == [0.0]
    gripped = first.idle.copy()
    gripped[7] *= 3.0
    guards, lost = Guards((replace(first, gripped=gripped),)), 0.3 * first.idle[None]
    assert guards.jumping_if_ordinary(guards.idle, usable, guards.idle) == [0.0]
    assert guards.jumping_if_ordinary(guards.gripped, usable, guards.idle) == [1 / N_CHANNELS]
    frame = np.where(np.arange(N_CHANNELS) == 7, lost, guards.idle)
    assert guards.jumping_if_ordinary(frame, usable, frame) is None


@pytest.mark.parametrize("at_rail", [8, 9])
def test_a_frame_at_a_rail_is_not_ordinary(guards, recorded, at_rail) -> None:
    frame = spoilt(recorded.channels[50], "clipped", at_rail, np.random.default_rng(0))
    found = guards.jumping_if_ordinary(frame, np.ones(frame.shape, dtype=np.bool_), frame)
    assert (found is None) == (at_rail == 9)


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
        assert guards.jumping_if_ordinary(frame, usable, before) == [share]


@settings(deadline=None, max_examples=200)
@given(st.sampled_from([*ODD, "shuffled"]), st.sampled_from([0, 1, 9, N_CHANNELS]), st.integers(0, 2**32 - 1))
def test_a_frame_is_placed_as_by_numpy_but_for_rounding(fused_calibration, recorded, kind, n, seed) -> None:
    """Differences to the bit; sums are taken in another order."""
    random = np.random.default_rng(seed)
    frame = spoilt(recorded.channels[random.integers(len(recorded.t_s))], kind, n, random)
    idle = np.array([guard.idle for guard in fused_calibration.guards]) * random.uniform(0.8, 1.2)
    gains = random.uniform(0.5, 2.0, (len(frame), 1))
    memories = [Memory(fused_calibration.guards, fused_calibration.motion)]
    with BY_NUMPY:
        memories.append(Memory(fused_calibration.guards, fused_calibration.motion))
    for memory in memories:
        memory._baselines, memory._gains = idle, gains
    usable = np.ones(frame.shape, dtype=np.bool_)
    with np.errstate(all="ignore"):
        one, other = (memory._placed(frame, usable) for memory in memories)
        assert memories[0]._guards.place(frame, usable, idle, gains) is not None
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
    assert memories[0]._guards.place(frame, usable, idle, gains) is None


FAULTS = ("none", "dead", "lost", "blinking", "rail", "noise", "garbled", "gap")


def with_fault(fault: str, series: FrameSeries) -> list[TactileFrame]:
    random = np.random.default_rng(1)
    channels, times = series.channels.copy(), series.t_s.copy()
    usable = np.ones(channels.shape, dtype=np.bool_)
    match fault:
        case "dead":
            usable[60:90, :, random.permutation(N_CHANNELS)[:80]] = False
        case "lost":
            channels[60:120, :, 100:160] *= 0.01
        case "blinking":
            channels[60:120:5, :, 100:260] *= 0.01
        case "rail":
            channels[60:120] = np.minimum(channels[60:120], np.quantile(channels, 0.97))
        case "noise":
            channels += random.normal(0, 0.002, channels.shape)
        case "garbled":
            channels[::17] = channels[::17][..., random.permutation(N_CHANNELS)]
        case "gap":
            times[80:] += 30.0
    return [TactileFrame.of(float(t), *each) for t, *each in zip(times, channels, usable, strict=True)]


@pytest.mark.parametrize("with_motion", [True, False])
@pytest.mark.parametrize("fault", FAULTS)
def test_a_session_is_the_same_as_by_numpy_but_for_rounding(fused_calibration, twisting, fault, with_motion) -> None:
    motion = replace(fused_calibration.motion, placed=True) if with_motion else None
    memory = Memory(fused_calibration.guards, motion, period_s=0.54)
    with BY_NUMPY:
        other = Memory(fused_calibration.guards, motion, period_s=0.54)
    n_valid, first, told = 0, None, None
    with mock.patch.object(memory._guards, "seen", wraps=memory._guards.seen) as looked_long:
        for frame in with_fault(fault, twisting(seed=7)):
            moment = memory.see(frame)
            with BY_NUMPY:
                expected = other.see(frame)
            assert moment.why == expected.why
            np.testing.assert_array_equal(moment.usable, expected.usable)
            np.testing.assert_allclose(moment.channels, expected.channels, rtol=0, atol=1e-12)
            np.testing.assert_allclose(moment.difference, expected.difference, rtol=0, atol=1e-12)
            if not moment.why:
                n_valid += 1
                first, told = (moment, expected) if n_valid == 1 else (first, told)
                np.testing.assert_allclose(memory.held, other.held, rtol=0, atol=1e-12)
                assert (memory.moved is not None) == with_motion
                if memory.moved is not None:
                    np.testing.assert_allclose(memory.moved, other.moved, rtol=0, atol=1e-9)
                    from_idle = motion.places(moment.difference)
                    np.testing.assert_allclose(memory.moved[-len(from_idle) :], from_idle, rtol=0, atol=1e-9)
    assert n_valid > 100
    np.testing.assert_allclose(
        first.difference, told.difference, rtol=0, atol=1e-12, err_msg="moments stay as they were"
    )
    assert not np.array_equal(first.difference, memory.held)
    if fault == "none":
        assert looked_long.call_count == 1, "only the first frame has none before it"


def test_what_is_no_frame_of_these_fingertips_goes_the_long_way(guards) -> None:
    frame, usable, gains = guards.idle, np.ones((2, N_CHANNELS), dtype=np.bool_), np.ones((2, 1))
    assert guards.jumping_if_ordinary(frame, usable, frame) == [0.0, 0.0]
    assert guards.place(frame, usable, frame, gains) is not None
    for other in (frame.astype(np.float32), frame[:1], frame.repeat(2, axis=1)[:, ::2], frame.astype(np.int64)):
        assert guards.jumping_if_ordinary(other, usable, frame) is None
        assert guards.jumping_if_ordinary(frame, usable, other) is None
        assert guards.place(frame, usable, other, gains) is None
    assert guards.jumping_if_ordinary(frame, usable[:1], frame) is None
    assert guards.place(frame, usable, frame, gains[:1]) is None


def test_fingertips_that_do_not_fit_together_are_refused() -> None:
    rows, limits = np.ones((2, N_CHANNELS)), (9, 224, 0.12, 0.6, 0.01)
    known, counts = np.ones((2, 2, N_CHANNELS)), np.full(4, N_CHANNELS)
    made = compiled._frames.Fingertips(2, 1, known, rows, rows, rows[:, None], counts, *limits)
    with pytest.raises(TypeError, match="made once"):
        made.__init__(2, 1, known, rows, rows, rows[:, None], counts, *limits)
    whole = (known, rows, rows, rows[:, None], counts)
    for i, one in enumerate(whole):
        arrays = [*whole[:i], one[:1], *whole[i + 1 :]]
        with pytest.raises(ValueError, match="does not fit together"):
            compiled._frames.Fingertips(2, 1, *arrays, *limits)
    for m, p in ((0, 1), (-1, 1), (2, -1), (2**40, 1), (2, 2**60)):
        with pytest.raises(ValueError, match="fingertips with"):
            compiled._frames.Fingertips(m, p, *whole, *limits)
    empty = compiled._frames.Fingertips.__new__(compiled._frames.Fingertips)
    with pytest.raises(ValueError, match="no fingertips"):
        empty.check(rows, rows, rows)


def test_fingertips_whose_arguments_make_them_stay_as_they_were_made() -> None:
    """A number that makes them while it is read for another making: what was made is kept, and its size with it."""
    rows, limits = np.ones((2, N_CHANNELS)), (9, 224, 0.12, 0.6, 0.01)
    arrays = np.ones((2, 2, N_CHANNELS)), rows, rows, rows[:, None], np.full(4, N_CHANNELS)
    made = compiled._frames.Fingertips.__new__(compiled._frames.Fingertips)

    class Meddling:
        def __index__(self) -> int:
            made.__init__(2, 1, *arrays, *limits)
            return 1000

    usable = np.ones((2, N_CHANNELS), dtype=np.bool_)
    with pytest.raises(TypeError, match="made once"):
        made.__init__(2, Meddling(), *arrays, *limits)
    frame = np.random.default_rng(0).uniform(0.95, 1.05, (2, N_CHANNELS))
    assert made.check(frame, usable, frame) == [0, 0]
