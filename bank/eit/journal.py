"""The journal of an unfinished bank: its finished rows, in a file `TARGET.part` beside the target.

A mark with the bank's identity, then one record with a checksum for each row, all of one size. A record that was cut
off when the build was killed is dropped, and its row solved again.
"""

import fcntl
import hashlib
import os
import struct
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Self

import numpy as np
from numpy.typing import NDArray

from shearloop.bank.eit.bank_file import BankDefinition, unwritable
from shearloop.bank.eit.channels import N_CHANNELS
from shearloop.bank.errors import BankFileError

_MAGIC = b"\x8eSHLPART"
_RECORD = struct.Struct("<Q32s")


@dataclass(frozen=True, slots=True, eq=False)
class BankRow:
    """The cells of one k: min_conductivity (S,), valid (S,), and signals (S, 896), zeros where not valid."""

    min_conductivity: NDArray[np.float64]
    valid: NDArray[np.bool_]
    signals: NDArray[np.float32]


class RowJournal:
    """The finished rows of one bank, kept on the disk while it is built. A context manager that holds the file's lock.

    `rows` are those that an earlier build of the same bank left, and those appended since.
    """

    def __init__(self, target: Path, definition: BankDefinition, on_notice: Callable[[str], None]) -> None:
        """Say which bank the journal is for; nothing is opened yet."""
        self.path = target.with_name(f"{target.name}.part")
        self.rows: dict[int, BankRow] = {}
        self._target = target
        self._on_notice = on_notice
        self._mark = _MAGIC + bytes.fromhex(definition.identity)
        self._n_rows = len(definition.k_grid)
        self._n_cells = len(definition.sigma_grid)
        self._file: BinaryIO | None = None

    def __enter__(self) -> Self:
        """Open the journal and read what it holds; raises BankFileError where that is not possible."""
        try:
            # Neither truncated nor created exclusively: what is there is judged when the lock is ours.
            handle = os.open(self.path, os.O_RDWR | os.O_CREAT, 0o644)
        except OSError as error:
            raise unwritable(self.path, error) from error
        file = os.fdopen(handle, "r+b")
        with ExitStack() as on_error:
            on_error.callback(file.close)
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                self._resume(file)
            except BlockingIOError as error:
                raise BankFileError(
                    f"{self._target}: another build is at work on this bank; wait for it or choose another --out"
                ) from error
            except OSError as error:
                raise unwritable(self.path, error) from error
            on_error.pop_all()
        self._file = file
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the file; it stays for the next build unless it was removed."""
        if self._file is not None:
            # What could not be flushed has been reported when it was appended.
            with suppress(OSError):
                self._file.close()

    def append(self, row: int, cells: BankRow) -> None:
        """Keep a finished row; when this returns, it is on the disk. Raises BankFileError when the disk refuses it."""
        if self._file is None:
            raise BankFileError(f"{self.path}: the journal is not open")
        body = cells.min_conductivity.astype("<f8").tobytes() + cells.valid.astype("|b1").tobytes()
        body += cells.signals.astype("<f4").tobytes()
        try:
            self._file.write(_RECORD.pack(row, _checksum(row, body)) + body)
            self._file.flush()
            os.fsync(self._file.fileno())
        except OSError as error:
            raise unwritable(self.path, error) from error
        self.rows[row] = cells

    def remove(self) -> None:
        """Delete the journal: the bank is finished."""
        self.path.unlink(missing_ok=True)

    def _resume(self, file: BinaryIO) -> None:
        mark = file.read(len(self._mark))
        if mark == self._mark:
            self._read_rows(file)
            if self.rows:
                self._on_notice(f"{self.path}: taking over {len(self.rows)} of {self._n_rows} rows already solved")
        elif mark:
            if not mark.startswith(_MAGIC):
                raise BankFileError(
                    f"{self.path} is in the way: it is not the journal of an unfinished bank; move it or choose "
                    "another --out"
                )
            self._on_notice(f"{self.path}: the rows there belong to another bank and are not reused")
        end = file.tell() if mark == self._mark else 0
        file.seek(end)
        file.truncate(end)
        if end == 0:
            file.write(self._mark)
            file.flush()

    def _read_rows(self, file: BinaryIO) -> None:
        size = self._n_cells * (8 + 1 + 4 * N_CHANNELS)
        while True:
            start = file.tell()
            head, body = file.read(_RECORD.size), file.read(size)
            if len(head) == _RECORD.size and len(body) == size:
                row, checksum = _RECORD.unpack(head)
                if checksum == _checksum(row, body) and row < self._n_rows:
                    self.rows[row] = self._cells(body)
                    continue
            file.seek(start)
            return

    def _cells(self, body: bytes) -> BankRow:
        n = self._n_cells
        return BankRow(
            np.frombuffer(body, "<f8", n),
            np.frombuffer(body, "|b1", n, offset=8 * n),
            np.frombuffer(body, "<f4", n * N_CHANNELS, offset=9 * n).reshape(n, N_CHANNELS),
        )


def _checksum(row: int, body: bytes) -> bytes:
    return hashlib.sha256(row.to_bytes(8, "little") + body).digest()
