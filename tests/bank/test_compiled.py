"""Whether what can be compiled has been, where it could be: without that it would be slow and nobody would know."""

import datetime
import shutil
import sysconfig
from collections.abc import Callable
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest import mock

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import cython_blas

import bank
from shearloop.bank.eit import compiled, compiled_frames, compiled_search
from shearloop.bank.eit.channels import N_CHANNELS
from shearloop.bank.eit.compression import FloatArray
from shearloop.drivers.compiled import cells
from shearloop.drivers.compiled import is_stale as are_cells_stale


@pytest.mark.skipif(
    shutil.which("cc") is None or not Path(sysconfig.get_path("include"), "Python.h").exists(),
    reason="there is no C compiler, or no Python.h",
)
def test_where_there_is_a_compiler_the_compiled_parts_are_there() -> None:
    assert compiled.IS_COMPILED
    assert cells is not None


def test_what_is_compiled_from_sources_that_have_changed_since_is_not_used(tmp_path, monkeypatch) -> None:
    """As after an update that was not installed: it would be handed what it does not know."""
    if compiled.IS_COMPILED:
        assert not are_cells_stale(cells)
    older, earliest = SimpleNamespace(SOURCES=1), SimpleNamespace()
    for module in (older, earliest):
        assert compiled.is_stale(module, "_search.c", "search.c")
        assert are_cells_stale(module)
    monkeypatch.setattr(compiled, "__file__", str(tmp_path / "compiled.py"))
    assert not compiled.is_stale(older, "_search.c", "search.c")


@pytest.mark.parametrize("name", ["_frames", "_search"])
def test_one_stale_part_leaves_all_to_numpy(name, monkeypatch) -> None:
    monkeypatch.setattr(bank, name, SimpleNamespace(SOURCES=1, is_sgemm=bool), raising=False)
    spec = spec_from_file_location("compiled_anew", compiled.__file__)
    anew = module_from_spec(spec)
    spec.loader.exec_module(anew)
    assert not anew.IS_COMPILED


def test_only_blas_as_it_is_called_is_taken() -> None:
    if compiled.IS_COMPILED:
        assert compiled.search.is_sgemm(cython_blas.__pyx_capi__["sgemm"])
        for other in (cython_blas.__pyx_capi__["dgemm"], datetime.datetime_CAPI, None, 3):
            assert not compiled.search.is_sgemm(other)


def test_the_energy_is_the_sum_of_squares_and_none_of_what_is_not_sound() -> None:
    random = np.random.default_rng(0)
    difference, noise = random.normal(size=2 * N_CHANNELS)[::2], random.uniform(0.1, 2, N_CHANNELS)
    found = compiled_search.energy(difference, noise)
    if not compiled.IS_COMPILED:
        assert found is None
        return
    assert found == pytest.approx(((difference / noise) ** 2).sum(), rel=1e-13)
    assert compiled_search.energy(np.full(N_CHANNELS, 1e200), noise) == np.inf
    for values, deviations in ((np.nan, 1.0), (np.inf, 1.0), (1.0, 0.0), (1.0, -1.0), (1.0, np.nan), (1.0, np.inf)):
        wrong, its_noise = difference.copy(), noise.copy()
        wrong[-1], its_noise[-1] = values, deviations
        assert compiled_search.energy(wrong, its_noise) is None
    assert compiled_search.energy(difference.astype(np.float32), noise.astype(">f8")) == pytest.approx(found, rel=1e-6)
    wrong_kinds = (
        noise[1:],
        noise.repeat(2)[::2],
        noise.astype(np.float32),
        noise.view(np.int64),
        noise.tobytes(),
        3.0,
    )
    for wrong in wrong_kinds:
        for pair in ((noise, wrong), (wrong, noise), (noise.repeat(2).astype(np.float32), wrong)):
            with pytest.raises(ValueError, match="as many float64 differences as noises"):
                compiled.search.energy(*pair)


# Rows as they come, all alike, in order, with ties, without some values, and of large ones.
KINDS = ("random", "alike", "rising", "falling", "ties", "lacking", "infinite", "empty")


def row_of(kind: str, random: np.random.Generator) -> FloatArray:
    row = random.normal(size=N_CHANNELS)
    match kind:
        case "alike":
            row[:] = row[0]
        case "rising":
            row.sort()
        case "falling":
            row = np.sort(row)[::-1]
        case "ties":
            row = row.round(random.integers(0, 2)) + 0.0
        case "lacking":
            row[random.uniform(size=N_CHANNELS) < random.uniform()] = np.nan
        case "infinite":
            row[random.uniform(size=N_CHANNELS) < 0.6] = random.choice([np.inf, -np.inf, np.nan])
        case "empty":
            row[:] = np.nan
    return row


