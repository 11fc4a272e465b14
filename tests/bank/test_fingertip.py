"""A mesh made from a fingertip's measures: where its electrodes are, and how its voltages converge."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shearloop.bank.eit.fingertip import ElectrodePlace, RectangularFingertip
from shearloop.bank.eit.forward import ForwardModel
from shearloop.bank.eit.mesh import boundary_edges, doubled_areas
from shearloop.bank.eit.models import conductivity
from shearloop.bank.errors import GeometryError

CENTRES = 0.1 + 0.4 * np.arange(8)
# A square with eight electrodes on each side, in order around it from the lower left corner.
SQUARE = RectangularFingertip(
    width_cm=3.2,
    height_cm=3.2,
    electrode_width_cm=0.2,
    contact_impedance=0.01,
    mesh_size_cm=0.2,
    electrodes=tuple(
        ElectrodePlace(side, float(centre))
        for side, centres in (
            ("left", CENTRES),
            ("top", CENTRES),
            ("right", 3.2 - CENTRES),
            ("bottom", 3.2 - CENTRES),
        )
        for centre in centres
    ),
)


def voltages(fingertip):
    """Return homogeneous voltages and a signal."""
    mesh = fingertip.mesh()
    forward = ForwardModel(mesh)
    homogeneous = forward.homogeneous()
    return homogeneous, forward.voltages(conductivity(mesh, "gaussian_derivative", 2.0, 1.0)) - homogeneous


@settings(deadline=None, max_examples=40)  # a mesh takes longer on a busy machine
@given(size=st.floats(0.1, 3), shift=st.floats(-0.06, 0.06), width=st.floats(0.05, 0.3))
def test_the_mesh_covers_the_rectangle_and_electrodes_have_their_place_and_width(size, shift, width):
    places = tuple(replace(p, centre_cm=0.25 + 0.87 * p.centre_cm + shift) for p in SQUARE.electrodes)
    tip = replace(SQUARE, height_cm=3.3, mesh_size_cm=size, electrodes=places, electrode_width_cm=width)
    mesh = tip.mesh()
    assert np.abs(doubled_areas(mesh.nodes, mesh.triangles)).sum() / 2 == pytest.approx(3.2 * 3.3, rel=1e-12)
    perimeter = mesh.nodes[boundary_edges(mesh.triangles)]
    assert np.linalg.norm(perimeter[:, 0] - perimeter[:, 1], axis=1).sum() == pytest.approx(2 * (3.2 + 3.3), rel=1e-12)
    axis = {"left": (0, 0.0), "right": (0, 3.2), "bottom": (1, 0.0), "top": (1, 3.3)}
    for electrode, place in enumerate(places):
        nodes = mesh.nodes[mesh.electrode_edges[mesh.electrode_of_edge == electrode]].reshape(-1, 2)
        fixed, at = axis[place.side]
        assert (nodes[:, fixed] == at).all()
        np.testing.assert_allclose(
            [nodes[:, 1 - fixed].min(), nodes[:, 1 - fixed].max()], tip.ends_cm(place), atol=2e-6
        )
    assert np.diff(np.unique(mesh.nodes[:, 0])).max() <= size + 1e-6


@pytest.mark.parametrize(
    ("impedance", "low", "high"),
    [
        # Contacts much better than the mesh is fine: the current crowds at the electrodes' ends like r^(-1/2), and
        # voltages, being quadratic in the solution, converge with first order.
        (0.001, 1.0, 1.35),
        # Contacts so poor that the ends are resolved: the second order of linear elements, less a logarithm.
        (1.0, 1.6, 2.05),
    ],
)
def test_voltages_and_signals_converge_at_the_rate_that_the_electrodes_ends_allow(impedance, low, high):
    sizes = (0.1, 0.05)
    truth = voltages(replace(SQUARE, contact_impedance=impedance, mesh_size_cm=0.0125))
    found = [voltages(replace(SQUARE, contact_impedance=impedance, mesh_size_cm=size)) for size in sizes]
    for which in range(2):
        errors = [np.linalg.norm(each[which] - truth[which]) for each in found]
        assert low < np.log2(errors[0] / errors[1]) < high


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        ({"width_cm": 0.0}, "width_cm must be above 0, not 0"),
        ({"contact_impedance": float("nan")}, "contact_impedance must be above 0"),
        ({"electrodes": SQUARE.electrodes[1:]}, "31 electrodes, expected 32"),
        ({"electrode_width_cm": 0.3}, "electrode 0 reaches from -0.05 to 0.25 cm on the left side"),
        (
            {"electrodes": (replace(SQUARE.electrodes[0], centre_cm=0.4), *SQUARE.electrodes[1:])},
            "electrodes 0 and 1 on the left side touch or overlap",
        ),
    ],
)
def test_measures_that_make_no_fingertip_are_refused(changed, sentence):
    with pytest.raises(GeometryError, match=sentence):
        replace(SQUARE, **changed)
