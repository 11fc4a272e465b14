import numpy as np
from numpy.typing import NDArray

SOURCES: int

class Search:
    def __init__(
        self,
        basis: NDArray[np.float32],
        fine: NDArray[np.float32],
        signals: NDArray[np.float32],
        places: NDArray[np.int64],
        norms: NDArray[np.float64],
        k_of: NDArray[np.int32],
        sigma_of: NDArray[np.int32],
        overlaps: NDArray[np.float64],
        spectra: NDArray[np.float32],
        roots: NDArray[np.float32],
        levels: tuple[tuple[NDArray[np.float32], NDArray[np.int32], NDArray[np.int32]], ...],
        multiply: object,
        coarse_rank: int,
        rounding: float,
        square_rounding: float,
        tie: float,
        tie_rounding: float,
        radius: int,
        /,
    ) -> None: ...
    def match(
        self, difference: NDArray[np.float64], runner_up: bool, most_scores: int, /
    ) -> tuple[int, float, int, float] | None: ...
    def match_at_all_lags(
        self, difference: NDArray[np.float64], runner_up: bool, most_scores: int, /
    ) -> tuple[int, float, int, float] | None: ...

def energy(difference: NDArray[np.float64], noise: NDArray[np.float64], /) -> float: ...
def is_sgemm(capsule: object, /) -> bool: ...
