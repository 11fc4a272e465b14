"""The shear skin's instruments, emulated byte for byte around one circuit: current source, scanner, converter board."""

import asyncio
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import TypeAlias

from shearloop.drivers.emulators import number_between, scpi
from shearloop.drivers.emulators.boards import EmulatedAdcBoard
from shearloop.drivers.emulators.ports import PtyServer, SocketServer

# The conductance of an open circuit's insulation.
OPEN_OHM = 1e9
LEAD_OHM = 0.4
GAUGES = ("1", "2")
# Two conversions of one mains period each, and the reply's transfer.
ANSWER_S = 0.04
DAQ_PERIOD_S = 0.1
# The paper's noise floor, 1.6 mN, as a voltage on each of two gauges of 25 Ω at 5 mA, 0.088 /N.
NOISE_V = 0.0016 * 0.088 / 2**0.5 * 0.125

SOURCE_IDENTITY = "KEITHLEY INSTRUMENTS INC.,MODEL 6430,0874421,C27   Feb  4 2004 14:58:04/A02  /F/H"
SOURCE_NO_ERROR = '0,"No error"'
OUTPUT_IS_OFF = '+803,"Not permitted with OUTPUT off"'
NOT_MEASURED = 9.91e37
MAX_A, MAX_V = 0.105, 210.0
ELEMENTS = ("VOLT", "CURR", "RES", "TIME", "STAT")
# Of one reading over one mains period, on the ranges of 10 mA and 1 V.
SOURCE_NOISE_V, SOURCE_NOISE_A = 3e-6, 5e-9
# The status word, page 17-47: front terminals, V and I measured, I sourced; and compliance.
_STATUS = 1 << 2 | 1 << 11 | 1 << 12 | 1 << 15
_COMPLIANCE = 1 << 3

SCANNER_IDENTITY = "Agilent Technologies,34972A,MY49007321,1.16-1.12-02-02"
SCANNER_NO_ERROR = '+0,"No error"'
OVERLOAD_V = 9.9e37
OVERRANGE = 1.2

# Returns the resistances of gauge 1 and gauge 2, in Ω.
Gauges: TypeAlias = Callable[[], tuple[float, float]]
# The path of an instrument's pseudo-terminal, or host and port of its socket.
Address: TypeAlias = Path | tuple[str, int]


@dataclass(frozen=True, slots=True)
class CircuitState:
    """Current and voltages at one time: of the source, and across each pair of sense wires."""

    current_a: float
    source_v: float
    v1_v: float
    v2_v: float
    compliance: bool


CIRCUIT_COMMANDS = (
    "open 1|2, short 1|2, reversed 1|2, swapped, drift 1|2 SHARE_PER_S, leads OHM (the source goes into compliance), "
    "mend"
)


@dataclass(slots=True)
class Circuit:
    """Two gauges in series with a current source: settings, wiring and faults. Times in s are passed in."""

    gauges: Gauges
    level_a: float = 0.0
    compliance_v: float = 21.0
    output_on: bool = False
    lead_ohm: float = LEAD_OHM
    swapped: bool = False
    opened: set[str] = field(default_factory=set)
    shorted: set[str] = field(default_factory=set)
    reversed: set[str] = field(default_factory=set)
    # Relative change of a gauge's resistance per second, and its start.
    _drifting: dict[str, tuple[float, float]] = field(default_factory=dict)
    _drifted: dict[str, float] = field(default_factory=dict)

    def state(self, time_s: float) -> CircuitState:
        """Return current and voltages."""
        ohm = [self._resistance(name, r, time_s) for name, r in zip(GAUGES, self.gauges(), strict=True)]
        whole_ohm = sum(ohm) + self.lead_ohm
        compliance = self.output_on and abs(self.level_a * whole_ohm) > self.compliance_v
        current_a = 0.0
        if self.output_on:
            current_a = self.compliance_v / whole_ohm if compliance else self.level_a
        v = [(-1 if name in self.reversed else 1) * r * current_a for name, r in zip(GAUGES, ohm, strict=True)]
        if self.swapped:
            v.reverse()
        return CircuitState(current_a, current_a * whole_ohm, v[0], v[1], compliance)

    def voltages(self) -> tuple[float, float]:
        """Return the voltages of both gauges now."""
        state = self.state(time.monotonic())
        return state.v1_v, state.v2_v

    def command(self, text: str, time_s: float) -> None:
        """Apply a fault; ValueError, with a sentence, for an unknown one."""
        match text.split():
            case ["open", ("1" | "2") as gauge]:
                self.opened.add(gauge)
            case ["short", ("1" | "2") as gauge]:
                self.shorted.add(gauge)
            case ["reversed", ("1" | "2") as gauge]:
                self.reversed.add(gauge)
            case ["swapped"]:
                self.swapped = True
            case ["drift", ("1" | "2") as gauge, share]:
                per_s = number_between(share, -1.0, 1.0, "not a share per second from -1 to 1")
                self._drifted[gauge] = self._drift(gauge, time_s)
                self._drifting[gauge] = (per_s, time_s)
            case ["leads", ohm]:
                self.lead_ohm = number_between(ohm, 0.0, OPEN_OHM, "not a resistance in Ω from 0 to 1e+09")
            case ["mend"]:
                self.mend()
            case _:
                raise ValueError(f"{text!r} is no fault of the circuit; there are {CIRCUIT_COMMANDS}")

    def mend(self) -> None:
        """End every fault; a drifted gauge recovers."""
        self.swapped = False
        self.lead_ohm = LEAD_OHM
        for faults in (self.opened, self.shorted, self.reversed, self._drifting, self._drifted):
            faults.clear()

    def _resistance(self, gauge: str, ohm: float, time_s: float) -> float:
        if gauge in self.opened:
            return OPEN_OHM
        return 0.0 if gauge in self.shorted else ohm * (1.0 + self._drift(gauge, time_s))

    def _drift(self, gauge: str, time_s: float) -> float:
        per_s, since_s = self._drifting.get(gauge, (0.0, time_s))
        return self._drifted.get(gauge, 0.0) + per_s * (time_s - since_s)