@given(st.lists(st.sampled_from(KINDS), min_size=1, max_size=4), st.integers(0, 2**32 - 1), st.integers(-2, 2))
def test_medians_are_those_of_sorted_rows_to_the_bit(kinds: list[str], seed: int, more: int) -> None:
    """Of as many values as there are, and of a few less or more: then what is not there is in the middle or not."""
    rows = np.array([row_of(kind, np.random.default_rng((seed, i))) for i, kind in enumerate(kinds)])
    counts = (np.count_nonzero(~np.isnan(rows), axis=-1) + more).clip(0, N_CHANNELS)
    with np.errstate(invalid="ignore"):
        expected = without_compiler(compiled_frames.medians, rows, counts)
    np.testing.assert_array_equal(compiled_frames.medians(rows, counts), expected)
    if more == 0 and kinds[0] == "random":
        assert expected[0] == np.median(rows[0])


@given(st.lists(st.sampled_from(KINDS[:5]), min_size=1, max_size=2), st.integers(0, 2**32 - 1), st.integers(0, 20))
def test_largest_values_are_counted(kinds: list[str], seed: int, n_at_rail: int) -> None:
    random = np.random.default_rng(seed)
    rows = np.array([row_of(kind, random) for kind in kinds])
    rows[0, random.permutation(N_CHANNELS)[:n_at_rail]] = 9.0
    found = compiled_frames.n_largest(rows)
    assert found == without_compiler(compiled_frames.n_largest, rows)
    assert found[0] == n_at_rail or n_at_rail == 0
    assert compiled_frames.n_largest(np.full((1, N_CHANNELS), -np.inf)) == [N_CHANNELS]
    assert compiled_frames.n_largest(rows.astype(np.float32)) == without_compiler(
        compiled_frames.n_largest, rows.astype(np.float32)
    )


@given(
    st.integers(1, 2), st.integers(1, 2), st.integers(0, 2**32 - 1), st.floats(0, 1), st.sampled_from([1.0, 0.0, -1.0])
)
def test_a_frame_is_compared_as_by_numpy_to_the_bit(m: int, k: int, seed: int, lacking: float, sign: float) -> None:
    random = np.random.default_rng(seed)
    known = random.uniform(0.03, 0.3, (m, k, N_CHANNELS))
    known[random.uniform(size=known.shape) < lacking * random.integers(0, 2)] = np.nan
    frame = sign * random.uniform(0.5, 2.0) * np.nan_to_num(known[:, 0], nan=0.1) + random.normal(
        0, 0.02, (m, N_CHANNELS)
    )
    counts = np.count_nonzero(~np.isnan(known), axis=-1).ravel()
    off, medians = compiled_frames.compared(known, frame, counts)
    off_too, medians_too = without_compiler(compiled_frames.compared, known, frame, counts)
    np.testing.assert_array_equal(off, off_too)
    np.testing.assert_array_equal(medians, medians_too)
    if k == 2 and m == 1:
        np.testing.assert_array_equal(compiled_frames.compared(known[0], frame[0], counts)[0], off[0])


# Sizes of arrays, and what one of their values is.
SIZES, ODD = (
    st.sampled_from([1, 2, 3, 4, 5, 52, N_CHANNELS]),
    st.sampled_from([1.0, 0.0, 5e-324, -1e300, np.inf, np.nan]),
)


@given(SIZES, st.integers(1, 3), ODD, st.integers(0, 2**32 - 1), st.sampled_from(["<f8", ">f8", "<f4", "<i8"]))
def test_what_is_said_of_a_few_arrays_is_what_numpy_says(n: int, apart: int, odd: float, seed: int, kind: str) -> None:
    """Arrays in pieces, or of other numbers, are left to numpy."""
    random = np.random.default_rng(seed)
    values, mean, weights, reach = 3.0 * random.normal(size=(4, n * apart))[:, ::apart]
    values[random.integers(n)] = odd
    with np.errstate(all="ignore"):
        values = values.astype(kind)
        assert compiled_frames.all_finite(values) == np.isfinite(values).all()
        expected = np.count_nonzero(np.abs(values - mean) > 1.6 * reach)
        assert compiled_frames.n_beyond(values, mean, reach, 1.6) == expected
        found, expected = compiled_frames.deviation(values, mean, weights), (values - mean) @ weights
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-14 * (np.abs(values - mean) @ np.abs(weights)))
        followed = mean.copy() if apart == 1 else mean
        expected = mean + (values - mean) / 7
        compiled_frames.follow(followed, values, 7)
        np.testing.assert_array_equal(followed, expected)


