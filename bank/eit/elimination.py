"""Eliminating the inner unknowns of many symmetric positive matrices of one pattern, all at the same steps.

The pattern decides where entries arise and which meet, so that is planned once (`shearloop.bank.eit.fronts`); what
is left for each
matrix is arithmetic on small dense matrices, and several matrices stand side by side in memory, so that every step of
it is one of whole vector registers (`shearloop.bank.eit.tiles`).
"""

import numpy as np

from shearloop.bank.arrays import FloatArray
from shearloop.bank.eit.fronts import Pattern, plan_of
from shearloop.bank.eit.tiles import LANES, require_compiler, schur_complements

_CACHE_LINE = 64


class Elimination:
    """Eliminates all unknowns but the last `kept` of n; keeps no state between calls, and may run in several threads.

    Unknowns are eliminated in their order, but for what does not matter, so that order decides how many entries arise.
    """

    def __init__(self, pattern: Pattern, n: int, kept: int) -> None:
        """Plan it. Raises BankError where numba was told to compile nothing."""
        require_compiler()
        self._kept = kept
        self._last_factor = int(pattern.source.max())
        self._plan, self._entries = plan_of(pattern, n, kept)

    def schur_complements(self, factors: FloatArray) -> FloatArray:
        """Return what is left of n matrices, (n, kept, kept), for the (n, F) factors that their entries are made of.

        Factor F is 1. The bits of one matrix do not depend on those that it is eliminated with. A matrix that is not
        positive definite, or not to rounding, gives numbers that mean nothing, or are not finite. Raises ValueError for
        fewer factors than the pattern names: compiled code looks them up unchecked.
        """
        if factors.shape[1] < self._last_factor:
            raise ValueError(f"the pattern names factor {self._last_factor}, but there are {factors.shape[1]}")
        left = np.empty((len(factors), self._kept, self._kept))
        schur_complements(
            self._plan, np.ascontiguousarray(factors), _lanes(factors.shape[1] + 1), _lanes(self._entries), left
        )
        return left


def _lanes(entries: int) -> FloatArray:
    """Return memory for so many entries that each is one cache line, or half of one."""
    raw = np.empty(entries * LANES + _CACHE_LINE // 8)
    first = -raw.ctypes.data % _CACHE_LINE // 8
    return raw[first : first + entries * LANES].reshape(entries, LANES)
