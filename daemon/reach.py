"""The torques that a source can measure; only a rig with such a source loads it."""

from typing import NamedTuple


class Reach(NamedTuple):
    """The torques that a source can measure, and why no others, with the cure."""

    low_nm: float
    high_nm: float
    why: str
