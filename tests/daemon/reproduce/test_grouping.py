from itertools import combinations

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from shearloop.daemon.analysis.reproduce.analysis import group_means, kmeans_groups, place_in_series

LEVELS = np.array([0.01, 0.03, 0.05, 0.06, 0.07, 0.08, 0.10, 0.11])


@given(
    repeats=st.integers(2, 9),
    lacking=st.dictionaries(st.integers(0, 8), st.integers(0, 7), max_size=4),
    seed=st.integers(0, 2**32 - 1),
)
def test_series_are_found_though_some_lack_a_level(repeats: int, lacking: dict[int, int], seed: int) -> None:
    # One repeat is complete; the others may lack any one level but the outermost together.
    lacking = {repeat: level for repeat, level in lacking.items() if 0 < repeat < repeats}
    places = [(repeat, level) for repeat in range(repeats) for level in range(8) if lacking.get(repeat) != level]
    # Two drifts that differ by half a spacing of levels, 0.005, make a value nearer to the neighbouring level.
    drift = np.random.default_rng(seed).uniform(-0.0024, 0.0024, len(places))
    series = place_in_series(np.array([LEVELS[level] for _, level in places]) + drift)
    assert series is not None
    level, repeat = series
    assert list(zip(repeat.tolist(), level.tolist(), strict=True)) == places


@given(drift=st.lists(st.floats(-0.02, 0.02), min_size=14, max_size=14), lacking=st.sampled_from([1, 2, 3, 4, 5, 6]))
def test_beyond_half_a_spacing_the_nearest_rising_levels_are_taken(drift: list[float], lacking: int) -> None:
    """By all ways there are: values that noise made change places stay in their order, and each has its own level."""
    lacks_two = [level for level in range(1, 8) if level != lacking]
    values = LEVELS[[*range(8), *lacks_two]] + drift
    series = place_in_series(values)
    # With this much noise nothing rises, or a level looks like the start of another series.
    assume(series is not None and series[1].tolist() == 8 * [0] + 6 * [1])
    assert series[0][:8].tolist() == list(range(8))
    found = series[0][8:]
    cost = {
        levels: float(((values[8:] - values[list(levels)]) ** 2).sum()) for levels in combinations(range(8), len(found))
    }
    assert tuple(found) in cost
    assert cost[tuple(found)] == pytest.approx(min(cost.values()), abs=1e-15)


def test_a_value_nearer_to_a_level_that_its_series_lacks_goes_there() -> None:
    """Nothing tells them apart: 0.06 that reads 0.0549 is 0.05, where no other value is."""
    whole, lacking = LEVELS.tolist(), np.delete(LEVELS, 2).tolist()
    for reading, level in ((0.0551, 3), (0.0549, 2)):
        lacking[2] = reading
        series = place_in_series(np.array([*whole, *lacking, *whole]))
        assert series is not None
        assert series[0][8:15].tolist() == [0, 1, level, 4, 5, 6, 7]


def test_in_a_whole_series_noise_moves_no_value_to_another_level() -> None:
    swapped = LEVELS.copy()
    swapped[[3, 4]] = 0.071, 0.059
    series = place_in_series(np.concatenate([LEVELS, swapped, LEVELS]))
    assert series is not None
    assert series[0].tolist() == 3 * list(range(8))


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
def test_what_is_no_repeated_series_is_told(values: np.ndarray) -> None:
    assert place_in_series(values) is None


def test_kmeans_finds_groups_that_are_there_and_the_same_ones_each_time() -> None:
    generator = np.random.default_rng(3)
    truth = generator.permutation(np.repeat(np.arange(4), 6))
    values = truth * 10.0 + generator.normal(size=24) * 0.5
    groups = kmeans_groups(values, 4)
    assert groups.tolist() == kmeans_groups(values, 4).tolist() == truth.tolist()
    np.testing.assert_allclose(group_means(values, groups), [0, 10, 20, 30], atol=1)


def test_kmeans_takes_as_many_groups_as_there_are_values() -> None:
    assert kmeans_groups(np.array([1.0, 1.0, 5.0]), 2).tolist() == [0, 0, 1]
    assert kmeans_groups(np.ones(3), 1).tolist() == [0, 0, 0]