class EmulatedKeithley6430(scpi.ScpiInterpreter):
    """The current source; replies as its manual (6430-901-01, sections 13 and 17) gives them."""

    def __init__(self, circuit: Circuit, seed: int = 0) -> None:
        self.circuit = circuit
        self._random = Random(seed)
        self._reset("")
        super().__init__(
            SOURCE_IDENTITY,
            {
                "*RST": self._reset,
                # Sourcing a voltage is not emulated.
                "SOURce:FUNCtion[:MODE]": scpi.accept_word("CURR", "CURRENT"),
                "SOURce:CURRent:MODE": scpi.accept_word("FIX", "FIXED"),
                "SOURce:CURRent:RANGe": scpi.accept_number(-MAX_A, MAX_A),
                "SOURce:CURRent[:LEVel][:IMMediate][:AMPLitude]": self._set_level,
                "SENSe:FUNCtion:CONCurrent": scpi.accept_word("ON", "1", "OFF", "0"),
                "SENSe:FUNCtion[:ON]": self._set_measured,
                "SENSe:VOLTage[:DC]:PROTection[:LEVel]": self._set_compliance,
                "SENSe:VOLTage[:DC]:RANGe[:UPPer]": scpi.accept_number(-MAX_V, MAX_V),
                "SENSe:VOLTage[:DC]:NPLCycles": scpi.accept_number(0.01, 10.0),
                "FORMat:ELEMents[:SENSe]": self._set_elements,
                "OUTPut[:STATe]": self._switch,
                "OUTPut[:STATe]?": lambda _: str(int(circuit.output_on)),
                "READ?": self._read,
            },
            SOURCE_NO_ERROR,
        )

    def _reset(self, _: str) -> None:
        self._measured = {"CURR"}
        self._elements = set(ELEMENTS)
        self.circuit.output_on = False
        self.circuit.level_a = 0.0
        self.circuit.compliance_v = 21.0

    def _set_level(self, text: str) -> None:
        self.circuit.level_a = scpi.parse_number(text, -MAX_A, MAX_A)

    def _set_compliance(self, text: str) -> None:
        self.circuit.compliance_v = scpi.parse_number(text, 2e-4, MAX_V)

    def _set_measured(self, text: str) -> None:
        self._measured = _parse_names(text, {"VOLT", "CURR", "RES"})

    def _set_elements(self, text: str) -> None:
        self._elements = _parse_names(text, {*ELEMENTS})

    def _switch(self, text: str) -> None:
        self.circuit.output_on = scpi.parse_boolean(text)

    def _read(self, _: str) -> str:
        if not self.circuit.output_on:
            raise scpi.ScpiError(OUTPUT_IS_OFF)
        now_s = time.monotonic()
        state = self.circuit.state(now_s)
        volts = state.source_v + self._random.gauss(0.0, SOURCE_NOISE_V)
        values = {
            "VOLT": volts if "VOLT" in self._measured else NOT_MEASURED,
            "CURR": state.current_a + self._random.gauss(0.0, SOURCE_NOISE_A),
            "RES": NOT_MEASURED,
            "TIME": now_s % 1e5,
            "STAT": float(_STATUS | (_COMPLIANCE if state.compliance else 0)),
        }
        return ",".join(f"{values[name]:+.6E}" for name in ELEMENTS if name in self._elements)


