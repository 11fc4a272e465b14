"""The EIT-kit (a Teensy on USB): starts it, turns what it sends into frames, and awaits it when it goes away."""

import os
import time
from collections.abc import AsyncGenerator, Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from shearloop.drivers.eit_line import NOMINAL_PERIOD_NS, Frame, FrameParser
from shearloop.drivers.errors import DeviceLostError
from shearloop.drivers.raw_event import InputKind, RawEvent, Tap, no_tap
from shearloop.drivers.serial_port import LinkEvent, Port, SerialLink
from shearloop.drivers.serial_sensor import SerialSensor

__all__ = ["EitKit", "Frame"]

START = b"y"
# Silence of so many periods is more than a frame that was late, and the board is started again.
SILENT_PERIODS = 4
# However fast the frames come: below this a busy machine may be what is silent.
SHORTEST_SILENCE_S = 0.5
# A board that was started again so often without a byte in return is opened anew.
STARTS_BEFORE_REOPENING = 5


class EitKit(SerialSensor[Frame]):
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
        path = None if path is None else os.fspath(path)
        super().__init__(SerialLink(serial_number=serial_number, path=path, on_event=on_event), self._frames_of, tap)
        self._on_frame = on_frame
        self._parser = FrameParser(zero_slots, nominal_period_ns=round(frame_period_s * 1e9))
        self._expected_hz = 1.0 / frame_period_s
        self._unanswered = 0
        self._silences = 0

    def frames(self) -> AsyncGenerator[Frame]:
        """Yield every frame that arrives; see `values`."""
        return self.values()

    async def _opened(self, port: Port) -> None:
        self._unanswered = 0
        await port.write(START)

    def _patience_s(self) -> float:
        return max(SILENT_PERIODS * self._parser.clock.period_ns / 1e9, SHORTEST_SILENCE_S)

    def _heard(self) -> None:
        self._unanswered = 0

    async def _silent(self, port: Port, _waited_s: float) -> None:
        """Start the board again, a few times; then it is lost."""
        if self._unanswered == STARTS_BEFORE_REOPENING:
            raise DeviceLostError(
                f"{port.path} is open but silent, though the board was started {STARTS_BEFORE_REOPENING} times more; "
                "see that it has power and that it is an EIT-kit."
            )
        self._unanswered += 1
        self._silences += 1
        self.tell(InputKind.STARTED, time.monotonic_ns())
        await port.write(START)

    def _frames_of(self, told: RawEvent) -> list[Frame]:
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
            **super().facts(),
            "frames": parser.frames,
            "errors": {kind.name.lower(): count for kind, count in parser.refused.items()},
            "last_refusal": "" if parser.last_refusal is None else str(parser.last_refusal),
            "partial_lines": parser.partial_lines,
            "unfinished": parser.unfinished,
            "silences": self._silences,
            "expected_hz": self._expected_hz,
            "measured_hz": 1e9 / clock.period_ns if clock.learned else None,
        }
