"""The circuit of the shear skin: a current source, two gauges in series, and what can go wrong with it. No I/O.

How the gauges' resistances come about is not known here: they are asked for, by the function that is passed in.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

# What an open circuit still conducts, through the insulation of its wires.
OPEN_OHM = 1e9
LEAD_OHM = 0.4
GAUGES = ("1", "2")

# The resistances of gauge 1 and gauge 2, in Ω, as the skin has them now.
Gauges = Callable[[], tuple[float, float]]


@dataclass(frozen=True, slots=True)
class Electric:
    """Currents and voltages at one time: what the source supplies, and what lies across each pair of sense wires."""

    current_a: float
    source_v: float
    v1_v: float
    v2_v: float
    compliance: bool


@dataclass(slots=True)
class Circuit:
    """Source settings, wiring and faults; `at` gives what follows from them at a time in s."""

    gauges: Gauges
    level_a: float = 0.0
    compliance_v: float = 21.0
    output_on: bool = False
    lead_ohm: float = LEAD_OHM
    swapped: bool = False
    opened: set[str] = field(default_factory=set)
    shorted: set[str] = field(default_factory=set)
    reversed: set[str] = field(default_factory=set)
    # Relative change of a gauge's resistance per second, and since when.
    _drifting: dict[str, tuple[float, float]] = field(default_factory=dict)
    _drifted: dict[str, float] = field(default_factory=dict)

    def at(self, time_s: float) -> Electric:
        """Return currents and voltages now; nothing flows while the source is off."""
        ohm = [self._resistance(name, r, time_s) for name, r in zip(GAUGES, self.gauges(), strict=True)]
        whole_ohm = sum(ohm) + self.lead_ohm
        wanted_v = self.level_a * whole_ohm
        compliance = self.output_on and abs(wanted_v) > self.compliance_v
        current_a = 0.0
        if self.output_on:
            current_a = self.compliance_v / whole_ohm if compliance else self.level_a
        v = [(-1 if name in self.reversed else 1) * r * current_a for name, r in zip(GAUGES, ohm, strict=True)]
        if self.swapped:
            v.reverse()
        return Electric(current_a, current_a * whole_ohm, v[0], v[1], compliance)

    def drift(self, gauge: str, per_s: float, time_s: float) -> None:
        """Let a gauge's resistance change by so much of itself a second from now on; what it has drifted stays."""
        self._drifted[gauge] = self._drift_at(gauge, time_s)
        self._drifting[gauge] = (per_s, time_s)

    def mend(self) -> None:
        """End every fault; a gauge that has drifted is as it was before."""
        self.swapped = False
        self.lead_ohm = LEAD_OHM
        for faults in (self.opened, self.shorted, self.reversed):
            faults.clear()
        self._drifting.clear()
        self._drifted.clear()

    def _resistance(self, gauge: str, ohm: float, time_s: float) -> float:
        if gauge in self.opened:
            return OPEN_OHM
        return 0.0 if gauge in self.shorted else ohm * (1.0 + self._drift_at(gauge, time_s))

    def _drift_at(self, gauge: str, time_s: float) -> float:
        per_s, since_s = self._drifting.get(gauge, (0.0, time_s))
        return self._drifted.get(gauge, 0.0) + per_s * (time_s - since_s)


COMMANDS = (
    "open 1|2, short 1|2, reversed 1|2, swapped, drift 1|2 SHARE_PER_S, leads OHM (the source goes into compliance), "
    "mend"
)


def befall(circuit: Circuit, text: str, time_s: float) -> None:
    """Do to the circuit what a line says; ValueError, with a sentence, for one that says nothing known."""
    match text.split():
        case ["open", ("1" | "2") as gauge]:
            circuit.opened.add(gauge)
        case ["short", ("1" | "2") as gauge]:
            circuit.shorted.add(gauge)
        case ["reversed", ("1" | "2") as gauge]:
            circuit.reversed.add(gauge)
        case ["swapped"]:
            circuit.swapped = True
        case ["drift", ("1" | "2") as gauge, share]:
            circuit.drift(gauge, _number(share, -1.0, 1.0, "a share per second"), time_s)
        case ["leads", ohm]:
            circuit.lead_ohm = _number(ohm, 0.0, OPEN_OHM, "a resistance in Ω")
        case ["mend"]:
            circuit.mend()
        case _:
            raise ValueError(f"{text!r} is no fault of the circuit; there are {COMMANDS}")


def _number(text: str, low: float, high: float, what: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not low <= value <= high:
        raise ValueError(f"{text!r} is not {what} from {low:g} to {high:g}")
    return value
