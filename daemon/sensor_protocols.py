"""Zeros of the torque sensors: what every sensor offers."""

import asyncio
from collections.abc import Iterable
from typing import Protocol, runtime_checkable

# The paper's ten frames take 5.4 s.
LONGEST_TARE_S = 30.0


class Tareable(Protocol):
    """A sensor with a zero."""

    def tare(self) -> None:
        """Take a new zero from what is measured from now on."""

    async def tare_and_wait(self, within_s: float) -> str:
        """Take a new zero and wait until it is done; return the reason of a failure, else an empty text."""


@runtime_checkable
class Adaptable(Protocol):
    """A sensor whose gain can be corrected by another sensor's torque."""

    async def adapt(self, reference: str) -> str:
        """Correct the gain by this source's torque during this grip; return why not, else an empty text."""


async def tare_all(sensors: Iterable[Tareable], within_s: float = LONGEST_TARE_S) -> str:
    """Zero every sensor at the same time; return the reasons of failures, or an empty text."""
    return " ".join(filter(None, await asyncio.gather(*(sensor.tare_and_wait(within_s) for sensor in sensors))))
