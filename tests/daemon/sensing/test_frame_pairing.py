"""Which frames of two boards belong together: by their times, whatever arrives first and whatever is lost."""

import random
from collections.abc import Iterable
from typing import NamedTuple

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shearloop.daemon.sensing.frame_pairing import FramePairing

PERIOD_S, PERIOD_NS = 0.54, 540_000_000
SIDES = ("right", "left")
N = 40
OFFSETS = [-0.45, -0.4, -0.2, 0.0, 0.1, 0.4, 0.45]


class Frame(NamedTuple):
    t_mid_ns: int
    seq: int


def frame(number: int, phase: float = 0.0) -> Frame:
    return Frame(round((number + phase) * PERIOD_NS), number)


def by_time(right: Iterable[Frame], left: Iterable[Frame]) -> list[tuple[str, Frame]]:
    frames = [*(("right", one) for one in right), *(("left", one) for one in left)]
    return sorted(frames, key=lambda one: one[1].t_mid_ns)


def paired(frames: Iterable[tuple[str, Frame]]) -> tuple[list[tuple[int, ...]], dict[str, int]]:
    """Return the numbers of the frames of each pair, and how many of each side have no partner."""
    pairing: FramePairing[Frame] = FramePairing(SIDES, PERIOD_S)
    found = [pair for side, one in frames if (pair := pairing.add(side, one)) is not None]
    pairing.end()
    return [tuple(one.seq for one in pair) for pair in found], dict(pairing.unpaired)


@given(
    offset=st.sampled_from(OFFSETS),
    lost_right=st.sets(st.integers(0, N - 1)),
    lost_left=st.sets(st.integers(0, N - 1)),
    jitter=st.randoms(use_true_random=False),
)
def test_each_frame_has_the_nearest_one_and_those_of_lost_ones_have_none(offset, lost_right, lost_left, jitter):
    def taken(phase: float, lost: set[int]) -> list[Frame]:
        return [frame(n, phase + jitter.uniform(-0.02, 0.02)) for n in range(N) if n not in lost]

    pairs, unpaired = paired(by_time(taken(0.0, lost_right), taken(offset, lost_left)))
    both = [n for n in range(N) if n not in lost_right | lost_left]
    assert pairs == [(n, n) for n in both]
    assert unpaired == {"right": len(lost_left - lost_right), "left": len(lost_right - lost_left)}


@given(offset=st.sampled_from(OFFSETS), lost=st.sets(st.integers(0, N - 1)), order=st.randoms(use_true_random=False))
def test_the_pairs_do_not_depend_on_the_order_of_arrival(offset, lost, order):
    right = [frame(n) for n in range(N)]
    left = [frame(n, offset) for n in range(N) if n not in lost]
    in_order = paired(by_time(right, left))
    # Up to four frames of one board are in one read, after those of the other.
    arrivals, waiting = [], {"right": right.copy(), "left": left.copy()}
    while any(waiting.values()):
        ready = [side for side, frames in waiting.items() if frames]
        side = min(ready, key=lambda one: waiting[one][0].t_mid_ns + order.uniform(0, 4 * PERIOD_NS))
        arrivals.append((side, waiting[side].pop(0)))
    assert paired(arrivals) == in_order


@given(st.lists(st.tuples(st.sampled_from(SIDES), st.integers(0, 20 * PERIOD_NS)), max_size=40))
def test_every_frame_is_used_once_and_with_one_that_is_near(frames):
    pairing: FramePairing[Frame] = FramePairing(SIDES, PERIOD_S)
    used: list[Frame] = []
    for number, (side, t_ns) in enumerate(frames):
        found = pairing.add(side, Frame(t_ns, number))
        if found is not None:
            first, second = found
            assert abs(first.t_mid_ns - second.t_mid_ns) <= 0.55 * PERIOD_NS
            used += found
    assert len(used) == len(set(used))
    pairing.end()
    assert len(used) + pairing.unpaired.total() == len(frames)


@pytest.mark.parametrize("offset", OFFSETS)
def test_a_pair_is_complete_as_soon_as_its_second_frame_arrives(offset):
    pairing: FramePairing[Frame] = FramePairing(SIDES, PERIOD_S)
    completed = [one for side, one in by_time(map(frame, range(8)), (frame(n, offset) for n in range(8)))
                 if pairing.add(side, one) is not None]  # fmt: skip
    assert [one.seq for one in completed] == list(range(8))
    assert all(one == max(frame(n), frame(n, offset)) for n, one in enumerate(completed))


def test_boards_half_a_period_apart_keep_their_order():
    noise = random.Random(5)
    left = [frame(n, 0.46 + 0.002 * n + noise.uniform(-0.02, 0.02)) for n in range(N)]
    pairs, unpaired = paired(by_time(map(frame, range(N)), left))
    # The left board drifts past half a period. Once, each side loses a frame.
    assert [right - left for right, left in pairs] == sorted(right - left for right, left in pairs)
    assert {right - left for right, left in pairs} == {0, 1}
    assert unpaired == {"right": 1, "left": 1}


def test_a_board_that_is_silent_leaves_the_other_without_a_partner():
    pairing: FramePairing[Frame] = FramePairing(SIDES, PERIOD_S)
    assert pairing.add("left", frame(0)) is None
    assert [pairing.add("right", frame(n)) for n in range(1, 15)] == [None] * 14
    later = frame(14, 0.01)
    assert pairing.add("left", later) == (frame(14), later)
    assert pairing.unpaired == {"right": 13, "left": 1}


def test_a_board_whose_times_begin_anew_is_paired_again():
    pairing: FramePairing[Frame] = FramePairing(SIDES, PERIOD_S)
    assert pairing.add("left", frame(100)) is None
    assert pairing.add("left", frame(3)) is None
    assert pairing.add("right", frame(3, 0.1)) == (frame(3, 0.1), frame(3))
    assert pairing.unpaired == {"right": 0, "left": 1}
