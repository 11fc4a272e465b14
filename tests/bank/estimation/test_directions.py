import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from shearloop.bank.estimation.novelty import _coordinates as coordinates


@given(st.integers(0, 2**32 - 1), st.integers(1, 4), st.floats(0, 0.6))
def test_coordinates_are_those_of_least_squares_by_the_usable_values(seed, n_directions, unusable_share):
    rng = np.random.default_rng(seed)
    directions = np.linalg.qr(rng.normal(size=(60, n_directions)))[0].T
    values, usable = rng.normal(size=60), rng.random(60) >= unusable_share
    found = coordinates(directions, np.where(usable, values, np.nan), usable)
    part = directions[:, usable]
    np.testing.assert_allclose(part @ part.T @ found, part @ values[usable], atol=1e-12)
