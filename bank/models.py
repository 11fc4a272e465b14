"""The five basis models of a sheared fingertip: conductivity 1 + f(y; k, σ), y along the fingertip's height.

Trehan et al. 2025, equations (1) to (5).
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from shearloop.bank.arrays import FloatArray, IntArray
from shearloop.bank.errors import ModelError

if TYPE_CHECKING:
    from shearloop.bank.mesh import Mesh


_SUBDIVISIONS = 5
# Equal triangles share these digits of their heights, each a fraction of the fingertip's height.
_DIGITS = 12


@dataclass(frozen=True, slots=True)
class BasisModel:
    """One basis function f(y, k, σ, c), where c is half the fingertip's height, and the units of its parameters."""

    name: str
    title: str
    k_unit: str
    sigma_unit: str
    function: Callable[[FloatArray, float, float, float], FloatArray]

    @property
    def uses_sigma(self) -> bool:
        """Whether f depends on σ."""
        return self.sigma_unit != "not used"


def _step(y: FloatArray, k: float, sigma: float, c: float) -> FloatArray:  # noqa: ARG001 - all five have one signature
    return np.where(y > k, 0.5, -0.5)


def _linear(y: FloatArray, k: float, sigma: float, c: float) -> FloatArray:  # noqa: ARG001 - as above
    return (y - k) / sigma


def _cut_linear(y: FloatArray, k: float, sigma: float, c: float) -> FloatArray:
    return np.where((c - k / 2 <= y) & (y <= c + k / 2), (y - c) / sigma, 0.0)


def _gaussian_derivative(y: FloatArray, k: float, sigma: float, c: float) -> FloatArray:  # noqa: ARG001 - as above
    d = y - k
    return np.asarray(np.exp(d * d * (-0.5 / np.square(sigma))) * d * (-1 / np.square(sigma)))


def _modulated_gaussian(y: FloatArray, k: float, sigma: float, c: float) -> FloatArray:
    return np.exp(-((y - c) ** 2) / (2 * sigma**2)) * np.cos(k * (y - c))


MODELS = {
    model.name: model
    for model in (
        BasisModel("step", "Step", "cm", "not used", _step),
        BasisModel("linear", "Linear", "cm", "cm", _linear),
        BasisModel("cut_linear", "Cut linear", "cm", "cm", _cut_linear),
        BasisModel("gaussian_derivative", "Gaussian derivative", "cm", "cm", _gaussian_derivative),
        BasisModel("modulated_gaussian", "Modulated Gaussian", "rad/cm", "cm", _modulated_gaussian),
    )
}


def model_named(name: str) -> BasisModel:
    """Return a basis model; raises ModelError with the known names for an unknown one."""
    try:
        return MODELS[name]
    except KeyError:
        raise ModelError(f"there is no basis model {name!r}; choose one of {', '.join(MODELS)}") from None


def averaging_points() -> FloatArray:
    """Return the (15, 3) barycentric coordinates of the points over which f is averaged in a triangle.

    Lines parallel to the edges, through five equal parts of each, cut the triangle into 25. The points are the
    centroids of the 15 upright ones: ((3i + 1)/15, (3j + 1)/15, (3l + 1)/15) with i + j + l = 4.
    """
    n = _SUBDIVISIONS
    steps = [(i, j, n - 1 - i - j) for i in range(n) for j in range(n - i)]
    return (3.0 * np.array(steps) + 1.0) / (3 * n)


def conductivity(mesh: "Mesh", model: str, k: float, sigma: float) -> FloatArray:
    """Return the (T,) conductivity of a mesh's triangles: 1 + the mean of f over the triangle's averaging points.

    It need not be positive. Raises ModelError for an unknown model, and for parameters that it does not take.
    """
    basis = model_named(model)
    if not (np.isfinite(k) and np.isfinite(sigma)):
        raise ModelError(f"k and sigma must be finite numbers, not k = {k} and sigma = {sigma}")
    if sigma <= 0 and basis.uses_sigma:
        raise ModelError(f"sigma must be above 0 for the model {model}, not {sigma}")
    heights, alike, centre = _averaged_heights(mesh)
    shape = basis.function(heights, k, sigma, centre).sum(axis=0) / len(heights)
    values: FloatArray = (1.0 + shape)[alike]
    return values


@lru_cache(maxsize=4)
def _averaged_heights(mesh: "Mesh") -> tuple[FloatArray, IntArray, float]:
    """Return the heights (15, h) of the averaging points, the number (T,) of each triangle's, and the middle height.

    Triangles with the same heights of corners share theirs.
    """
    y = mesh.nodes[:, 1]
    # A triangle's mean does not depend on the order of its corners, nor on rounding.
    corners = np.sort(y[mesh.triangles], axis=1)
    _, first, alike = np.unique(
        np.round(corners / mesh.height_cm, _DIGITS), axis=0, return_index=True, return_inverse=True
    )
    heights = np.ascontiguousarray((corners[first] @ averaging_points().T).T)
    return heights, alike, float((y.min() + y.max()) / 2)
