"""The shear skin's task: builds instruments and estimator, publishes the shear force, takes the zero."""

import contextlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import structlog

from shearloop.bank.errors import CalibrationError
from shearloop.daemon.clock import Clock
from shearloop.daemon.config import InstrumentSocket, SerialDevice, SkinConfig
from shearloop.daemon.logs import LinkReporter
from shearloop.daemon.messaging.messages import SkinShear
from shearloop.daemon.messaging.publisher import Publisher
from shearloop.daemon.reach import Reach
from shearloop.daemon.sensing.skin_estimator import SkinEstimator, SkinReading
from shearloop.daemon.sensing.zero_request import ZERO_TIMEOUT_S, ZeroRequest, ZeroState
from shearloop.daemon.torques import SensorListener, TorqueSample, TorqueSource
from shearloop.drivers.connection import DEFAULT_BAUD, Diagnostics, Link, LinkMonitor, LinkObserver, SerialLink
from shearloop.drivers.serial_sensor import InputKind, InputRecorder, RawEvent
from shearloop.drivers.shear_skin.instruments import AdcBoard, Daq, Keithley6430, ScpiScanner
from shearloop.drivers.shear_skin.skin import ShearSkin, SkinSample
from shearloop.drivers.shear_skin.tcp_link import TcpLink
from shearloop.errors import UserError
from shearloop.estimation.skin.calibration import SkinCalibration, load_calibration
from shearloop.estimation.skin.membrane import joule_heating_k

SKIN = "skin"
# The instruments' names in health and in recordings.
SKIN_CURRENT, SKIN_DAQ = f"{SKIN}.source", f"{SKIN}.daq"
# All sources of a skin's recorded inputs.
SKIN_SOURCES = SKIN, SKIN_CURRENT, SKIN_DAQ
# The paper's bound.
MAX_WARMING_K = 5.0
# The last digit of a converter board's line, 1 µV, is then a response of 3e-4, 4 mN.
MIN_GAUGE_V = 3e-3
# The recorded data of a zero that is given up before its time is over, because its step has ended.
GIVEN_UP = b"given up"
_NO_RADIUS = "it has no torque without `skin.tool_radius_mm`"


@dataclass(frozen=True, slots=True)
class SkinCurrentTask:
    """Keeps the current source set up and read."""

    skin: ShearSkin

    async def run(self) -> None:
        """Read until cancelled."""
        await self.skin.watch_source()

    def diagnostics(self) -> Diagnostics:
        """Return the values of the current source for `health`."""
        return self.skin.source_diagnostics()


