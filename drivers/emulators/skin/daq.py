"""What reads the gauges' voltages, played: a scanning multimeter, and a cheap converter board. Byte for byte."""

import asyncio
from collections.abc import Callable
from pathlib import Path
from random import Random

from shearloop.drivers.emulators.board import PlayedBoard
from shearloop.drivers.emulators.skin.circuit import Circuit
from shearloop.drivers.emulators.skin.scpi_face import ILLEGAL_VALUE, ScpiError, ScpiFace, number
from shearloop.drivers.emulators.skin.servers import time_of

SCANNER_IDENTITY = "Agilent Technologies,34972A,MY49007321,1.16-1.12-02-02"
SCANNER_NO_ERROR = '+0,"No error"'
OVERLOAD_V = 9.9e37
# A range reads so much beyond its name before it is overloaded.
OVERRANGE = 1.2
PERIOD_S = 0.1
# The noise floor of the paper, 1.6 mN, as a voltage on each of two gauges of 25 Ω at 5 mA, 0.088 /N.
NOISE_V = 0.0016 * 0.088 / 2**0.5 * 0.125
# An ADS1220 at gain 4: 24 bits over ±0.512 V.
FULL_SCALE_V, STEP_V = 0.512, 0.512 / 2**23


class Scanner:
    """A scanning multimeter whose first two scanned channels are the gauges."""

    def __init__(self, circuit: Circuit, now_s: Callable[[], float], noise_v: float = NOISE_V, seed: int = 0) -> None:
        """Be switched on, with an empty scan list."""
        self._circuit = circuit
        self._now_s = now_s
        self._noise_v = noise_v
        self._random = Random(seed)
        self._reset("")
        self.face = ScpiFace(
            SCANNER_IDENTITY,
            {
                "*RST": self._reset,
                "CONFigure:VOLTage:DC": self._configure,
                "[SENSe:]VOLTage:DC:NPLCycles": lambda text: self._check(text.split(",", 1)[0], 0.02, 200.0),
                "ROUTe:SCAN": self._set_scan,
                "READ?": self._read,
            },
            SCANNER_NO_ERROR,
        )

    def feed(self, data: bytes) -> bytes:
        """Return the replies to what was sent."""
        return self.face.feed(data)

    def _reset(self, _: str) -> None:
        self._range_v = 300.0
        self._channels = 0

    @staticmethod
    def _check(text: str, low: float, high: float) -> None:
        number(text, low, high)

    def _configure(self, text: str) -> None:
        self._range_v = number(text.split(",", 1)[0], 0.0, 300.0)

    def _set_scan(self, text: str) -> None:
        if not (text.startswith("(@") and text.endswith(")")):
            raise ScpiError(ILLEGAL_VALUE)
        self._channels = text.count(",") + 1

    def _read(self, _: str) -> str:
        if not self._channels:
            raise ScpiError('-221,"Settings conflict"')
        electric = self._circuit.at(self._now_s())
        return ",".join(self._digits(value) for value in (electric.v1_v, electric.v2_v)[: self._channels])

    def _digits(self, volts: float) -> str:
        volts += self._random.gauss(0.0, self._noise_v)
        if abs(volts) > OVERRANGE * self._range_v:
            volts = OVERLOAD_V if volts > 0 else -OVERLOAD_V
        return f"{volts:+.8E}"


ONE_LINE = ("missing", "garbage", "torn")
LASTING = ("silence", "stuck", "unplug")
BOARD_COMMANDS = f"{', '.join(ONE_LINE)}, {' [SECONDS], '.join(LASTING)} [SECONDS]"


class EmulatedAdcBoard(PlayedBoard[str]):
    """A converter board on a pseudo-terminal: a line `v1,v2` in volts at each period, whoever listens.

    `on_port` hears the port's path whenever it appears; `sent` counts the sound lines.
    """

    def __init__(
        self,
        circuit: Circuit,
        now_s: Callable[[], float],
        *,
        period_s: float = PERIOD_S,
        noise_v: float = NOISE_V,
        link: Path | None = None,
        on_port: Callable[[str], None] = lambda _: None,
        seed: int = 0,
    ) -> None:
        super().__init__(period_s, link, on_port, seed)
        self._circuit = circuit
        self._now_s = now_s
        self._noise_v = noise_v
        self._lasting = ""
        self._lasts_until_s = 0.0
        self._line = b""

    def command(self, text: str) -> None:
        """Let something befall the next line, or what follows; ValueError for a line that says nothing known."""
        match text.split():
            case [kind] if kind in ONE_LINE:
                self.inject(kind)
            case [kind, *seconds] if kind in LASTING and len(seconds) < 2:
                self._end_lasting()
                self._lasting = kind
                self._lasts_until_s = self._now_s() + (time_of(seconds[0]) if seconds else float("inf"))
                if kind == "unplug":
                    self._port.unplug()
            case ["normal"]:
                self._injected.clear()
                self._end_lasting()
            case _:
                raise ValueError(f"{text!r} is no fault of the board; there are {BOARD_COMMANDS}, normal")

    async def run(self) -> None:
        """Play until cancelled."""
        loop = asyncio.get_running_loop()
        due_s = loop.time()
        with self._port:
            self._on_port(self.path)
            while True:
                due_s = max(due_s + self._period_s, loop.time())
                await asyncio.sleep(due_s - loop.time())
                if self._lasting and self._now_s() >= self._lasts_until_s:
                    self._end_lasting()
                line = self._next_line()
                if line:
                    try:
                        await self._port.write(line)
                    except ConnectionError:  # unplugged while it waited to be read
                        continue
                    self.sent += 1

    def _next_line(self) -> bytes:
        if self._lasting in ("silence", "unplug"):
            return b""
        if self._lasting != "stuck" or not self._line:
            electric = self._circuit.at(self._now_s())
            self._line = f"{self._convert(electric.v1_v):.6f},{self._convert(electric.v2_v):.6f}\r\n".encode()
        match self._injected.popleft() if self._injected else "":
            case "missing":
                return b""
            case "garbage":
                return self._garbage(12) + b"\r\n"
            case "torn":
                return self._line[len(self._line) // 2 :]
        return self._line

    def _convert(self, volts: float) -> float:
        steps = round((volts + self._random.gauss(0.0, self._noise_v)) / STEP_V)
        return min(max(steps * STEP_V, -FULL_SCALE_V), FULL_SCALE_V)

    def _end_lasting(self) -> None:
        if self._lasting == "unplug":
            self._plug()
        self._lasting = ""
