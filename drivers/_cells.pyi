import numpy as np
from numpy.typing import NDArray

SOURCES: int

def read(line: bytes, zero_slots: NDArray[np.bool_], most: float, values: NDArray[np.float64], /) -> bool: ...
def look(
    channels: NDArray[np.float64],
    before: NDArray[np.float64],
    changed_in: NDArray[np.int64],
    number: int,
    full_scale: float,
    /,
) -> bool: ...
