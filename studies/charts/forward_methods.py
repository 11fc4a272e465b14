"""Forward methods: time per cell of a bank against error to a converged mesh."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from shearloop.bank.arrays import FloatArray
from shearloop.bank.forward import BatchForwardModel, ForwardModel
from shearloop.bank.mesh import Mesh
from shearloop.bank.models import conductivity
from shearloop.studies.charts.chart_data import own_fingertip

MODEL = "gaussian_derivative"
# Cells all over the valid part of the paper's grid.
CELLS = ((3.2, 1.2), (3.3, 1.9), (2.2, 1.0), (1.4, 1.4), (0.8, 2.5), (4.0, 3.5))
DIRECT_SIZES_CM = (0.4, 0.2, 0.1, 0.05)
# Errors fall in proportion to the mesh size: two fine meshes give the limit (Richardson extrapolation).
CONVERGED_SIZES_CM = (0.04, 0.025)
BATCH, BATCHES = "batch of cells", 8
# The mesh of the cited times. The direct solve agrees with EIDORS' voltages on it to 1e-9.
PAPER_TRIANGLES = 4882
# Seconds with warm caches on that mesh.
EIDORS_CELL_S, PYEIT_CELL_S = 0.034, 0.244


@dataclass(frozen=True, slots=True)
class SolvedForward:
    """A forward method: the median time per cell in ms, and the signals' relative L2 error.

    `cited` times were not measured here. The error is None where it is unknown.
    """

    name: str
    family: str
    triangles: int
    cell_ms: float
    error: float | None
    cited: bool = False


def forward_methods(
    rounds: int,
    mesh: Mesh | None,
    sizes_cm: Sequence[float] = DIRECT_SIZES_CM,
    converged_cm: tuple[float, float] = CONVERGED_SIZES_CM,
) -> list[SolvedForward]:
    """Return all forward methods: direct and batched solves on ever finer meshes and on `mesh`, and two cited ones.

    Methods take turns, so that a busy moment of the machine affects all alike.
    """
    coarse, fine = (own_fingertip(size).mesh() for size in converged_cm)
    truth = converged(coarse, fine, converged_cm[0] / converged_cm[1])
    meshes = [(f"{size:g} cm", "", own_fingertip(size).mesh(), truth) for size in sizes_cm]
    if mesh is not None:
        once = mesh.refined()
        meshes.append(("--mesh", ", the given mesh", mesh, converged(once, once.refined(), 2.0)))
    solvers = [
        (f"{kind}, {name}", f"{family}{given}", solved_mesh, solver(solved_mesh), true)
        for name, given, solved_mesh, true in meshes
        for kind, family, solver in (("direct", "direct", direct), ("batch", BATCH, batch))
    ]
    times_ms: dict[str, list[float]] = {name: [] for name, *_ in solvers}
    for _ in range(rounds):
        for name, _, _, solve, _ in solvers:
            begun = time.perf_counter()
            solved = len(solve())
            times_ms[name].append(1e3 * (time.perf_counter() - begun) / solved)
    found = [
        SolvedForward(
            name,
            family,
            len(solved_mesh.triangles),
            float(np.median(times_ms[name])),
            error_of(solve()[: len(CELLS)], true),
        )
        for name, family, solved_mesh, solve, true in solvers
    ]
    # EIDORS solves the same model: its error is known where the paper's mesh is given. pyEIT's electrodes are points.
    paper = next((method.error for method in found if method.triangles == PAPER_TRIANGLES), None)
    cited = (("EIDORS 3.10", "EIDORS", EIDORS_CELL_S, paper), ("pyEIT", "pyEIT", PYEIT_CELL_S, None))
    return found + [
        SolvedForward(f"{name} (cited)", family, PAPER_TRIANGLES, 1e3 * cell_s, error, cited=True)
        for name, family, cell_s, error in cited
    ]


def batch(mesh: Mesh) -> Callable[[], FloatArray]:
    """Return a function that solves the same cells several times in one batch, as `bank build` does."""
    model = BatchForwardModel(mesh)
    (homogeneous,) = model.voltages(np.ones((1, len(mesh.triangles))))
    # The elimination takes several cells at once; six alone would leave lanes empty.
    cells = np.array([conductivity(mesh, MODEL, k, s) for k, s in CELLS])
    many = np.resize(np.arange(len(CELLS)), BATCHES * len(CELLS))
    return lambda: model.voltages(cells[many]) - homogeneous


def direct(mesh: Mesh) -> Callable[[], FloatArray]:
    """Return a function that solves the cells' (m, 896) difference signals one by one."""
    model = ForwardModel(mesh)
    homogeneous = model.homogeneous()
    return lambda: np.array([model.voltages(conductivity(mesh, MODEL, k, s)) - homogeneous for k, s in CELLS])


def converged(coarse: Mesh, fine: Mesh, ratio: float) -> FloatArray:
    """Return the extrapolated signals of two meshes, the first `ratio` times as coarse, for an error of first order."""
    first, second = direct(coarse)(), direct(fine)()
    return np.asarray(second + (second - first) / (ratio - 1.0))


def error_of(signals: FloatArray, truth: FloatArray) -> float:
    """Return the median over the cells of ‖signal − truth‖ / ‖truth‖."""
    return float(np.median(np.linalg.norm(signals - truth, axis=1) / np.linalg.norm(truth, axis=1)))