def _parse_names(text: str, allowed: set[str]) -> set[str]:
    """Return the short forms of comma-separated names, quoted or not; ScpiError for an unknown one."""
    names = {part.strip().strip("'\"").upper().removesuffix(":DC")[:4] for part in text.split(",")}
    if not names <= allowed:
        raise scpi.ScpiError(scpi.ILLEGAL_VALUE)
    return names


class EmulatedScanner(scpi.ScpiInterpreter):
    """A scanning multimeter; the first two channels of a scan are the gauges."""

    def __init__(self, circuit: Circuit, seed: int = 0) -> None:
        self._circuit = circuit
        self._random = Random(seed)
        self._reset("")
        super().__init__(
            SCANNER_IDENTITY,
            {
                "*RST": self._reset,
                "CONFigure:VOLTage:DC": self._configure,
                "[SENSe:]VOLTage:DC:NPLCycles": scpi.accept_number(0.02, 200.0),
                "ROUTe:SCAN": self._set_scan,
                "READ?": self._read,
            },
            SCANNER_NO_ERROR,
        )

    def _reset(self, _: str) -> None:
        self._range_v = 300.0
        self._channels = 0

    def _configure(self, text: str) -> None:
        self._range_v = scpi.parse_number(text.split(",", 1)[0], 0.0, 300.0)

    def _set_scan(self, text: str) -> None:
        if not (text.startswith("(@") and text.endswith(")")):
            raise scpi.ScpiError(scpi.ILLEGAL_VALUE)
        self._channels = text.count(",") + 1

    def _read(self, _: str) -> str:
        if not self._channels:
            raise scpi.ScpiError(scpi.SETTINGS_CONFLICT)
        return ",".join(self._digits(volts) for volts in self._circuit.voltages()[: self._channels])

    def _digits(self, volts: float) -> str:
        volts += self._random.gauss(0.0, NOISE_V)
        if abs(volts) > OVERRANGE * self._range_v:
            volts = OVERLOAD_V if volts > 0 else -OVERLOAD_V
        return f"{volts:+.8E}"


def play_source(
    circuit: Circuit, address: Address | None, on_port: Callable[[str], None], *, speed: float = 1.0, seed: int = 0
) -> scpi.FaultyServer:
    """Return the current source at an address; None for a new pseudo-terminal."""
    feed = EmulatedKeithley6430(circuit, seed).feed
    if isinstance(address, tuple):
        return scpi.FaultyServer(SocketServer(lambda: feed, *address, on_port=on_port, answer_s=ANSWER_S / speed))
    return scpi.FaultyServer(PtyServer(feed, address, on_port, answer_s=ANSWER_S / speed))


def play_daq(
    circuit: Circuit, address: Address | None, on_port: Callable[[str], None], *, speed: float = 1.0, seed: int = 0
) -> scpi.FaultyServer | EmulatedAdcBoard:
    """Return a scanner on a socket, or a converter board on a pseudo-terminal."""
    if isinstance(address, tuple):
        feed = EmulatedScanner(circuit, seed).feed
        return scpi.FaultyServer(SocketServer(lambda: feed, *address, on_port=on_port, answer_s=ANSWER_S / speed))
    period_s = DAQ_PERIOD_S / speed
    return EmulatedAdcBoard(
        circuit.voltages, period_s=period_s, noise_v=NOISE_V, link=address, on_port=on_port, seed=seed
    )


class SkinInstruments:
    """Current source and DAQ of one skin; `gauges` returns its resistances."""

    def __init__(
        self,
        gauges: Gauges,
        source_at: Address | None,
        daq_at: Address | None,
        *,
        on_port: Callable[[str, str], None] = lambda _device, _port: None,
        speed: float = 1.0,
        seed: int = 0,
    ) -> None:
        """Use the addresses; `on_port` receives `source` or `daq` and its address whenever it appears."""
        self.circuit = Circuit(gauges)
        self._source = play_source(
            self.circuit, source_at, lambda port: on_port("source", port), speed=speed, seed=seed
        )
        self._daq = play_daq(self.circuit, daq_at, lambda port: on_port("daq", port), speed=speed, seed=seed + 1)

    async def run(self) -> None:
        """Play until cancelled; OSError, in a group, if an address is taken."""
        async with asyncio.TaskGroup() as group:
            group.create_task(self._source.run())
            group.create_task(self._daq.run())

    def command(self, text: str) -> None:
        """Execute a command; ValueError, with a sentence, for an unknown one."""
        match text.split():
            case ["source", *words] if words:
                self._source.command(" ".join(words))
            case ["daq", *words] if words:
                self._daq.command(" ".join(words))
            case ["normal"]:
                self.circuit.mend()
                self._source.command("normal")
                self._daq.command("normal")
            case _:
                self.circuit.command(text, time.monotonic())