@given(SIZES, st.integers(1, 13), st.booleans(), st.integers(0, 2**32 - 1), st.sampled_from(["<f8", "<f4"]))
def test_motion_is_how_far_the_last_place_is_from_those_before(n, n_places, with_tail, seed, kind) -> None:
    random = np.random.default_rng(seed)
    places, tail = tuple(random.normal(size=(n_places, n)).astype(kind)), random.normal(size=n) if with_tail else None
    found = compiled_frames.motion(places, tail)
    moved = [places[-1] - places[-1 - lag] for lag in range(1, n_places)]
    np.testing.assert_array_equal(found, np.concatenate([np.zeros(0), *moved, *([tail] if with_tail else [])]))
    np.testing.assert_array_equal(found, without_compiler(compiled_frames.motion, places, tail))


def test_at_its_reach_a_value_is_not_beyond() -> None:
    for values, expected in (([2.0, -2.0], 0), ([2.0, -2.1], 1)):
        assert compiled_frames.n_beyond(np.array(values), np.zeros(2), np.ones(2), 2.0) == expected


def test_places_of_several_lengths_are_no_motion() -> None:
    places = np.zeros(4), np.zeros(3), np.zeros(4)
    with pytest.raises(ValueError, match="inhomogeneous"):
        compiled_frames.motion(places, None)
    with pytest.raises(ValueError, match="broadcast"):
        compiled_frames.deviation(np.zeros(3), np.zeros(4), np.zeros(4))
    if compiled.IS_COMPILED:
        assert not compiled.frames.motion((), None, np.zeros(0))
        assert not compiled.frames.motion(places[:1], np.zeros(5), np.zeros(5))
        assert not compiled.frames.motion(places[:1], np.zeros(4), np.zeros(5))


def test_rows_of_other_lengths_and_kinds_are_refused() -> None:
    if not compiled.IS_COMPILED:
        return
    rows, counts, frames = np.ones((2, N_CHANNELS)), np.array([N_CHANNELS, N_CHANNELS]), compiled.frames
    wrong_rows = (rows[:, 1:], rows[:1], rows.astype(np.float32), rows.astype(np.int64), rows.repeat(2, 1)[:, ::2], b"")
    wrong_counts = (counts[:1], counts.repeat(2), counts.astype(np.int32), counts.astype(float), bytes(16), None)
    for one in wrong_rows:
        with pytest.raises(ValueError, match=r"medians are taken of \(n, 896\) float64 rows"):
            frames.medians(one, counts)
        for arguments in ((one, rows, counts, rows), (rows, one, counts, rows), (rows, rows, counts, one)):
            if one.__class__ is np.ndarray and arguments[1] is one and one.shape == (1, N_CHANNELS):
                continue
            with pytest.raises(ValueError, match=r"compared with \(m, k, 896\)"):
                frames.compared(*(array.copy() if array is rows else array for array in arguments))
    for one in wrong_counts:
        with pytest.raises(ValueError, match="as n int64 counts say"):
            frames.medians(rows, one)
        with pytest.raises(ValueError, match="int64 counts tell how many are known"):
            frames.compared(rows, rows, one, rows.copy())
    for one in (rows[:, 1:], rows.astype(np.float32), rows.astype(np.int64), bytes(7), 3.0):
        with pytest.raises(ValueError, match=r"counted in \(n, 896\) float64 rows"):
            frames.n_largest(one)
    written = rows.copy()
    written.setflags(write=False)
    with pytest.raises(ValueError, match="as many are written"):
        frames.compared(rows, rows, counts, written)
    for call, n in ((frames.medians, 2), (frames.compared, 4), (frames.deviation, 3), (frames.follow, 3)):
        with pytest.raises(TypeError, match=f"1 arguments instead of {n}"):
            call(rows)
    with pytest.raises(TypeError, match="must be real number"):
        frames.beyond(rows, rows, rows, "far")


def without_compiler(function: Callable[..., Any], *arguments: object) -> Any:
    """Return what a function returns where nothing is compiled."""
    with mock.patch.object(compiled, "IS_COMPILED", False):
        return function(*arguments)
