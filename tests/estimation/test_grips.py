"""Recordings of several grips: each is found, and all of them are fitted."""

from dataclasses import replace

import numpy as np
import pytest

from shearloop.bank.errors import CalibrationError
from shearloop.estimation import FrameSeries, fit
from shearloop.estimation.grips import find_grips, segment_grip
from tests.estimation.conftest import IDLE_S, PERIOD_S, elastic, follow, tip, twisting


def after(first: FrameSeries, second: FrameSeries) -> FrameSeries:
    """Return two recordings as one."""
    later_s = first.t_s[-1] + PERIOD_S
    return FrameSeries(
        first.sides,
        np.concatenate([first.t_s, later_s + second.t_s]),
        np.concatenate([first.channels, second.channels]),
        np.concatenate([first.torque_t_s, later_s + second.torque_t_s[second.torque_t_s >= 0.0]]),
        np.concatenate([first.torque_nm, second.torque_nm[second.torque_t_s >= 0.0]]),
        np.concatenate([first.diameter_mm, second.diameter_mm]),
    )


def truly_gripped(series: FrameSeries) -> list[tuple[int, int]]:
    """Return the begin and end of each grip by the two fingertips' known frames."""
    first = tip(1)
    way = (series.channels[:, 0] - first.idle) @ first.grip / (first.grip @ first.grip)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], way > 0.5, [False]]).astype(int)))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


TWO_GRIPS = {
    "a twist begins as the grip closes": lambda: elastic(6, 6, rest=0),
    "rests between the twists": lambda: elastic(6, 6),
    "three grips": lambda: elastic(4, 6, 5),
    "a short pause": lambda: elastic(6, 6, idle=12),
    "a lever with a gel that creeps": lambda: after(twisting(), twisting(seed=1)),
}


@pytest.mark.long
@pytest.mark.parametrize("recorded", TWO_GRIPS.values(), ids=TWO_GRIPS)
def test_every_grip_of_a_recording_is_found_and_fitted(recorded):
    series = recorded()
    grips, truth = find_grips(series), truly_gripped(series)
    assert len(grips) == len(truth)
    for grip, (begin, end) in zip(grips, truth, strict=True):
        assert begin - 5 <= grip.idle.stop <= begin
        assert begin <= grip.gripped.start <= begin + 4
        assert end - 4 <= grip.gripped.stop <= end
        assert end <= grip.released.start
    whole = segment_grip(series)
    assert (whole.idle, whole.released) == (grips[0].idle, grips[-1].released)
    assert (whole.gripped.start, whole.gripped.stop) == (grips[0].gripped.start, grips[-1].gripped.stop)
    calibration = fit("motion_regression", [series], "rig")
    valid = np.array([one.valid for one in follow(calibration, series)])
    assert all(valid[grip.gripped].any() for grip in grips)
    assert not any(valid[grip.idle].any() or valid[grip.released].any() for grip in grips)


def test_a_recording_of_two_grips_joins_one_of_one():
    calibration = fit("motion_regression", [elastic(6, rest=5), elastic(6, 6, rest=0, seed=1)], "rig")
    assert calibration.torque is not None


@pytest.mark.parametrize(("frames", "found"), [(3, 1), (6, 2)])
def test_a_recording_may_end_as_a_grip_begins(frames, found):
    """A grip of a few frames is too short to be fitted, and does not keep the others from it."""
    series = elastic(6, 6, rest=0)
    begun = series.between(0, truly_gripped(series)[1][0] + frames)
    assert len(find_grips(begun)) == found
    assert fit("motion_regression", [begun], "rig").torque is not None


@pytest.mark.parametrize(
    "gripped",
    [
        elastic(6, rest=12, begins_gripped=True),
        twisting().between(int(IDLE_S / PERIOD_S) + 20, 10**6),
        twisting().between(int(IDLE_S / PERIOD_S) + 30, 10**6),
    ],
    ids=["elastic", "creeping", "creeping, from a twist"],
)
def test_rests_between_twists_are_no_release_where_a_recording_begins_gripped(gripped):
    assert [(one.idle.start, one.idle.stop) for one in find_grips(gripped)] == [(0, 0)]


def test_a_recording_without_idle_frames_is_named():
    with pytest.raises(CalibrationError, match="recording 2 of 2: 0 idle and"):
        fit("motion_regression", [elastic(6), elastic(6, begins_gripped=True)], "rig")


def test_a_load_cell_whose_zero_is_off_is_named_instead_of_missing_idle_frames():
    recorded = elastic(6)
    off = replace(recorded, torque_nm=recorded.torque_nm + 2.0 * np.abs(recorded.torque_nm).max())
    with pytest.raises(CalibrationError, match=r"the load cell shows \+\d.* N·m from the first frame on"):
        fit("motion_regression", [off], "rig")
    flat = replace(recorded, torque_nm=np.full_like(recorded.torque_nm, 1e-4))
    with pytest.raises(CalibrationError) as told:
        fit("motion_regression", [flat], "rig")
    assert "from the first frame on" not in str(told.value), "its zero is right, and nothing was twisted"
