"""Building a bank: row by row (a row is one k), with the same bytes from any number of threads."""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from shearloop.bank.arrays import BoolArray, Float32Array, FloatArray
from shearloop.bank.bank_file import MIN_SIGNAL_NORM, BankDefinition, write_bank
from shearloop.bank.errors import BankFileError, ModelError
from shearloop.bank.forward import BatchForwardModel
from shearloop.bank.mesh import Mesh
from shearloop.bank.models import conductivity


@dataclass(frozen=True, slots=True, eq=False)
class BankRow:
    """The cells of one k: min_conductivity (S,), valid (S,), and signals (S, n), zeros where not valid."""

    min_conductivity: FloatArray
    valid: BoolArray
    signals: Float32Array


class RowSolver:
    """Solves a bank's rows on its mesh; safe to use from several threads.

    `homogeneous` are the (n,) voltages that signals are differences from.
    """

    def __init__(self, mesh: Mesh, definition: BankDefinition) -> None:
        """Prepare the forward model and solve it for the homogeneous voltages."""
        self._forward = BatchForwardModel(mesh, definition.table)
        self._mesh, self._definition = mesh, definition
        (self.homogeneous,) = self._forward.voltages(np.ones((1, len(mesh.triangles))))

    def solve(self, row: int) -> BankRow:
        """Return the cells of the k at `row`. A cell with a conductivity that is not positive is not solved."""
        k, sigmas = float(self._definition.k_grid[row]), self._definition.sigma_grid
        cells, smallest, n_solved = np.empty((len(sigmas), len(self._mesh.triangles))), np.empty(len(sigmas)), 0
        for cell, sigma in enumerate(sigmas.tolist()):
            # The next cell overwrites one that is not positive.
            cells[n_solved] = conductivity(self._mesh, self._definition.model, k, sigma)
            smallest[cell] = cells[n_solved].min()
            n_solved += smallest[cell] > 0
        valid = smallest > 0
        signals = np.zeros((len(sigmas), self._definition.table.n_channels), dtype=np.float32)
        differences = self._forward.voltages(cells[:n_solved]) - self.homogeneous
        loud = np.linalg.norm(differences, axis=1) >= MIN_SIGNAL_NORM
        valid[valid] = loud
        signals[valid] = differences[loud]
        return BankRow(smallest, valid, signals)


def build_bank(
    mesh: Mesh,
    definition: BankDefinition,
    path: Path,
    *,
    jobs: int = 1,
    elsewhere: Iterator[BankRow] | None = None,
    on_row: Callable[[int], None] = lambda _: None,
) -> None:
    """Build a bank file on the mesh of its definition.

    Rows are solved in `jobs` threads, or come in order from `elsewhere`, with the same bytes. `on_row(done)` is
    called after each. An existing bank is replaced only by a finished one. Raises GeometryError, ModelError where no
    cell is valid, and BankFileError where the bank cannot be written.
    """
    if path.is_dir():
        raise BankFileError(f"{path} is a directory; give the name of a file in it to --out")
    if path.exists() and not path.is_file():
        raise BankFileError(f"{path} is no file, and cannot hold a bank; give the name of a file to --out")
    if not path.parent.is_dir():
        raise BankFileError(f"{path}: there is no folder {path.parent}; make it or choose another --out")
    solver, total = RowSolver(mesh, definition), len(definition.k_grid)
    rows: list[BankRow] = []
    for cells in elsewhere or _solve(solver, total, jobs):
        rows.append(cells)
        on_row(len(rows))
    if not any(cells.valid.any() for cells in rows):
        why = f"no signal has a norm of {MIN_SIGNAL_NORM:g} or more"
        if (highest := max(float(cells.min_conductivity.max()) for cells in rows)) <= 0:
            why = f"the conductivity of each falls to {highest:.3g} or below, and must be above 0"
        raise ModelError(f"{path}: no cell of this bank is valid: {why}; choose other values of k and sigma")
    write_bank(
        path,
        definition,
        solver.homogeneous,
        np.stack([cells.min_conductivity for cells in rows]),
        np.stack([cells.valid for cells in rows]),
        np.stack([cells.signals for cells in rows]),
    )


def solve_row(task: tuple[Mesh, BankDefinition], row: int) -> BankRow:
    """Return the cells of a row, in any process; the solver is kept for the next row of the same bank."""
    definition = task[1]
    if definition.identity not in _solvers:
        _solvers.clear()
        _solvers[definition.identity] = RowSolver(*task)
    return _solvers[definition.identity].solve(row)


_solvers: dict[str, RowSolver] = {}


def _solve(solver: RowSolver, rows: int, jobs: int) -> Iterator[BankRow]:
    """Yield rows in order; the solver releases the interpreter's lock."""
    with ThreadPoolExecutor(min(jobs, rows)) as pool:
        try:
            yield from pool.map(solver.solve, range(rows))
        finally:
            pool.shutdown(cancel_futures=True)
