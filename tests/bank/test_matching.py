import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from shearloop.bank.channels import PAPER_TABLE
from shearloop.bank.errors import MatchingError
from shearloop.bank.matching import Matcher, ReferenceMatcher, ZeroLagMatcher, best_match, signal_above_noise

K_GRID, SIGMA_GRID = np.linspace(3.1, 3.4, 7), np.linspace(1.2, 1.9, 8)
VALID = np.ones((7, 8), dtype=np.bool_)
VALID[2, 3] = VALID[0, 0] = VALID[6, 7] = False


def bank_signals() -> np.ndarray:
    signals = np.random.default_rng(1).normal(size=(7, 8, PAPER_TABLE.n_channels)).astype(np.float32)
    signals[~VALID] = np.nan  # must never be read
    return signals


SIGNALS = bank_signals()
REFERENCE = ReferenceMatcher(SIGNALS, VALID, K_GRID, SIGMA_GRID)
MATCHERS: tuple[Matcher, ...] = (REFERENCE, ZeroLagMatcher(SIGNALS, VALID, K_GRID, SIGMA_GRID))
both = pytest.mark.parametrize("matcher", MATCHERS, ids=lambda matcher: type(matcher).__name__)
frames = hnp.arrays(np.float64, PAPER_TABLE.n_channels, elements=st.floats(-10, 10, width=32)).filter(np.any)


def correlations(frame: np.ndarray, cell: tuple[int, int]) -> np.ndarray:
    """All lags, by the definition: sums of products, over the product of the norms."""
    a, b = np.abs(frame), np.abs(SIGNALS[cell].astype(np.float64))
    return np.asarray(np.correlate(a, b, mode="full") / np.sqrt((a @ a) * (b @ b)))


@given(frames)
@settings(max_examples=20, deadline=None)
def test_scores_are_those_of_the_definition(frame):
    reference, zero_lag = (matcher.heatmap(frame) for matcher in MATCHERS)
    for cell in [(0, 1), (3, 3), (6, 6)]:
        every_lag = correlations(frame, cell)
        assert every_lag.shape == (2 * PAPER_TABLE.n_channels - 1,)
        assert reference[cell] == pytest.approx(every_lag.max(), abs=1e-12)
        assert zero_lag[cell] == pytest.approx(every_lag[PAPER_TABLE.n_channels - 1], abs=1e-12)


@both
@given(frame=frames, scale=st.floats(1e-150, 1e150))
@settings(max_examples=20, deadline=None)
def test_scores_lie_between_0_and_1_and_know_neither_scale_nor_sign(matcher, frame, scale):
    heatmap = matcher.heatmap(frame)
    assert (np.isnan(heatmap) == ~VALID).all()
    assert ((heatmap[VALID] >= 0) & (heatmap[VALID] <= 1)).all()
    np.testing.assert_allclose(matcher.heatmap(-scale * frame), heatmap, atol=1e-12)


@both
def test_a_bank_row_is_found_in_its_own_cell(matcher):
    for row, column in np.argwhere(VALID):
        match = best_match(matcher.heatmap(SIGNALS[row, column] * -3.0), K_GRID, SIGMA_GRID)
        assert match.cell == (row, column)
        assert match.score == pytest.approx(1.0, abs=1e-12)
        assert (match.k, match.sigma) == (K_GRID[row], SIGMA_GRID[column])


@both
def test_many_frames_are_scored_like_each_of_them(matcher):
    batch = np.random.default_rng(2).normal(size=(3, PAPER_TABLE.n_channels))
    maps = matcher.heatmaps(batch)
    for frame, heatmap in zip(batch, maps, strict=True):
        np.testing.assert_allclose(matcher.heatmap(frame), heatmap, atol=1e-14)


def test_a_bank_of_more_cells_than_fit_a_chunk_is_scored_cell_by_cell_all_the_same():
    signals = np.random.default_rng(3).normal(size=(1030, 2, PAPER_TABLE.n_channels)).astype(np.float32)
    every = np.ones((1030, 2), dtype=np.bool_)
    large = ReferenceMatcher(signals, every, np.arange(1030.0), np.arange(2.0))
    small = ReferenceMatcher(signals[1020:], every[1020:], np.arange(10.0), np.arange(2.0))
    frame = signals[1025, 1]
    np.testing.assert_allclose(large.heatmap(frame)[1020:], small.heatmap(frame), atol=1e-14)