class SkinTask:
    """Connects the skin's instruments and its estimator to the publisher and the control loop."""

    def __init__(
        self,
        config: SkinConfig,
        publisher: Publisher,
        clock: Clock,
        loop: SensorListener | None = None,
        inputs: Mapping[str, InputRecorder | None] = MappingProxyType({}),
    ) -> None:
        """Build everything, not yet open; `inputs` keeps the inputs of each source, by its name.

        Raises BankError for an unusable calibration and UserError if the instruments cannot measure these gauges.
        """
        calibration = load_calibration(config.calibration)
        self._skin = skin_device(config, calibration, config.daq.averaged, inputs)
        self.source = SkinCurrentTask(self._skin)
        self._estimator = estimator_of(config, calibration)
        self._publisher = publisher
        self._clock = clock
        self._loop = loop
        self._inputs = inputs.get(SKIN)
        self._radius_m = tool_radius_m(config)
        self._zero_timeout_s = zero_timeout_s(config)
        # The latest request for a zero. The first zero is taken without one.
        self._zero: ZeroRequest | None = None
        self._reason = ""
        self._drift_warning = ""
        self._valid = 0

    async def run(self) -> None:
        """Publish every sample's force and pass its torque on, until cancelled."""
        async with contextlib.aclosing(self._skin.batches()) as batches:
            async for samples in batches:
                for sample in samples:
                    self._expire_zero(sample.t_arrival_ns)
                    self._publish(sample, self._estimator.update(sample))
                    self._follow_estimator()
                    self._warn_of_drift()
                if self._inputs is not None and self._inputs.wants_state:
                    state = {**self._skin.state, "estimator": self._estimator}
                    self._inputs.record_state(state, self._estimator.fixed, self._clock.now_ns())

    def tare(self, *, confirmed: bool = False) -> None:  # noqa: ARG002 - the skin judges by its gauges at rest
        """Take a new zero from samples measured from now on."""
        self._request_zero()

    @property
    def taring(self) -> bool:
        """Whether the next samples belong to a zero that was asked for a short time ago, also after a refused one."""
        zero, now_ns = self._zero, self._clock.now_ns()
        if zero is None or now_ns > zero.until_ns:
            return False
        retakes = zero.state is ZeroState.FAILED and self._estimator.zero is None and not self._estimator.given_up
        return retakes or zero.is_under_way(now_ns)

    async def tare_and_wait(self, within_s: float) -> str | None:
        """Take a new zero and wait until it is done; return None, or why it was not taken."""
        zero, within_s = self._request_zero(), min(self._zero_timeout_s, within_s)
        try:
            return await zero.wait(within_s, lambda: self._not_taken(within_s))
        finally:
            if zero is self._zero and zero.state is ZeroState.EXPIRED and not self._estimator.given_up:
                self._record(self._clock.now_ns(), GIVEN_UP)
                self._estimator.give_up_zero()

    def _request_zero(self) -> ZeroRequest:
        now_ns = self._clock.now_ns()
        self._zero = ZeroRequest(now_ns, now_ns + round(self._zero_timeout_s * 1e9), self._zero)
        self._record(now_ns)
        self._skin.restart_average()
        self._estimator.tare(now_ns, self._zero.until_ns)
        return self._zero

    def _expire_zero(self, t_ns: int) -> None:
        """End a request for which a sample that arrives then is too late; the estimator gives up by the same time."""
        if self._zero is not None:
            self._zero.expire_if_late(t_ns, lambda: self._not_taken(self._zero_timeout_s))

    def _follow_estimator(self) -> None:
        """Bring the request for a zero up to the estimator, which has taken the next sample."""
        zero, estimator = self._zero, self._estimator
        if zero is None or not zero.is_open:
            return
        if estimator.zero is not None:
            zero.take()
        elif estimator.refused:
            # The estimator takes it again until the request's end.
            zero.fail(f"the skin's zero was refused: {estimator.refused}")
        elif estimator.is_collecting:
            zero.collect()

    def _warn_of_drift(self) -> None:
        """Log when the latest zero changes the known drift."""
        before, self._drift_warning = self._drift_warning, self._estimator.drift_warning
        if self._drift_warning != before:
            structlog.get_logger().warning(self._drift_warning or "the skin's zeros show no drift any more")

    def _not_taken(self, within_s: float) -> str:
        return f"the skin's zero could not be taken within {within_s:.3g} s: {self._reason or 'nothing came'}"

    def _record(self, now_ns: int, data: bytes = b"") -> None:
        if self._inputs is not None:
            self._inputs.record(RawEvent(InputKind.TARE, now_ns, data))

    def diagnostics(self) -> Diagnostics:
        """Return the values of voltages, zero and force for `health`."""
        # Also where no sample comes.
        self._expire_zero(self._clock.now_ns())
        zero, voltages = self._estimator.zero, self._skin.diagnostics()
        request = self._zero
        why_no_zero = request.reason if request is not None and request.state is ZeroState.EXPIRED else ""
        return {
            **voltages,
            "valid": self._valid,
            "error": self._reason or why_no_zero or self._drift_warning or str(voltages.get("last_refusal", "")),
            "zero_1_ohm": zero.r1_ohm if zero is not None else None,
            "zero_2_ohm": zero.r2_ohm if zero is not None else None,
            "drift_per_hour": self._estimator.drift_per_hour,
        }

    def _publish(self, sample: SkinSample, reading: SkinReading) -> None:
        now_ns = self._clock.now_ns()
        message = shear_message(sample, reading, self._radius_m, now_ns)
        self._reason = message.reason
        self._valid += reading.valid
        if self._loop is not None:
            self._loop.on_torque(self._judged_torque(sample, reading, now_ns))
        self._publisher.publish(message)

    def _judged_torque(self, sample: SkinSample, reading: SkinReading, now_ns: int) -> TorqueSample:
        """Return the torque, and the load beyond drift; without a radius the load is a force."""
        load, loaded_n = self._estimator.why_not_at_rest(sample), self._estimator.loaded_n
        if self._radius_m is not None:
            torque = skin_torque(reading, self._radius_m, sample.t_mid_ns, now_ns)
            return replace(torque, loaded_nm=loaded_n * self._radius_m, load=load)
        shear_n = reading.shear_n
        loading = f"{shear_n:+.2f} N" if shear_n is not None and abs(shear_n) > loaded_n else ""
        return TorqueSample(SKIN, None, _NO_RADIUS, sample.t_mid_ns, now_ns, loading=loading, load=load)


