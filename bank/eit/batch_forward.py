"""The forward model for many conductivities of one mesh: the direct solve's voltages, at a fraction of its cost.

Only the electrodes' potentials are wanted, so the nodes are eliminated and never solved for (static condensation,
Guyan 1965): what is left of the finite elements is a 32 × 32 matrix from potentials of electrodes to currents into
them. No node is grounded, so raising all electrodes alike drives no current, and the rows of that matrix add up to
zero: what they add up to in truth is what rounding has done. A cell where that is too much is solved directly.
"""

import numpy as np

from shearloop.bank.arrays import FloatArray
from shearloop.bank.eit.channels import N_CHANNELS, N_ELECTRODES
from shearloop.bank.eit.elimination import Elimination
from shearloop.bank.eit.forward import ForwardModel, assemble, elimination_order, require_positive
from shearloop.bank.eit.fronts import Pattern
from shearloop.bank.eit.mesh import Mesh

# The largest sum of a row, as a share of its diagonal: rounding in 896 differences of voltages is of that size, and
# the smallest signal that a bank holds is 5e-5 of the voltages.
LARGEST_LEAK = 1e-11


class BatchForwardModel:
    """The 896 voltages of a fingertip, for many conductivities at once; safe to use from several threads.

    Raises GeometryError for a mesh that has not 32 electrodes.
    """

    def __init__(self, mesh: Mesh) -> None:
        """Assemble, and find out the steps of the elimination (about a tenth of a second for 5000 triangles)."""
        self.mesh = mesh
        self.direct = ForwardModel(mesh)
        stiffness, contact = assemble(mesh)
        n_nodes, n_triangles = len(mesh.nodes), len(mesh.triangles)
        place = elimination_order(mesh, stiffness)
        # The node that is grounded there is the last one here.
        place[n_nodes:] += 1
        place[place < 0] = n_nodes - 1
        # The factor after the triangles' is the constant 1, of the contacts.
        source = np.full(len(stiffness.values) + len(contact.values), n_triangles)
        source[: len(stiffness.values)] = np.tile(np.arange(n_triangles), 9)
        pattern = Pattern(
            place[np.concatenate([stiffness.rows, contact.rows])],
            place[np.concatenate([stiffness.columns, contact.columns])],
            np.concatenate([stiffness.values, contact.values]),
            source,
        )
        self._elimination = Elimination(pattern, n_nodes + N_ELECTRODES, N_ELECTRODES)

    def voltages(self, conductivities: FloatArray) -> FloatArray:
        """Return the (n, 896) voltages, in channel order, of (n, T) conductivities of the mesh's triangles.

        The bits of one do not depend on the others. Raises ConductivityError, before anything is solved, where a
        conductivity is not positive.
        """
        for each in conductivities:
            require_positive(each, len(self.mesh.triangles))
        schur = self._elimination.schur_complements(conductivities)
        found = np.empty((len(conductivities), N_CHANNELS))
        sound = rounding_leaks(schur) <= LARGEST_LEAK
        # The last electrode is grounded: only differences of potentials are wanted.
        potentials = np.zeros((int(sound.sum()), N_ELECTRODES, self.direct.currents.shape[1]))
        potentials[:, :-1] = np.linalg.solve(schur[sound, :-1, :-1], self.direct.currents[:-1])
        found[sound] = self.direct.channels_of(potentials)
        for cell in np.flatnonzero(~sound):
            found[cell] = self.direct.voltages(conductivities[cell])
        return found


def rounding_leaks(schur: FloatArray) -> FloatArray:
    """Return the largest current, of (n, L, L) matrices, that equal potentials drive, over that of one potential."""
    with np.errstate(invalid="ignore", divide="ignore"):
        leaks = np.abs(schur.sum(axis=2)) / np.einsum("nii->ni", schur)
        return np.asarray(np.where((leaks >= 0).all(axis=1), leaks.max(axis=1), np.inf))
