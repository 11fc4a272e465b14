"""The bounds of the pruned matcher: no score lies above them, and few cells remain."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shearloop.bank.eit import pruned_matching
from shearloop.bank.eit.channels import N_CHANNELS
from shearloop.bank.eit.matching import Matcher, unit_magnitudes
from shearloop.bank.eit.pruned_matching import COARSE_RANK, ROUNDING, AllLagsBounds, ZeroLagBounds, columns
from tests.bank.small_banks import BANK, PAIRS, assert_same, both, cells, without_runner_up


@both
@pytest.mark.parametrize(("limit", "value"), [("_MAX_BOUNDS", 10), ("_FEW_LAGS", 0)])
def test_where_bounds_do_not_help_all_is_scored(slow, fast, monkeypatch, limit, value) -> None:
    monkeypatch.setattr(pruned_matching, limit, value)
    for frame in np.random.default_rng(5).random((4, N_CHANNELS)):
        assert_same(fast.match(frame), slow.match(frame))


@settings(max_examples=100)
@given(cells, st.sampled_from([0.0, 1e-6, 1e-4, 1e-2, 0.1, 1.0]), st.integers(0, 2**32 - 1))
def test_no_bound_is_below_its_score(cell, noise, seed) -> None:
    """Also of frames that are a cell's own signal, where next to nothing is left out of the bank's basis."""
    _, fast = PAIRS[1]
    noisy = BANK[0][cell] + noise * np.random.default_rng(seed).normal(size=N_CHANNELS)
    (frame,) = unit_magnitudes(noisy[None])
    signals = np.abs(BANK[0][BANK[1]].astype(np.float64))
    scores = (signals @ frame) / np.linalg.norm(signals, axis=1)
    found = ZeroLagBounds(fast.compressed, frame)
    everything = found.candidates(-1.0)
    np.testing.assert_array_equal(everything.cells, np.arange(len(scores)))
    assert (everything.bounds - scores).min() >= -ROUNDING / 2
    for score in np.quantile(scores, [0.5, 0.9, 1.0]):
        assert set(np.flatnonzero(scores >= score)) <= set(found.candidates(score).cells)


def test_no_group_of_cells_is_bounded_below_one_of_them() -> None:
    """By frames that point from one cell to another, or along the mean: where a centre alone says too little."""
    bank = PAIRS[0][1].compressed
    signals = np.abs(BANK[0][BANK[1]].astype(np.float64))
    signals /= np.linalg.norm(signals, axis=1, keepdims=True)
    apart = np.maximum(signals[::3, None] - 0.95 * signals[None, ::7], 0.0).reshape(-1, N_CHANNELS)
    frames = np.vstack([signals, signals.mean(axis=0), apart[apart.any(axis=1)]])
    frames /= np.linalg.norm(frames, axis=1, keepdims=True)
    scores = frames @ signals.T
    at = columns((frames @ bank.basis[:COARSE_RANK].T).T.astype(np.float32), np.ones(len(frames)))
    highest = np.array([scores[:, members].max(axis=1) for members in bank.members])
    assert (bank.groups @ at - highest).min() >= -ROUNDING / 2


@settings(max_examples=12, deadline=None)
@given(cells, st.sampled_from([0.0, 1e-6, 1e-2, 1.0]), st.integers(0, 2**32 - 1))
def test_no_bound_at_any_lag_is_below_its_score(cell, noise, seed) -> None:
    slow, fast = PAIRS[0]
    frame = BANK[0][cell] + noise * np.random.default_rng(seed).normal(size=N_CHANNELS)
    found = AllLagsBounds(fast, unit_magnitudes(frame[None])[0])
    scores = slow.heatmap(frame)[BANK[1]]
    best, reached = found.reached
    assert 0 < reached <= scores[best] + 1e-12
    for limit in np.quantile(scores, [0.9, 1.0, 0.0]).tolist():
        left = found.candidates(limit)
        assert set(np.flatnonzero(scores >= limit)) <= set(left.cells)
        reaching = scores[left.cells] >= limit
        assert (left.bounds - scores[left.cells])[reaching].min() >= -ROUNDING / 2


@both
def test_few_cells_are_scored_exactly(slow, fast, monkeypatch) -> None:
    """What makes it fast: of a frame near to the bank's, most cells are never read."""
    read = []
    contenders = type(fast)._contenders

    def counted(self, frame, cells, frames, reached):
        read.append(len(cells))
        return contenders(self, frame, cells, frames, reached)

    monkeypatch.setattr(type(fast), "_contenders", counted)
    frame = BANK[0][7, 12] * (1 + 0.05 * np.random.default_rng(6).normal(size=N_CHANNELS))
    assert_same(fast.match(frame), slow.match(frame))
    assert sum(read) < BANK[1].sum() / 4


@both
def test_a_tie_that_hangs_on_rounding_is_left_to_the_slow_matcher(slow, fast, monkeypatch) -> None:
    frame = BANK[0][6, 6] + BANK[0][16, 5]
    expected = slow.match(frame)
    scored = []
    monkeypatch.setattr(type(slow), "heatmap", lambda self, each: scored.append(each) or Matcher.heatmap(self, each))
    assert_same(fast.match(frame), expected)
    assert not scored
    monkeypatch.setattr(pruned_matching, "_ROUNDING_64", 2.0)
    assert_same(fast.match(frame), expected)
    assert len(scored) == 1
    assert_same(fast.match(frame, runner_up=False), without_runner_up(expected))
