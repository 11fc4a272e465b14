"""The compiled search: what it decides itself, what it leaves to numpy, and what it refuses to be handed."""

import datetime
from contextlib import suppress

import numpy as np
import pytest
from scipy.linalg import cython_blas

from shearloop.bank.eit import compiled, compiled_search, fast_matching
from shearloop.bank.eit.channels import N_CHANNELS
from tests.bank.small_banks import (
    BANK,
    COMPILED,
    COMPILED_PAIRS,
    PAIRS,
    SHAPE,
    assert_same,
    bank_of_five_alone,
    bank_of_noise,
    by_compiled,
    is_compiled,
    pair,
    two_contacts,
    without_runner_up,
)


@is_compiled
@by_compiled
def test_the_compiled_search_scores_few_cells_and_gives_up_on_many(slow, fast) -> None:
    frame = BANK[0][7, 12] * (1 + 0.05 * np.random.default_rng(6).normal(size=N_CHANNELS))
    few = int(BANK[1].sum()) // 4
    assert_same(fast._found(frame, True, few), slow.match(frame))
    alone = without_runner_up(slow.match(frame))
    assert_same(fast._found(frame, False, few), alone)
    among_ties = BANK[0][12, 6].astype(np.float64)
    assert fast._found(among_ties, True, 3) is None
    assert_same(fast.match(among_ties), slow.match(among_ties))


@is_compiled
@by_compiled
def test_the_compiled_search_leaves_a_tie_that_hangs_on_rounding(slow, fast, monkeypatch) -> None:
    monkeypatch.setattr(fast_matching, "_ROUNDING_64", 2.0)
    unsure = type(fast)(*BANK, slow.k_grid, slow.sigma_grid)
    frame = BANK[0][6, 6] + BANK[0][16, 5]
    assert unsure._found(frame, True, len(unsure._cells)) is None
    assert unsure.match_quickly(frame) is None
    monkeypatch.undo()
    assert_same(unsure.match(frame), slow.match(frame))


@is_compiled
@by_compiled
def test_what_has_no_magnitude_is_not_searched(slow, fast) -> None:
    del slow
    for frame in (np.zeros(N_CHANNELS), np.full(N_CHANNELS, np.nan), np.full(N_CHANNELS, np.inf), np.ones(3)):
        assert fast._found(frame, True, 1000) is None
    lone = np.ones(N_CHANNELS)
    lone[-1] = np.nan
    assert fast._found(lone, True, 1000) is None


@is_compiled
def test_most_frames_are_decided_by_the_compiled_search_wherever_their_best_lag_is() -> None:
    """What it leaves to numpy is right as well, but slow."""
    slow, fast = COMPILED_PAIRS[0]
    random = np.random.default_rng(11)
    n_decided = 0
    for number, cell in enumerate(np.argwhere(BANK[1])[::7]):
        lag = (0, 1, -28, 300, -600)[number % 5]
        frame = np.abs(BANK[0][tuple(cell)]) + (0, 1e-3, 0.1, 1.0)[number % 4] * random.random(N_CHANNELS)
        moved = np.zeros(N_CHANNELS)
        moved[max(lag, 0) : N_CHANNELS + min(lag, 0)] = frame[max(-lag, 0) : N_CHANNELS - max(lag, 0)]
        found = fast._found(moved, True, 1000)
        if found is not None:
            n_decided += 1
            assert_same(found, slow.match(moved))
    assert n_decided > 0.95 * (number + 1)


@is_compiled
@pytest.mark.parametrize("first", [True, False])
def test_the_outermost_lags_are_searched(first) -> None:
    signals, valid = bank_of_noise()
    signals[14, 5] = 0.1
    signals[14, 5, 0 if first else -1] = 30.0
    slow, fast = pair(*COMPILED[0], (signals, valid))
    frame = np.eye(N_CHANNELS)[-1 if first else 0]
    assert slow.match(frame).cell == (14, 5)
    assert_same(fast._found(frame, False, 1000), without_runner_up(slow.match(frame)))


def arguments_of_search() -> list:
    _, fast = PAIRS[1]
    handed = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compiled.search, "Search", lambda *arguments: handed.append(arguments))
        compiled_search.search_of(
            *(fast._bank, fast._signals, fast._cells, fast._norms, (fast._row, fast._column)),
            tie=1e-12,
            tie_rounding=1e-14,
            radius=5,
        )
    return list(handed[0])


