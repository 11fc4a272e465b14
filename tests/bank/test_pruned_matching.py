"""The pruned matcher returns the reference matcher's cell, score and runner-up for any frame and bank.

No score lies above its bound, and few cells remain.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.io import loadmat

from shearloop.bank import pruned_matching
from shearloop.bank.channels import PAPER_TABLE
from shearloop.bank.errors import MatchingError
from shearloop.bank.matching import Match, Matcher, ReferenceMatcher, ZeroLagMatcher, unit_magnitudes
from shearloop.bank.pruned_matching import (
    COARSE_RANK,
    ROUNDING,
    AllLagsBounds,
    PrunedMatcher,
    PrunedZeroLagMatcher,
    columns,
)

SHAPE = (22, 20)


def smooth_bank() -> tuple[np.ndarray, np.ndarray]:
    """Return signals that change little from cell to cell, as a bank's do, with plateaus of cells that are alike."""
    k, sigma = np.meshgrid(np.linspace(0, 1, SHAPE[0]), np.linspace(0.1, 1, SHAPE[1]), indexing="ij")
    channel = np.arange(PAPER_TABLE.n_channels)
    phase = 2 * np.pi * (channel % 28) / 28
    signals = np.sin(phase + 6 * k[..., None]) * np.exp(
        -(((channel / PAPER_TABLE.n_channels - k[..., None]) / sigma[..., None]) ** 2)
    )
    signals += 0.3 * np.cos(3 * phase * sigma[..., None]) * k[..., None]
    signals[10:14, 3:9] = signals[10, 3]
    signals[18:] = signals[18]
    valid = k + sigma < 1.8
    valid[4, 4] = False
    signals[~valid] = np.nan  # must never be read
    return signals.astype(np.float32), valid


def bank_of_noise(*, n_live: int = PAPER_TABLE.n_channels) -> tuple[np.ndarray, np.ndarray]:
    signals = np.zeros((*SHAPE, PAPER_TABLE.n_channels), dtype=np.float32)
    signals[..., :n_live] = np.random.default_rng(0).random((*SHAPE, n_live))
    return signals, np.ones(SHAPE, dtype=np.bool_)


def pair(slow: type[Matcher], fast: type[Matcher], bank: tuple[np.ndarray, np.ndarray]) -> tuple[Matcher, Matcher]:
    grids = np.arange(1.0, bank[1].shape[0] + 1), np.arange(1.0, bank[1].shape[1] + 1)
    return slow(*bank, *grids), fast(*bank, *grids)


KINDS = ((ReferenceMatcher, PrunedMatcher), (ZeroLagMatcher, PrunedZeroLagMatcher))
BANK = smooth_bank()
PAIRS = [pair(*kind, BANK) for kind in KINDS]
both = pytest.mark.parametrize(("slow", "fast"), PAIRS, ids=["all lags", "zero lag"])
cells = st.sampled_from([tuple(cell) for cell in np.argwhere(BANK[1]).tolist()])


def two_contacts(seed: int) -> np.ndarray:
    """Return a frame of two cells, one of them at another lag."""
    random = np.random.default_rng(seed)
    one, other = (np.abs(BANK[0][BANK[1]][cell]) for cell in random.integers(0, BANK[1].sum(), 2))
    lag = int(random.integers(0, 60))
    frame = other * random.random()
    frame[lag:] += (one * random.random() + 0.01 * random.random(PAPER_TABLE.n_channels))[
        : PAPER_TABLE.n_channels - lag
    ]
    return frame


def assert_same(fast: Match, slow: Match) -> None:
    assert fast.cell == slow.cell
    assert fast.runner_up_cell == slow.runner_up_cell
    assert fast.score == pytest.approx(slow.score, abs=1e-13)
    assert (fast.runner_up is None) == (slow.runner_up is None)
    if slow.runner_up is not None:
        assert fast.runner_up == pytest.approx(slow.runner_up, abs=1e-13)
    assert (fast.k, fast.sigma) == (slow.k, slow.sigma)


