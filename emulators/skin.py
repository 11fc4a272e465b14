"""The shear skin's instruments, emulated byte for byte around one circuit: current source, scanner, converter board.

Source and scanner understand the SCPI commands of our driver, in their short form, and have an error queue.
"""

import asyncio
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import Protocol, TypeAlias

from shearloop.drivers.defaults import DAQ_RATE_HZ
from shearloop.emulators.boards import EmulatedBoard
from shearloop.emulators.numbers import number_between
from shearloop.emulators.ports import PtyServer, SocketServer

# The conductance of an open circuit's insulation.
OPEN_OHM = 1e9
LEAD_OHM = 0.4
GAUGES = ("1", "2")
# Two conversions of one mains period each, and the reply's transfer.
ANSWER_S = 0.04
# The paper's noise floor, 1.6 mN, as a voltage on each of two gauges of 25 Ω at 5 mA, 0.088 /N.
NOISE_V = 0.0016 * 0.088 / 2**0.5 * 0.125

SOURCE_IDENTITY = "KEITHLEY INSTRUMENTS INC.,MODEL 6430,0874421,C27   Feb  4 2004 14:58:04/A02  /F/H"
SOURCE_NO_ERROR = '0,"No error"'
OUTPUT_IS_OFF = '+803,"Not permitted with OUTPUT off"'
NOT_MEASURED = 9.91e37
MAX_A, MAX_V = 0.105, 210.0
ELEMENTS = ("VOLT", "CURR", "RES", "TIME", "STAT")
# Settings without an effect here: sourcing a voltage is not emulated.
SOURCE_IGNORES = ("SOUR:FUNC", "SOUR:CURR:MODE", "SOUR:CURR:RANG", "SENS:FUNC:CONC", "SENS:VOLT:RANG", "SENS:VOLT:NPLC")
# Of one reading over one mains period, on the ranges of 10 mA and 1 V.
SOURCE_NOISE_V, SOURCE_NOISE_A = 3e-6, 5e-9
# The status word, page 17-47: front terminals, V and I measured, I sourced; and compliance.
_STATUS = 1 << 2 | 1 << 11 | 1 << 12 | 1 << 15
_COMPLIANCE = 1 << 3

SCANNER_IDENTITY = "Agilent Technologies,34972A,MY49007321,1.16-1.12-02-02"
SCANNER_NO_ERROR = '+0,"No error"'
OVERLOAD_V = 9.9e37
OVERRANGE = 1.2

# 24 bits over ±0.512 V, at gain 4.
ADC_FULL_SCALE_V, ADC_STEP_V = 0.512, 0.512 / 2**23

MAX_LINE_BYTES = 512
MAX_ERRORS = 10
UNDEFINED_HEADER = '-113,"Undefined header"'
SETTINGS_CONFLICT = '-221,"Settings conflict"'
OUT_OF_RANGE = '-222,"Parameter data out of range"'
ILLEGAL_VALUE = '-224,"Illegal parameter value"'

# Returns the answer to a query, or None for a command; the argument is the text after the header.
Handler: TypeAlias = Callable[[str], str | None]
# The path of an instrument's pseudo-terminal, or host and port of its socket.
Address: TypeAlias = Path | tuple[str, int]


class Gauges(Protocol):
    """A skin's two gauges."""

    def resistances_ohm(self) -> tuple[float, float]:
        """Return R₁ and R₂ now."""


CIRCUIT_COMMANDS = "open 1|2, short 1|2, reversed 1|2, swapped, leads OHM (the source goes into compliance), mend"


@dataclass(slots=True)
class Circuit:
    """Two gauges in series with a current source: settings, wiring and faults."""

    gauges: Gauges
    level_a: float = 0.0
    compliance_v: float = 21.0
    output_on: bool = False
    lead_ohm: float = LEAD_OHM
    swapped: bool = False
    # Pairs of a fault, open, short or reversed, and its gauge.
    faults: set[tuple[str, str]] = field(default_factory=set)

    def source(self) -> tuple[float, float, bool]:
        """Return the source's current and voltage now, and whether it is in compliance."""
        whole_ohm = sum(self._resistances_ohm()) + self.lead_ohm
        if not self.output_on:
            return 0.0, 0.0, False
        if abs(self.level_a * whole_ohm) > self.compliance_v:
            return self.compliance_v / whole_ohm, self.compliance_v, True
        return self.level_a, self.level_a * whole_ohm, False

    def voltages(self) -> tuple[float, float]:
        """Return the voltages across each pair of sense wires now."""
        current_a, _, _ = self.source()
        signs = (-1 if ("reversed", gauge) in self.faults else 1 for gauge in GAUGES)
        v1_v, v2_v = (sign * ohm * current_a for sign, ohm in zip(signs, self._resistances_ohm(), strict=True))
        return (v2_v, v1_v) if self.swapped else (v1_v, v2_v)

    def command(self, text: str) -> None:
        """Apply a fault; ValueError, with a sentence, for an unknown one."""
        match text.split():
            case ["open" | "short" | "reversed" as fault, "1" | "2" as gauge]:
                self.faults.add((fault, gauge))
            case ["swapped"]:
                self.swapped = True
            case ["leads", ohm]:
                self.lead_ohm = number_between(ohm, 0.0, OPEN_OHM, "not a resistance in Ω from 0 to 1e+09")
            case ["mend"]:
                self.mend()
            case _:
                raise ValueError(f"{text!r} is no fault of the circuit; there are {CIRCUIT_COMMANDS}")

    def mend(self) -> None:
        """End every fault."""
        self.swapped = False
        self.lead_ohm = LEAD_OHM
        self.faults.clear()

    def _resistances_ohm(self) -> list[float]:
        return [
            OPEN_OHM if ("open", gauge) in self.faults else 0.0 if ("short", gauge) in self.faults else ohm
            for gauge, ohm in zip(GAUGES, self.gauges.resistances_ohm(), strict=True)
        ]


