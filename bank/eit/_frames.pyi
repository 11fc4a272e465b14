from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

SOURCES: int

class Fingertips:
    def __init__(
        self,
        n_sides: int,
        n_directions: int,
        n_moves: int,
        arrays: tuple[NDArray[Any], ...],
        fewest_at_rail: int,
        fewest_compared: int,
        largest_deviation: float,
        lost_share: float,
        small_v: float,
        /,
    ) -> None: ...
    def check(
        self,
        frame: NDArray[np.float64],
        told: NDArray[np.bool_],
        lost: NDArray[np.bool_],
        before: NDArray[np.float64],
        /,
    ) -> list[int] | None: ...
    def fill_in(self, channels: NDArray[np.float64], before: NDArray[np.float64], /) -> None: ...
    def placed(
        self,
        frame: NDArray[np.float64],
        usable: NDArray[np.bool_],
        idle: NDArray[np.float64],
        gains: NDArray[np.float64],
        difference: NDArray[np.float64],
        places: NDArray[np.float64],
        /,
    ) -> list[float] | None: ...
    def __reduce__(self) -> tuple[type[Self], tuple[Any, ...]]: ...

def all_finite(values: NDArray[np.float64], /) -> bool | None: ...
def beyond(
    values: NDArray[np.float64], centre: NDArray[np.float64], reach: NDArray[np.float64], times: float, /
) -> int | None: ...
def deviation(
    values: NDArray[np.float64], mean: NDArray[np.float64], weights: NDArray[np.float64], /
) -> float | None: ...
def follow(mean: NDArray[np.float64], values: NDArray[np.float64], n: int, /) -> bool | None: ...
def compared(
    known: NDArray[np.float64], frame: NDArray[np.float64], counts: NDArray[np.int64], off: NDArray[np.float64], /
) -> list[float]: ...
def medians(rows: NDArray[np.float64], counts: NDArray[np.int64], /) -> list[float]: ...
def motion(
    places: tuple[NDArray[np.float64], ...], at: NDArray[np.float64] | None, features: NDArray[np.float64], /
) -> bool: ...
def n_largest(rows: NDArray[np.float64], /) -> list[int]: ...
