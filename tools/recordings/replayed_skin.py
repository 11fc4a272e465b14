"""The skin's part of a replay: its parsers, validator and estimator, fed with recorded inputs."""

from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Generic

from shearloop.daemon.config import SkinConfig
from shearloop.daemon.messaging.messages import SkinShear
from shearloop.daemon.sensing.skin_task import (
    GIVEN_UP,
    SKIN_CURRENT,
    SKIN_DAQ,
    estimator_of,
    gauge_ohm,
    shear_message,
    tool_radius_m,
    zero_timeout_s,
)
from shearloop.daemon.sensing.snapshots import restored
from shearloop.drivers.errors import ProtocolError
from shearloop.drivers.serial_sensor import InputKind, RawEvent
from shearloop.drivers.shear_skin.instruments import (
    OUTPUT,
    READ,
    SCAN,
    SOURCE_PERIOD_S,
    PairParser,
    ReadingT,
    Reply,
    SourceReading,
    Voltages,
    read_elements,
    read_output,
    read_scan,
)
from shearloop.drivers.shear_skin.skin import SampleAverager, SampleValidator
from shearloop.estimation.skin.calibration import load_calibration


class ReplayedInstrument(Generic[ReadingT]):
    """Parses an instrument's recorded replies. No I/O."""

    def __init__(self, parsers: Mapping[str, Callable[[Reply], ReadingT | None]]) -> None:
        """Parse the replies to these queries."""
        self._parsers = parsers
        self._asked: RawEvent | None = None

    def handle(self, event: RawEvent) -> list[ReadingT]:
        """Return the readings that an event completes; invalid replies give none, as they did live."""
        if event.kind is InputKind.ASKED:
            self._asked = event
        elif event.kind is InputKind.DATA and self._asked is not None:
            asked, self._asked = self._asked, None
            reply = Reply(event.data.decode("latin-1"), asked.t_ns, event.t_ns)
            if parse := self._parsers.get(asked.data.decode("latin-1")):
                with suppress(ProtocolError):
                    reading = parse(reply)
                    return [] if reading is None else [reading]
        return []


class ReplayedSkin:
    """The skin's parsers, validator and estimator, for the replay of recorded events."""

    def __init__(self, config: SkinConfig) -> None:
        """Raises BankError for an unusable calibration."""
        calibration = load_calibration(config.calibration)
        self._estimator = estimator_of(config, calibration)
        current_a = config.source.current_ma * 1e-3
        daq_period_s = 1.0 / config.daq.rate_hz
        self._validator = SampleValidator(current_a, SOURCE_PERIOD_S, daq_period_s, gauge_ohm(calibration))
        self._averager = SampleAverager(config.daq.averaged)
        self._radius_m = tool_radius_m(config)
        self._zero_timeout_ns = round(zero_timeout_s(config) * 1e9)
        self._source = ReplayedInstrument({READ: read_elements, OUTPUT: read_output})
        adc = config.daq.adc
        self._daq: ReplayedInstrument[Voltages] | PairParser = (
            ReplayedInstrument({SCAN: read_scan}) if adc is None else PairParser(config.daq.rate_hz, adc.full_scale_v)
        )
        self._latest: SourceReading | None = None

    def restore(self, text: bytes) -> None:
        """Continue from a recorded state; raises SnapshotError for one that does not fit."""
        like = {"estimator": self._estimator, "validator": self._validator, "averager": self._averager}
        state = restored(text, self._estimator.fixed, like)
        self._validator, self._averager = state["validator"], state["averager"]
        self._latest, self._estimator = state["latest"], state["estimator"]
        self._daq = state.get("parser", self._daq)

    def handle(self, source: str, event: RawEvent) -> list[SkinShear]:
        """Return the messages that a source's event leads to, without processing time."""
        if source == SKIN_CURRENT:
            readings = self._source.handle(event)
            self._latest = readings[-1] if readings else self._latest
        elif source == SKIN_DAQ:
            samples = (self._validator.sample(voltages, self._latest) for voltages in self._daq.handle(event))
            return [
                shear_message(sample, self._estimator.update(sample), self._radius_m, sample.t_arrival_ns)
                for sample in map(self._averager.add, samples)
                if sample is not None
            ]
        elif event.kind is InputKind.TARE and event.data == GIVEN_UP:
            self._estimator.give_up_zero()
        elif event.kind is InputKind.TARE:
            self._averager.restart()
            self._estimator.tare(event.t_ns, event.t_ns + self._zero_timeout_ns)
        return []