@is_compiled
@pytest.mark.parametrize(
    ("argument", "broken"),
    [
        (0, lambda rows: rows[:, :-1].copy()),
        (0, lambda rows: rows.view(np.int32)),
        (1, lambda rows: rows[:-1]),
        (2, lambda rows: rows.astype(np.float64)),
        (3, lambda places: places + 10_000),
        (3, lambda places: places.view(np.float64)),
        (4, lambda norms: norms[:-1]),
        (4, lambda norms: norms.view(np.float32)),
        (5, lambda rows: rows.view(np.float32)),
        (6, lambda columns: columns[::2]),
        (7, lambda overlaps: overlaps[1:]),
        (8, lambda spectra: spectra[..., :-1, :, :]),
        (9, lambda roots: roots[1:]),
        (9, lambda roots: roots.astype(roots.dtype.newbyteorder())),
        (10, lambda levels: levels[:-1]),
        (10, lambda levels: levels[:0]),
        (10, lambda levels: levels * 4),
        (10, lambda levels: ((levels[0][0][1:], *levels[0][1:]), *levels[1:])),
        (10, lambda levels: ((levels[0][0], levels[0][1] + 1, levels[0][2]), *levels[1:])),
        (10, lambda levels: ((levels[0][0], levels[0][1] - 1, levels[0][2]), *levels[1:])),
        (10, lambda levels: ((levels[0][0], levels[0][1][1:], levels[0][2]), *levels[1:])),
        (10, lambda levels: (levels[0], (*levels[1][:2], levels[1][2] + 1), *levels[2:])),
        (10, lambda levels: (levels[0], (*levels[1][:2], levels[1][2][::-1].copy()), *levels[2:])),
        (10, lambda levels: (levels[0], (*levels[1][:2], levels[1][2][:0]), *levels[2:])),
        (10, lambda levels: (levels[0], (*levels[1][:2], levels[1][2][1:]), *levels[2:])),
        (11, lambda _: None),
        (11, lambda _: datetime.datetime_CAPI),
        (11, lambda _: cython_blas.__pyx_capi__["dgemm"]),
        (12, lambda _: 0),
        (12, lambda rank: rank + 1),
    ],
)
def test_arrays_that_do_not_fit_are_refused_and_not_searched(argument, broken) -> None:
    """What a compiled search is handed decides where it reads."""
    arguments = arguments_of_search()
    assert compiled.search.Search(*arguments).match(np.ones(N_CHANNELS), True, 1000) is not None
    arguments[argument] = broken(arguments[argument])
    with pytest.raises((ValueError, BufferError, TypeError)):
        compiled.search.Search(*arguments)
    refused = compiled.search.Search.__new__(compiled.search.Search)
    with suppress(ValueError, BufferError, TypeError):
        refused.__init__(*arguments)
    with pytest.raises(ValueError, match="has no bank"):
        refused.match(np.ones(N_CHANNELS), True, 1000)
    with pytest.raises(ValueError, match="has no bank"):
        refused.match_at_all_lags(np.ones(N_CHANNELS), True, 1000)


@is_compiled
def test_differences_of_other_lengths_and_kinds_are_not_searched() -> None:
    """Nor read as what they are not: of some the bytes are as many."""
    search, frame = compiled.search.Search(*arguments_of_search()), np.ones(N_CHANNELS)
    for find in (search.match, search.match_at_all_lags):
        assert find(frame, True, 100_000) is not None
        for wrong in (
            *(frame[1:], frame.repeat(2), frame.repeat(2)[::2], frame.repeat(2).astype(np.float32)),
            *(frame.astype(np.int64), frame.astype(frame.dtype.newbyteorder()), frame.tobytes(), None),
        ):
            assert find(wrong, True, 100_000) is None


@is_compiled
def test_a_search_is_made_once() -> None:
    arguments = arguments_of_search()
    with pytest.raises(TypeError, match="made once"):
        compiled.search.Search(*arguments).__init__(*arguments)


