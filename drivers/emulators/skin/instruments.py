"""The skin's instruments around one circuit, as one thing to run and to be told what befalls it."""

import asyncio
import time
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from shearloop.drivers.emulators.skin.circuit import Circuit, Gauges, befall
from shearloop.drivers.emulators.skin.daq import PERIOD_S, EmulatedAdcBoard, Scanner
from shearloop.drivers.emulators.skin.keithley import EmulatedKeithley6430
from shearloop.drivers.emulators.skin.servers import Outages, ScpiSerial, ScpiSocket

# What asking takes: two conversions of one period of the mains each, and the reply's way.
ANSWER_S = 0.04
# Where an instrument is to be found: a name for its pseudo-terminal, or host and port of its socket.
Place = Path | tuple[str, int]


class Played(Protocol):
    """An instrument that plays by itself."""

    async def run(self) -> None:
        """Play until cancelled."""

    def command(self, text: str) -> None:
        """Let something befall it."""


def play_source(
    circuit: Circuit, place: Place | None, on_port: Callable[[str], None], *, speed: float = 1.0, seed: int = 0
) -> Played:
    """Return the current source at a place; a new pseudo-terminal where none is given."""
    feed = EmulatedKeithley6430(circuit, time.monotonic, seed).feed
    if isinstance(place, tuple):
        return Outages(ScpiSocket(feed, *place, on_port=on_port, answer_s=ANSWER_S / speed))
    return Outages(ScpiSerial(feed, place, on_port, answer_s=ANSWER_S / speed))


def play_daq(
    circuit: Circuit, place: Place | None, on_port: Callable[[str], None], *, speed: float = 1.0, seed: int = 0
) -> Played:
    """Return what reads the voltages at a place: a scanner on a socket, a converter board on a pseudo-terminal."""
    if isinstance(place, tuple):
        feed = Scanner(circuit, time.monotonic, seed=seed).feed
        return Outages(ScpiSocket(feed, *place, on_port=on_port, answer_s=ANSWER_S / speed))
    return EmulatedAdcBoard(circuit, time.monotonic, period_s=PERIOD_S / speed, link=place, on_port=on_port, seed=seed)


class SkinInstruments:
    """Current source and DAQ of one skin, whose gauges are asked for by the function that is passed in."""

    def __init__(
        self,
        gauges: Gauges,
        source_at: Place | None,
        daq_at: Place | None,
        *,
        on_port: Callable[[str, str], None] = lambda _device, _port: None,
        speed: float = 1.0,
        seed: int = 0,
    ) -> None:
        """Take the places; `on_port` hears `source` or `daq` and where it is, whenever it appears."""
        self.circuit = Circuit(gauges)
        self._source = play_source(
            self.circuit, source_at, lambda port: on_port("source", port), speed=speed, seed=seed
        )
        self._daq = play_daq(self.circuit, daq_at, lambda port: on_port("daq", port), speed=speed, seed=seed + 1)

    async def run(self) -> None:
        """Play until cancelled; OSError, in a group, when an address is taken."""
        async with asyncio.TaskGroup() as group:
            group.create_task(self._source.run())
            group.create_task(self._daq.run())

    def command(self, text: str) -> None:
        """Do what a line says; ValueError, with a sentence, for one that says nothing known."""
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
                befall(self.circuit, text, time.monotonic())
