"""Whether what can be compiled has been, where it could be: without that it would be slow and nobody would know."""

import shutil
import sysconfig
from pathlib import Path

import numpy as np
import pytest

from bank import compiled
from bank.channels import N_CHANNELS
from drivers.compiled import cells


@pytest.mark.skipif(
    shutil.which("cc") is None or not Path(sysconfig.get_path("include"), "Python.h").exists(),
    reason="there is no C compiler, or no Python.h",
)
def test_where_there_is_a_compiler_the_compiled_parts_are_there() -> None:
    assert compiled.IS_COMPILED
    assert cells is not None


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
