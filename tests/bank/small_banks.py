"""Small, hard banks, and pairs of a slow reference matcher and the pruned matcher that must equal it."""

import dataclasses

import numpy as np
import pytest
from hypothesis import strategies as st

from shearloop.bank.eit.channels import N_CHANNELS
from shearloop.bank.eit.matching import Match, Matcher, ReferenceMatcher, ZeroLagMatcher
from shearloop.bank.eit.pruned_matching import PrunedMatcher, PrunedZeroLagMatcher

SHAPE = (22, 20)


def smooth_bank() -> tuple[np.ndarray, np.ndarray]:
    """Return signals that change little from cell to cell, as a bank's do, with plateaus of cells that are alike."""
    k, sigma = np.meshgrid(np.linspace(0, 1, SHAPE[0]), np.linspace(0.1, 1, SHAPE[1]), indexing="ij")
    channel = np.arange(N_CHANNELS)
    phase = 2 * np.pi * (channel % 28) / 28
    signals = np.sin(phase + 6 * k[..., None]) * np.exp(
        -(((channel / N_CHANNELS - k[..., None]) / sigma[..., None]) ** 2)
    )
    signals += 0.3 * np.cos(3 * phase * sigma[..., None]) * k[..., None]
    signals[10:14, 3:9] = signals[10, 3]
    signals[18:] = signals[18]
    valid = k + sigma < 1.8
    valid[4, 4] = False
    signals[~valid] = np.nan  # must never be read
    return signals.astype(np.float32), valid


def bank_of_noise(*, n_live: int = N_CHANNELS, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    signals = np.zeros((*SHAPE, N_CHANNELS), dtype=np.float32)
    signals[..., :n_live] = np.random.default_rng(seed).random((*SHAPE, n_live))
    return signals, np.ones(SHAPE, dtype=np.bool_)


def bank_of_five_alone() -> tuple[tuple[np.ndarray, np.ndarray], dict[str, tuple[int, int]]]:
    """Return a bank of five cells that have nothing in common with each other nor with the rest, and where they are.

    "above" has the first channels alone, so that it may lie whole in a frame's last ones.
    """
    random = np.random.default_rng(0)
    signals = np.zeros((20, 20, N_CHANNELS), dtype=np.float32)
    signals[..., 860:] = random.random((20, 20, 2)) @ random.random((2, 36))
    alone = {"left": (10, 5), "right": (10, 11), "between": (10, 8), "below": (2, 2), "above": (18, 18)}
    for name, cell in alone.items():
        signals[cell] = 0.0
        signals[cell][random.choice(200 if name == "above" else 700, 40, replace=False)] = 1.0
    return (signals, np.ones((20, 20), dtype=np.bool_)), alone


def pair(slow: type[Matcher], fast: type[Matcher], bank: tuple[np.ndarray, np.ndarray]) -> tuple[Matcher, Matcher]:
    grids = np.arange(1.0, bank[1].shape[0] + 1), np.arange(1.0, bank[1].shape[1] + 1)
    return slow(*bank, *grids), fast(*bank, *grids)


class Searching(PrunedMatcher):
    """Searches however few cells there are."""

    _min_cells = 0


KINDS = ((ReferenceMatcher, Searching), (ZeroLagMatcher, PrunedZeroLagMatcher))
BANK = smooth_bank()
PAIRS = [pair(*kind, BANK) for kind in KINDS]
NAMES = ["all lags", "zero lag"]
both = pytest.mark.parametrize(("slow", "fast"), PAIRS, ids=NAMES)
cells = st.sampled_from([tuple(cell) for cell in np.argwhere(BANK[1]).tolist()])


def two_contacts(seed: int) -> np.ndarray:
    """Return a frame of two cells, one of them at another lag."""
    random = np.random.default_rng(seed)
    one, other = (np.abs(BANK[0][BANK[1]][cell]) for cell in random.integers(0, BANK[1].sum(), 2))
    lag = int(random.integers(0, 60))
    frame = other * random.random()
    frame[lag:] += (one * random.random() + 0.01 * random.random(N_CHANNELS))[: N_CHANNELS - lag]
    return frame


def assert_same(fast: Match, slow: Match) -> None:
    assert fast.cell == slow.cell
    assert fast.runner_up_cell == slow.runner_up_cell
    assert fast.score == pytest.approx(slow.score, abs=1e-13)
    assert (fast.runner_up is None) == (slow.runner_up is None)
    if slow.runner_up is not None:
        assert fast.runner_up == pytest.approx(slow.runner_up, abs=1e-13)
    assert (fast.k, fast.sigma) == (slow.k, slow.sigma)


def without_runner_up(match: Match) -> Match:
    return dataclasses.replace(match, runner_up=None, runner_up_cell=None)
