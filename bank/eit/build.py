"""Building a bank: row by row (a row is one k), in threads, resuming an interrupted build.

The finished bank has the same bytes however often the build was interrupted and with any number of threads.
"""

import fcntl
import hashlib
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np

from shearloop.bank.arrays import BoolArray, Float32Array, FloatArray
from shearloop.bank.eit.bank_file import MIN_SIGNAL_NORM, BankDefinition, unwritable, write_bank
from shearloop.bank.eit.forward import BatchForwardModel
from shearloop.bank.eit.mesh import Mesh
from shearloop.bank.eit.models import ConductivityModel
from shearloop.bank.errors import BankFileError, EmptyBankError
from shearloop.files import replace_file

_CHECKSUM_BYTES = 32


@dataclass(frozen=True, slots=True, eq=False)
class BankRow:
    """The cells of one k: min_conductivity (S,), valid (S,), and signals (S, n), zeros where not valid."""

    min_conductivity: FloatArray
    valid: BoolArray
    signals: Float32Array


# Yields (row, its cells) for the rows of a bank on a mesh, in any order.
RowsSolver = Callable[[Mesh, BankDefinition, Sequence[int]], Iterator[tuple[int, BankRow]]]


class RowSolver:
    """Solves a bank's rows on its mesh; safe to use from several threads.

    `homogeneous` are the (n,) voltages that signals are differences from.
    """

    def __init__(self, mesh: Mesh, definition: BankDefinition) -> None:
        """Prepare the forward model and solve it for the homogeneous voltages."""
        self._forward = BatchForwardModel(mesh, definition.table)
        self._conductivities = ConductivityModel(mesh)
        self._definition = definition
        self._n_triangles = len(mesh.triangles)
        (self.homogeneous,) = self._forward.voltages(np.ones((1, len(mesh.triangles))))

    def solve(self, row: int) -> BankRow:
        """Return the cells of the k at `row`. A cell whose conductivity is not positive is not solved."""
        k, sigmas = float(self._definition.k_grid[row]), self._definition.sigma_grid
        cells, smallest, n_solved = np.empty((len(sigmas), self._n_triangles)), np.empty(len(sigmas)), 0
        for cell, sigma in enumerate(sigmas.tolist()):
            # The next cell overwrites one that is not positive.
            cells[n_solved] = self._conductivities.conductivity(self._definition.model, k, sigma)
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
    elsewhere: RowsSolver | None = None,
    on_row: Callable[[int, int], None] = lambda *_: None,
    on_notice: Callable[[str], None] = lambda _: None,
) -> None:
    """Build a bank file on the mesh of its definition, resuming an interrupted build of the same bank.

    `on_row(done, total)` is called once at the start and after each row that is safely on the disk; `on_notice` gets
    sentences for the user. Rows are solved in `jobs` threads, or by `elsewhere`, with the same bytes. An existing bank
    is replaced only by a finished one. Raises GeometryError, EmptyBankError where no cell is valid, and
    BankFileError where the bank cannot be written or another build works on it.
    """
    if path.is_dir():
        raise BankFileError(f"{path} is a directory; give the name of a file in it to --out")
    if path.exists() and not path.is_file():
        raise BankFileError(f"{path} is no file, and cannot hold a bank; give the name of a file to --out")
    solver = RowSolver(mesh, definition)
    with RowJournal(path, definition) as journal:
        if journal.notice:
            on_notice(journal.notice)
        total = len(definition.k_grid)
        missing = [row for row in range(total) if row not in journal.rows]
        on_row(total - len(missing), total)
        solved = _solve(solver, missing, jobs) if elsewhere is None else elsewhere(mesh, definition, missing)
        for row, cells in solved:
            journal.append(row, cells)
            on_row(len(journal.rows), total)
        rows = [journal.rows[row] for row in range(total)]
        if not any(cells.valid.any() for cells in rows):
            journal.remove()
            highest = max(float(cells.min_conductivity.max()) for cells in rows)
            raise EmptyBankError(
                f"{path}: no cell of this bank is valid: {_why_empty(highest)}; choose other values of k and sigma"
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
    """Return the cells of a row, in any process; the solver is kept for the next row of the same bank."""
    definition = task[1]
    if definition.identity not in _solvers:
        _solvers.clear()
        _solvers[definition.identity] = RowSolver(*task)
    return _solvers[definition.identity].solve(row)


_solvers: dict[str, RowSolver] = {}


def _solve(solver: RowSolver, rows: Sequence[int], jobs: int) -> Iterator[tuple[int, BankRow]]:
    """Yield rows as they are finished; the solver releases the interpreter's lock."""
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


class RowJournal:
    """The finished rows of an unfinished bank, one file each in the folder `TARGET.part`; a context manager.

    It holds a lock on the folder. A file begins with the checksum of the bank's identity, the row and its cells, so
    that damaged rows and those of another bank are solved again. `rows` are those of earlier builds of the same bank,
    and those appended since; `notice` says to the user what became of earlier ones.
    """

    def __init__(self, target: Path, definition: BankDefinition) -> None:
        """Take the bank that the journal belongs to; nothing is opened yet."""
        self.path = target.with_name(f"{target.name}.part")
        self.rows: dict[int, BankRow] = {}
        self.notice = ""
        self._target = target
        self._definition = definition
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        """Lock the folder and read its rows; raises BankFileError where that is not possible."""
        with self._stack as on_error:
            try:
                self.path.mkdir(exist_ok=True)
                handle = os.open(self.path, os.O_RDONLY | os.O_DIRECTORY)
                on_error.callback(os.close, handle)
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                self._read_rows()
            except FileExistsError as error:
                raise self._in_the_way() from error
            except BlockingIOError as error:
                raise BankFileError(
                    f"{self._target}: another build is at work on this bank; wait for it or choose another --out"
                ) from error
            except OSError as error:
                raise unwritable(self.path, error) from error
            self._stack = on_error.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        """Release the folder; it stays for the next build unless it was removed."""
        self._stack.close()

    def append(self, row: int, cells: BankRow) -> None:
        """Write a finished row to the disk. Raises BankFileError when the disk refuses it."""
        body = cells.min_conductivity.astype("<f8").tobytes() + cells.valid.astype("|b1").tobytes()
        body += cells.signals.astype("<f4").tobytes()
        try:
            with replace_file(self.path / f"{row}.row") as file:
                file.write(self._checksum(row, body) + body)
        except OSError as error:
            raise unwritable(self.path, error) from error
        self.rows[row] = cells

    def remove(self) -> None:
        """Delete the journal of a finished bank."""
        shutil.rmtree(self.path, ignore_errors=True)

    def _read_rows(self) -> None:
        found = list(self.path.iterdir())
        if any(path.suffix not in (".row", ".tmp") for path in found):
            raise self._in_the_way()
        n, total = len(self._definition.sigma_grid), len(self._definition.k_grid)
        channels = self._definition.table.n_channels
        for row in range(total):
            path = self.path / f"{row}.row"
            content = path.read_bytes() if path.exists() else b""
            checksum, body = content[:_CHECKSUM_BYTES], content[_CHECKSUM_BYTES:]
            if checksum == self._checksum(row, body):
                self.rows[row] = BankRow(
                    np.frombuffer(body, "<f8", n),
                    np.frombuffer(body, "|b1", n, offset=8 * n),
                    np.frombuffer(body, "<f4", n * channels, offset=9 * n).reshape(n, channels),
                )
        if self.rows:
            self.notice = f"{self.path}: resuming, {len(self.rows)} of {total} rows are already solved"
        elif found:
            self.notice = f"{self.path}: its rows belong to another bank or are damaged, and are discarded"

    def _checksum(self, row: int, body: bytes) -> bytes:
        return hashlib.sha256(f"{self._definition.identity} {row} ".encode() + body).digest()

    def _in_the_way(self) -> BankFileError:
        return BankFileError(
            f"{self.path} is in the way: it is not the journal of an unfinished bank; move it or choose another --out"
        )
