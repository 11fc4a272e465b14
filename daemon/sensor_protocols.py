"""Zeros of the torque sensors: what every sensor offers."""

import asyncio
from collections.abc import Iterable
from typing import Protocol, runtime_checkable

from shearloop.daemon.errors import ActionError

# The paper's ten frames take 5.4 s.
LONGEST_TARE_S = 30.0


class Tareable(Protocol):
    """A sensor with a zero."""

    def tare(self) -> None:
        """Take a new zero from what is measured from now on."""

    async def tare_and_wait(self, within_s: float) -> str | None:
        """Take a new zero and wait until it is done; return None, or why it was not taken."""


@runtime_checkable
class Adaptable(Protocol):
    """A sensor whose gain can be corrected by another sensor's torque."""

    async def adapt(self, reference: str) -> None:
        """Correct the gain by this source's torque during this grip; raises ActionError."""


async def tare_all(sensors: Iterable[Tareable], within_s: float = LONGEST_TARE_S) -> None:
    """Zero every sensor at the same time; raises ActionError with the reason of each one that was not zeroed."""
    reasons = await asyncio.gather(*(sensor.tare_and_wait(within_s) for sensor in sensors))
    if any(reasons):
        raise ActionError(" ".join(filter(None, reasons)))
