"""What one compiled call says of a frame, against what NumPy says of it in many."""

from dataclasses import replace
from unittest import mock

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bank import compiled
from bank.channels import CHANNELS, N_CHANNELS
from bank.estimators.guard import unsaturated
from bank.estimators.guards import JUMP_V, Guards
from bank.estimators.memory import Memory
from bank.estimators.values import BoolArray, FloatArray, FrameSeries, TactileFrame, everywhere

pytestmark = pytest.mark.skipif(not compiled.IS_COMPILED, reason="nothing is compiled")
# What a channel reads, or all of a side's.
ODD = {
    "nan": np.nan, "infinite": np.inf, "zero": 0.0, "subnormal": 5e-324, "negative": -0.2, "huge": 1e300,
    "tiny": 1e-300, "rail": 3.3,
}  # fmt: skip
BY_NUMPY = mock.patch.object(compiled, "IS_COMPILED", False)


@pytest.fixture(scope="module")
def guards(fused_calibration) -> Guards:
    return Guards(fused_calibration.guards, fused_calibration.motion)


def jumping(guards: Guards, frame: FloatArray, usable: BoolArray, before: FloatArray) -> list[float] | None:
    """Return the shares of channels that jump of a frame that is looked at in a few calls."""
    look = guards.views.look(frame, usable, np.zeros(frame.shape, dtype=np.bool_), before)
    return None if look is None else look.jumping_shares


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
    memories = [Memory(fused_calibration.guards, fused_calibration.motion)]
    with BY_NUMPY:
        memories.append(Memory(fused_calibration.guards, fused_calibration.motion))
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


MASKS = ("none", "some", "electrode", "two electrodes", "one side", "all")


def mask_of(kind: str, m: int, random: np.random.Generator) -> BoolArray:
    """Return which (m, 896) channels are told to be usable, or lost."""
    unusable = np.zeros((m, N_CHANNELS), dtype=np.bool_)
    side = random.integers(m)
    match kind:
        case "some":
            for one in unusable:
                one[random.permutation(N_CHANNELS)[: random.integers(301)]] = True
        case "electrode" | "two electrodes":
            electrodes = random.integers(32, size=1 + (kind != "electrode"))
            # As driven ones they tell nothing at all; as measuring ones two of each injection's channels.
            unusable[side] = np.isin(CHANNELS if random.integers(2) else CHANNELS[:, 2:], electrodes).any(axis=1)
        case "one side":
            unusable[side] = True
        case "all":
            unusable[:] = True
    return ~unusable


@settings(deadline=None, max_examples=300)
@given(
    st.sampled_from(MASKS),
    st.sampled_from(["none", "none", "some", "electrode"]),
    st.sampled_from([*ODD, "shuffled", "clipped"]),
    st.sampled_from([0, 0, 0, 1, 8, 9, 200]),
    st.sampled_from([0.0, 0.003, 0.05]),
    st.floats(0.2, 5.0),
    st.booleans(),
    st.integers(0, 2**32 - 1),
)
def test_a_frame_of_which_not_all_is_usable_is_looked_at_as_by_numpy(
    fused_calibration, recorded, mask, lost_kind, kind, n, noise, gain, steadily, seed
) -> None:
    """Whatever is told, lost, and odd where it is looked at or not, in a frame after one of which the same was lost."""
    random = np.random.default_rng(seed)
    number = random.integers(1, len(recorded.t_s))
    before, channels = gain * recorded.channels[number - 1 : number + 1]
    told, broken = mask_of(mask, 2, random), ~mask_of(lost_kind, 2, random)
    channels = channels * np.where(broken, 0.01, 1.0) * (1 + random.normal(0, noise, before.shape))
    odd = spoilt(channels, kind, n, random)
    if random.integers(2):
        odd = np.where(told, channels, odd)
    frame = TactileFrame.of(1.0, odd, told)
    memories = [Memory(fused_calibration.guards, fused_calibration.motion)]
    with BY_NUMPY, np.errstate(all="ignore"):
        memories.append(Memory(fused_calibration.guards, fused_calibration.motion))
        lost = memories[1]._guards.seen(channels, told)[1]
    baselines, gains = gain * memories[0]._guards.idle, np.full((2, 1), gain)
    for memory in memories:
        memory._before, memory._baselines, memory._gains = before, baselines, gains
        memory._lost = lost if steadily else np.zeros_like(lost)
    views = memories[0]._guards.views
    for _ in range(2):
        views.prepare(frame.usable, lost)
    with np.errstate(all="ignore"):
        look = views.look(frame.channels, frame.usable, memories[0]._lost, before)
        one = memories[0]._looked_at(frame)
        with BY_NUMPY:
            seen, usable, why, shares = memories[1]._looked_at(frame)
        np.testing.assert_array_equal(one[1], usable)
        assert (tuple(filter(None, one[2])), one[3]) == (tuple(filter(None, why)), shares)
        np.testing.assert_array_equal(memories[0]._lost, memories[1]._lost)
        np.testing.assert_array_equal(one[0][usable], seen[usable])
        # Ordinary is what nothing speaks against, with nothing at a rail, and the same lost as before and as prepared.
        found_lost = memories[1]._lost
        as_before = not found_lost.any() or (steadily and np.array_equal(found_lost, lost))
        at_rail = not np.array_equal(unsaturated(frame.channels, frame.usable), frame.usable)
        prepared = np.array_equal(found_lost, lost) or everywhere(frame.usable) or not lost.any()
        assert (look is not None) == (not any(why) and as_before and not at_rail and prepared)
        if any(why):
            return
        np.testing.assert_allclose(one[0], seen, rtol=0, atol=1e-13 * max(1.0, np.abs(seen - before).max()))
        placed = [memories[0]._placed(seen, usable)]
        with BY_NUMPY:
            placed.append(memories[1]._placed(seen, usable))
        np.testing.assert_allclose(placed[0].difference, placed[1].difference, rtol=0, atol=1e-12)
        np.testing.assert_array_equal(placed[0].difference[usable], placed[1].difference[usable])
        for name in ("grips", "place", "from_idle"):
            np.testing.assert_allclose(getattr(placed[0], name), getattr(placed[1], name), rtol=0, atol=1e-9)


