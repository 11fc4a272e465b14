"""What compiled calls say of a frame of which not all is usable, against what NumPy says of it in many."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shearloop.bank.eit import compiled
from shearloop.bank.eit.channels import CHANNELS, N_CHANNELS
from shearloop.bank.estimation.fingertip_validator import unsaturated
from shearloop.bank.estimation.session_state import SessionState
from shearloop.bank.estimation.values import BoolArray, TactileFrame, everywhere
from tests.bank.estimators.odd_frames import BY_NUMPY, ODD, spoilt

pytestmark = pytest.mark.skipif(not compiled.IS_COMPILED, reason="nothing is compiled")

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
    memories = [SessionState(fused_calibration.guards, fused_calibration.motion)]
    with BY_NUMPY, np.errstate(all="ignore"):
        memories.append(SessionState(fused_calibration.guards, fused_calibration.motion))
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
