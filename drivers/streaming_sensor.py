"""A board on a serial port that only ever sends: lost when it falls silent."""

from collections.abc import Callable, Sequence

from shearloop.drivers.errors import DeviceLostError
from shearloop.drivers.raw_event import RawEvent, Tap, no_tap
from shearloop.drivers.serial_port import Link, Port
from shearloop.drivers.serial_sensor import SerialSensor, ValueT

# Opening the port resets an Uno, whose boot loader waits before it starts the sketch.
BOOT_S = 4.0
SILENT_PERIODS = 8


class StreamingSensor(SerialSensor[ValueT]):
    """One board behind a link; there is nothing to command."""

    def __init__(
        self,
        link: Link,
        take: Callable[[RawEvent], Sequence[ValueT]],
        *,
        period_s: float,
        silent: Callable[[str, float], str],
        tap: Tap = no_tap,
    ) -> None:
        """Take the link and the parser; nothing is opened yet. `tap` hears of all that the parser is told.

        `period_s` is between two lines; `silent` is the sentence for a port that has sent nothing for so many seconds.
        """
        super().__init__(link, take, tap)
        self._silence_s = SILENT_PERIODS * period_s
        self._says_silent = silent
        self._has_begun = False

    async def _opened(self, _port: Port) -> None:
        self._has_begun = False

    def _patience_s(self) -> float:
        return self._silence_s if self._has_begun else BOOT_S

    def _heard(self) -> None:
        self._has_begun = True

    async def _silent(self, port: Port, waited_s: float) -> None:
        raise DeviceLostError(self._says_silent(port.path, waited_s))
