"""Recordings of the same frames are not two measurements; frames of two fingertips are paired as in the daemon."""

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from shearloop.bank.channels import PAPER_TABLE
from shearloop.daemon.sensing.frame_pairing import FramePairing
from shearloop.errors import UserError
from shearloop.tools.frame_series import check_no_copies, read_series, series_of
from shearloop.tools.recordings.frames import Recording, SideFrames
from tests.estimation.conftest import kept, twisting


def test_a_copy_that_lacks_frames_is_a_copy():
    whole = twisting(cycles=1)
    lost = np.ones(len(whole.t_s), dtype=np.bool_)
    lost[[3, 60]] = False
    n = len(whole.t_s)
    for named, said in (
        ([("a", whole), ("b", kept(whole, lost))], f"{n - 2} of {n - 2} frames of b are in a too; give one of the two"),
        ([("b", kept(whole, lost)), ("a", whole)], f"{n - 2} of {n} frames of a are in b too; give one of the two"),
        ([("a", whole), ("b", whole)], f"{n} of {n} frames of b are in a too"),
    ):
        with pytest.raises(UserError, match=said):
            check_no_copies(named)


def test_a_side_may_be_given_alone(imported):
    (alone,), (listed,) = read_series(imported, "right"), read_series(imported, ["right"])
    assert alone.sides == listed.sides == ("right",)
    assert replace(alone, sides="right").sides == ("right",)
    (both,) = read_series(imported)
    assert both.select_sides("left").sides == ("left",)
    with pytest.raises(UserError, match="has frames of right and left, not of middle"):
        read_series(imported, "middle")


def test_parts_and_common_idle_frames_are_no_copies():
    whole = twisting(cycles=1)
    n = len(whole.t_s)
    check_no_copies([("a", whole.between(0, 80)), ("b", whole.between(80, n)), ("c", twisting(cycles=1, seed=2))])
    check_no_copies([("a", whole.between(0, 80)), ("b", whole.between(50, n))])


PERIOD_NS = 540_000_000


class Frame(NamedTuple):
    t_mid_ns: int
    seq: int


def frames_at(numbers: list[int], phase: float) -> list[Frame]:
    return [Frame(round((number + phase) * PERIOD_NS), number) for number in numbers]


def recording_of(**sides: list[Frame]) -> Recording:
    """Return a recording whose frames hold their number in every channel."""
    found = {
        side: SideFrames(
            np.array([one.t_mid_ns for one in frames]),
            np.array([np.full(PAPER_TABLE.n_line_values, one.seq, dtype=np.float64) for one in frames]),
            np.zeros(len(frames), dtype=np.bool_),
        )
        for side, frames in sides.items()
    }
    return Recording(Path("a.mcap"), "", {}, found, np.zeros(0, np.int64), np.zeros(0))


@pytest.mark.parametrize("phase", [-0.45, -0.4, 0.0, 0.4, 0.45])
@pytest.mark.parametrize("lost", [{"left": 4}, {"right": 4}, {"right": 3, "left": 4}])
def test_a_fit_has_the_pairs_of_the_daemon(phase, lost):
    numbers = {side: [n for n in range(12) if n != lost.get(side)] for side in ("right", "left")}
    sides = {"right": frames_at(numbers["right"], 0.0), "left": frames_at(numbers["left"], phase)}
    pairing: FramePairing[Frame] = FramePairing(("right", "left"), PERIOD_NS / 1e9)
    # The daemon takes frames as they arrive: here all of a read of the left board before those of the right one.
    live = [
        (right.seq, left.seq)
        for first in range(0, 12, 3)
        for side in ("left", "right")
        for one in sides[side]
        if first <= one.seq < first + 3 and (pair := pairing.add(side, one)) is not None
        for right, left in [pair]
    ]
    series = series_of(recording_of(**sides))
    assert [tuple(map(round, pair)) for pair in series.channels[:, :, 0].tolist()] == live
    assert live == [(n, n) for n in range(12) if n not in lost.values()]
    np.testing.assert_allclose(series.t_s, PERIOD_NS / 1e9 * (np.array(live)[:, 0] + phase / 2), atol=1e-6)


def test_frames_without_a_partner_are_named():
    sides = {"right": frames_at([0, 1, 2, 3, 5], 0.0), "left": frames_at([1, 2, 3, 4, 5, 6], -0.4)}
    assert series_of(recording_of(**sides)).left_out == (
        "1 frame of the right side, without one of the others at that time",
        "2 frames of the left side, without one of the others at that time",
    )
    assert series_of(recording_of(**sides), ("left",)).left_out == ()


def test_the_period_of_a_recorded_daemon_counts_and_not_that_of_boards_that_lose_frames():
    sides = {"right": frames_at([0, 2, 4, 6], 0.0), "left": frames_at([1, 3, 5, 7], -0.2)}
    recording = recording_of(**sides)
    recording = replace(recording, periods_s={"right": PERIOD_NS / 1e9})
    assert len(series_of(recording).t_s) == 0
    assert series_of(recording, ("left",)).period_s == np.inf
    assert series_of(recording, ("right",)).period_s == PERIOD_NS / 1e9
