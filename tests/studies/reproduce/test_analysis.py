from itertools import combinations

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from shearloop.bank.bank_file import BankDefinition
from shearloop.bank.build import RowSolver
from shearloop.bank.channels import smoothed_along_channels
from shearloop.bank.matching import ReferenceMatcher, best_match
from shearloop.bank.mesh import load_mesh
from shearloop.studies.reproduce.analysis import (
    TorqueResult,
    analyse_diameter,
    analyse_torque,
    correlation,
    group_means,
    kmeans_groups,
    match_slices,
    place_in_series,
    score_models,
)
from shearloop.studies.reproduce.report import Reproduction, table
from shearloop.tools.banks import Grid, cached_bank
from shearloop.tools.recordings.matlab_import import Slices, read_torque_slices
from tests.studies.reproduce.conftest import SIGMA, K


@pytest.fixture(scope="module")
def bank(coarse_mesh, tmp_path_factory):
    return cached_bank("small", Grid(K, SIGMA), coarse_mesh, tmp_path_factory.mktemp("banks"))


def slices_of(signals: NDArray, torque: list[float], diameter_mm: list[float] | None = None) -> Slices:
    differences = np.abs(signals).astype(float)
    return Slices(
        differences, np.array(torque), np.arange(len(torque)), np.array(diameter_mm or [np.nan] * len(torque))
    )


def analysed(signals: NDArray, bank, columns: list[int], torque: list[float]) -> TorqueResult:
    slices = slices_of(signals[3, columns], torque)
    matches = match_slices(slices.differences, bank, lambda _: None)
    return analyse_torque(slices, matches, matches)


def test_torque_is_related_to_the_sigma_of_the_best_match(signals, bank):
    columns = [6, 5, 3, 1, 7, 6, 4, 2, 0, 7, 6, 4, 1, 1]  # three series, the first without its lowest level
    torque = [0.02, 0.04, 0.06, 0.08, 0.01, 0.021, 0.041, 0.061, 0.081, 0.011, 0.019, 0.039, 0.061, 0.079]
    found = analysed(signals, bank, columns, torque)
    sigma = bank.sigma_grid[columns]
    assert found.focused.sigma.tolist() == sigma.tolist()
    assert found.r_focused == found.r_wide == pytest.approx(np.corrcoef(sigma, torque)[0, 1], abs=1e-12)
    assert found.groups.tolist() == [1, 2, 3, 4, 0, 1, 2, 3, 4, 0, 1, 2, 3, 4]
    means = group_means(sigma, found.groups), group_means(np.array(torque), found.groups)
    assert found.r_clustered == pytest.approx(np.corrcoef(*means)[0, 1], abs=1e-12)
    # Leaving out each series in turn, by numpy's own fit.
    parts = np.array([0] * 4 + [1] * 5 + [2] * 5)
    errors = [
        np.polyval(np.polyfit(sigma[parts != part], np.array(torque)[parts != part], 2), sigma[parts == part])
        - np.array(torque)[parts == part]
        for part in range(3)
    ]
    assert found.rmse_nm == pytest.approx(np.sqrt(np.mean(np.concatenate(errors) ** 2)), rel=1e-9)
    assert found.grouping == "by place in 3 repeated series"


def test_slices_that_are_no_repeats_are_grouped_by_torque(signals, bank):
    columns = [4, 1, 7, 2, 5, 0, 3, 6, 6, 1]
    torque = [0.03, 0.06, 0.0, 0.05, 0.02, 0.07, 0.04, 0.01, 0.011, 0.061]
    found = analysed(signals, bank, columns, torque)
    assert found.grouping == "by k-means of the torques into 3 (no repeated series found)"
    assert found.held_out == "one of 5 stretches of time left out at a time"
    assert found.r_clustered < -0.95
    assert found.rmse_nm < 0.005


