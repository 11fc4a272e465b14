"""The tasks of the shear skin: keep its source going, read its voltages, publish the shear force, take its zero."""

import contextlib
from collections.abc import Callable, Mapping

from shearloop.daemon.clock import Clock
from shearloop.daemon.control.loop_inputs import TorqueSample
from shearloop.daemon.messaging.messages import Scalar, SkinShear
from shearloop.daemon.messaging.publisher import Publisher
from shearloop.daemon.sensing.skin_estimator import SkinEstimator, SkinReading
from shearloop.daemon.waiting import Waiting
from shearloop.drivers.raw_event import InputKind, RawEvent, Tap, no_tap
from shearloop.drivers.shear_skin.judge import SkinSample
from shearloop.drivers.shear_skin.skin import ShearSkin

SKIN = "skin"
# What its instruments are called in health and in recordings.
SKIN_SOURCE, SKIN_DAQ = f"{SKIN}.source", f"{SKIN}.daq"
# A zero takes two seconds; what keeps it for longer than this does not go away by waiting.
ZERO_DEADLINE_S = 15.0


class SkinTask:
    """Ties the skin's instruments and its estimator to the publisher and to whoever goes by its torque."""

    def __init__(
        self,
        skin: ShearSkin,
        estimator: SkinEstimator,
        publisher: Publisher,
        clock: Clock,
        hear: Callable[[TorqueSample], None] = lambda _: None,
        tool_radius_mm: float | None = None,
        tap: Tap = no_tap,
    ) -> None:
        """Take what is to be tied together; `tap` hears of each tare."""
        self._tap = tap
        self._skin = skin
        self._estimator = estimator
        self._publisher = publisher
        self._clock = clock
        self._hear = hear
        self._radius_m = None if tool_radius_mm is None else tool_radius_mm * 1e-3
        self._waiting = Waiting()
        self._why = ""
        self._valid = 0

    async def watch_source(self) -> None:
        """Keep the current source set up and read, until cancelled."""
        await self._skin.watch_source()

    async def read(self) -> None:
        """Publish every sample's force and pass its torque on, until cancelled."""
        async with contextlib.aclosing(self._skin.samples()) as samples:
            async for sample in samples:
                reading = self._estimator.update(sample)
                self._publish(sample, reading)
                self._tell_zero()

    def tare(self) -> None:
        """Take a new zero, beginning with the first sample that is measured from now on."""
        now_ns = self._clock.now_ns()
        self._tap(RawEvent(InputKind.TARE, now_ns))
        self._estimator.tare(now_ns)

    async def zero(self) -> str:
        """Take a new zero and wait until it is there; return why it could not be taken, or an empty text."""
        self.tare()
        try:
            # Who waits for a zero that was asked for before waits for this one, which is later still.
            return await self._waiting.wait(ZERO_DEADLINE_S)
        except TimeoutError:
            return f"the skin's zero could not be taken within {ZERO_DEADLINE_S:g} s: {self._why or 'nothing came'}"

    def facts(self) -> Mapping[str, Scalar | Mapping[str, int]]:
        """Return what health tells of the voltages, the zero and the force."""
        zero = self._estimator.zero
        return {
            **self._skin.facts(),
            "valid": self._valid,
            "error": self._why,
            "zero_1_ohm": zero.r1_ohm if zero is not None else None,
            "zero_2_ohm": zero.r2_ohm if zero is not None else None,
            "drift_per_hour": self._estimator.drift_per_hour,
        }

    def source_facts(self) -> Mapping[str, Scalar | Mapping[str, int]]:
        """Return what health tells of the current source."""
        return self._skin.source_facts()

    def _tell_zero(self) -> None:
        if self._estimator.refused:
            self._waiting.tell(f"the skin's zero was refused: {self._estimator.refused}")
        elif self._estimator.zero is not None:
            self._waiting.tell("")

    def _publish(self, sample: SkinSample, reading: SkinReading) -> None:
        now_ns = self._clock.now_ns()
        message = shear_message(sample, reading, self._radius_m, now_ns)
        self._why = message.reason
        self._valid += reading.valid
        if self._radius_m is not None:
            self._hear(skin_torque(reading, self._radius_m, sample.t_mid_ns, now_ns))
        self._publisher.publish(message)


def shear_message(sample: SkinSample, reading: SkinReading, radius_m: float | None, now_ns: int) -> SkinShear:
    """Return what is published of a sample; without a radius there is no torque."""
    interval = reading.interval
    torque = None if radius_m is None else skin_torque(reading, radius_m, sample.t_mid_ns, now_ns)
    return SkinShear(
        source=SKIN,
        t_mono_ns=sample.t_mid_ns,
        shear_n=reading.shear_n,
        shear_low_n=interval.low_n if interval is not None else None,
        shear_high_n=interval.high_n if interval is not None else None,
        torque_nm=torque.torque_nm if torque is not None else None,
        response=reading.response,
        response_1=reading.response_1,
        response_2=reading.response_2,
        r1_ohm=sample.r1_ohm,
        r2_ohm=sample.r2_ohm,
        deadband=interval is not None and interval.in_deadband,
        direction=reading.direction.value,
        valid=reading.valid,
        reason="; ".join(reading.why),
        sample=sample.seq,
        missed=sample.missed,
        latency_s=(now_ns - sample.t_arrival_ns) / 1e9,
    )


def skin_torque(reading: SkinReading, radius_m: float, t_mid_ns: int, now_ns: int) -> TorqueSample:
    """Return the torque of a shear force at a radius, with the band that friction leaves to it."""
    if reading.band is None:
        return TorqueSample(SKIN, None, "; ".join(reading.why), t_mid_ns, now_ns)
    force_nm, low_nm, high_nm = (force_n * radius_m for force_n in reading.band)
    return TorqueSample(SKIN, force_nm, "", t_mid_ns, now_ns, low_nm, high_nm)