class ScpiError(Exception):
    """A handler's refusal; its text goes into the error queue."""


class ScpiInterpreter:
    """One instrument's interpreter of one command a line, without I/O.

    Refused commands go into the error queue and get no reply.
    """

    def __init__(self, identity: str, commands: Mapping[str, Handler], no_error: str) -> None:
        """Map headers in capitals, in their short form, to handlers."""
        self._commands: dict[str, Handler] = {
            **commands,
            "*IDN?": lambda _: identity,
            "*CLS": lambda _: self.errors.clear(),
            "SYST:ERR?": lambda _: self.errors.popleft() if self.errors else no_error,
        }
        self._buffer = b""
        self.errors: deque[str] = deque(maxlen=MAX_ERRORS)

    def feed(self, data: bytes) -> bytes:
        """Return the replies to the lines that `data` completes."""
        *lines, self._buffer = (self._buffer + data).replace(b"\r", b"\n").split(b"\n")
        self._buffer = self._buffer[-MAX_LINE_BYTES:]
        answers = [self._answer(line.decode("ascii", "replace").strip()) for line in lines if line.strip()]
        return b"".join(f"{answer}\n".encode() for answer in answers if answer is not None)

    def _answer(self, line: str) -> str | None:
        header, _, argument = line.partition(" ")
        try:
            if (handler := self._commands.get(header.upper().removeprefix(":"))) is None:
                raise ScpiError(UNDEFINED_HEADER)
            return handler(argument.strip())
        except ScpiError as error:
            self.errors.append(str(error))
        except (KeyError, ValueError):
            self.errors.append(ILLEGAL_VALUE)
        return None


def _number(text: str, low: float, high: float) -> float:
    """Return a command's number; ValueError for other text, and ScpiError for one out of range."""
    if not low <= (value := float(text)) <= high:
        raise ScpiError(OUT_OF_RANGE)
    return value


