"""Angles that may be decimals with a comma: YAML takes `[0,2]` for two angles, 0 and 2."""

from collections.abc import Sequence
from typing import Final

DECIMAL_POINT: Final = "if these are decimals, the decimal sign is a point: 0.2, not 0,2"


def may_be_decimals(angles_rad: Sequence[float]) -> bool:
    """Return whether angles are whole numbers, as the parts of decimals are.

    >>> may_be_decimals([0, 2]), may_be_decimals([0.2]), may_be_decimals([2])
    (True, False, False)
    """
    return len(angles_rad) > 1 and all(float(angle_rad).is_integer() for angle_rad in angles_rad)


def are_probably_decimals(angles_rad: Sequence[float]) -> bool:
    """Return whether angles are pairs of 0 and another whole number, as 0,2 and 0,3 are.

    >>> are_probably_decimals([0, 2, 0, 3]), are_probably_decimals([0, 1, 2]), are_probably_decimals([1, 2])
    (True, False, False)
    """
    return (
        may_be_decimals(angles_rad)
        and len(angles_rad) % 2 == 0
        and not any(angles_rad[::2])
        and min(angles_rad[1::2]) > 0
    )
