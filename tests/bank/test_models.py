"""The five basis models, and the averaging over triangles."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shearloop.bank.errors import ModelError
from shearloop.bank.models import MODELS, averaging_points, conductivity


def test_the_averaging_points_are_those_of_the_reference(shared):
    with np.load(shared / "reference" / "fingertip_mesh.npz") as archive:
        expected = archive["averaging_barycentric"]
    np.testing.assert_allclose(averaging_points(), expected, rtol=0, atol=1e-15)


@given(k=st.floats(0, 3), sigma=st.floats(0.3, 5))
def test_the_linear_model_averages_to_its_value_at_the_centroid(fingertip, k, sigma):
    centroid = fingertip.nodes[fingertip.triangles, 1].mean(axis=1)
    np.testing.assert_allclose(conductivity(fingertip, "linear", k, sigma), 1 + (centroid - k) / sigma, atol=1e-12)


def test_the_functions_have_the_values_of_the_equations():
    y = np.array([1.0, 2.0, 3.0])
    values = {name: model.function(y, 2.0, 0.5, 1.5) for name, model in MODELS.items()}
    np.testing.assert_array_equal(values["step"], [-0.5, -0.5, 0.5])
    np.testing.assert_array_equal(values["linear"], [-2, 0, 2])
    np.testing.assert_array_equal(values["cut_linear"], [-1, 1, 0])
    np.testing.assert_allclose(values["gaussian_derivative"], [4 * np.exp(-2), 0, -4 * np.exp(-2)])
    np.testing.assert_allclose(
        values["modulated_gaussian"], np.exp([-0.5, -0.5, -4.5]) * np.cos([1.0, 1.0, 3.0]), rtol=1e-15
    )


def test_mistakes_are_refused(fingertip):
    with pytest.raises(ModelError, match="no basis model 'square'; choose one of step, linear"):
        conductivity(fingertip, "square", 1, 1)
    with pytest.raises(ModelError, match="sigma must be above 0 for the model linear, not 0"):
        conductivity(fingertip, "linear", 1, 0)
    with pytest.raises(ModelError, match="finite"):
        conductivity(fingertip, "linear", np.nan, 1)
    assert conductivity(fingertip, "step", 1, 0).min() == 0.5


@pytest.mark.parametrize("name", MODELS)
def test_the_conductivity_is_the_mean_over_the_averaging_points(name, fingertip, paper_mesh):
    for mesh in (fingertip, paper_mesh):
        y = mesh.nodes[mesh.triangles, 1] @ averaging_points().T
        centre = (mesh.nodes[:, 1].min() + mesh.nodes[:, 1].max()) / 2
        for k, sigma in [(0.7, 0.3), (2.0, 1.1)]:
            expected = 1 + MODELS[name].function(y, k, sigma, centre).mean(axis=1)
            np.testing.assert_allclose(conductivity(mesh, name, k, sigma), expected, rtol=0, atol=1e-12)