def shear_message(sample: SkinSample, reading: SkinReading, radius_m: float | None, now_ns: int) -> SkinShear:
    """Return the published message of a sample; without a radius there is no torque."""
    interval = reading.interval
    torque = None if radius_m is None else skin_torque(reading, radius_m, sample.t_mid_ns, now_ns)
    return SkinShear(
        source=SKIN,
        t_mono_ns=sample.t_mid_ns,
        shear_n=reading.shear_n,
        shear_low_n=interval.low_n if interval is not None else None,
        shear_high_n=interval.high_n if interval is not None else None,
        torque_nm=torque.torque_nm if torque is not None else None,
        torque_low_nm=interval.low_n * radius_m if interval is not None and radius_m is not None else None,
        torque_high_nm=interval.high_n * radius_m if interval is not None and radius_m is not None else None,
        response=reading.response,
        response_1=reading.response_1,
        response_2=reading.response_2,
        r1_ohm=sample.r1_ohm,
        r2_ohm=sample.r2_ohm,
        deadband=interval is not None and interval.in_deadband,
        direction=reading.direction.value,
        valid=reading.valid,
        reason="; ".join(reading.reasons),
        sample=sample.seq,
        missed=sample.missed,
        latency_s=(now_ns - sample.t_arrival_ns) / 1e9,
    )


def skin_torque(reading: SkinReading, radius_m: float, t_mid_ns: int, now_ns: int) -> TorqueSample:
    """Return the torque of a shear force at a radius, with the band that friction leaves."""
    if reading.band is None:
        return TorqueSample(SKIN, None, "; ".join(reading.reasons), t_mid_ns, now_ns)
    force_nm, low_nm, high_nm = (force_n * radius_m for force_n in reading.band)
    return TorqueSample(SKIN, force_nm, "", t_mid_ns, now_ns, low_nm, high_nm)


def skin_torque_source(config: SkinConfig) -> TorqueSource | None:
    """Return the skin as a source of torque; None without a radius."""
    radius_m = tool_radius_m(config)
    if radius_m is None:
        return None
    reach, period_s = _reach(config, radius_m), config.daq.sample_period_s
    return TorqueSource(name=SKIN, period_s=period_s, has_friction_band=True, reach=reach)


def _reach(config: SkinConfig, radius_m: float) -> Reach | None:
    """Return the torques at a radius within the calibrated curve; None if the calibration cannot be read.

    The curve is over the skin's tension. The shear differs from it by up to the friction force, half the band of
    `friction_band_n`.
    """
    try:
        calibration = load_calibration(config.calibration)
    except CalibrationError:
        # The skin's task, and its part of `check`, name the mistake.
        return None
    largest_friction_n = 0.5 * friction_band_n(config, calibration)
    low_n, high_n = calibration.tension_n[0], calibration.tension_n[-1]
    why = (
        f"it is calibrated from {low_n:+.1f} to {high_n:+.1f} N, and its radius is {1e3 * radius_m:g} mm; ask for "
        "less, or calibrate it further"
    )
    return Reach((low_n - largest_friction_n) * radius_m, (high_n + largest_friction_n) * radius_m, why)


def check_circuit(config: SkinConfig, calibration: SkinCalibration) -> None:
    """Raise UserError if the skin cannot be measured so.

    The gauges would get too warm, their voltages are too small or exceed source or converter, or friction hides the
    whole calibrated range.
    """
    largest_n = max(calibration.tension_n[-1], -calibration.tension_n[0])
    if friction_band_n(config, calibration) > largest_n:
        raise UserError(
            f"`skin.normal_n`: {config.normal_n:g} N hide {friction_band_n(config, calibration):.1f} N of shear by "
            f"friction, and the calibration ends at {largest_n:.1f} N; give the force that presses on the skin, in N"
        )
    current_a = config.source.current_ma * 1e-3
    max_ohm = max(calibration.rest_ohm) * (1.0 + max(calibration.response[-1], -calibration.response[0]))
    gauge_v, whole_v = max_ohm * current_a, (max_ohm + min(calibration.rest_ohm)) * current_a
    warming_k = joule_heating_k(max(calibration.rest_ohm) * current_a**2)
    setting = f"`skin.source.current_ma`: {config.source.current_ma:g} mA"
    if warming_k > MAX_WARMING_K:
        raise UserError(
            f"{setting} warm a gauge of {max(calibration.rest_ohm):.1f} Ω by {warming_k:.1f} K, more than the "
            f"{MAX_WARMING_K:g} K that are allowed; take 5"
        )
    if (rest_v := min(calibration.rest_ohm) * current_a) < MIN_GAUGE_V:
        raise UserError(
            f"{setting} make {1e3 * rest_v:.2g} mV of a gauge at rest, less than the {1e3 * MIN_GAUGE_V:g} mV that "
            "can be read well enough; take 5"
        )
    if whole_v > config.source.compliance_v:
        raise UserError(
            f"{setting} need {whole_v:.2f} V at the end of the calibration, and `skin.source.compliance_v` is "
            f"{config.source.compliance_v:g}; raise that, or lower the current"
        )
    adc, scanner = config.daq.adc, config.daq.scanner
    at_end = f"{setting} make {gauge_v:.2f} V of a gauge at the end of the calibration, and"
    if adc is not None and gauge_v >= adc.full_scale_v:
        raise UserError(
            f"{at_end} `skin.daq.adc.full_scale_v` is {adc.full_scale_v:g}; set the converter's gain lower, or the "
            "current"
        )
    if scanner is not None and gauge_v > scanner.range_v:
        raise UserError(f"{at_end} `skin.daq.scanner.range_v` is {scanner.range_v:g}; take the next range")


