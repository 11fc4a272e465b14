"""Builds the shear skin from the configuration: instruments, estimator, task."""

from collections.abc import Callable
from functools import partial

from shearloop.bank.skin.calibration import SkinCalibration, load_calibration
from shearloop.bank.skin.membrane import joule_heating_k
from shearloop.daemon.clock import Clock
from shearloop.daemon.config import InstrumentSocket, SerialDevice, SkinConfig, SkinDaqConfig, SkinSourceConfig
from shearloop.daemon.control.loop_inputs import TorqueSample, TorqueSource
from shearloop.daemon.errors import UserError
from shearloop.daemon.links import log_link
from shearloop.daemon.messaging.messages import SkinShear
from shearloop.daemon.messaging.publisher import Publisher
from shearloop.daemon.sensing.skin_estimator import SkinEstimator
from shearloop.daemon.sensing.skin_task import SKIN, SKIN_DAQ, SKIN_SOURCE, SkinTask, shear_message
from shearloop.drivers.raw_event import InputKind, RawEvent, Tap, no_tap
from shearloop.drivers.serial_port import DEFAULT_BAUD, Link, LinkEvent, SerialLink
from shearloop.drivers.shear_skin.adc_board import AdcBoard, PairParser
from shearloop.drivers.shear_skin.daq import Daq
from shearloop.drivers.shear_skin.judge import CircuitLimits, SampleValidator
from shearloop.drivers.shear_skin.scanner import RecordedScanner, ScpiScanner
from shearloop.drivers.shear_skin.skin import ShearSkin
from shearloop.drivers.shear_skin.source import PERIOD_S as SOURCE_PERIOD_S
from shearloop.drivers.shear_skin.source import Keithley6430, RecordedSource, SourceReading
from shearloop.drivers.tcp_port import TcpLink

# The paper's bound.
MOST_WARMING_K = 5.0

OnEvent = Callable[[LinkEvent], None]


def make_skin(
    config: SkinConfig,
    publisher: Publisher,
    clock: Clock,
    hear: Callable[[TorqueSample], None] = lambda _: None,
    tap: Callable[[str], Tap] = lambda _: no_tap,
) -> SkinTask:
    """Return the skin's task; raises BankError when its calibration cannot be used. Nothing is opened yet.

    Raises UserError where the instruments cannot measure these gauges. `tap` gives what hears of the inputs of a
    source, by its name.
    """
    calibration = load_calibration(config.calibration)
    check_circuit(config, calibration)
    source = _current_source(config.source, tap(SKIN_SOURCE))
    skin = ShearSkin(source, _daq(config.daq, tap(SKIN_DAQ)), _limits(calibration))
    estimator = _estimator(config, calibration)
    return SkinTask(skin, estimator, publisher, clock, hear, config.tool_radius_mm, tap(SKIN))


def check_circuit(config: SkinConfig, calibration: SkinCalibration) -> None:
    """Raise UserError where the gauges would get too warm, or their voltages reach beyond source or converter."""
    current_a = config.source.current_ma * 1e-3
    largest_ohm = max(calibration.rest_ohm) * (1.0 + max(calibration.response[-1], -calibration.response[0]))
    gauge_v, whole_v = largest_ohm * current_a, (largest_ohm + min(calibration.rest_ohm)) * current_a
    warming_k = joule_heating_k(max(calibration.rest_ohm) * current_a**2)
    told = f"`skin.source.current_ma`: {config.source.current_ma:g} mA"
    if warming_k > MOST_WARMING_K:
        raise UserError(
            f"{told} warm a gauge of {max(calibration.rest_ohm):.1f} Ω by {warming_k:.1f} K, more than the "
            f"{MOST_WARMING_K:g} K that are allowed; take 5"
        )
    if whole_v > config.source.compliance_v:
        raise UserError(
            f"{told} need {whole_v:.2f} V at the end of the calibration, and `skin.source.compliance_v` is "
            f"{config.source.compliance_v:g}; raise that, or lower the current"
        )
    adc, scanner = config.daq.adc, config.daq.scanner
    if adc is not None and gauge_v >= adc.full_scale_v:
        raise UserError(
            f"{told} make {gauge_v:.2f} V of a gauge at the end of the calibration, and `skin.daq.adc.full_scale_v` is "
            f"{adc.full_scale_v:g}; set the converter's gain lower, or the current"
        )
    if scanner is not None and gauge_v > scanner.range_v:
        raise UserError(
            f"{told} make {gauge_v:.2f} V of a gauge at the end of the calibration, and `skin.daq.scanner.range_v` is "
            f"{scanner.range_v:g}; take the next range"
        )


