"""The load cell's task: reads it, publishes its torque, takes its zero."""

import contextlib
from collections.abc import Sequence
from itertools import pairwise
from statistics import median

import structlog

from shearloop.daemon.clock import Clock
from shearloop.daemon.messaging.messages import LoadTorque
from shearloop.daemon.messaging.publisher import Publisher
from shearloop.daemon.sensing.zero_request import ZERO_TIMEOUT_S, ZeroRequest, ZeroState
from shearloop.daemon.torques import LOAD_CELL, SensorListener, TorqueSample, load_of
from shearloop.drivers.connection import Diagnostics
from shearloop.drivers.load_cell import LoadCalibration, LoadCell, LoadSample

# Two seconds at 10.9 Hz.
ZERO_SAMPLES = 22
# The paper's cell, unloaded, changes by 0.0001 N·m in this time. A load that comes or goes would be in the mean.
LARGEST_CHANGE_NM = 0.005
# A large cell has more noise. The range of 22 normal values is beyond this many of their median steps twice in 1000.
NOISE_STEPS = 10.0
# An HX711 settles within four conversions (data sheet, "Output settling time": 400 ms at 10 a second, 50 ms at 80).
SETTLING_PERIODS = 4


class LoadCellTask:
    """Connects the load cell's board to the publisher and the control loop."""

    def __init__(
        self, board: LoadCell, publisher: Publisher, clock: Clock, loop: SensorListener | None, rate_hz: float
    ) -> None:
        self._period_s = 1.0 / rate_hz
        # A zero of a slow board gets twice the time of its readings.
        self._timeout_s = max(ZERO_TIMEOUT_S, 2.0 * (ZERO_SAMPLES + SETTLING_PERIODS) / rate_hz)
        self._board = board
        self._publisher = publisher
        self._clock = clock
        self._loop = loop
        # The latest request for a zero, its raw values, and whether the operator has confirmed that nothing is loaded.
        self._zero: ZeroRequest | None = None
        self._raw: list[float] = []
        self._confirmed = False
        # A new zero is judged by this one: of the daemon's start, or of the last confirmed tare. Judged by the latest,
        # small loads in one tare after the other would add up.
        self._judged_by: LoadCalibration | None = None
        self._latest: LoadSample | None = None
        # Readings in a row that are beyond what it can measure.
        self._overloaded = 0

    async def run(self) -> None:
        """Publish every sample and pass it on, until cancelled."""
        async with contextlib.aclosing(self._board.batches()) as batches:
            async for samples in batches:
                inputs = self._board.inputs
                if not samples and inputs is not None and inputs.wants_state:
                    inputs.record_state({"parser": self._board.parser}, {}, self._clock.now_ns())
                for sample in samples:
                    self._process(sample)

    def _process(self, sample: LoadSample) -> None:
        message = load_message(sample)
        self._publisher.publish(message)
        self._latest = sample
        if self._loop is not None:
            now_ns = self._clock.now_ns()
            torque_nm = sample.torque_nm if sample.trusted else None
            # A single one may be a line that was changed on its way.
            self._overloaded = self._overloaded + 1 if sample.overloaded else 0
            load = "the reading is beyond what it can measure" if self._overloaded > 1 else ""
            self._loop.on_torque(TorqueSample(LOAD_CELL, torque_nm, message.reason, sample.t_mid_ns, now_ns, load=load))
        self._take_zero(sample)

    def tare(self, *, confirmed: bool = False) -> None:
        """Make the mean of samples measured from now on the zero; samples under way belong to the load before.

        A mean that is a load is refused unless the operator has `confirmed` that nothing is loaded. It is judged by the
        zero of the last confirmed tare, else by the one at the daemon's start.
        """
        self._request_zero(confirmed=confirmed)

    @property
    def taring(self) -> bool:
        """Whether the next readings belong to a zero that was asked for."""
        return self._zero is not None and self._zero.is_under_way(self._clock.now_ns())

    async def tare_and_wait(self, within_s: float) -> str | None:
        """Take a new zero and wait until it is done; return None, or why it was not taken."""
        zero, within_s = self._request_zero(confirmed=False), min(self._timeout_s, within_s)
        return await zero.wait(within_s, lambda: self._not_taken(zero, within_s))

    def _request_zero(self, *, confirmed: bool) -> ZeroRequest:
        if self._loop is not None:
            # A request for a zero means that the one before is not trusted.
            self._loop.on_zero(LOAD_CELL, known=False)
        now_ns = self._clock.now_ns()
        # The middle of the first settled reading.
        from_ns = now_ns + round((SETTLING_PERIODS - 0.5) * self._period_s * 1e9)
        self._zero = ZeroRequest(from_ns, now_ns + round(self._timeout_s * 1e9), self._zero)
        self._raw, self._confirmed = [], confirmed
        return self._zero

    def diagnostics(self) -> Diagnostics:
        """Return the board's values for `health`."""
        self._expire_zero(self._clock.now_ns())
        found = self._board.diagnostics()
        own, zero = found["last_refusal"], self._zero
        if self._latest is not None and self._latest.other_unit is not None:
            own = self._latest.other_unit.clause
        if zero is not None and zero.reason:
            own = zero.reason
        # The reason of an expired request names the loss.
        shows_own = found["connected"] or (zero is not None and zero.state is ZeroState.EXPIRED)
        error = own if shows_own else found["last_loss"]
        return {**found, "expected_hz": 1.0 / self._period_s, "error": error}

    def _not_taken(self, zero: ZeroRequest, within_s: float) -> str:
        latest, reason = self._latest, ""
        # A reading from before says nothing of the time since.
        if latest is not None and latest.t_mid_ns >= zero.from_ns:
            reason = _reason(latest)
        board = self._board.diagnostics()
        if not board["connected"]:
            reason = str(board["last_loss"]).removesuffix(".")
        reason = reason or "no usable reading came"
        return f"the load cell's zero could not be taken within {within_s:.3g} s: {reason}"

    def _take_zero(self, sample: LoadSample) -> None:
        self._expire_zero(sample.t_arrival_ns)
        zero = self._zero
        if zero is None or not zero.is_open:
            return
        if sample.trusted and sample.t_mid_ns >= zero.from_ns:
            zero.collect()
            self._raw.append(sample.raw)
        if len(self._raw) == ZERO_SAMPLES:
            self._end_zero(zero, self._raw)

    def _expire_zero(self, t_ns: int) -> None:
        """End a request for a zero for which this time is too late, also where no reading comes."""
        if (zero := self._zero) is not None:
            zero.expire_if_late(t_ns, lambda: self._not_taken(zero, self._timeout_s))

    def _end_zero(self, zero: ZeroRequest, samples: Sequence[float]) -> None:
        """Make the mean of raw samples the zero, unless they are of a load, or of one that came or went."""
        raw = sum(samples) / len(samples)
        if why_not := self._why_no_zero(raw, samples):
            zero.fail(f"the load cell's zero was not taken: {why_not}")
            structlog.get_logger().warning(zero.reason)
            return
        self._board.tare(raw)
        if self._confirmed:
            self._judged_by = self._board.calibration
        if self._loop is not None:
            self._loop.on_zero(LOAD_CELL)
        zero.take()

    def _why_no_zero(self, raw: float, samples: Sequence[float]) -> str:
        """Return why the mean of raw samples is no zero, or an empty string.

        The operator can confirm that a constant torque is no load. A torque that changes is a load.
        """
        calibration = self._board.calibration
        torques_nm = [calibration.torque_nm(one) for one in samples]
        changed_nm = max(torques_nm) - min(torques_nm)
        # The median step is of the noise, also where a load comes once.
        step_nm = median(abs(after - before) for before, after in pairwise(torques_nm))
        if changed_nm > max(LARGEST_CHANGE_NM, NOISE_STEPS * step_nm):
            return f"its torque changed by {changed_nm:.3f} N·m during the tare; keep loads away and tare again"
        if self._judged_by is None:
            self._judged_by = calibration
        now_ns = self._clock.now_ns()
        torque = TorqueSample(LOAD_CELL, self._judged_by.torque_nm(raw), "", now_ns, now_ns)
        loaded = load_of([torque])
        if loaded is not None and not self._confirmed:
            return f"{loaded.sentence}, counted from the last confirmed tare or the daemon's start; {loaded.cure}"
        return ""


def load_message(sample: LoadSample) -> LoadTorque:
    """Return the published message of a sample."""
    return LoadTorque(
        source=LOAD_CELL,
        t_mono_ns=sample.t_mid_ns,
        torque_nm=sample.torque_nm,
        raw=sample.raw,
        saturated=sample.saturated,
        spike=sample.spike,
        valid=sample.trusted,
        reason=_reason(sample),
    )


def _reason(sample: LoadSample) -> str:
    """Return why a reading is not trusted, or an empty text."""
    if sample.trusted:
        return ""
    if sample.other_unit is not None:
        return sample.other_unit.clause
    flags = {
        "at the end of its range": sample.saturated,
        "further from the last one than the rig can move": sample.spike,
        "the same for two seconds (its board hangs, or prints too few digits)": sample.stuck,
        "perhaps the end of a longer line": sample.partial,
    }
    return "the reading is " + " and ".join(text for text, is_set in flags.items() if is_set)
