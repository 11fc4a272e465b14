from hypothesis import given
from hypothesis import strategies as st

from shearloop.daemon.sensing.fingertip_task import _MAX_APART_PERIODS, FramePairing

PERIOD_NS = 540_000_000


def test_two_boards_of_one_period_make_a_pair_a_period_whatever_their_phase():
    for phase in (0.0, 0.1, 0.5, 0.74, 0.9):
        pairing: FramePairing[int] = FramePairing(("right", "left"), PERIOD_NS)
        frames = [("right", n * PERIOD_NS, n) for n in range(20)]
        frames += [("left", round((n + phase) * PERIOD_NS), n) for n in range(20)]
        pairs = [
            found for side, t_ns, n in sorted(frames, key=lambda one: one[1]) if (found := pairing.add(side, t_ns, n))
        ]
        assert len(pairs) >= 19
        assert all(abs(right - left) <= 1 for right, left in pairs)


def test_a_board_that_is_silent_leaves_the_other_without_a_partner():
    pairing: FramePairing[int] = FramePairing(("right", "left"), PERIOD_NS)
    assert pairing.add("left", 0, 0) is None
    assert [pairing.add("right", n * PERIOD_NS, n) for n in range(1, 5)] == [None] * 4
    assert pairing.add("left", 4 * PERIOD_NS + 1000, 9) == (4, 9)


@given(st.lists(st.tuples(st.sampled_from(["right", "left"]), st.integers(0, 20 * PERIOD_NS)), max_size=40))
def test_every_frame_is_used_once_and_with_one_that_is_near(frames):
    pairing: FramePairing[tuple[int, int]] = FramePairing(("right", "left"), PERIOD_NS)
    used = []
    for number, (side, t_ns) in enumerate(frames):
        found = pairing.add(side, t_ns, (number, t_ns))
        if found is not None:
            (first, first_ns), (second, second_ns) = found
            assert abs(first_ns - second_ns) <= _MAX_APART_PERIODS * PERIOD_NS
            used += [first, second]
    assert len(used) == len(set(used))
