"""The load cell as a device: kept connected, and lost when it falls silent."""

import os
import time
from collections.abc import AsyncGenerator, Callable, Mapping
from contextlib import aclosing

from shearloop.drivers.hx711 import BAUD_RATE, RATE_HZ, LoadCalibration, LoadParser, LoadSample, refusals
from shearloop.drivers.raw_event import InputKind, Tap, no_tap
from shearloop.drivers.serial_port import LinkEvent, ReconnectPolicy, SerialLink
from shearloop.drivers.streaming_sensor import StreamingSensor


class LoadCell:
    """One board, by USB serial number or path. It only ever sends; there is nothing to command."""

    def __init__(
        self,
        calibration: LoadCalibration,
        *,
        serial_number: str | None = None,
        path: str | os.PathLike[str] | None = None,
        rate_hz: float = RATE_HZ,
        policy: ReconnectPolicy | None = None,
        on_event: Callable[[LinkEvent], None] = lambda _: None,
        tap: Tap = no_tap,
    ) -> None:
        """Name the board and how many lines a second it sends; nothing is opened yet.

        `tap` hears of all that the parser is told.
        """
        link = SerialLink(
            serial_number=serial_number,
            path=None if path is None else os.fspath(path),
            baud=BAUD_RATE,
            policy=policy,
            on_event=on_event,
        )
        self._parser = LoadParser(calibration, rate_hz)
        self._board = StreamingSensor(
            link,
            self._parser.take,
            # One that is quicker is not silent yet where this computer was late; opening it anew would reset it.
            period_s=1.0 / min(rate_hz, RATE_HZ),
            silent=_silent,
            tap=tap,
        )
        self._samples = 0
        self._flagged = 0

    @property
    def calibration(self) -> LoadCalibration:
        """The calibration of the samples to come; a tare makes a new one."""
        return self._parser.calibration

    def tare(self, raw_at_rest: float) -> None:
        """Take a raw value for the zero of the samples to come."""
        self._board.tell(InputKind.TARE, time.monotonic_ns(), repr(raw_at_rest).encode())

    async def samples(self) -> AsyncGenerator[LoadSample]:
        """Yield every sample that arrives, in order and for ever, whatever becomes of the board meanwhile.

        Iterate within `contextlib.aclosing`, so that the port is closed when the iteration is left.
        """
        async with aclosing(self._board.values()) as samples:
            async for sample in samples:
                self._samples += 1
                self._flagged += not sample.trusted
                yield sample

    def facts(self) -> Mapping[str, bool | int | float | str | Mapping[str, int] | None]:
        """Return what health tells of the board; counts are since the process began."""
        return {
            **self._board.facts(),
            "samples": self._samples,
            "flagged": self._flagged,
            "errors": dict(self._parser.refused),
            "refusals": " ".join(refusals(self._parser)),
        }


def _silent(path: str, waited_s: float) -> str:
    return (
        f"{path} is open but has sent nothing for {waited_s:.1f} s; "
        "check that it is the load cell's board and that the HX711 has power and its DT and SCK wires."
    )
