"""Building a bank: row by row (a row is one k), in processes, and going on where an interrupted build stopped.

The finished bank has the same bytes however often the build was interrupted and however many processes took part.
"""

import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context, parent_process
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bank.bank_file import MIN_SIGNAL_NORM, BankDefinition, write_bank
from bank.channels import N_CHANNELS
from bank.errors import BankFileError
from bank.forward import ForwardModel
from bank.journal import BankRow, RowJournal
from bank.mesh import Mesh
from bank.models import conductivity

Progress = Callable[[int, int], None]
Notice = Callable[[str], None]


class RowSolver:
    """Solves a bank's rows on its mesh; `homogeneous` are the (896,) voltages that signals are differences from."""

    def __init__(self, mesh: Mesh, definition: BankDefinition) -> None:
        """Assemble the forward model and solve it for the homogeneous voltages."""
        self._forward = ForwardModel(mesh)
        self._definition = definition
        self.homogeneous = self._forward.homogeneous()

    def solve(self, row: int) -> BankRow:
        """Return the cells of the k at `row`. A cell whose conductivity is not positive is not solved."""
        k, sigmas = float(self._definition.k_grid[row]), self._definition.sigma_grid
        smallest = np.empty(len(sigmas))
        valid = np.zeros(len(sigmas), dtype=np.bool_)
        signals = np.zeros((len(sigmas), N_CHANNELS), dtype=np.float32)
        for column, sigma in enumerate(sigmas.tolist()):
            cell = conductivity(self._forward.mesh, self._definition.model, k, sigma)
            smallest[column] = cell.min()
            if smallest[column] <= 0:
                continue
            difference = self._forward.voltages(cell) - self.homogeneous
            if np.linalg.norm(difference) >= MIN_SIGNAL_NORM:
                valid[column] = True
                signals[column] = difference
        return BankRow(smallest, valid, signals)


def build_bank(
    mesh: Mesh,
    model: str,
    k_grid: NDArray[np.float64],
    sigma_grid: NDArray[np.float64],
    path: Path,
    *,
    jobs: int = 1,
    on_row: Progress | None = None,
    on_notice: Notice | None = None,
) -> None:
    """Build a bank file of (K,) k and (S,) σ, taking over the finished rows of an interrupted build of the same bank.

    `on_row(done, total)` is called once at the start and after each row that is safely on the disk; `on_notice` gets
    a sentence when there is something to say. Raises ModelError, GeometryError, and BankFileError where the bank
    cannot be written or another build is at work on it. A bank that was there before is replaced only by a finished
    one.
    """
    definition = BankDefinition(mesh.digest, model, k_grid, sigma_grid)
    if path.is_dir():
        raise BankFileError(f"{path} is a directory; give the name of a file in it to --out")
    solver = RowSolver(mesh, definition)
    with RowJournal(path, definition, on_notice or _ignore) as journal:
        total = len(definition.k_grid)
        missing = [row for row in range(total) if row not in journal.rows]
        tell = on_row or _ignore
        tell(total - len(missing), total)
        alone = jobs <= 1 or len(missing) <= 1
        solved = _in_turn(solver, missing) if alone else _in_processes(mesh, definition, missing, jobs)
        for row, cells in solved:
            journal.append(row, cells)
            tell(len(journal.rows), total)
        rows = [journal.rows[row] for row in range(total)]
        write_bank(
            path,
            definition,
            solver.homogeneous,
            np.stack([cells.min_conductivity for cells in rows]),
            np.stack([cells.valid for cells in rows]),
            np.stack([cells.signals for cells in rows]),
        )
        journal.remove()


def _in_turn(solver: RowSolver, rows: Sequence[int]) -> Iterator[tuple[int, BankRow]]:
    for row in rows:
        yield row, solver.solve(row)


def _in_processes(
    mesh: Mesh, definition: BankDefinition, rows: Sequence[int], jobs: int
) -> Iterator[tuple[int, BankRow]]:
    """Yield rows as they are finished. Processes are spawned: none inherits our files, threads or locks."""
    with ProcessPoolExecutor(
        min(jobs, len(rows)), get_context("spawn"), initializer=_start_worker, initargs=(mesh, definition)
    ) as pool:
        try:
            tasks = {pool.submit(_solve_row, row): row for row in rows}
            for task in as_completed(tasks):
                yield tasks.pop(task), task.result()
        except BrokenProcessPool as error:
            raise BankFileError(
                "a process that solves rows was killed, perhaps for want of memory; build again with fewer --jobs: "
                "the finished rows are kept"
            ) from error
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


_worker: list[RowSolver] = []


def _start_worker(mesh: Mesh, definition: BankDefinition) -> None:
    # Ctrl-C reaches every process of the terminal: the parent decides what it means.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    _worker.append(RowSolver(mesh, definition))


def _end_with_parent() -> None:
    """End this process when its parent has gone, even killed: a worker waits for rows and would wait for ever."""
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _solve_row(row: int) -> BankRow:
    return _worker[0].solve(row)


def _ignore(*_: object) -> None:
    """Tell nobody."""
