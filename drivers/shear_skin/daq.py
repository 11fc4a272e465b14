"""What reads the two voltages: the interface that the real ones share, and what they read."""

from collections.abc import AsyncGenerator, Mapping
from dataclasses import dataclass
from typing import Protocol

RATE_HZ = 10.0
PERIOD_NS = round(1e9 / RATE_HZ)


@dataclass(frozen=True, slots=True)
class Voltages:
    """The voltages across gauge 1 and gauge 2, and whether each is beyond what the instrument can measure.

    `t_mid_ns` is the middle of the conversions and `t_arrival_ns` when the numbers were there (both monotonic).
    """

    v1_v: float
    v2_v: float
    t_mid_ns: int
    t_arrival_ns: int
    over_1: bool = False
    over_2: bool = False


class Daq(Protocol):
    """Anything that reads two voltages, ten times a second."""

    @property
    def period_s(self) -> float:
        """How often a reading is to be expected."""

    def readings(self) -> AsyncGenerator[Voltages]:
        """Yield every reading, in order and for ever, whatever becomes of the instrument meanwhile.

        Iterate within `contextlib.aclosing`, so that the port is closed when the iteration is left.
        """

    def facts(self) -> Mapping[str, bool | int | float | str | Mapping[str, int] | None]:
        """Return what health tells of the instrument; counts are since the process began."""
