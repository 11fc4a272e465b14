"""A mesh made from a fingertip's measures: where its electrodes are, and how its voltages converge."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shearloop.bank.channels import ChannelTable
from shearloop.bank.errors import GeometryError
from shearloop.bank.fingertip import ElectrodePlace, RectangularFingertip, RoundFingertip
from shearloop.bank.forward import ForwardModel
from shearloop.bank.mesh import boundary_edges, doubled_areas
from shearloop.bank.models import conductivity

CENTRES = 0.1 + 0.4 * np.arange(8)
SIDES = {"left": CENTRES, "top": CENTRES, "right": 3.2 - CENTRES, "bottom": 3.2 - CENTRES}
# A square with eight electrodes on each side, in order around it from the lower left corner.
SQUARE = RectangularFingertip(
    width_cm=3.2,
    height_cm=3.2,
    electrode_width_cm=0.2,
    contact_impedance=0.01,
    mesh_size_cm=0.2,
    electrodes=tuple(ElectrodePlace(side, float(centre)) for side, centres in SIDES.items() for centre in centres),
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


@pytest.mark.long
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
        ({"electrodes": SQUARE.electrodes[1:]}, "8 to 32 electrodes, not 31"),
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


def disc(size_cm, injection="adjacent"):
    return RoundFingertip(4.0, 0.05, 0.01, size_cm, tuple(22.5 * np.arange(16)), injection)


def point_electrodes(tip):
    """Return the voltages of a disc with point electrodes, from u = I/π · ln(|x − sink| / |x − source|)."""
    sink, source, positive, negative = np.deg2rad(tip.angles_deg)[tip.table.electrodes].T

    def potential(at):
        return 5 / np.pi * np.log(np.abs(np.sin((at - sink) / 2) / np.sin((at - source) / 2)))

    return potential(positive) - potential(negative)


@pytest.mark.parametrize("injection", ["adjacent", "opposite"])
def test_a_disc_has_the_voltages_of_the_closed_form(injection):
    """Narrow electrodes are nearly points; the error of linear elements falls with the mesh size."""
    expected = point_electrodes(disc(0.2, injection))
    errors = [
        np.linalg.norm(ForwardModel(tip.mesh(), tip.table).homogeneous() - expected) / np.linalg.norm(expected)
        for tip in (disc(0.2, injection), disc(0.025, injection))
    ]
    assert errors[1] < 0.0001
    assert errors[1] < 0.05 * errors[0]


@settings(deadline=None, max_examples=20)  # a mesh takes longer on a busy machine
@given(size=st.floats(0.1, 1.5), width=st.floats(0.02, 0.6), turn=st.floats(-360, 360))
def test_the_mesh_covers_the_disc_and_electrodes_have_their_place_and_width(size, width, turn):
    tip = replace(disc(size), electrode_width_cm=width, angles_deg=tuple(turn + 22.5 * np.arange(16)))
    mesh = tip.mesh()
    x, y = (mesh.nodes[np.unique(boundary_edges(mesh.triangles))] - 2.0).T
    np.testing.assert_allclose(np.hypot(x, y), 2.0)
    around = np.sort(np.arctan2(y, x))
    polygon = 2.0 * np.sin(np.diff(around, append=around[0] + 2 * np.pi)).sum()
    assert np.abs(doubled_areas(mesh.nodes, mesh.triangles)).sum() / 2 == pytest.approx(polygon, rel=1e-12)
    for electrode, centre in enumerate(np.deg2rad(tip.angles_deg)):
        nodes = mesh.nodes[mesh.electrode_edges[mesh.electrode_of_edge == electrode]].reshape(-1, 2) - 2.0
        from_centre = np.angle(np.exp(1j * (np.arctan2(nodes[:, 1], nodes[:, 0]) - centre)))
        np.testing.assert_allclose([from_centre.min(), from_centre.max()], [-width / 4, width / 4], atol=1e-6)


def test_a_disc_whose_electrodes_overlap_is_refused():
    with pytest.raises(GeometryError, match="electrodes 0 and 1 touch or overlap"):
        replace(disc(0.2), electrode_width_cm=0.8)


@pytest.mark.parametrize("table", [ChannelTable(), ChannelTable(16, "adjacent"), ChannelTable(10, "opposite")])
def test_a_channel_table_numbers_each_voltage_twice(table):
    """Twins have the same magnitude on any conductivity."""
    sink, source, positive, negative = table.electrodes.T
    assert not (table.electrodes[:, :2, None] == table.electrodes[:, None, 2:]).any()
    step = table.n_electrodes // 2 if table.injection == "opposite" else 1
    np.testing.assert_array_equal((sink + step) % table.n_electrodes, source)
    np.testing.assert_array_equal((positive + 1) % table.n_electrodes, negative)
    assert sorted(table.twins.ravel()) == list(range(table.n_channels))
    tip = RoundFingertip(4.0, 0.1, 0.01, 0.4, tuple(360 / table.n_electrodes * np.arange(table.n_electrodes)))
    mesh = tip.mesh()
    random = np.random.default_rng(1).uniform(0.5, 2.0, len(mesh.triangles))
    first, second = np.abs(ForwardModel(mesh, table).voltages(random))[table.twins]
    np.testing.assert_allclose(first, second, rtol=1e-9)


@pytest.mark.parametrize("n", [6, 15, 34])
def test_numbers_of_electrodes_that_the_board_has_not_are_refused(n):
    with pytest.raises(GeometryError, match=f"an even number of 8 to 32 electrodes, not {n}"):
        ChannelTable(n)
