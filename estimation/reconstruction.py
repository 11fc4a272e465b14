"""The estimator that reads an image of the conductivity.

`image_matrix` is one Gauss–Newton step from the homogeneous conductivity with the NOSER prior (Cheney et al. 1990).
"""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, ClassVar, Literal, Self

import numpy as np

from shearloop.bank.arrays import FloatArray
from shearloop.bank.channels import ChannelTable
from shearloop.estimation.estimator import Estimator, Material, Quantity, Reading

if TYPE_CHECKING:
    from shearloop.bank.mesh import Mesh

_PIXELS_ALONG = 12
_STEP, _SMOOTHING = 1e-3, 0.05


@dataclass(frozen=True, eq=False)
class Reconstruction(Estimator):
    """A ridge on an image of the conductivity; image (p, c) maps a difference to pixels."""

    name: ClassVar[str] = "reconstruction"
    needs: ClassVar[Literal["bank", "mesh", ""]] = "mesh"

    image: FloatArray = field(kw_only=True)

    @classmethod
    def prepare(cls, material: Material) -> Self:
        """Return the estimator with the mesh's image."""
        if material.physics.mesh is None:
            raise ValueError("a reconstruction needs a mesh")
        return cls(material.scale, material.table, image=image_matrix(material.physics.mesh, material.table))

    def features(self, reading: Reading) -> FloatArray:
        """Return the pixels of each side."""
        return (reading.frame.difference @ self.image.T).ravel()

    def feature_width(self, _quantity: Quantity) -> int:
        """Return the number of pixels of all sides; raises ValueError for an image of other channels."""
        sides, channels = self.scale.shape
        if self.image.ndim != 2 or self.image.shape[1] != channels:
            raise ValueError(f"the image has the shape {self.image.shape}, expected pixels of {channels} channels")
        return int(sides * len(self.image))


def image_matrix(mesh: "Mesh", table: ChannelTable) -> FloatArray:
    """Return the (p, c) matrix from a difference of voltages to the change of p pixels' log conductivity.

    One Gauss–Newton step, (JᵀJ + 0.05 · diag(JᵀJ))⁻¹ Jᵀ, with J by central differences of whole pixels. Pixels are
    squares of the mesh's bounding box with at least one triangle.
    """
    # Imported here because only fitting needs it: it would slow the daemon's start.
    from shearloop.bank.forward import BatchForwardModel

    centres = mesh.nodes[mesh.triangles].mean(axis=1)
    low, high = mesh.nodes.min(axis=0), mesh.nodes.max(axis=0)
    size = float((high - low).max()) / _PIXELS_ALONG
    _, pixel = np.unique(np.floor((centres - low) / size).astype(np.int64) @ [1, 1000], return_inverse=True)
    steps = np.where(pixel == np.arange(int(pixel.max()) + 1)[:, None], _STEP, 0.0)
    up, down = np.split(BatchForwardModel(mesh, table).voltages(1.0 + np.concatenate([steps, -steps])), 2)
    jacobian = (up - down).T / (2 * _STEP)
    normal = jacobian.T @ jacobian
    return np.asarray(np.linalg.solve(normal + _SMOOTHING * np.diag(np.diag(normal)), jacobian.T))