amplitudes = hnp.arrays(np.float64, PAPER_TABLE.n_channels, elements=st.floats(-10, 10, width=32)).filter(np.any)


@both
@given(frame=amplitudes)
@settings(max_examples=25, deadline=None)
def test_random_frames_match_as_without_pruning(slow, fast, frame):
    assert_same(fast.match(frame), slow.match(frame))


@pytest.mark.long
@both
@given(
    cell=cells,
    other=cells,
    share=st.sampled_from([0.0, 1e-9, 0.3, 0.5]),
    noise=st.sampled_from([0.0, 1e-7, 1e-3, 0.3]),
    lag=st.sampled_from([0, 0, 1, -28, 300, -890]),
    seed=st.integers(0, 1000),
)
@settings(max_examples=50, deadline=None)
def test_frames_like_those_of_the_bank_match_as_without_pruning(slow, fast, cell, other, share, noise, lag, seed):
    signals = BANK[0].astype(np.float64)
    frame = np.abs((1 - share) * signals[cell] + share * signals[other])
    frame += noise * np.abs(np.random.default_rng(seed).normal(size=PAPER_TABLE.n_channels))
    moved = np.zeros(PAPER_TABLE.n_channels)
    moved[max(lag, 0) : PAPER_TABLE.n_channels + min(lag, 0)] = frame[
        max(-lag, 0) : PAPER_TABLE.n_channels - max(lag, 0)
    ]
    if moved.any():
        assert_same(fast.match(moved), slow.match(moved))


@both
def test_constant_frames_and_cells_that_tie(slow, fast):
    one = np.eye(PAPER_TABLE.n_channels)
    alike = np.ones(PAPER_TABLE.n_channels), BANK[0][12, 6], BANK[0][20, 3], np.arange(PAPER_TABLE.n_channels)
    for frame in (*alike, one[895], 1e-300 * one[5], 1e300 * one[[0, 400]].sum(axis=0)):
        assert_same(fast.match(frame), slow.match(frame))
    # Rounding may carry the score of a cell's own signal past 1.
    assert max(fast.match(signal.astype(np.float64)).score for signal in BANK[0][BANK[1]][::5]) == 1.0
    assert fast.match(BANK[0][12, 6]).cell == (10, 3)


@pytest.mark.parametrize("kind", KINDS)
@given(n_k=st.integers(1, 14), n_sigma=st.integers(1, 14), few=st.integers(1, 40), seed=st.integers(0, 1000))
@settings(max_examples=8, deadline=None)
def test_banks_of_a_few_numbers_where_many_cells_tie(kind, n_k, n_sigma, few, seed):
    random = np.random.default_rng(seed)
    signals = np.zeros((n_k, n_sigma, PAPER_TABLE.n_channels), dtype=np.float32)
    signals[..., random.choice(PAPER_TABLE.n_channels, few)] = random.choice([0, 1, 2, 1e-3], (n_k, n_sigma, few))
    valid, frame = signals.any(axis=2), random.choice([0, 1, 0.5], PAPER_TABLE.n_channels, p=[0.9, 0.05, 0.05])
    if valid.any() and frame.any():
        slow, fast = pair(*kind, (signals, valid))
        assert_same(fast.match(frame), slow.match(frame))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("bank", [BANK, bank_of_noise()], ids=["smooth", "noise"])
def test_a_basis_that_is_fitted_to_few_cells_bounds_all(kind, bank, monkeypatch):
    monkeypatch.setattr(pruned_matching, "_FITTED_CELLS", 5)
    slow, fast = pair(*kind, bank)
    random = np.random.default_rng(7)
    for signal in bank[0][bank[1]][::40]:
        frame = signal + 0.3 * signal.std() * random.normal(size=PAPER_TABLE.n_channels)
        assert_same(fast.match(frame), slow.match(frame))