@pytest.mark.parametrize("kind", COMPILED)
def test_signals_in_another_order_or_of_another_type_are_matched_the_same(kind) -> None:
    """By numpy, for a compiled search reads float32, one after the other."""
    spread = np.zeros((*SHAPE, 2 * N_CHANNELS), np.float32)
    spread[..., ::2] = BANK[0]
    frame = BANK[0][6, 6] + BANK[0][16, 5]
    for signals in (spread[..., ::2], BANK[0].astype(np.float64), BANK[0].astype(">f4")):
        slow, fast = pair(*kind, (signals, BANK[1]))
        assert fast._found(frame, True, 1000) is None
        assert_same(fast.match(frame), slow.match(frame))


@is_compiled
@pytest.mark.parametrize("seed", [0, 6, 191, 192, 1859, 2887])
def test_where_another_cell_is_the_best_than_was_thought_the_compiled_search_looks_again(seed) -> None:
    """For the known runner-up may be in its peak: so it is of one such frame in eight, and of a recorded one in 16."""
    slow, fast = COMPILED_PAIRS[0]
    found = fast._found(two_contacts(seed), True, 1000)
    assert found is not None
    assert_same(found, slow.match(two_contacts(seed)))


@is_compiled
def test_frames_of_two_contacts_are_decided_by_the_compiled_search() -> None:
    slow, fast = COMPILED_PAIRS[0]
    for seed in range(100, 160):
        found = fast._found(two_contacts(seed), True, 1000)
        assert found is not None
        assert_same(found, slow.match(two_contacts(seed)))


@is_compiled
def test_of_a_cells_lags_that_tie_the_highest_score_is_told() -> None:
    """The frame, of two channels, is a cell's signal at lag 0, and nearly so at lag 100."""
    signals, valid = bank_of_noise(n_live=40)
    signals[3, 3] = 0.0
    signals[3, 3, [200, 700]] = 1.0
    slow, fast = pair(*COMPILED[0], (signals, valid))
    for at_0, at_100 in ((1.0, 1.0 - 7e-13), (1.0 - 7e-13, 1.0)):
        frame = np.zeros(N_CHANNELS)
        frame[[200, 700]], frame[[300, 800]] = at_0, at_100
        assert_same(fast._found(frame, False, 1000), without_runner_up(slow.match(frame)))


@is_compiled
@pytest.mark.parametrize("kind", COMPILED)
def test_no_score_is_bounded_below_itself_where_next_to_nothing_is_left_out_of_the_basis(kind) -> None:
    """Of cells that float32 hardly tells apart: there the bounds have nothing to spare for their own rounding."""
    random = np.random.default_rng(3)
    signals = 1 + 1e-3 * (random.random((*SHAPE, 3)) @ random.random((3, N_CHANNELS)))
    slow, fast = pair(*kind, (signals.astype(np.float32), np.ones(SHAPE, dtype=np.bool_)))
    for frame in signals.reshape(-1, N_CHANNELS)[::22]:
        found = fast._found(frame, True, 10_000)
        assert found is not None
        assert_same(found, slow.match(frame))


@is_compiled
def test_where_there_is_too_much_to_look_at_the_compiled_search_leaves_it() -> None:
    """Signals and frames of noise, which nearly any cell fits at nearly any lag."""
    slow, fast = pair(*COMPILED[0], bank_of_noise())
    for frame in np.random.default_rng(12).random((4, N_CHANNELS)) ** 8:
        assert fast._found(frame, False, 1_000_000) is None
        assert_same(fast.match(frame), slow.match(frame))


@is_compiled
@by_compiled
def test_no_score_is_above_1(slow, fast) -> None:
    """Of a cell's own signal, which rounding may carry past it."""
    del slow
    found = [fast._found(signal.astype(np.float64), False, 1000) for signal in BANK[0][BANK[1]][::5]]
    assert max(match.score for match in found if match is not None) == 1.0


@is_compiled
def test_a_lag_at_which_a_cell_is_hardly_better_is_looked_at() -> None:
    bank, alone = bank_of_five_alone()
    slow, fast = pair(*COMPILED[0], bank)
    frame = np.zeros(N_CHANNELS)
    for name, size, lag in (("left", 5, 0), ("between", 5.01, 7)):
        frame[lag:] += size * bank[0][alone[name]][: N_CHANNELS - lag]
    assert slow.match(frame).cell == alone["between"]
    found = fast._found(frame, False, 1000)
    assert found is not None
    assert_same(found, without_runner_up(slow.match(frame)))
