"""Whether what can be compiled has been, where it could be: without that it would be slow and nobody would know."""

import datetime
import runpy
import shutil
import sysconfig
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.linalg import cython_blas

from bank import compiled
from bank.channels import N_CHANNELS
from bank.stale import is_stale
from drivers.compiled import cells


@pytest.mark.skipif(
    shutil.which("cc") is None or not Path(sysconfig.get_path("include"), "Python.h").exists(),
    reason="there is no C compiler, or no Python.h",
)
def test_where_there_is_a_compiler_the_compiled_parts_are_there() -> None:
    assert compiled.IS_COMPILED
    assert cells is not None


def test_what_is_compiled_from_sources_that_have_changed_since_is_not_used(tmp_path) -> None:
    """As after an update that was not installed: it would be handed what it does not know."""
    (tmp_path / "one.c").write_bytes(b"12345")
    (tmp_path / "other.c").write_bytes(b"6789")
    # The check value of this CRC.
    assert not is_stale(SimpleNamespace(SOURCES=0xCBF43926), tmp_path, "one.c", "other.c")
    older, earliest = SimpleNamespace(SOURCES=1), SimpleNamespace()
    for module in (older, earliest):
        assert is_stale(module, tmp_path, "one.c", "other.c")
    # From a wheel come no sources.
    assert not is_stale(older, tmp_path / "elsewhere", "one.c", "other.c")


@pytest.mark.parametrize(("package", "name"), [("bank", "_search"), ("drivers", "_cells")])
def test_compiled_parts_of_other_sources_are_left_alone_where_they_are_imported(package, name, monkeypatch) -> None:
    part = pytest.importorskip(f"{package}.{name}")
    monkeypatch.setattr(part, "SOURCES", 1)
    found = runpy.run_path(str(Path(compiled.__file__).parents[1] / package / "compiled.py"))
    assert not (found["IS_COMPILED"] if package == "bank" else found["cells"])


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