def friction_band_n(config: SkinConfig, calibration: SkinCalibration) -> float:
    """Return the width of the forces that a skin that sticks leaves open, 2 μFₙ."""
    return 2.0 * calibration.friction * config.normal_n


def zero_timeout_s(config: SkinConfig) -> float:
    """Return the longest time of a zero that was asked for; from averaged samples it takes longer."""
    return max(ZERO_TIMEOUT_S, 2.0 * config.zero_samples * config.daq.sample_period_s)


def tool_radius_m(config: SkinConfig) -> float | None:
    """Return the tool's radius in m, None if the skin gives no torque."""
    return None if config.tool_radius_mm is None else config.tool_radius_mm * 1e-3


def gauge_ohm(calibration: SkinCalibration) -> float:
    """Return the mean resistance of a gauge at rest."""
    return sum(calibration.rest_ohm) / 2.0


def estimator_of(config: SkinConfig, calibration: SkinCalibration) -> SkinEstimator:
    """Return the estimator of a configured skin, before its first sample."""
    return SkinEstimator(
        calibration, normal_n=config.normal_n, zero_samples=config.zero_samples, drift_per_hour=config.drift_per_hour
    )


def skin_device(
    config: SkinConfig,
    calibration: SkinCalibration,
    averaged: int,
    inputs: Mapping[str, InputRecorder | None] = MappingProxyType({}),
    observer_of: Callable[[str], LinkObserver | None] = LinkReporter,
) -> ShearSkin:
    """Return the skin's instruments, not yet open; `averaged` readings become a sample.

    `observer_of` returns the observer of an instrument's link. Raises UserError if the instruments cannot measure these
    gauges.
    """
    check_circuit(config, calibration)
    source, daq = (LinkMonitor(observer_of(name)) for name in ("skin source", "skin daq"))
    return ShearSkin(
        current_source(config, source, inputs.get(SKIN_CURRENT)),
        voltage_reader(config, daq, inputs.get(SKIN_DAQ)),
        gauge_ohm(calibration),
        averaged,
    )


def current_source(config: SkinConfig, monitor: LinkMonitor, inputs: InputRecorder | None = None) -> Keithley6430:
    """Return the driver of the current source, not yet open."""
    source = config.source
    link = _link(source.socket, source.serial, source.baud, monitor)
    return Keithley6430(link, current_a=source.current_ma * 1e-3, compliance_v=source.compliance_v, inputs=inputs)


def voltage_reader(config: SkinConfig, monitor: LinkMonitor, inputs: InputRecorder | None = None) -> Daq:
    """Return the driver of the instrument that reads the voltages, not yet open."""
    rate_hz, scanner, adc = config.daq.rate_hz, config.daq.scanner, config.daq.adc
    if scanner is not None:
        link = _link(scanner.socket, None, DEFAULT_BAUD, monitor)
        channels, range_v = scanner.channels, scanner.range_v
        return ScpiScanner(link, channels=channels, period_s=1.0 / rate_hz, range_v=range_v, inputs=inputs)
    if adc is not None:
        return AdcBoard(_link(None, adc.device, DEFAULT_BAUD, monitor), rate_hz, adc.full_scale_v, inputs)
    raise ValueError("a skin needs an instrument that reads its voltages")


def _link(socket: InstrumentSocket | None, serial: SerialDevice | None, baud: int, monitor: LinkMonitor) -> Link:
    if socket is not None:
        return TcpLink(socket.host, socket.port, monitor=monitor)
    if serial is None:
        raise ValueError("an instrument needs a socket or a serial port")
    return SerialLink(serial_number=serial.serial_number, path=serial.path, baud=baud, monitor=monitor)