def hard_scenes() -> dict[str, tuple[tuple[np.ndarray, np.ndarray], list[np.ndarray]]]:
    """Return banks with frames for which a careless search finds another cell than the whole heatmap."""
    n, one, random = PAPER_TABLE.n_channels, np.eye(PAPER_TABLE.n_channels), np.random.default_rng(3)
    cells, lags, first, last = (bank_of_noise(n_live=n_live) for n_live in (40, 40, n, n))
    cells[0][3, 3] = one[[200, 300]].sum(axis=0)
    cells[0][9, 9] = one[[600, 750]].sum(axis=0)
    lags[0][3, 3] = one[[200, 700]].sum(axis=0)
    first[0][14, 5], last[0][14, 5] = 0.1 + 30.0 * one[0], 0.1 + 30.0 * one[-1]
    # Next to nothing is left out of the basis, so the bounds have no room for their own rounding.
    alike = 1 + 1e-3 * (random.random((*SHAPE, 3)) @ random.random((3, n)))
    # In one of eight of the contacts the known runner-up lies in the best cell's peak, and the search begins again.
    contacts = [two_contacts(seed) for seed in (0, 6, 191, 192, 1859, 2887, *range(100, 110))]
    return {
        "no channel in common": (bank_of_noise(n_live=40), [one[-1]]),
        "cells that tie but for rounding": (
            cells,
            [(1.0 - less) * cells[0][3, 3] + cells[0][9, 9] for less in (0.0, 4e-13, 4e-12)],
        ),
        "lags that tie but for rounding": (
            lags,
            [a * lags[0][3, 3] + b * np.roll(lags[0][3, 3], 100) for a, b in ((1.0, 1.0 - 7e-13), (1.0 - 7e-13, 1.0))],
        ),
        "the first lag": (first, [one[-1]]),
        "the last lag": (last, [one[0]]),
        "two contacts": (BANK, contacts),
        "cells alike in float32": (
            (alike.astype(np.float32), np.ones(SHAPE, dtype=np.bool_)),
            list(alike.reshape(-1, n)[::22]),
        ),
    }


SCENES = hard_scenes()


@pytest.mark.parametrize("kind", KINDS, ids=["all lags", "zero lag"])
@pytest.mark.parametrize("scene", SCENES)
def test_hard_scenes_match_as_without_pruning(kind, scene):
    bank, frames = SCENES[scene]
    slow, fast = pair(*kind, bank)
    for frame in frames:
        assert_same(fast.match(frame), slow.match(frame))


@both
def test_what_cannot_be_matched_is_refused_alike(slow, fast):
    for frame, says in (
        (np.zeros(PAPER_TABLE.n_channels), "zero in all channels"),
        (np.full(PAPER_TABLE.n_channels, np.nan), "has 896 channels that are not finite"),
        (np.append(np.ones(PAPER_TABLE.n_channels - 1), np.inf), "has 1 channel that is not finite"),
        (np.ones(1024), "896 channels; the array has shape"),
        (np.ones((1, PAPER_TABLE.n_channels)), "has shape"),
        (np.ones((PAPER_TABLE.n_channels, 1)), "has shape"),
    ):
        for matcher in (slow, fast):
            with pytest.raises(MatchingError, match=says):
                matcher.match(frame)
    with pytest.raises(MatchingError, match="build the bank again"):
        type(fast)(np.zeros_like(BANK[0]), BANK[1], np.arange(22.0), np.arange(20.0))


@pytest.fixture(scope="module")
def recorded_frames(shared) -> list[np.ndarray]:
    found = [loadmat(path)["data_diff"].ravel() for path in (shared / "recordings").glob("*_slices/*_*.mat")]
    for path in (shared / "recordings" / "streams").glob("*/*.mat"):
        for values in loadmat(path).values():
            if getattr(values, "shape", (0, 0))[-1] == 1025:
                channels = PAPER_TABLE.channels_of_line(values[:, 1:])
                found += [*(channels[20::701] - channels[:10].mean(axis=0))]
    return found


@pytest.mark.long
@both
def test_recorded_frames_match_as_without_pruning(recorded_frames, slow, fast):
    """Far from anything in this bank, as they are from every bank: a hard case."""
    assert len(recorded_frames) > 60
    for frame in recorded_frames:
        assert_same(fast.match(frame), slow.match(frame))


