"""The forward model: from conductivity to voltages, by linear finite elements and the complete electrode model.

Cheng, Isaacson, Newell and Gisser 1989; Somersalo, Cheney and Isaacson 1992. With u the potential inside, U_e the
potential of electrode e, z_e its contact impedance and I_e the current into it, for all test functions (v, V):

    ∫ s ∇u·∇v dx + Σ_e 1/z_e ∫_e (u − U_e)(v − V_e) ds = Σ_e I_e V_e
"""

from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import reverse_cuthill_mckee
from scipy.sparse.linalg import splu
from skfem import Basis, BilinearForm, ElementTriP1, FacetBasis, LinearForm, MeshTri
from skfem.helpers import dot, grad

from shearloop.bank.arrays import FloatArray, IntArray
from shearloop.bank.channels import PAPER_TABLE, STIMULATION_CURRENT, ChannelTable
from shearloop.bank.errors import ConductivityError, GeometryError
from shearloop.bank.mesh import Mesh, Terms, rows_of_edges

# Symmetric positive definite matrices need no pivoting.
_LITTLE_FILL: Any = {"permc_spec": "MMD_AT_PLUS_A", "diag_pivot_thresh": 0.0, "options": {"SymmetricMode": True}}
# The node of zero potential; only differences of potentials leave this module.
_GROUND = 0
# The largest sum of a row as a fraction of its diagonal: rounding in differences of voltages is of that size, and the
# smallest signal in a bank is 5e-5 of the voltages.
MAX_LEAK = 1e-11


def electrode_potentials(mesh: Mesh, terms: Terms, conductivity: FloatArray, currents: FloatArray) -> FloatArray:
    """Return the (L, R) potentials of the electrodes for (T,) conductivities and (L, R) currents into them.

    `terms` are the assembled mesh's. Currents must add up to zero over the electrodes. Raises ConductivityError where
    conductivity is not positive: the matrix would be indefinite, its solution finite and meaningless.
    """
    require_positive(conductivity, len(mesh.triangles))
    n = len(mesh.nodes) + mesh.n_electrodes
    entries: Any = terms.values * np.append(conductivity, 1.0)[terms.source], (terms.rows, terms.columns)
    free = np.delete(np.arange(n), _GROUND)
    right = np.zeros((n, currents.shape[1]))
    right[-mesh.n_electrodes :] = currents
    factors = splu(sp.csc_array(entries, shape=(n, n))[free][:, free], **_LITTLE_FILL)
    return np.asarray(factors.solve(right[free])[-mesh.n_electrodes :])


class ForwardModel:
    """The n voltages of a fingertip. Raises GeometryError for a mesh with another number of electrodes than its table.

    currents (L, p) go into the electrodes in the p injections that differ by more than their sign.
    """

    def __init__(self, mesh: Mesh, table: ChannelTable = PAPER_TABLE) -> None:
        """Check the mesh and assemble."""
        if mesh.n_electrodes != table.n_electrodes:
            raise GeometryError(
                f"the mesh has {mesh.n_electrodes} electrodes, but the channel table needs {table.n_electrodes}"
            )
        self.mesh, self.table, self.terms = mesh, table, assemble(mesh)
        sink, source, self._positive, self._negative = table.electrodes.T
        # The second half of opposite injections is the first with the current reversed.
        patterns = table.n_electrodes // (2 if table.injection == "opposite" else 1)
        self._pattern = sink % patterns
        self._sign = np.where(sink < patterns, 1.0, -1.0)
        first = np.array([np.flatnonzero(sink == pattern)[0] for pattern in range(patterns)])
        self.currents = np.zeros((table.n_electrodes, patterns))
        self.currents[sink[first], np.arange(patterns)] = -STIMULATION_CURRENT
        self.currents[source[first], np.arange(patterns)] = STIMULATION_CURRENT

    def voltages(self, conductivity: FloatArray) -> FloatArray:
        """Return the (n,) voltages of (T,) conductivities of the mesh's triangles.

        Raises ConductivityError, before anything is solved, where conductivity is not positive.
        """
        return self.channels_of(electrode_potentials(self.mesh, self.terms, conductivity, self.currents))

    def channels_of(self, potentials: FloatArray) -> FloatArray:
        """Return the (…, n) voltages of the (…, L, p) potentials that `currents` raise."""
        differences: FloatArray = (
            potentials[..., self._positive, self._pattern] - potentials[..., self._negative, self._pattern]
        )
        return self._sign * differences

    def homogeneous(self) -> FloatArray:
        """Return the (n,) voltages of conductivity 1 everywhere."""
        return self.voltages(np.ones(len(self.mesh.triangles)))


