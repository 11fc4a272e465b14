import numpy as np
from numpy.typing import NDArray

SOURCES: int

def compared(
    known: NDArray[np.float64], frame: NDArray[np.float64], counts: NDArray[np.int64], off: NDArray[np.float64], /
) -> list[float]: ...
def medians(rows: NDArray[np.float64], counts: NDArray[np.int64], /) -> list[float]: ...
def n_largest(rows: NDArray[np.float64], /) -> list[int]: ...