@both
def test_where_bounds_do_not_help_all_is_scored(slow, fast, monkeypatch):
    monkeypatch.setattr(pruned_matching, "_MAX_BOUNDS", 10)
    for frame in np.random.default_rng(5).random((4, PAPER_TABLE.n_channels)):
        assert_same(fast.match(frame), slow.match(frame))


@settings(max_examples=100)
@given(cells, st.sampled_from([0.0, 1e-6, 1e-4, 1e-2, 0.1, 1.0]), st.integers(0, 2**32 - 1))
def test_no_bound_is_below_its_score(cell, noise, seed):
    """Also of frames that are a cell's own signal, where next to nothing is left out of the bank's basis."""
    _, fast = PAIRS[1]
    noisy = BANK[0][cell] + noise * np.random.default_rng(seed).normal(size=PAPER_TABLE.n_channels)
    (frame,) = unit_magnitudes(noisy[None], 896)
    signals = np.abs(BANK[0][BANK[1]].astype(np.float64))
    scores = (signals @ frame) / np.linalg.norm(signals, axis=1)
    found = fast.bounds(frame)
    np.testing.assert_array_equal(found.cells, np.arange(len(scores)))
    assert (found.bounds - scores).min() >= -ROUNDING / 2


def test_no_group_of_cells_is_bounded_below_one_of_them():
    """By frames that point from one cell to another, or along the mean: where a centre alone says too little."""
    bank = PAIRS[0][1].compressed
    signals = np.abs(BANK[0][BANK[1]].astype(np.float64))
    signals /= np.linalg.norm(signals, axis=1, keepdims=True)
    apart = np.maximum(signals[::3, None] - 0.95 * signals[None, ::7], 0.0).reshape(-1, PAPER_TABLE.n_channels)
    frames = np.vstack([signals, signals.mean(axis=0), apart[apart.any(axis=1)]])
    frames /= np.linalg.norm(frames, axis=1, keepdims=True)
    scores = frames @ signals.T
    at = columns((frames @ bank.basis[:COARSE_RANK].T).T.astype(np.float32), np.ones(len(frames)))
    highest = np.array([scores[:, members].max(axis=1) for members in bank.members])
    assert (bank.groups @ at - highest).min() >= -ROUNDING / 2


@settings(max_examples=12, deadline=None)
@given(cells, st.sampled_from([0.0, 1e-6, 1e-2, 1.0]), st.integers(0, 2**32 - 1))
def test_no_bound_at_any_lag_is_below_its_score(cell, noise, seed):
    slow, fast = PAIRS[0]
    frame = BANK[0][cell] + noise * np.random.default_rng(seed).normal(size=PAPER_TABLE.n_channels)
    found = AllLagsBounds(fast, unit_magnitudes(frame[None], 896)[0])
    scores = slow.heatmap(frame)[BANK[1]]
    best, reached = found.reached
    assert 0 < reached <= scores[best] + 1e-12
    for limit in np.quantile(scores, [0.9, 1.0, 0.0]).tolist():
        left = found.candidates(limit)
        assert set(np.flatnonzero(scores >= limit)) <= set(left.cells)
        reaching = scores[left.cells] >= limit
        assert (left.bounds - scores[left.cells])[reaching].min() >= -ROUNDING / 2


@both
def test_few_cells_are_scored_exactly(slow, fast, monkeypatch):
    """What makes it fast: of a frame near to the bank's, most cells are never read."""
    read = []
    highest_scores = type(fast).highest_scores

    def counted(self, cells, frames):
        read.append(len(cells))
        return highest_scores(self, cells, frames)

    monkeypatch.setattr(type(fast), "highest_scores", counted)
    frame = BANK[0][7, 12] * (1 + 0.05 * np.random.default_rng(6).normal(size=PAPER_TABLE.n_channels))
    assert_same(fast.match(frame), slow.match(frame))
    assert sum(read) < BANK[1].sum() / 4
