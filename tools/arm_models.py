"""The models of UR arms, and the payloads that they are rated for."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from shearloop.drivers.ur.dashboard import ask_dashboard

# The rated payloads in kg of UR's data sheets, by PolyScope's major version and the dashboard's model. A model that was
# sold with several has them all, the smallest one first: no controller says which one its arm has.
_RATED_KG: Final[Mapping[int, Mapping[str, tuple[float, ...]]]] = {
    3: {"UR3": (3.0,), "UR5": (5.0,), "UR10": (10.0,)},
    5: {"UR3": (3.0,), "UR5": (5.0,), "UR10": (10.0, 12.5), "UR16": (16.0,)},
}
SMALLEST_ARM_KG: Final = min(rated_kg[0] for models in _RATED_KG.values() for rated_kg in models.values())


@dataclass(frozen=True, slots=True)
class Arm:
    """An arm's model, and the payloads in kg that it may be rated for, the smallest one first.

    Both are empty for a model that is not known, or not reported.
    """

    model: str = ""
    rated_kg: tuple[float, ...] = ()

    @property
    def rated(self) -> str:
        """The rated payload in words."""
        return f"{' or '.join(f'{kg:g}' for kg in self.rated_kg)} kg"

    def is_beyond(self, payload_kg: float | None) -> bool:
        """Return whether no arm of this model may carry a payload; NaN is a payload that is not known."""
        return payload_kg is not None and bool(self.rated_kg) and payload_kg > self.rated_kg[-1]

    def may_be_beyond(self, payload_kg: float | None) -> bool:
        """Return whether some arms of this model may not carry a payload, and others may."""
        if payload_kg is None or not self.rated_kg:
            return False
        return self.rated_kg[0] < payload_kg <= self.rated_kg[-1]


UNKNOWN_ARM: Final = Arm()


def read_arm(host: str, timeout_s: float, major: int) -> Arm:
    """Return which arm a controller has; `major` is PolyScope's major version.

    DriverError where the dashboard server does not answer.
    """
    (answer,) = ask_dashboard(host, timeout_s, ("get robot model",))
    match = re.fullmatch(r"(UR\d+)e?", answer.strip())
    if match is None:
        return UNKNOWN_ARM
    model = match[1]
    return Arm(model, _RATED_KG.get(major, {}).get(model, ()))
