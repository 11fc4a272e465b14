"""The choice of directions, memory and penalty by twists left out."""

import numpy as np
import pytest

from shearloop.estimation import TRUSTED, fit
from shearloop.estimation.motion_fit import (
    MAX_DIRECTIONS,
    MEMORY_EDGES,
    Layout,
    choose_motion,
    mean_ridge,
    twists_left_out,
)
from shearloop.estimation.ridge import CensoredRidge, Ridge
from tests.estimation.conftest import elastic, follow, judged

LAYOUT = Layout(len(MEMORY_EDGES) - 1, 2, 3)
TWIST = [0.0, 0.0, 0.0, 0.0, 0.0, 0.02, 0.05, 0.04, 0.0, 0.0]


@pytest.mark.parametrize(("n_twists", "n_parts"), [(3, 3), (7, 7), (10, 10), (25, 10)])
def test_each_part_holds_whole_twists_with_frames_on_both_sides(n_twists, n_parts):
    torque_nm = np.tile(TWIST, n_twists)
    parts = twists_left_out(torque_nm)
    assert len(parts) == n_parts
    np.testing.assert_array_equal(np.sort(np.concatenate([part for _, part in parts])), np.arange(len(torque_nm)))
    for rest, part in parts:
        assert not set(rest) & set(part)
        assert torque_nm[part[0]] == torque_nm[part[-1]] == 0.0
        assert np.count_nonzero(torque_nm[part] == 0.05) in (n_twists // n_parts, n_twists // n_parts + 1)


def test_a_single_twist_is_left_out_frame_by_frame():
    parts = twists_left_out(np.array([*np.zeros(20), *TWIST, *np.zeros(20)]))
    assert max(len(part) for _, part in parts) == 2


def played(rng, n_twists, own):
    """Return features, noise but for the first direction of both sides and `own` of the second one, and torques."""
    torque_nm = np.tile(TWIST, n_twists)
    features = rng.normal(0, 0.05, (len(torque_nm), len(LAYOUT.columns(12, 3, position=True))))
    first = LAYOUT.columns(12, 1, position=False)
    features[:, first] += torque_nm[:, None] / 0.05
    features[:, LAYOUT.columns(12, 2, position=False) & ~first] += own * torque_nm[:, None]
    return features, torque_nm


def test_one_direction_is_enough_where_more_say_nothing():
    features, torque_nm = played(np.random.default_rng(0), 8, own=0.0)
    chosen = choose_motion(features, torque_nm, LAYOUT, CensoredRidge.fit, twists_left_out(torque_nm), position=False)
    assert 1 in {one.n_directions for one in chosen.candidates}
    assert chosen.slope == pytest.approx(1.0, abs=0.05)
    predicted = chosen.fit(features, torque_nm).predict(features)
    assert np.abs(np.maximum(predicted, 0.0) - torque_nm).max() < 0.01


def test_a_single_twist_is_fitted_along_one_direction():
    features, torque_nm = played(np.random.default_rng(1), 1, own=40.0)
    features, torque_nm = np.tile(features, (4, 1)), np.concatenate([torque_nm, np.zeros(30)])
    chosen = choose_motion(features, torque_nm, LAYOUT, CensoredRidge.fit, twists_left_out(torque_nm), position=False)
    assert chosen.n_directions == 1


def test_what_shrinks_is_divided_out():
    rng = np.random.default_rng(2)
    features, torque_nm = played(rng, 8, own=0.0)

    def shrinking(rows, values, strength):
        return CensoredRidge.fit(rows, values, strength).scaled(0.9)

    chosen = choose_motion(features, torque_nm, LAYOUT, shrinking, twists_left_out(torque_nm), position=False)
    assert chosen.slope == pytest.approx(0.9, abs=0.03)


def test_a_nested_choice_takes_the_window_whose_directions_follow_the_torque():
    windows = Layout(len(MEMORY_EDGES) - 1, 2, 3 * MAX_DIRECTIONS)
    rng = np.random.default_rng(4)
    torque_nm = np.tile(TWIST, 8)
    features = rng.normal(0, 0.05, (len(torque_nm), len(windows.columns(12, 3, position=True))))
    features[:, windows.columns(12, 1, 2, position=False)] += torque_nm[:, None] / 0.05
    left_out = twists_left_out(torque_nm)
    chosen = choose_motion(features, torque_nm, windows, CensoredRidge.fit, left_out, position=False)
    assert {one.window for one in chosen.candidates} == {2}
    assert chosen.first_direction == 2 * MAX_DIRECTIONS
    predicted = chosen.fit(features, torque_nm).predict(features)
    assert np.abs(np.maximum(predicted, 0.0) - torque_nm).max() < 0.01
    used = features[:, chosen.columns]
    assert used.shape[1] == 2 * chosen.n_directions * chosen.n_steps


def test_a_mean_of_ridges_predicts_the_mean():
    rng = np.random.default_rng(3)
    rows, values = rng.normal(size=(40, 5)), rng.normal(size=40)
    members = [Ridge.fit(rows[part], values[part], 0.1) for part in (slice(0, 20), slice(20, 40))]
    mean = np.mean([one.predict(rows) for one in members], axis=0)
    np.testing.assert_allclose(mean_ridge(members).predict(rows), mean)


@pytest.mark.long
@pytest.mark.parametrize("sides", [("right", "left"), ("right",)])
@pytest.mark.parametrize("rest", [1, 5])
def test_twists_that_alternate_do_not_teach_their_order(rest, sides):
    """The motion over 10 s tells which twist comes next; the gel's position tells the torque."""
    learnt = [elastic(12, 12, rest=rest, turns=(0.5, -0.5, 1.0, -1.0)).select_sides(sides)]
    calibration = fit("motion_regression", learnt, "rig", timing=TRUSTED)
    others = elastic(3, rest=10, turns=(1.0,), seed=3).select_sides(sides)
    found = judged(follow(calibration, others), others)
    assert found.rmse < 0.005
    assert found.coverage > 0.95


def test_a_gel_that_drifts_is_read_by_its_motion(motion_calibration):
    assert not motion_calibration.estimator.temporal.uses_position
