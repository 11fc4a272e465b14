"""The forward model against EIDORS, closed forms and the symmetries of the physics."""

import numpy as np
import pytest

from shearloop.bank.channels import PAPER_TABLE, smoothed_along_channels
from shearloop.bank.errors import ConductivityError
from shearloop.bank.forward import ForwardModel, assemble, electrode_potentials
from shearloop.bank.mesh import Mesh
from shearloop.bank.models import MODELS, conductivity
from tests.fixtures.physics import rectangle, relative


def test_homogeneous_voltages_are_those_of_eidors(paper_forward, eidors):
    voltages = paper_forward.homogeneous()
    assert relative(voltages, eidors["v_homogeneous"]) < 1e-12
    assert np.abs(voltages).max() == pytest.approx(2.122496187102785, rel=1e-12)
    assert sorted(np.argsort(np.abs(voltages))[-2:].tolist()) == [115, 563]


@pytest.mark.parametrize("name", MODELS)
def test_every_conductivity_and_its_voltages_are_those_of_eidors(name, paper_mesh, paper_forward, eidors):
    solved = 0
    for stem in [n.removesuffix("_v") for n in eidors if n.startswith(name) and n.endswith("_v")]:
        for cell, smallest in enumerate(eidors[f"{stem}_min_conductivity"]):
            values = conductivity(paper_mesh, name, eidors[f"{stem}_k"][cell], eidors[f"{stem}_sigma"][cell])
            assert values.min() == pytest.approx(smallest, rel=1e-9)
            if smallest > 0:
                assert relative(paper_forward.voltages(values), eidors[f"{stem}_v"][cell]) < 1e-9
                solved += 1
    assert solved >= 1


def test_refined_meshes_give_the_voltages_of_eidors(paper_mesh, eidors):
    refined = ForwardModel(paper_mesh.refined())
    assert relative(refined.homogeneous(), eidors["v_homogeneous_refined_mesh"]) < 1e-9
    inherited = np.repeat(eidors["element_conductivity_random_0"], 4)
    expected = eidors["gaussian_derivative_random_v_refined_mesh"][0]
    assert relative(refined.voltages(inherited), expected) < 1e-9


def test_a_bar_between_two_plates_is_its_resistance_in_series_with_its_contacts():
    """Layers across the current, plates over the whole width: R = Σ h_i/(s_i w) + (z_top + z_bottom)/w."""
    width, height, columns, rows = 1.5, 2.0, 4, 6
    nodes, triangles = rectangle(columns, rows, width, height)
    bottom = np.column_stack([np.arange(columns), np.arange(1, columns + 1)])
    edges = np.vstack([bottom, bottom + rows * (columns + 1)])
    mesh = Mesh(nodes, triangles, edges, np.repeat([0, 1], columns), [0.3, 0.05])
    layer = np.minimum((nodes[triangles, 1].mean(axis=1) / height * rows).astype(int), rows - 1)
    layers = np.array([1.0, 0.2, 3.0, 7.0, 0.5, 1.0])
    potentials = electrode_potentials(mesh, assemble(mesh), layers[layer], np.array([[2.0], [-2.0]]))
    expected = np.sum(height / rows / layers) / width + (0.3 + 0.05) / width
    assert (potentials[0, 0] - potentials[1, 0]) / 2.0 == pytest.approx(expected, rel=1e-12)


def test_the_triangles_orientation_does_not_matter(fingertip, forward):
    turned = fingertip.triangles.copy()
    turned[::3] = turned[::3, ::-1]
    mesh = Mesh(
        fingertip.nodes, turned, fingertip.electrode_edges, fingertip.electrode_of_edge, fingertip.contact_impedance
    )
    assert relative(ForwardModel(mesh).homogeneous(), forward.homogeneous()) < 1e-12


def test_channels_are_differences_between_neighbours_under_opposite_injection(fingertip, forward):
    values = conductivity(fingertip, "step", 1.1, 1.0)
    voltages = forward.voltages(values)
    for channel in (0, 27, 28, 500, PAPER_TABLE.n_channels - 1):
        sink, source, positive, negative = PAPER_TABLE.electrodes[channel]
        currents = np.zeros((32, 1))
        currents[[sink, source], 0] = -5, 5
        potentials = electrode_potentials(fingertip, forward.terms, values, currents)[:, 0]
        assert voltages[channel] == pytest.approx(potentials[positive] - potentials[negative], rel=1e-11)


@pytest.mark.parametrize(
    ("value", "sentence"),
    [(0.0, "smallest value is 0, and 1 of"), (-0.5, "smallest value is -0.5"), (np.nan, "not finite")],
)
def test_a_conductivity_that_is_not_positive_is_refused_before_solving(fingertip, forward, value, sentence):
    values = np.ones(len(fingertip.triangles))
    values[11] = value
    with pytest.raises(ConductivityError, match=sentence):
        forward.voltages(values)
    with pytest.raises(ConductivityError, match=r"512 triangles, but conductivities of shape \(3,\)"):
        forward.voltages(np.ones(3))


def test_a_line_and_its_channels_are_one_another():
    frame = np.arange(1.0, PAPER_TABLE.n_channels + 1)
    line = PAPER_TABLE.line_of_channels(frame)
    assert (line[PAPER_TABLE.zero_slots] == 0).all()
    np.testing.assert_array_equal(PAPER_TABLE.channels_of_line(line), frame)
    assert line[:3].tolist() == [0.0, 1.0, 2.0], "injection 0: the pair 0-1 touches the driven electrode 0"


def test_smoothing_keeps_what_is_constant_and_spreads_a_peak_over_nine_channels():
    peak = np.zeros((2, 896))
    peak[0] = 3.0
    peak[1, 100] = 1.0
    smooth = smoothed_along_channels(peak)
    np.testing.assert_allclose(smooth[0], 3.0)
    assert np.flatnonzero(smooth[1]).tolist() == list(range(96, 105))
    assert smooth[1].sum() == pytest.approx(1.0)
    assert smooth[1, 101] / smooth[1, 100] == pytest.approx(np.exp(-0.5 / 1.8**2))
