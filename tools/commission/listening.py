"""Listens to the load cell in a thread, while the stages move the robot."""

import asyncio
import statistics
import threading
import time
from contextlib import aclosing
from types import TracebackType
from typing import Final, Self

from shearloop.daemon.config import LoadCellConfig
from shearloop.daemon.rig import load_cell_calibration
from shearloop.drivers.connection import SerialLink
from shearloop.drivers.load_cell import LoadCell, LoadSample
from shearloop.errors import UserError

# Opening the port resets an Uno, which starts within some seconds.
_SILENT_S: Final = 15.0


class LoadCellListener:
    """The load cell's samples that can be trusted; a context, which opens and closes its port."""

    def __init__(self, config: LoadCellConfig) -> None:
        self._config = config
        self.samples: list[LoadSample] = []
        self._changed = threading.Condition()
        self._loop = asyncio.new_event_loop()
        self._task: asyncio.Task[None] | None = None
        self._thread = threading.Thread(target=self._run, name="load cell", daemon=True)

    def __enter__(self) -> Self:
        """Begin to listen; raises UserError where the board is silent."""
        self._thread.start()
        self.wait(0, 1)
        return self

    def __exit__(
        self, _kind: type[BaseException] | None, _error: BaseException | None, _trace: TracebackType | None
    ) -> None:
        """Close the port."""
        if self._task is not None:
            self._loop.call_soon_threadsafe(self._task.cancel)
        self._thread.join()

    def _run(self) -> None:
        self._task = self._loop.create_task(self._listen())
        try:
            self._loop.run_until_complete(asyncio.gather(self._task, return_exceptions=True))
        finally:
            self._loop.close()

    async def _listen(self) -> None:
        config = self._config
        cell = LoadCell(SerialLink(**config.device.model_dump()), load_cell_calibration(config), config.rate_hz)
        async with aclosing(cell.readings()) as readings:
            async for sample in readings:
                if sample.trusted:
                    with self._changed:
                        self.samples.append(sample)
                        self._changed.notify_all()

    def wait(self, since_ns: int, count: int) -> list[LoadSample]:
        """Return the first samples whose conversions began after a moment; raises UserError where none come."""
        until_s = time.monotonic() + _SILENT_S
        with self._changed:
            while len(found := [one for one in self.samples if one.t_mid_ns >= since_ns]) < count:
                if not self._changed.wait(max(0.0, until_s - time.monotonic())) and time.monotonic() > until_s:
                    raise UserError("the load cell is silent: `shearloop doctor CONFIG` examines it")
            return found[:count]

    def since(self, t_ns: int) -> list[LoadSample]:
        """Return the samples whose conversions were after a moment."""
        with self._changed:
            return [sample for sample in self.samples if sample.t_mid_ns >= t_ns]

    def mean_nm(self, seconds: float) -> float:
        """Return the mean torque of the next seconds."""
        count = max(3, round(seconds * self._config.rate_hz))
        return statistics.fmean(sample.torque_nm for sample in self.wait(time.monotonic_ns(), count))
