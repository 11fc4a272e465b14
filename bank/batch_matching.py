"""Matches of many recorded frames, shared by processes: threads would wait for the interpreter's lock."""

from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from bank.bank_file import Bank
from bank.fast_matching import FastMatcher, FastZeroLagMatcher
from bank.matching import FloatArray, Match, unit_magnitudes

# Long enough that sending them costs nothing, short enough that no process waits long for the last.
_FRAMES_PER_TASK = 250


class BatchMatcher:
    """Matchers of a bank in processes of their own, spawned, so that none inherits our files, threads or locks.

    Each opens the bank itself, whose pages they share, and takes about a second for it.
    """

    def __init__(self, kind: type[FastMatcher | FastZeroLagMatcher], bank: Path, processes: int) -> None:
        """Take the bank's file; raises BankFileError as `Bank.open` does."""
        # Here, and not in each process.
        Bank.open(bank)
        self._pool = ProcessPoolExecutor(processes, get_context("spawn"), initializer=_open, initargs=(kind, bank))

    def matches(self, differences: ArrayLike) -> list[Match]:
        """Return what the matcher's `matches` returns of (n, 896) differences, in their order; errors are the same."""
        frames = np.asarray(differences, dtype=np.float64)
        # Wrong input is told before any process is at work.
        unit_magnitudes(frames)
        parts = [frames[i : i + _FRAMES_PER_TASK] for i in range(0, len(frames), _FRAMES_PER_TASK)]
        return [match for part in self._pool.map(_matches, parts) for match in part]

    def __enter__(self) -> Self:
        """Return itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """End the processes."""
        self._pool.shutdown(cancel_futures=True)


_opened: list[FastMatcher | FastZeroLagMatcher] = []


def _open(kind: type[FastMatcher | FastZeroLagMatcher], bank: Path) -> None:
    _opened[:] = [kind.from_bank(Bank.open(bank))]


def _matches(frames: FloatArray) -> list[Match]:
    return _opened[0].matches(frames)