def test_banks_that_cannot_be_matched_are_refused():
    with pytest.raises(MatchingError, match="no cell of the bank is valid"):
        ReferenceMatcher(SIGNALS, np.zeros_like(VALID), K_GRID, SIGMA_GRID)
    empty = ZeroLagMatcher(np.zeros_like(SIGNALS), VALID, K_GRID, SIGMA_GRID)
    with pytest.raises(MatchingError, match="build the bank again"):
        empty.heatmap(np.ones(PAPER_TABLE.n_channels))


heatmaps = hnp.arrays(np.float64, (7, 8), elements=st.floats(0, 1) | st.just(np.nan)).filter(
    lambda heatmap: not np.isnan(heatmap).all()
)


@given(heatmaps, st.integers(0, 8))
def test_the_match_is_the_maximum_and_the_runner_up_stands_outside_its_neighbourhood(heatmap, radius):
    match = best_match(heatmap, K_GRID, SIGMA_GRID, radius)
    assert match.score == heatmap[match.cell] >= np.nanmax(heatmap) - 1e-12
    outside = [
        cell
        for cell in map(tuple, np.argwhere(~np.isnan(heatmap)).tolist())
        if max(abs(cell[0] - match.cell[0]), abs(cell[1] - match.cell[1])) > radius
    ]
    if match.runner_up_cell is None:
        assert not outside
        assert match.runner_up is None
    else:
        assert match.runner_up_cell in outside
        assert match.runner_up == pytest.approx(max(heatmap[cell] for cell in outside), abs=1e-12)


def test_of_scores_that_tie_the_first_cell_wins():
    heatmap = np.full((7, 8), 0.5)
    heatmap[1, 2], heatmap[3, 4] = 0.7, 0.7 + 5e-13
    assert best_match(heatmap, K_GRID, SIGMA_GRID).cell == (1, 2)
    heatmap[3, 4] = 0.7 + 5e-12
    assert best_match(heatmap, K_GRID, SIGMA_GRID).cell == (3, 4)


def test_a_heatmap_without_a_valid_cell_is_refused():
    with pytest.raises(MatchingError, match="no cell of the heatmap is valid"):
        best_match(np.full((7, 8), np.nan), K_GRID, SIGMA_GRID)
    with pytest.raises(MatchingError, match="the grids 7 k × 8 σ"):
        best_match(np.ones((8, 7)), K_GRID, SIGMA_GRID)


def test_noise_is_no_signal_and_a_signal_is_not_noise():
    generator = np.random.default_rng(4)
    std = generator.uniform(1e-4, 1e-2, PAPER_TABLE.n_channels)
    frames_of_noise = std * generator.normal(size=(2000, PAPER_TABLE.n_channels))
    assert all(signal_above_noise(frame, std) is not None for frame in frames_of_noise)
    assert signal_above_noise(frames_of_noise[0] + 0.7 * std, std) is None
    assert signal_above_noise(np.full(PAPER_TABLE.n_channels, 1e300), std) is None
    silent = signal_above_noise(np.zeros(PAPER_TABLE.n_channels), 1.0)
    assert silent == "no signal above the noise: the difference is 0.00 times the noise, and a signal needs 1.11 times"


def test_the_noise_test_keeps_its_false_alarm_rate():
    # χ² of 896 degrees is close to Gaussian: mean 896, variance 2 · 896; the quantile of 1e-6 is 4.75 sd and a little.
    limit = 896 + 4.7534 * np.sqrt(2 * 896)
    lower, upper = (np.full(PAPER_TABLE.n_channels, np.sqrt(energy / 896)) for energy in (limit, limit + 20))
    assert signal_above_noise(lower, 1.0) is not None
    assert signal_above_noise(upper, 1.0) is None