FAULTS = (
    "none",
    "dead",
    "one dead",
    "growing",
    "flickering",
    "lost",
    "lost beside dead",
    "blinking",
    "rail",
    "noise",
    "garbled",
    "gap",
)
# How many frames are looked at the long way: the first, those at which masks change, and the one after each.
LONG_LOOKS = {"none": 1, "dead": 3, "one dead": 2, "growing": 9, "lost": 3, "lost beside dead": 7}


def with_fault(fault: str, series: FrameSeries) -> list[TactileFrame]:
    random = np.random.default_rng(1)
    channels, times = series.channels.copy(), series.t_s.copy()
    usable = np.ones(channels.shape, dtype=np.bool_)
    match fault:
        case "dead":
            usable[60:90, :, random.permutation(N_CHANNELS)[:80]] = False
        case "one dead":
            usable[:, 1, 17] = False
        case "growing":
            for n in range(4):
                usable[60 + 20 * n :, n % 2, 3 * n : 30 * n + 5] = False
        case "flickering":
            usable[60::2, :, 200:210] = False
        case "lost":
            channels[60:120, :, 100:160] *= 0.01
        case "lost beside dead":
            usable[40:, :, 300:310] = False
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
    assert looked_long.call_count == LONG_LOOKS.get(fault, looked_long.call_count)


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


@pytest.fixture
def parts() -> dict[str, np.ndarray]:
    """What two fingertips with one direction are made of, in order."""
    rows, mask = np.ones((2, N_CHANNELS)), np.ones((2, N_CHANNELS), dtype=np.bool_)
    moves = np.zeros((2, 3, N_CHANNELS))
    return {
        "known": np.ones((2, 2, N_CHANNELS)), "jumps_v": rows, "weights": rows, "directions": rows[:, None],
        "reads": moves, "shapes": moves, "counts": np.full(4, N_CHANNELS), "told": mask, "lost": ~mask,
    }  # fmt: skip


LIMITS = (9, 224, 0.12, 0.6, 0.01)


def test_fingertips_that_do_not_fit_together_are_refused(parts) -> None:
    made = compiled.frames.Fingertips(2, 1, 3, tuple(parts.values()), *LIMITS)
    with pytest.raises(TypeError, match="made once"):
        made.__init__(2, 1, 3, tuple(parts.values()), *LIMITS)
    for name, one in parts.items():
        other = {"counts": np.int32, "told": np.uint8, "lost": np.int8}.get(name, np.float32)
        for wrong in (
            one[:1],
            one.repeat(2, axis=-1)[..., ::2],
            one.astype(other),
            one.astype(one.dtype.newbyteorder()),
        ):
            if wrong.dtype == one.dtype and wrong.shape == one.shape and wrong.flags.c_contiguous:
                # A byte has no order.
                continue
            with pytest.raises(ValueError, match="does not fit together, or is of another kind"):
                compiled.frames.Fingertips(2, 1, 3, tuple((parts | {name: wrong}).values()), *LIMITS)
    for arrays in ((), tuple(parts.values())[:-1], (*parts.values(), parts["lost"])):
        with pytest.raises(TypeError, match=f"{len(arrays)} arguments instead of 9"):
            compiled.frames.Fingertips(2, 1, 3, arrays, *LIMITS)
    for m, p, q in ((0, 1, 3), (-1, 1, 3), (2, -1, 3), (2**40, 1, 3), (2, 2**60, 3), (2, 1, -1), (2, 1, 2**60)):
        with pytest.raises(ValueError, match="fingertips with"):
            compiled.frames.Fingertips(m, p, q, tuple(parts.values()), *LIMITS)
    empty = compiled.frames.Fingertips.__new__(compiled.frames.Fingertips)
    for call in (empty.check, empty.fill_in, empty.placed):
        with pytest.raises(ValueError, match="no fingertips"):
            call(*[parts["weights"]] * 4)


def test_fingertips_whose_arguments_make_them_stay_as_they_were_made(parts) -> None:
    """A number that makes them while it is read for another making: what was made is kept, and its size with it."""
    made = compiled.frames.Fingertips.__new__(compiled.frames.Fingertips)
    arrays = tuple(parts.values())

    class Meddling:
        def __index__(self) -> int:
            made.__init__(2, 1, 3, arrays, *LIMITS)
            return 1000

    with pytest.raises(TypeError, match="made once"):
        made.__init__(2, Meddling(), 3, arrays, *LIMITS)
    frame = np.random.default_rng(0).uniform(0.95, 1.05, (2, N_CHANNELS))
    assert made.check(frame, parts["told"], parts["lost"], frame) == [0, 0]
    with pytest.raises(TypeError, match="2 arguments instead of 4"):
        made.check(frame, parts["told"])
    with pytest.raises(ValueError, match=r"are \(m, 896\) float64 values"):
        made.fill_in(frame[:1], frame)
