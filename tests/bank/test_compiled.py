"""Whether what can be compiled has been, where it could be: without that it would be slow and nobody would know."""

import datetime
import shutil
import sysconfig
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.linalg import cython_blas

from bank import compiled
from bank.channels import N_CHANNELS
from drivers.compiled import cells
from drivers.compiled import is_stale as are_cells_stale


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


def test_only_blas_as_it_is_called_is_taken() -> None:
    if compiled.IS_COMPILED:
        assert compiled._search.is_sgemm(cython_blas.__pyx_capi__["sgemm"])
        for other in (cython_blas.__pyx_capi__["dgemm"], datetime.datetime_CAPI, None, 3):
            assert not compiled._search.is_sgemm(other)


def test_the_energy_is_the_sum_of_squares_and_none_of_what_is_not_sound() -> None:
    random = np.random.default_rng(0)
    difference, noise = random.normal(size=2 * N_CHANNELS)[::2], random.uniform(0.1, 2, N_CHANNELS)
    found = compiled.energy(difference, noise)
    if not compiled.IS_COMPILED:
        assert found is None
        return
    assert found == pytest.approx(((difference / noise) ** 2).sum(), rel=1e-13)
    assert compiled.energy(np.full(N_CHANNELS, 1e200), noise) == np.inf
    for values, deviations in ((np.nan, 1.0), (np.inf, 1.0), (1.0, 0.0), (1.0, -1.0), (1.0, np.nan), (1.0, np.inf)):
        wrong, its_noise = difference.copy(), noise.copy()
        wrong[-1], its_noise[-1] = values, deviations
        assert compiled.energy(wrong, its_noise) is None
