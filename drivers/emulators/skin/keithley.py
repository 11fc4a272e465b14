"""A Keithley 6430, played: its replies byte for byte, as its manual (6430-901-01, sections 13 and 17) gives them."""

from collections.abc import Callable
from random import Random

from shearloop.drivers.emulators.skin.circuit import Circuit
from shearloop.drivers.emulators.skin.scpi_face import ILLEGAL_VALUE, ScpiError, ScpiFace, boolean, number

IDENTITY = "KEITHLEY INSTRUMENTS INC.,MODEL 6430,0874421,C27   Feb  4 2004 14:58:04/A02  /F/H"
NO_ERROR = '0,"No error"'
OUTPUT_IS_OFF = '+803,"Not permitted with OUTPUT off"'
NOT_MEASURED = 9.91e37
LARGEST_A, LARGEST_V = 0.105, 210.0
ELEMENTS = ("VOLT", "CURR", "RES", "TIME", "STAT")
# Of one reading over one period of the mains, on the ranges of 10 mA and 1 V.
NOISE_V, NOISE_A = 3e-6, 5e-9
# The status word, page 17-47: front terminals, V and I measured, I sourced; and compliance.
_STATUS = 1 << 2 | 1 << 11 | 1 << 12 | 1 << 15
_COMPLIANCE = 1 << 3


class EmulatedKeithley6430:
    """The instrument behind its interface; `now_s` tells the time, `feed` takes bytes and returns the replies."""

    def __init__(self, circuit: Circuit, now_s: Callable[[], float], seed: int = 0) -> None:
        """Be switched on, with the output off."""
        self.circuit = circuit
        self._now_s = now_s
        self._random = Random(seed)
        self._reset("")
        self.face = ScpiFace(
            IDENTITY,
            {
                "*RST": self._reset,
                "SOURce:FUNCtion[:MODE]": self._set_function,
                "SOURce:FUNCtion[:MODE]?": lambda _: self._function,
                "SOURce:CURRent:MODE": _one_of("FIX", "FIXED"),
                "SOURce:CURRent:RANGe": lambda text: _ignored(number(text, -LARGEST_A, LARGEST_A)),
                "SOURce:CURRent[:LEVel][:IMMediate][:AMPLitude]": self._set_level,
                "SOURce:CURRent[:LEVel][:IMMediate][:AMPLitude]?": lambda _: _scientific(self.circuit.level_a),
                "SENSe:FUNCtion:CONCurrent": lambda text: _ignored(boolean(text)),
                "SENSe:FUNCtion[:ON]": self._set_measured,
                "SENSe:VOLTage[:DC]:PROTection[:LEVel]": self._set_compliance,
                "SENSe:VOLTage[:DC]:PROTection[:LEVel]?": lambda _: _scientific(self.circuit.compliance_v),
                "SENSe:VOLTage[:DC]:PROTection:TRIPped?": lambda _: str(int(circuit.at(now_s()).compliance)),
                "SENSe:VOLTage[:DC]:RANGe[:UPPer]": lambda text: _ignored(number(text, -LARGEST_V, LARGEST_V)),
                "SENSe:VOLTage[:DC]:NPLCycles": lambda text: _ignored(number(text, 0.01, 10.0)),
                "FORMat:ELEMents[:SENSe]": self._set_elements,
                "OUTPut[:STATe]": self._switch,
                "OUTPut[:STATe]?": lambda _: str(int(self.circuit.output_on)),
                "READ?": self._read,
            },
            NO_ERROR,
        )

    def feed(self, data: bytes) -> bytes:
        """Return the replies to what was sent."""
        return self.face.feed(data)

    def _reset(self, _: str) -> None:
        self._function = "VOLT"
        self._measured = {"CURR"}
        self._elements = set(ELEMENTS)
        self.circuit.output_on = False
        self.circuit.level_a = 0.0
        self.circuit.compliance_v = 21.0

    def _set_function(self, text: str) -> None:
        if text.upper() not in ("CURR", "CURRENT"):
            # The gauges are never fed with a voltage, and nothing here could play that.
            raise ScpiError(ILLEGAL_VALUE)
        self._function = "CURR"

    def _set_level(self, text: str) -> None:
        self.circuit.level_a = number(text, -LARGEST_A, LARGEST_A)

    def _set_compliance(self, text: str) -> None:
        self.circuit.compliance_v = number(text, 2e-4, LARGEST_V)

    def _set_measured(self, text: str) -> None:
        names = {part.strip().strip("'\"").upper().removesuffix(":DC")[:4] for part in text.split(",")}
        if not names <= {"VOLT", "CURR", "RES"}:
            raise ScpiError(ILLEGAL_VALUE)
        self._measured = names

    def _set_elements(self, text: str) -> None:
        names = {part.strip().upper()[:4] for part in text.split(",")}
        if not names <= {*ELEMENTS}:
            raise ScpiError(ILLEGAL_VALUE)
        self._elements = names

    def _switch(self, text: str) -> None:
        self.circuit.output_on = boolean(text)

    def _read(self, _: str) -> str:
        if not self.circuit.output_on:
            raise ScpiError(OUTPUT_IS_OFF)
        now_s = self._now_s()
        electric = self.circuit.at(now_s)
        values = {
            "VOLT": electric.source_v + self._random.gauss(0.0, NOISE_V) if "VOLT" in self._measured else NOT_MEASURED,
            "CURR": electric.current_a + self._random.gauss(0.0, NOISE_A),
            "RES": NOT_MEASURED,
            "TIME": now_s % 1e5,
            "STAT": float(_STATUS | (_COMPLIANCE if electric.compliance else 0)),
        }
        return ",".join(_scientific(values[name]) for name in ELEMENTS if name in self._elements)


def _scientific(value: float) -> str:
    return f"{value:+.6E}"


def _ignored(_: object) -> None:
    """Take a setting that changes nothing that can be seen here."""


def _one_of(*names: str) -> Callable[[str], None]:
    def check(text: str) -> None:
        if text.upper() not in names:
            raise ScpiError(ILLEGAL_VALUE)

    return check
