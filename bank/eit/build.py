"""Building a bank: row by row (a row is one k), in threads, and going on where an interrupted build stopped.

The finished bank has the same bytes however often the build was interrupted and however many threads took part.
"""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from shearloop.bank.eit.bank_file import MIN_SIGNAL_NORM, BankDefinition, write_bank
from shearloop.bank.eit.batch_forward import BatchForwardModel
from shearloop.bank.eit.channels import N_CHANNELS
from shearloop.bank.eit.journal import BankRow, RowJournal
from shearloop.bank.eit.mesh import Mesh
from shearloop.bank.eit.models import PLAIN, Conductivities, Variation
from shearloop.bank.errors import BankFileError, EmptyBankError

Progress = Callable[[int, int], None]
Notice = Callable[[str], None]
# Yields (row, its cells) for the rows of a bank on a mesh, in any order.
RowsSolver = Callable[[Mesh, BankDefinition, Sequence[int]], Iterator[tuple[int, BankRow]]]


class RowSolver:
    """Solves a bank's rows on its mesh, in several threads if need be.

    `homogeneous` are the (896,) voltages that signals are differences from.
    """

    def __init__(self, mesh: Mesh, definition: BankDefinition) -> None:
        """Prepare the forward model and solve it for the homogeneous voltages."""
        self._forward = BatchForwardModel(mesh)
        self._conductivities = Conductivities(mesh, definition.variation)
        self._definition = definition
        self._n_triangles = len(mesh.triangles)
        (self.homogeneous,) = self._forward.voltages(np.ones((1, len(mesh.triangles))))

    def solve(self, row: int) -> BankRow:
        """Return the cells of the k at `row`. A cell whose conductivity is not positive is not solved."""
        k, sigmas = float(self._definition.k_grid[row]), self._definition.sigma_grid
        cells, smallest, n_solved = np.empty((len(sigmas), self._n_triangles)), np.empty(len(sigmas)), 0
        for cell, sigma in enumerate(sigmas.tolist()):
            # What is not positive is written over by the next one.
            cells[n_solved] = self._conductivities.of(self._definition.model, k, sigma)
            smallest[cell] = cells[n_solved].min()
            n_solved += smallest[cell] > 0
        valid = smallest > 0
        signals = np.zeros((len(sigmas), N_CHANNELS), dtype=np.float32)
        differences = self._forward.voltages(cells[:n_solved]) - self.homogeneous
        loud = np.linalg.norm(differences, axis=1) >= MIN_SIGNAL_NORM
        valid[valid] = loud
        signals[valid] = differences[loud]
        return BankRow(smallest, valid, signals)


def build_bank(
    mesh: Mesh,
    model: str,
    k_grid: NDArray[np.float64],
    sigma_grid: NDArray[np.float64],
    path: Path,
    *,
    variation: Variation = PLAIN,
    jobs: int = 1,
    elsewhere: RowsSolver | None = None,
    on_row: Progress | None = None,
    on_notice: Notice | None = None,
) -> None:
    """Build a bank file of (K,) k and (S,) σ, taking over the finished rows of an interrupted build of the same bank.

    `on_row(done, total)` is called once at the start and after each row that is safely on the disk; `on_notice` gets
    a sentence when there is something to say. Rows are solved by `elsewhere` where that is given, else in `jobs`
    threads: with the same bytes. Raises ModelError, GeometryError, EmptyBankError where no cell is valid, and
    BankFileError where the bank cannot be written or another build is at work on it. A bank that was there before is
    replaced only by a finished one.
    """
    definition = BankDefinition(mesh.digest, model, k_grid, sigma_grid, variation)
    if path.is_dir():
        raise BankFileError(f"{path} is a directory; give the name of a file in it to --out")
    # A device or a pipe cannot be opened as a bank once all is solved.
    if path.exists() and not path.is_file():
        raise BankFileError(f"{path} is no file, and cannot hold a bank; give the name of a file to --out")
    solver = RowSolver(mesh, definition)
    with RowJournal(path, definition, on_notice or _ignore) as journal:
        total = len(definition.k_grid)
        missing = [row for row in range(total) if row not in journal.rows]
        tell = on_row or _ignore
        tell(total - len(missing), total)
        solved = _solve(solver, missing, jobs) if elsewhere is None else elsewhere(mesh, definition, missing)
        for row, cells in solved:
            journal.append(row, cells)
            tell(len(journal.rows), total)
        rows = [journal.rows[row] for row in range(total)]
        if not any(cells.valid.any() for cells in rows):
            journal.remove()
            highest = max(float(cells.min_conductivity.max()) for cells in rows)
            raise EmptyBankError(
                f"{path}: no cell of this bank is valid: {_why_empty(highest)}; choose other values of k and sigma, "
                "and of what it is `over`"
            )
        write_bank(
            path,
            definition,
            solver.homogeneous,
            np.stack([cells.min_conductivity for cells in rows]),
            np.stack([cells.valid for cells in rows]),
            np.stack([cells.signals for cells in rows]),
        )
        journal.remove()


def solve_row(task: tuple[Mesh, BankDefinition], row: int) -> BankRow:
    """Return the cells of a row, wherever this runs; the solver is kept for the next row of the same bank."""
    definition = task[1]
    if definition.identity not in _solvers:
        _solvers.clear()
        _solvers[definition.identity] = RowSolver(*task)
    return _solvers[definition.identity].solve(row)


_solvers: dict[str, RowSolver] = {}


def _solve(solver: RowSolver, rows: Sequence[int], jobs: int) -> Iterator[tuple[int, BankRow]]:
    """Yield rows as they are finished. What takes long in them leaves the interpreter to the other threads."""
    with ThreadPoolExecutor(max(1, min(jobs, len(rows)))) as pool:
        try:
            tasks = {pool.submit(solver.solve, row): row for row in rows}
            for task in as_completed(tasks):
                yield tasks.pop(task), task.result()
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def _why_empty(highest: float) -> str:
    """Return why no cell is valid, by the highest of their smallest conductivities."""
    if highest > 0:
        return f"no signal has a norm of {MIN_SIGNAL_NORM:g} or more"
    return f"the conductivity of each falls to {highest:.3g} or below, and must be above 0"


def _ignore(*_: object) -> None:
    """Tell nobody."""
