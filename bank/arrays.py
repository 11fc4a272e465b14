"""The array types that signatures share, and the compiler of loops over arrays."""

from collections.abc import Callable
from typing import Any, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

FloatArray: TypeAlias = NDArray[np.float64]
Float32Array: TypeAlias = NDArray[np.float32]
IntArray: TypeAlias = NDArray[np.int64]
BoolArray: TypeAlias = NDArray[np.bool_]
_F = TypeVar("_F", bound=Callable[..., Any])


def compiled(function: _F) -> _F:
    """Compile a function, which releases the interpreter's lock; cache the result on the disk where that is possible.

    No products and sums are fused or reordered: every machine computes the same bits.
    """
    # numba takes 60 MB.
    from numba import config, njit

    # Statements that differ in the lane alone become one vector instruction.
    config.SLP_VECTORIZE = 1
    try:
        result: _F = njit(cache=True, nogil=True)(function)
    except RuntimeError:  # no folder for the cache is writable
        result = njit(nogil=True)(function)
    return result