class EmulatedKeithley6430(ScpiInterpreter):
    """The current source; replies as its manual (6430-901-01, sections 13 and 17) gives them."""

    def __init__(self, circuit: Circuit, seed: int = 0) -> None:
        self.circuit = circuit
        self._random = Random(seed)
        self._reset("")
        super().__init__(
            SOURCE_IDENTITY,
            {
                "*RST": self._reset,
                **dict.fromkeys(SOURCE_IGNORES, lambda _: None),
                "SOUR:CURR": self._set_level,
                "SENS:FUNC": self._set_measured,
                "SENS:VOLT:PROT": self._set_compliance,
                "FORM:ELEM": self._set_elements,
                "OUTP": self._switch,
                "OUTP?": lambda _: str(int(circuit.output_on)),
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
        self.circuit.level_a = _number(text, -MAX_A, MAX_A)

    def _set_compliance(self, text: str) -> None:
        self.circuit.compliance_v = _number(text, 2e-4, MAX_V)

    def _set_measured(self, text: str) -> None:
        self._measured = set(text.upper().replace("'", "").split(","))

    def _set_elements(self, text: str) -> None:
        self._elements = set(text.upper().split(","))

    def _switch(self, text: str) -> None:
        self.circuit.output_on = {"ON": True, "1": True, "OFF": False, "0": False}[text.upper()]

    def _read(self, _: str) -> str:
        if not self.circuit.output_on:
            raise ScpiError(OUTPUT_IS_OFF)
        current_a, volts, compliance = self.circuit.source()
        volts += self._random.gauss(0.0, SOURCE_NOISE_V)
        values = dict.fromkeys(ELEMENTS, NOT_MEASURED) | {
            "VOLT": volts if "VOLT" in self._measured else NOT_MEASURED,
            "CURR": current_a + self._random.gauss(0.0, SOURCE_NOISE_A),
            "STAT": float(_STATUS | (_COMPLIANCE if compliance else 0)),
        }
        return ",".join(f"{values[name]:+.6E}" for name in ELEMENTS if name in self._elements)


class EmulatedScanner(ScpiInterpreter):
    """A scanning multimeter; the first two channels of a scan are the gauges."""

    def __init__(self, circuit: Circuit, seed: int = 0) -> None:
        self._circuit = circuit
        self._random = Random(seed)
        self._range_v, self._channels = 300.0, 0
        super().__init__(
            SCANNER_IDENTITY,
            {
                "CONF:VOLT:DC": self._configure,
                "VOLT:DC:NPLC": lambda _: None,
                "ROUT:SCAN": self._set_scan,
                "READ?": self._read,
            },
            SCANNER_NO_ERROR,
        )

    def _configure(self, text: str) -> None:
        self._range_v = _number(text.split(",", 1)[0], 0.0, 300.0)

    def _set_scan(self, text: str) -> None:
        if not (text.startswith("(@") and text.endswith(")")):
            raise ValueError(f"{text!r} is no list of channels")
        self._channels = text.count(",") + 1

    def _read(self, _: str) -> str:
        if not self._channels:
            raise ScpiError(SETTINGS_CONFLICT)
        return ",".join(self._digits(volts) for volts in self._circuit.voltages()[: self._channels])

    def _digits(self, volts: float) -> str:
        volts += self._random.gauss(0.0, NOISE_V)
        if abs(volts) > OVERRANGE * self._range_v:
            volts = OVERLOAD_V if volts > 0 else -OVERLOAD_V
        return f"{volts:+.8E}"


class EmulatedAdcBoard(EmulatedBoard):
    """A converter board, an ADS1220: sends a line `v1,v2` in volts for each conversion."""

    faults = ("missing", "garbage", "torn", "silence", "stuck", "unplug")

    def next_line(self, now_s: float) -> bytes:
        """Return the line that is due now, with its faults, or nothing; its converter runs on in every fault."""
        line = super().next_line(now_s)
        if self._lasting is not None:
            next(self._lines)
        return line


def adc_lines(circuit: Circuit, seed: int = 0) -> Iterator[bytes]:
    """Yield a line of the converter board, with its noise and steps, for the mean voltages since the line before."""
    random = Random(seed)
    after = circuit.voltages()
    while True:
        before, after = after, circuit.voltages()
        means = [(first + last) / 2 for first, last in zip(before, after, strict=True)]
        steps = [round((volts + random.gauss(0.0, NOISE_V)) / ADC_STEP_V) for volts in means]
        v1_v, v2_v = (min(max(step * ADC_STEP_V, -ADC_FULL_SCALE_V), ADC_FULL_SCALE_V) for step in steps)
        yield f"{v1_v:.6f},{v2_v:.6f}\r\n".encode()


class SkinInstruments:
    """Current source and DAQ of one skin: a scanner on a socket, or a converter board on a pseudo-terminal.

    An address is None for a pseudo-terminal without a name. `source_port` and `daq_port` get the path or address
    whenever it appears.
    """

    def __init__(
        self,
        gauges: Gauges,
        source_at: Address | None,
        daq_at: Address | None,
        *,
        speed: float = 1.0,
        daq_rate_hz: float = DAQ_RATE_HZ,
        seed: int = 0,
    ) -> None:
        self.circuit = Circuit(gauges)
        self.source = source = EmulatedKeithley6430(self.circuit, seed)
        answer_s = ANSWER_S / speed
        self._server: SocketServer | PtyServer = (
            SocketServer(source, *source_at, answer_s)
            if isinstance(source_at, tuple)
            else PtyServer(source, source_at, answer_s)
        )
        self.source_port = self._server.appearances
        self.daq: SocketServer | EmulatedAdcBoard
        if isinstance(daq_at, tuple):
            # Between the conversions of its two channels.
            self.daq = SocketServer(EmulatedScanner(self.circuit, seed + 1), *daq_at, answer_s, measures_at=0.5)
            self.daq_port = self.daq.appearances
        else:
            lines = adc_lines(self.circuit, seed + 1)
            self.daq = EmulatedAdcBoard(lines, period_s=1 / daq_rate_hz / speed, link=daq_at, seed=seed + 1)
            self.daq_port = self.daq.port.appearances

    async def run(self) -> None:
        """Play until cancelled; OSError, in a group, if an address is taken."""
        async with asyncio.TaskGroup() as group:
            group.create_task(self._server.run())
            group.create_task(self.daq.run())

    def command(self, text: str) -> None:
        """Execute a command; ValueError, with a sentence, for an unknown one."""
        match text.split():
            case ["source", *words] if words:
                self._server.command(" ".join(words))
            case ["daq", *words] if words:
                self.daq.command(" ".join(words))
            case ["silence" | "unplug", *_]:
                # Without its voltages the skin measures nothing.
                self.daq.command(text)
            case ["normal"]:
                self.circuit.mend()
                self._server.command("normal")
                self.daq.command("normal")
            case _:
                self.circuit.command(text)
