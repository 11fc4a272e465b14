"""The load cell as a device: kept connected, and lost when it falls silent."""

import os
import time
from collections.abc import AsyncGenerator, Callable, Mapping

from drivers.errors import DeviceLostError, DriverError
from drivers.hx711 import BAUD_RATE, PERIOD_NS, LoadCalibration, LoadLimits, LoadParser, LoadSample, refusals
from drivers.raw_input import InputKind, RawInput, Tap, no_tap
from drivers.serial_port import LinkEvent, Received, ReconnectPolicy, SerialLink

# Opening the port resets an Uno, whose boot loader waits before it starts the sketch.
BOOT_S = 4.0
SILENT_PERIODS = 8
SILENCE_S = SILENT_PERIODS * PERIOD_NS * 1e-9


class LoadCell:
    """One board, by USB serial number or path. It only ever sends; there is nothing to command."""

    def __init__(
        self,
        calibration: LoadCalibration,
        limits: LoadLimits | None = None,
        *,
        serial_number: str | None = None,
        path: str | os.PathLike[str] | None = None,
        policy: ReconnectPolicy | None = None,
        on_event: Callable[[LinkEvent], None] = lambda _: None,
        tap: Tap = no_tap,
    ) -> None:
        """Name the board; nothing is opened yet. `tap` hears of all that the parser is told."""
        self._tap = tap
        self._link = SerialLink(
            serial_number=serial_number,
            path=None if path is None else os.fspath(path),
            baud=BAUD_RATE,
            policy=policy,
            on_event=on_event,
        )
        self._parser = LoadParser(calibration, limits)
        self._patience_s = BOOT_S
        self._samples = 0
        self._flagged = 0

    @property
    def calibration(self) -> LoadCalibration:
        """The calibration of the samples to come; a tare makes a new one."""
        return self._parser.calibration

    def tare(self, raw_at_rest: float) -> None:
        """Take a raw value for the zero of the samples to come."""
        self._told(InputKind.TARE, time.monotonic_ns(), repr(raw_at_rest).encode())

    async def samples(self) -> AsyncGenerator[LoadSample]:
        """Yield every sample that arrives, in order and for ever, whatever becomes of the board meanwhile.

        Iterate within `contextlib.aclosing`, so that the port is closed when the iteration is left.
        """
        with self._link:
            while True:
                try:
                    received = await self._receive()
                except DriverError as error:
                    await self._link.lost(error)
                    continue
                for sample in self._told(InputKind.DATA, received.t_arrival_ns, received.data):
                    self._samples += 1
                    self._flagged += not sample.trusted
                    yield sample

    async def _receive(self) -> Received:
        port = self._link.port
        if port is None:
            port = await self._link.open()
            self._told(InputKind.OPENED, time.monotonic_ns())
            self._patience_s = BOOT_S
        received = await port.read(self._patience_s)
        if received is None:
            raise DeviceLostError(
                f"{port.path} is open but has sent nothing for {self._patience_s:.1f} s; "
                "check that it is the load cell's board and that the HX711 has power and its DT and SCK wires."
            )
        self._patience_s = SILENCE_S
        return received

    def _told(self, kind: InputKind, t_ns: int, data: bytes = b"") -> list[LoadSample]:
        told = RawInput(kind, t_ns, data)
        self._tap(told)
        return self._parser.take(told)

    def facts(self) -> Mapping[str, bool | int | float | str | Mapping[str, int] | None]:
        """Return what health tells of the board; counts are since the process began."""
        return {
            "connected": self._link.port is not None,
            "samples": self._samples,
            "flagged": self._flagged,
            "errors": dict(self._parser.refused),
            "refusals": " ".join(refusals(self._parser)),
            "openings": self._link.openings,
            "last_loss": self._link.last_error,
        }