def test_what_the_slices_do_not_determine_is_none_and_said(signals, bank, coarse_mesh):
    found = analysed(signals, bank, [4, 4, 4], [0.01, 0.02, 0.03])
    assert (found.r_focused, found.r_clustered, found.fit, found.rmse_nm) == (None, None, None, None)
    told = table(Reproduction(coarse_mesh, "here", {"wide": bank}, found, None, None, (), None, ()))
    assert told.count(" none\n") == 4
    assert "none: slices are too few, or their matches too alike, for this number" in told


def test_diameter_is_related_to_the_k_of_the_best_match(signals, bank):
    rows = [5, 5, 4, 2, 1]
    slices = slices_of(signals[rows, 4], [0.0] * 5, [10.0, 10.0, 20.0, 30.0, 30.0])
    smooth = smoothed_along_channels(slices.differences)
    found = analyse_diameter(slices, match_slices(smooth, bank, lambda _: None), bank)
    expected = [best_match(heatmap, bank.k_grid, bank.sigma_grid).k for heatmap in found.single.heatmaps]
    assert found.single.k.tolist() == expected
    np.testing.assert_allclose(found.single.heatmaps, ReferenceMatcher.from_bank(bank).heatmaps(smooth), atol=1e-14)
    np.testing.assert_allclose(found.accumulated.heatmaps[2], found.single.heatmaps[3:].mean(axis=0), atol=1e-14)
    assert max(found.r_single, found.r_accumulated) < -0.9
    sums = [
        found.single.heatmaps[:1],
        found.single.heatmaps[:2],
        *([heatmap] for heatmap in found.single.heatmaps[2:4]),
    ]
    sums.append(found.single.heatmaps[3:])
    running = [best_match(np.sum(one, axis=0), bank.k_grid, bank.sigma_grid).k for one in sums]
    assert found.running_k.tolist() == running
    assert found.r_running_sum == pytest.approx(np.corrcoef(running, slices.diameter_mm)[0, 1], abs=1e-12)


def test_two_diameters_make_no_correlation(signals, bank):
    slices = slices_of(signals[[5, 1], 4], [0.0] * 2, [10.0, 30.0])
    found = analyse_diameter(slices, match_slices(slices.differences, bank, lambda _: None), bank)
    assert (found.r_single, found.r_accumulated, found.fit) == (None, None, None)


def test_a_correlation_needs_three_points_that_differ():
    assert correlation(np.arange(3.0), -np.arange(3.0)) == pytest.approx(-1.0)
    assert correlation(np.arange(2.0), np.arange(2.0)) is None
    assert correlation(np.ones(5), np.arange(5.0)) is None


def test_without_a_raw_frame_models_are_scored_by_the_matching(signals, coarse_mesh):
    slices = slices_of(signals[3, [4, 5]], [0.01, 0.02])
    scores = score_models(slices, None, coarse_mesh)
    assert scores.envelope is None
    assert scores.chosen is scores.matching
    assert max(scores.matching, key=lambda name: scores.matching[name] or 0) == "gaussian_derivative"
    assert scores.n_slices["gaussian_derivative"] == sum(scores.n_slices.values()) == 2
    assert sum(scores.n_envelopes.values()) == 0
    silent = score_models(slices, np.zeros(896), coarse_mesh)
    assert set(silent.chosen.values()) == {None}


def test_sigma_falls_with_torque_on_the_shared_slices(shared):
    mesh = load_mesh(shared / "reference" / "fingertip_mesh.npz")
    slices = read_torque_slices(shared / "recordings" / "torque_slices")
    k, sigma = np.linspace(3.1, 3.4, 6), np.linspace(1.2, 1.9, 15)
    solver = RowSolver(mesh, BankDefinition(mesh.digest, "gaussian_derivative", k, sigma))
    rows = [solver.solve(row) for row in range(len(k))]
    matcher = ReferenceMatcher(np.stack([row.signals for row in rows]), np.stack([row.valid for row in rows]), k, sigma)
    best = [best_match(heatmap, k, sigma).sigma for heatmap in matcher.heatmaps(slices.differences)]
    # On the full focused grid of 100 × 100 it is −0.67487; on these 6 × 15 cells it was measured as −0.69073.
    assert correlation(np.array(best), slices.torque_nm) == pytest.approx(-0.69073, abs=0.002)


