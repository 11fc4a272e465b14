"""The task of the load cell: read it, publish it, take its zero."""

import contextlib
from collections.abc import Callable, Mapping

import structlog

from shearloop.daemon.clock import Clock
from shearloop.daemon.control.loop_inputs import TorqueSample, TorqueSource
from shearloop.daemon.messaging.messages import LoadTorque, Scalar
from shearloop.daemon.messaging.publisher import Publisher
from shearloop.daemon.waiting import Waiting
from shearloop.drivers.hx711 import LoadSample
from shearloop.drivers.load_cell import LoadCell

LOAD_CELL = "load_cell"
# Two seconds at 10.9 Hz; their mean is known ten times better than one reading moves.
ZERO_SAMPLES = 22
# So many conversions a reading is of, the last of them its own: an HX711 settles within four (data sheet, "Output
# settling time": 400 ms at 10 a second, 50 ms at 80).
SETTLING_PERIODS = 4
# A zero takes two seconds; what keeps it for longer than this does not go away by waiting. Of a board that is slower it
# takes longer: then it is twice the time that the readings need.
ZERO_DEADLINE_S = 15.0


class LoadCellTask:
    """Ties the load cell's board to the publisher and to whoever goes by its torque."""

    def __init__(
        self, board: LoadCell, publisher: Publisher, clock: Clock, hear: Callable[[TorqueSample], None], rate_hz: float
    ) -> None:
        self.source = TorqueSource(name=LOAD_CELL, period_s=1.0 / rate_hz)
        self._zero_within_s = max(ZERO_DEADLINE_S, 2.0 * (ZERO_SAMPLES + SETTLING_PERIODS) / rate_hz)
        self._board = board
        self._publisher = publisher
        self._clock = clock
        self._hear = hear
        self._zeroing: list[float] | None = None
        # From when on and until when a zero is taken, and why the last one was not.
        self._zero_from_ns = self._zero_until_ns = 0
        self._untaken = ""
        self._waiting = Waiting()
        self._why = ""

    async def read(self) -> None:
        """Publish every sample and pass it on, until cancelled."""
        async with contextlib.aclosing(self._board.samples()) as samples:
            async for sample in samples:
                self._publisher.publish(load_message(sample))
                torque_nm = sample.torque_nm if sample.trusted else None
                self._hear(TorqueSample(LOAD_CELL, torque_nm, _why(sample), sample.t_mid_ns, self._clock.now_ns()))
                self._take_zero(sample)

    def tare(self) -> None:
        """Take the mean of the samples that are measured from now on for zero.

        Those under way know of the load before; with those that come too late for it, it would be of any load.
        """
        self._zeroing, self._untaken = [], ""
        now_ns = self._clock.now_ns()
        # The middle of the first reading that knows of nothing before.
        self._zero_from_ns = now_ns + round((SETTLING_PERIODS - 0.5) * self.source.period_s * 1e9)
        self._zero_until_ns = now_ns + round(self._zero_within_s * 1e9)

    async def zero(self) -> str:
        """Take the mean of the next samples for zero; return why it could not be done, or an empty text."""
        self.tare()
        try:
            # Who waits for a zero that was asked for before waits for this one, which is later still.
            return await self._waiting.wait(self._zero_within_s)
        except TimeoutError:
            why = self._why or "nothing came"
            return f"the load cell's zero could not be taken within {self._zero_within_s:g} s: {why}"
        finally:
            if not self._waiting:
                # A zero that nobody waits for any longer would be taken at whatever load comes.
                self._zeroing = None

    def facts(self) -> Mapping[str, Scalar | Mapping[str, int]]:
        """Return what health tells of the board."""
        facts = self._board.facts()
        told = {"expected_hz": 1.0 / self.source.period_s}
        return {**facts, **told, "error": self._untaken if facts["connected"] else facts["last_loss"]}

    def _take_zero(self, sample: LoadSample) -> None:
        self._why = _why(sample)
        if self._zeroing is None:
            return
        if sample.t_arrival_ns > self._zero_until_ns:
            self._zeroing = None
            self._untaken = (
                f"a zero that was asked for was not taken within {self._zero_within_s:g} s, and is not taken any more; "
                "see what the load cell says, and tare again"
            )
            structlog.get_logger().warning(self._untaken)
            return
        if sample.trusted and sample.t_mid_ns >= self._zero_from_ns:
            self._zeroing.append(sample.raw)
        if len(self._zeroing) == ZERO_SAMPLES:
            mean = sum(self._zeroing) / ZERO_SAMPLES
            self._board.tare(mean)
            self._zeroing = None
            self._waiting.tell("")


def load_message(sample: LoadSample) -> LoadTorque:
    """Return what is published of a sample."""
    return LoadTorque(
        source=LOAD_CELL,
        t_mono_ns=sample.t_mid_ns,
        torque_nm=sample.torque_nm,
        raw=sample.raw,
        saturated=sample.saturated,
        spike=sample.spike,
        valid=sample.trusted,
        reason=_why(sample),
    )


def _why(sample: LoadSample) -> str:
    """Return what speaks against a reading, or an empty text."""
    if sample.trusted:
        return ""
    flags = {
        "at the end of its range": sample.saturated,
        "further from the last one than the rig can move": sample.spike,
        "the same for two seconds": sample.stuck,
        "perhaps the end of a longer line": sample.partial,
    }
    return "the reading is " + " and ".join(what for what, is_so in flags.items() if is_so)
