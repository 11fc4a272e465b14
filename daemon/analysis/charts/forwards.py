"""Forward methods: time per cell of a bank against error to a converged mesh."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.peers import EIDORS_CELL_S, pyeit_solver
from shearloop.bank.arrays import FloatArray
from shearloop.bank.eit.batch_forward import BatchForwardModel
from shearloop.bank.eit.forward import ForwardModel
from shearloop.bank.eit.mesh import Mesh
from shearloop.bank.eit.models import Conductivities, conductivity
from shearloop.daemon.analysis.charts.sources import own_fingertip

MODEL = "gaussian_derivative"
# Cells all over the valid part of the paper's grid.
CELLS = ((3.2, 1.2), (3.3, 1.9), (2.2, 1.0), (1.4, 1.4), (0.8, 2.5), (4.0, 3.5))
DIRECT_SIZES_CM = (0.4, 0.2, 0.1, 0.05)
# Errors fall in proportion to the mesh size: two fine meshes tell where they go (Richardson).
CONVERGED_SIZES_CM = (0.04, 0.025)
BATCH, BATCHES = "batch of cells", 8
# What the peers' times are cited of. EIDORS' voltages there the direct solve gives to 1e-9.
PAPER_TRIANGLES = 4882
# pyEIT with warm caches on that mesh, cited where it is not installed.
PYEIT_CELL_S = 0.244


@dataclass(frozen=True, slots=True)
class Solved:
    """A forward method: ms per cell (median, fastest and slowest round), relative L2 error of the difference signal.

    What is cited was not measured here; its error is None where nobody has measured it, or it is of another model.
    """

    name: str
    family: str
    triangles: int
    cell_ms: float
    cell_low_ms: float
    cell_high_ms: float
    error: float | None
    cited: bool = False


@dataclass(frozen=True, slots=True)
class _Solver:
    name: str
    family: str
    mesh: Mesh
    solve: Callable[[], object]
    # None where another model is solved, with other signals.
    truth: FloatArray | None

    @property
    def times(self) -> int:
        """How often one call solves all cells."""
        return BATCHES if self.family.startswith(BATCH) else 1


def forwards(
    rounds: int,
    mesh: Mesh | None,
    sizes_cm: Sequence[float] = DIRECT_SIZES_CM,
    converged_cm: tuple[float, float] = CONVERGED_SIZES_CM,
) -> list[Solved]:
    """Return all forward methods: direct solves on ever finer meshes, on `mesh` too where it is given, and the peers.

    Methods take turns, so that a busy moment of the machine meets all of them alike. pyEIT solves on the mesh whose
    triangles are nearest in number to the paper's, and is cited where it is not installed; EIDORS is cited.
    """
    coarse, fine = (own_fingertip(size).mesh() for size in converged_cm)
    truth = converged(coarse, fine, converged_cm[0] / converged_cm[1])
    solvers = []
    for size in sizes_cm:
        own = own_fingertip(size).mesh()
        solvers.append(_Solver(f"direct, {size:g} cm", "direct", own, direct(own), truth))
        solvers.append(_Solver(f"batch, {size:g} cm", BATCH, own, batch(own), truth))
    if mesh is not None:
        once = mesh.refined()
        given = converged(once, once.refined(), 2.0)
        solvers.append(_Solver("direct, --mesh", "direct, the given mesh", mesh, direct(mesh), given))
        solvers.append(_Solver("batch, --mesh", f"{BATCH}, the given mesh", mesh, batch(mesh), given))
    alike = min((one.mesh for one in solvers), key=lambda mesh: abs(len(mesh.triangles) - PAPER_TRIANGLES))
    solve = pyeit(alike)
    if solve is not None:
        solvers.append(_Solver("pyEIT", "pyEIT", alike, solve, None))
    times: dict[str, list[float]] = {one.name: [] for one in solvers}
    found = []
    for turn in range(rounds):
        for one in solvers:
            begun = time.perf_counter()
            signals = one.solve()
            times[one.name].append(1e3 * (time.perf_counter() - begun) / (len(CELLS) * one.times))
            if turn == rounds - 1:
                own_ms = times[one.name]
                found.append(
                    Solved(
                        one.name, one.family, len(one.mesh.triangles), float(np.median(own_ms)), min(own_ms),
                        max(own_ms), None if one.truth is None else error_of(np.asarray(signals), one.truth),
                    )
                )  # fmt: skip
    # Where the paper's mesh was not given, nobody knows the error of what was solved on it.
    error = next((one.error for one in found if one.triangles == PAPER_TRIANGLES), None)
    found.append(_cited("EIDORS 3.10", "EIDORS", EIDORS_CELL_S, error))
    return found if solve is not None else [*found, _cited("pyEIT", "pyEIT", PYEIT_CELL_S, None)]


def _cited(name: str, family: str, cell_s: float, error: float | None) -> Solved:
    cell_ms = 1e3 * cell_s
    return Solved(f"{name} (cited)", family, PAPER_TRIANGLES, cell_ms, cell_ms, cell_ms, error, cited=True)


def pyeit(mesh: Mesh) -> Callable[[], object] | None:
    """Return what solves the cells by pyEIT, with point electrodes, one after the other; None where it is not there."""
    solve = pyeit_solver(mesh)
    if solve is None:
        return None
    of = Conductivities(mesh)
    cells = [of.of(MODEL, k, s) for k, s in CELLS]
    return lambda: [solve(cell) for cell in cells]


def batch(mesh: Mesh) -> Callable[[], FloatArray]:
    """Return what solves the same signals all at once, as `bank build` does."""
    model, of = BatchForwardModel(mesh), Conductivities(mesh)
    (homogeneous,) = model.voltages(np.ones((1, len(mesh.triangles))))
    # Several cells go through the elimination together; six alone would pay for lanes that are empty.
    cells = np.array([of.of(MODEL, k, s) for k, s in CELLS])
    many = np.resize(np.arange(len(CELLS)), BATCHES * len(CELLS))
    return lambda: (model.voltages(cells[many]) - homogeneous)[: len(CELLS)]


def direct(mesh: Mesh) -> Callable[[], FloatArray]:
    """Return what solves the (m, 896) difference signals of the cells on a mesh."""
    model = ForwardModel(mesh)
    homogeneous = model.homogeneous()
    return lambda: np.array([model.voltages(conductivity(mesh, MODEL, k, s)) - homogeneous for k, s in CELLS])


def converged(coarse: Mesh, fine: Mesh, ratio: float) -> FloatArray:
    """Return the signals that two meshes point to, the first `ratio` times as coarse, with an error of first order."""
    first, second = direct(coarse)(), direct(fine)()
    return np.asarray(second + (second - first) / (ratio - 1.0))


def error_of(signals: FloatArray, truth: FloatArray) -> float:
    """Return the median over the cells of ‖signal − truth‖ / ‖truth‖."""
    return float(np.median(np.linalg.norm(signals - truth, axis=1) / np.linalg.norm(truth, axis=1)))