class BatchForwardModel:
    """The n voltages of a fingertip for many conductivities at once; safe to use from several threads.

    The nodes are eliminated and never solved for (static condensation, Guyan 1965): an L × L matrix from potentials of
    electrodes to currents into them remains. No node is grounded, so equal potentials drive no current and the rows of
    that matrix add up to zero, up to rounding. A cell with too much rounding is solved directly. Raises GeometryError
    as `ForwardModel` does.
    """

    def __init__(self, mesh: Mesh, table: ChannelTable = PAPER_TABLE) -> None:
        """Assemble, and plan the elimination (about a tenth of a second for 5000 triangles)."""
        # The daemon imports this module, and numba takes 60 MB.
        from shearloop.bank.elimination import Elimination

        self.mesh = mesh
        self.direct = ForwardModel(mesh, table)
        place = elimination_order(mesh, self.direct.terms)
        # The node that the direct solve grounds is the last one here.
        n_nodes = len(mesh.nodes)
        place[n_nodes:] += 1
        place[place < 0] = n_nodes - 1
        self.elimination = Elimination(self.direct.terms.moved(place), n_nodes + mesh.n_electrodes, mesh.n_electrodes)

    def voltages(self, conductivities: FloatArray) -> FloatArray:
        """Return the (m, n) voltages of (m, T) conductivities of the mesh's triangles.

        The bits of one do not depend on the others. Raises ConductivityError, before anything is solved, where a
        conductivity is not positive.
        """
        for conductivity in conductivities:
            require_positive(conductivity, len(self.mesh.triangles))
        schur = self.elimination.schur_complements(conductivities)
        found = np.empty((len(conductivities), self.direct.table.n_channels))
        sound = rounding_leaks(schur) <= MAX_LEAK
        # The last electrode is grounded: only differences of potentials are wanted.
        potentials = np.zeros((int(sound.sum()), *self.direct.currents.shape))
        potentials[:, :-1] = np.linalg.solve(schur[sound, :-1, :-1], self.direct.currents[:-1])
        found[sound] = self.direct.channels_of(potentials)
        for cell in np.flatnonzero(~sound):
            found[cell] = self.direct.voltages(conductivities[cell])
        return found


def rounding_leaks(schur: FloatArray) -> FloatArray:
    """Return the largest current, of (n, L, L) matrices, that equal potentials drive, over the current of one."""
    with np.errstate(invalid="ignore", divide="ignore"):
        leaks = np.abs(schur.sum(axis=2)) / np.einsum("nii->ni", schur)
        return np.asarray(np.where((leaks >= 0).all(axis=1), leaks.max(axis=1), np.inf))


def require_positive(conductivity: FloatArray, n_triangles: int) -> None:
    """Raise ConductivityError unless there is one finite, positive conductivity for every triangle."""
    if conductivity.shape != (n_triangles,):
        raise ConductivityError(f"there are {n_triangles} triangles, but conductivities of shape {conductivity.shape}")
    if not np.isfinite(conductivity).all():
        raise ConductivityError("the conductivity is not finite everywhere")
    if conductivity.min() <= 0:
        raise ConductivityError(
            f"the conductivity is not positive everywhere: its smallest value is {conductivity.min():.6g}, "
            f"and {int((conductivity <= 0).sum())} of {n_triangles} triangles are at or below 0"
        )


@BilinearForm
def _stiffness(u, v, _):  # type: ignore[no-untyped-def]  # skfem carries no types
    return dot(grad(u), grad(v))


@BilinearForm
def _mass(u, v, w):  # type: ignore[no-untyped-def]  # as above
    return u * v / w.z


@LinearForm
def _load(v, w):  # type: ignore[no-untyped-def]  # as above
    return v / w.z


def assemble(mesh: Mesh) -> Terms:
    """Return the terms ∫∇u·∇v of every triangle, then the contacts' terms, with the electrodes after the nodes."""
    domain = MeshTri(mesh.nodes.T.copy(), mesh.triangles.T.copy())
    inside = _stiffness.coo_data(Basis(domain, ElementTriP1(), intorder=0))
    n_triangles = len(mesh.triangles)
    stiffness = Terms(inside.indices[0], inside.indices[1], inside.data, np.tile(np.arange(n_triangles), 9))

    electrode_edges, facets = np.sort(mesh.electrode_edges, axis=1), domain.facets.T.astype(np.int64)
    numbers = rows_of_edges(electrode_edges, facets, len(mesh.nodes))
    edges = FacetBasis(domain, ElementTriP1(), facets=numbers, intorder=2)
    impedance = mesh.contact_impedance[mesh.electrode_of_edge]
    z = np.repeat(impedance[:, None], edges.dx.shape[1], axis=1)
    mass, load = _mass.coo_data(edges, z=z), _load.coo_data(edges, z=z)
    node = load.indices[0]
    electrode = len(mesh.nodes) + np.tile(mesh.electrode_of_edge, 3)
    contact = Terms(
        np.concatenate([mass.indices[0], node, electrode, electrode]),
        np.concatenate([mass.indices[1], electrode, node, electrode]),
        # An edge's functions add up to 1, so its loads add up to its length over z.
        np.concatenate([mass.data, -load.data, -load.data, load.data]),
        np.full(len(mass.data) + 3 * len(load.data), n_triangles),
    )
    # The third node of the triangle behind an edge has a function that vanishes on the edge.
    contact = contact.where(np.abs(contact.values) > 1e-12 * np.abs(contact.values).max())
    terms: Any = (np.concatenate(pair) for pair in zip(stiffness, contact, strict=True))
    return Terms(*terms)


def elimination_order(mesh: Mesh, terms: Terms) -> IntArray:
    """Return each unknown's place: −1 for the grounded node, then nodes in an order of little fill, then electrodes.

    Minimum degree breaks its ties by the order that it starts from: the one of three with the least fill is taken.
    """
    n, inside = len(mesh.nodes), terms.where(terms.source < len(mesh.triangles))
    laplacian = sp.csc_array((inside.values, (inside.rows, inside.columns)), shape=(n, n))
    free = np.delete(np.arange(n), _GROUND)
    grounded = sp.csc_array(laplacian[free][:, free])
    narrow = reverse_cuthill_mckee(grounded.tocsr(), symmetric_mode=True)
    starts = np.arange(n - 1), narrow, narrow[::-1]
    orderings = [splu(grounded[start][:, start], **_LITTLE_FILL) for start in starts]
    best = int(np.argmin([ordering.L.nnz for ordering in orderings]))
    place = np.full(n + mesh.n_electrodes, -1, dtype=np.int64)
    place[free[starts[best]]] = orderings[best].perm_c
    place[n:] = n - 1 + np.arange(mesh.n_electrodes)
    return place