class RecordedSkin:
    """The skin's own parsers, judge and estimator, told again what a recording says that they were told."""

    sources = (SKIN, SKIN_SOURCE, SKIN_DAQ)

    def __init__(self, config: SkinConfig) -> None:
        """Raises BankError when the calibration cannot be used."""
        calibration = load_calibration(config.calibration)
        self._estimator = _estimator(config, calibration)
        self._judge = SampleValidator(
            config.source.current_ma * 1e-3, SOURCE_PERIOD_S, 1.0 / config.daq.rate_hz, _limits(calibration)
        )
        self._radius_m = None if config.tool_radius_mm is None else config.tool_radius_mm * 1e-3
        self._source = RecordedSource()
        adc = config.daq.adc
        self._daq: RecordedScanner | PairParser = (
            RecordedScanner() if adc is None else PairParser(config.daq.rate_hz, adc.full_scale_v)
        )
        self._latest: SourceReading | None = None

    def take(self, source: str, told: RawEvent) -> list[SkinShear]:
        """Return the messages that an input of one of the sources leads to, as if none had taken any time."""
        if source == SKIN_SOURCE:
            readings = self._source.take(told)
            self._latest = readings[-1] if readings else self._latest
        elif source == SKIN_DAQ:
            samples = (self._judge.sample(voltages, self._latest) for voltages in self._daq.take(told))
            return [
                shear_message(sample, self._estimator.update(sample), self._radius_m, sample.t_arrival_ns)
                for sample in samples
            ]
        elif told.kind is InputKind.TARE:
            self._estimator.tare(told.t_ns)
        return []


def skin_source(config: SkinConfig) -> TorqueSource | None:
    """Return how often the skin's torque comes; None where no radius makes a torque of its force."""
    if config.tool_radius_mm is None:
        return None
    return TorqueSource(name=SKIN, period_s=1.0 / config.daq.rate_hz, has_friction_band=True)


def _estimator(config: SkinConfig, calibration: SkinCalibration) -> SkinEstimator:
    return SkinEstimator(
        calibration,
        normal_n=config.normal_n,
        zero_samples=config.zero_samples,
        drift_per_hour=config.drift_per_hour,
    )


def _limits(calibration: SkinCalibration) -> CircuitLimits:
    # What a gauge can have is judged by what this skin's gauges have at rest.
    return CircuitLimits(resistance_ohm=sum(calibration.rest_ohm) / 2.0)


def _current_source(config: SkinSourceConfig, tap: Tap) -> Keithley6430:
    link = _link(config.socket, config.serial, config.baud, partial(log_link, "skin source"))
    return Keithley6430(link, config.current_ma * 1e-3, config.compliance_v, SOURCE_PERIOD_S, tap=tap)


def _daq(config: SkinDaqConfig, tap: Tap) -> Daq:
    on_event = partial(log_link, "skin daq")
    if config.scanner is not None:
        link = _link(config.scanner.socket, None, DEFAULT_BAUD, on_event)
        return ScpiScanner(link, config.scanner.channels, config.rate_hz, config.scanner.range_v, tap=tap)
    if config.adc is not None:
        link = _link(None, config.adc.device, DEFAULT_BAUD, on_event)
        return AdcBoard(link, config.rate_hz, config.adc.full_scale_v, tap)
    raise ValueError("a skin has something that reads its voltages")


def _link(socket: InstrumentSocket | None, serial: SerialDevice | None, baud: int, on_event: OnEvent) -> Link:
    if socket is not None:
        return TcpLink(socket.host, socket.port, on_event=on_event)
    if serial is None:
        raise ValueError("an instrument is reached by a socket or by a serial port")
    path = None if serial.path is None else str(serial.path)
    return SerialLink(serial_number=serial.serial_number, path=path, baud=baud, on_event=on_event)
