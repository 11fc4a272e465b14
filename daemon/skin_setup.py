"""Builds the shear skin from the configuration: instruments, estimator, task."""

from collections.abc import Callable
from functools import partial

from bank.skin.calibration_file import load_calibration
from daemon.clock import Clock
from daemon.config import InstrumentSocket, SerialDevice, SkinConfig, SkinDaqConfig, SkinSourceConfig
from daemon.links import log_link
from daemon.loop.senses import Source, Torque
from daemon.publisher import Publisher
from daemon.skin_estimator import SkinEstimator
from daemon.skin_task import SKIN, SkinTask
from drivers.serial_port import DEFAULT_BAUD, Link, LinkEvent, SerialLink
from drivers.shear_skin.adc_board import AdcBoard
from drivers.shear_skin.daq import Daq
from drivers.shear_skin.judge import CircuitLimits
from drivers.shear_skin.scanner import ScpiScanner
from drivers.shear_skin.skin import ShearSkin
from drivers.shear_skin.source import Keithley6430
from drivers.tcp_port import TcpLink

OnEvent = Callable[[LinkEvent], None]


def make_skin(
    config: SkinConfig, publisher: Publisher, clock: Clock, hear: Callable[[Torque], None] = lambda _: None
) -> SkinTask:
    """Return the skin's task; raises BankError when its calibration cannot be used. Nothing is opened yet."""
    calibration = load_calibration(config.calibration)
    estimator = SkinEstimator(
        calibration,
        normal_n=config.normal_n,
        zero_samples=config.zero_samples,
        drift_per_hour=config.drift_per_hour,
    )
    # What a gauge can have is judged by what this skin's gauges have at rest.
    limits = CircuitLimits(resistance_ohm=sum(calibration.rest_ohm) / 2.0)
    skin = ShearSkin(_current_source(config.source), _daq(config.daq), limits)
    return SkinTask(skin, estimator, publisher, clock, hear, config.tool_radius_mm)


def skin_source(config: SkinConfig) -> Source | None:
    """Return how often the skin's torque comes; None where no radius makes a torque of its force."""
    if config.tool_radius_mm is None:
        return None
    return Source(name=SKIN, period_s=1.0 / config.daq.rate_hz, sticks=True)


def _current_source(config: SkinSourceConfig) -> Keithley6430:
    link = _link(config.socket, config.serial, config.baud, partial(log_link, "skin source"))
    return Keithley6430(link, config.current_ma * 1e-3, config.compliance_v)


def _daq(config: SkinDaqConfig) -> Daq:
    on_event = partial(log_link, "skin daq")
    if config.scanner is not None:
        link = _link(config.scanner.socket, None, DEFAULT_BAUD, on_event)
        return ScpiScanner(link, config.scanner.channels, config.rate_hz, config.scanner.range_v)
    if config.adc is not None:
        link = _link(None, config.adc.device, DEFAULT_BAUD, on_event)
        return AdcBoard(link, config.rate_hz, config.adc.full_scale_v)
    raise ValueError("a skin has something that reads its voltages")


def _link(socket: InstrumentSocket | None, serial: SerialDevice | None, baud: int, on_event: OnEvent) -> Link:
    if socket is not None:
        return TcpLink(socket.host, socket.port, on_event=on_event)
    if serial is None:
        raise ValueError("an instrument is reached by a socket or by a serial port")
    path = None if serial.path is None else str(serial.path)
    return SerialLink(serial_number=serial.serial_number, path=path, baud=baud, on_event=on_event)
