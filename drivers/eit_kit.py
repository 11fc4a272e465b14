"""The EIT-kit (a Teensy on USB): starts it, turns what it sends into frames, and awaits it when it goes away."""

import os
import time
from collections.abc import AsyncGenerator, Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from drivers.eit_line import NOMINAL_PERIOD_NS, Frame, LineParser
from drivers.errors import DeviceLostError, DriverError
from drivers.raw_input import InputKind, RawInput, Tap, no_tap
from drivers.serial_port import LinkEvent, Received, SerialLink

__all__ = ["EitKit", "Frame"]

START = b"y"
# Silence of so many periods is more than a frame that was late, and the board is started again.
SILENT_PERIODS = 4
# However fast the frames come: below this a busy machine may be what is silent.
SHORTEST_SILENCE_S = 0.5
# A board that was started again so often without a byte in return is opened anew.
STARTS_BEFORE_REOPENING = 5


class EitKit:
    """One board, named by USB serial number or path.

    `zero_slots` (1024,) is true where its injection pattern makes a value 0; `frame_period_s` serves until the period
    is measured; `on_event` hears when the board comes and goes, `tap` of all that the parser is told, and `on_frame` at
    once of every frame that comes of it, whenever `frames` is asked for the next.
    """

    def __init__(
        self,
        *,
        zero_slots: NDArray[np.bool_],
        serial_number: str | None = None,
        path: str | os.PathLike[str] | None = None,
        frame_period_s: float = NOMINAL_PERIOD_NS / 1e9,
        on_event: Callable[[LinkEvent], None] = lambda _: None,
        tap: Tap = no_tap,
        on_frame: Callable[[Frame], None] = lambda _: None,
    ) -> None:
        self._tap = tap
        self._on_frame = on_frame
        self._link = SerialLink(
            serial_number=serial_number, path=None if path is None else os.fspath(path), on_event=on_event
        )
        self._parser = LineParser(zero_slots, nominal_period_ns=round(frame_period_s * 1e9))
        self._expected_hz = 1.0 / frame_period_s
        self._unanswered = 0
        self._silences = 0

    async def frames(self) -> AsyncGenerator[Frame]:
        """Yield every frame that arrives, in order and for ever, whatever becomes of the board meanwhile.

        While the receiver is busy nothing is read and nothing is lost: the bytes wait in the kernel, then on the board.
        Iterate within `contextlib.aclosing`, so that the port is closed when the iteration is left.
        """
        with self._link:
            while True:
                try:
                    received = await self._receive()
                except DriverError as error:
                    await self._link.lost(error)
                    continue
                if received is not None:
                    for frame in self._told(InputKind.DATA, received.t_arrival_ns, received.data):
                        yield frame

    async def _receive(self) -> Received | None:
        """Return what arrives next, or None when the board had to be started again."""
        port = self._link.port
        if port is None:
            port = await self._link.open()
            self._unanswered = 0
            self._told(InputKind.OPENED, time.monotonic_ns())
            await port.write(START)
        received = await port.read(max(SILENT_PERIODS * self._parser.clock.period_ns / 1e9, SHORTEST_SILENCE_S))
        if received is not None:
            self._unanswered = 0
            return received
        if self._unanswered == STARTS_BEFORE_REOPENING:
            raise DeviceLostError(
                f"{port.path} is open but silent, though the board was started {STARTS_BEFORE_REOPENING} times more; "
                "see that it has power and that it is an EIT-kit."
            )
        self._unanswered += 1
        self._silences += 1
        self._told(InputKind.STARTED, time.monotonic_ns())
        await port.write(START)
        return None

    def _told(self, kind: InputKind, t_ns: int, data: bytes = b"") -> list[Frame]:
        told = RawInput(kind, t_ns, data)
        self._tap(told)
        frames = self._parser.take(told)
        for frame in frames:
            self._on_frame(frame)
        return frames

    @property
    def period_s(self) -> float:
        """The board's period as it was measured, or as it was given until it is."""
        return self._parser.clock.period_ns / 1e9

    def facts(self) -> Mapping[str, bool | int | float | str | Mapping[str, int] | None]:
        """Return what health tells of the board; counts are since the process began."""
        parser, clock = self._parser, self._parser.clock
        return {
            "connected": self._link.port is not None,
            "frames": parser.frames,
            "errors": {kind.name.lower(): count for kind, count in parser.refused.items()},
            "last_refusal": "" if parser.last_refusal is None else str(parser.last_refusal),
            "first_partials": parser.first_partials,
            "unfinished": parser.unfinished,
            "openings": self._link.openings,
            "silences": self._silences,
            "last_loss": self._link.last_error,
            "expected_hz": self._expected_hz,
            "measured_hz": 1e9 / clock.period_ns if clock.learned else None,
        }
