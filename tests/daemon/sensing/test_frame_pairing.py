from typing import NamedTuple

from hypothesis import given
from hypothesis import strategies as st

from shearloop.daemon.sensing.frame_pairing import _MAX_APART_PERIODS, FramePairing

PERIOD_S, PERIOD_NS = 0.54, 540_000_000


class Frame(NamedTuple):
    t_mid_ns: int
    seq: int


def test_two_boards_of_one_period_make_a_pair_a_period_whatever_their_phase():
    for phase in (0.0, 0.1, 0.5, 0.74, 0.9):
        pairing = FramePairing(("right", "left"), PERIOD_S)
        frames = [("right", Frame(n * PERIOD_NS, n)) for n in range(20)]
        frames += [("left", Frame(round((n + phase) * PERIOD_NS), n)) for n in range(20)]
        pairs = [found for one in sorted(frames, key=lambda one: one[1]) if (found := pairing.add(*one))]
        assert len(pairs) >= 19
        assert all(abs(right.seq - left.seq) <= 1 for right, left in pairs)


def test_a_board_that_is_silent_leaves_the_other_without_a_partner():
    pairing = FramePairing(("right", "left"), PERIOD_S)
    assert pairing.add("left", Frame(0, 0)) is None
    assert [pairing.add("right", Frame(n * PERIOD_NS, n)) for n in range(1, 5)] == [None] * 4
    later = Frame(4 * PERIOD_NS + 1000, 9)
    assert pairing.add("left", later) == (Frame(4 * PERIOD_NS, 4), later)


@given(st.lists(st.tuples(st.sampled_from(["right", "left"]), st.integers(0, 20 * PERIOD_NS)), max_size=40))
def test_every_frame_is_used_once_and_with_one_that_is_near(frames):
    pairing = FramePairing(("right", "left"), PERIOD_S)
    used = []
    for number, (side, t_ns) in enumerate(frames):
        found = pairing.add(side, Frame(t_ns, number))
        if found is not None:
            first, second = found
            assert abs(first.t_mid_ns - second.t_mid_ns) <= _MAX_APART_PERIODS * PERIOD_NS
            used += found
    assert len(used) == len(set(used))