LEVELS = np.array([0.01, 0.03, 0.05, 0.06, 0.07, 0.08, 0.10, 0.11])


@given(
    repeats=st.integers(2, 9),
    lacking=st.dictionaries(st.integers(0, 8), st.integers(0, 7), max_size=4),
    seed=st.integers(0, 2**32 - 1),
)
def test_series_are_found_though_some_lack_a_level(repeats, lacking, seed):
    # One repeat is complete; the others may lack any one level but the outermost together.
    lacking = {repeat: level for repeat, level in lacking.items() if 0 < repeat < repeats}
    places = [(repeat, level) for repeat in range(repeats) for level in range(8) if lacking.get(repeat) != level]
    # Two drifts that differ by half a spacing of levels, 0.005, make a value nearer to the neighbouring level.
    drift = np.random.default_rng(seed).uniform(-0.0024, 0.0024, len(places))
    series = place_in_series(np.array([LEVELS[level] for _, level in places]) + drift)
    assert series is not None
    level, repeat = series
    assert list(zip(repeat.tolist(), level.tolist(), strict=True)) == places


def test_a_load_cell_that_reads_negative_shows_the_same_series():
    values = np.tile(LEVELS, 3) + np.random.default_rng(1).uniform(-0.002, 0.002, 3 * len(LEVELS))
    series, mirrored = place_in_series(values), place_in_series(-values)
    assert series is not None
    np.testing.assert_array_equal(mirrored, series)


@given(drift=st.lists(st.floats(-0.02, 0.02), min_size=14, max_size=14), lacking=st.sampled_from([1, 2, 3, 4, 5, 6]))
def test_beyond_half_a_spacing_the_nearest_rising_levels_are_taken(drift, lacking):
    """By all ways there are: each value has its own level, in order of size."""
    lacks_two = [level for level in range(1, 8) if level != lacking]
    values = LEVELS[[*range(8), *lacks_two]] + drift
    series = place_in_series(values)
    # With this much noise nothing rises, or a level looks like the start of another series.
    assume(series is not None and series[1].tolist() == 8 * [0] + 6 * [1])
    assert series[0][:8].tolist() == list(range(8))
    found = series[0][8:]
    rising = np.sort(values[8:])
    cost = {
        levels: float(((rising - np.sort(values[list(levels)])) ** 2).sum())
        for levels in combinations(range(8), len(found))
    }
    assert tuple(found) in cost
    assert cost[tuple(found)] == pytest.approx(min(cost.values()), abs=1e-15)


@pytest.mark.parametrize(
    "values",
    [
        np.linspace(0, 1, 20),  # one series is no repeat
        np.linspace(1, 0, 20),
        np.tile([0.0, 1.0], 10),  # two levels
        np.random.default_rng(0).permutation(np.linspace(0, 1, 40)),
        np.full(10, 0.3),
        np.array([0.1]),
    ],
)
def test_place_in_series_returns_none_for_values_that_are_no_repeated_series(values):
    assert place_in_series(values) is None


@given(values=st.lists(st.integers(0, 12), min_size=1, max_size=9), data=st.data())
def test_kmeans_groups_have_the_least_squares_of_all_groups(values, data):
    n_groups = data.draw(st.integers(1, len(set(values))))
    values = np.array(values, dtype=float)
    ordered = np.sort(values)

    def squares(parts) -> float:
        return sum(float(((part - part.mean()) ** 2).sum()) for part in parts)

    groups = kmeans_groups(values, n_groups)
    assert np.unique(groups).tolist() == list(range(n_groups))
    assert (np.diff(group_means(values, groups)) > 0).all()
    cuts = combinations(range(1, len(values)), n_groups - 1)
    least = min(squares(np.split(ordered, list(cut))) for cut in cuts)
    assert squares([values[groups == one] for one in range(n_groups)]) == pytest.approx(least, abs=1e-9)
