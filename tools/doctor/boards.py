"""Checks of the boards on serial ports, from their data while the doctor listens."""

import os
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final, Generic, TypeVar

import numpy as np

from shearloop.bank.arrays import BoolArray, FloatArray
from shearloop.bank.channels import PAPER_TABLE, ChannelTable
from shearloop.bank.errors import BankError
from shearloop.daemon.config import AdcConfig, FingertipConfig, LoadCellConfig, SerialDevice
from shearloop.daemon.sensors import load_cell_calibration
from shearloop.drivers.connection import SerialPort, find_port
from shearloop.drivers.eit_kit import START, Frame, FrameParser
from shearloop.drivers.errors import DriverError
from shearloop.drivers.load_cell import LoadCalibration, LoadParser, LoadSample
from shearloop.drivers.refused_lines import shown
from shearloop.drivers.serial_sensor import InputKind, Parser, RawEvent
from shearloop.drivers.shear_skin.instruments import PairParser
from shearloop.errors import Hint
from shearloop.tools.doctor.findings import Finding, from_error, good, note, trouble
from shearloop.tools.fingertip_table import fingertip_table
from shearloop.tools.serial_ports import access_error
from shearloop.words import counted

# A larger relative difference between measured and configured rate is reported.
RATE_TOLERANCE = 0.1
# In recordings at most a third of an electrode's channels stand still for this many frames.
STILL_FRAMES = 10
# A live converter never sends one value this many times.
STUCK_SAMPLES = 10
# What `--seconds` takes.
LONGEST_S: Final = 600.0

ValueT = TypeVar("ValueT")


@dataclass(slots=True)
class Received(Generic[ValueT]):
    """What a board sent while the doctor listened: its values, and its lines with the times of their arrival."""

    seconds: float
    values: list[ValueT] = field(default_factory=list)
    # (monotonic ns, lines) of each read that ended a line, refused lines included.
    lines: list[tuple[int, int]] = field(default_factory=list)
    refused: int = 0
    refusal: Hint | None = None
    # The beginning of a line that did not end.
    unfinished: bytes = b""
    # Why the port was lost while listening; empty where it was not.
    loss: str = ""

    @property
    def rate_hz(self) -> float | None:
        """Lines per second; None for fewer than two reads with lines. The first read holds what had waited."""
        if not self.lines:
            return None
        arrivals_ns = [arrival_ns for arrival_ns, _ in self.lines]
        lasted_ns = arrivals_ns[-1] - arrivals_ns[0]
        n_after_first = sum(count for _, count in self.lines[1:])
        return n_after_first * 1e9 / lasted_ns if lasted_ns > 0 else None


async def listen(path: str, parser: Parser[ValueT], seconds: float, greeting: bytes = b"") -> Received[ValueT]:
    """Open a port once, send the greeting, and return what comes within `seconds`.

    Raises DriverError for a port that cannot be opened. A driver would connect again after a silence, which depends on
    the configured rate.
    """
    received = Received[ValueT](seconds)
    with SerialPort(path) as port:
        parser.handle(RawEvent(InputKind.OPENED, time.monotonic_ns()))
        until_s = time.monotonic() + seconds
        try:
            if greeting:
                await port.write(greeting)
            while (left_s := until_s - time.monotonic()) > 0:
                chunk = await port.read(left_s)
                if chunk is None:
                    break
                before = parser.refused
                values = parser.handle(RawEvent(InputKind.DATA, chunk.t_arrival_ns, chunk.data))
                received.values += values
                if count := len(values) + parser.refused - before:
                    received.lines.append((chunk.t_arrival_ns, count))
        except DriverError as error:
            received.loss = str(error)
    received.refused, received.refusal, received.unfinished = parser.refused, parser.refusal, parser.unfinished
    return received


def check_port(name: str, device: SerialDevice) -> Finding:
    """Check that a serial device is plugged in and may be opened; does not open it."""
    subject = f"port of {name}"
    try:
        path = _path_of(device)
    except DriverError as error:
        cure = "plug the board in, or correct its name in the configuration: `shearloop ports` lists the boards"
        return trouble(subject, str(error), "the board is not plugged in, or has another serial number", cure)
    denied = access_error(path)
    if denied:
        what, _, cure = denied.partition("; ")
        return trouble(subject, f"{path} exists, but {what}", "the daemon cannot read the board", cure)
    by = f"serial number {device.serial_number}" if device.serial_number else "its path"
    return good(subject, f"{os.path.realpath(path)}, found by {by}")


def table_of(config: FingertipConfig) -> ChannelTable:
    """Return a fingertip's channels; the paper's where its bank or calibration cannot be read."""
    try:
        return fingertip_table(config)
    except BankError:
        # Among the files this is a finding of its own, and the board is read all the same.
        return PAPER_TABLE


async def check_fingertip(name: str, config: FingertipConfig, seconds: float) -> list[Finding]:
    """Check a fingertip's port, lines, rate and channels."""
    table = table_of(config)
    parser = FrameParser(table.zero_slots, nominal_period_ns=round(config.frame_period_s * 1e9))
    findings, received = await _receive(name, config.device, parser, seconds, START)
    if received is None:
        return findings
    key = f"fingertips.{name}.frame_period_s"
    findings += _check_pace(name, received, 1.0 / config.frame_period_s, key, as_period=True)
    if received.values:
        findings.append(check_frames(name, received.values, table))
    return findings


async def check_load_cell(config: LoadCellConfig, seconds: float) -> list[Finding]:
    """Check the load cell's port, lines, rate and signal."""
    try:
        calibration = load_cell_calibration(config)
    except DriverError:
        # Among the files this is a finding of its own.
        calibration = LoadCalibration.of_torque_lines()
    parser = LoadParser(calibration, config.rate_hz)
    findings, received = await _receive("load_cell", config.device, parser, seconds)
    if received is None:
        return findings
    findings += _check_pace("load_cell", received, config.rate_hz, "load_cell.rate_hz")
    # The first line may lack its beginning.
    samples = [sample for sample in received.values if not sample.partial]
    if samples:
        findings.append(check_samples(samples))
    return findings


async def check_adc(name: str, config: AdcConfig, rate_hz: float, seconds: float) -> list[Finding]:
    """Check the port, the lines and the rate of the skin's converter board."""
    parser = PairParser(rate_hz, config.full_scale_v)
    findings, received = await _receive(name, config.device, parser, seconds)
    return findings if received is None else findings + _check_pace(name, received, rate_hz, "skin.daq.rate_hz")


def check_rate(subject: str, measured_hz: float, configured_hz: float, key: str, *, as_period: bool = False) -> Finding:
    """Compare a measured rate with the configured one; `key` sets it, as a period or as a rate."""
    found = f"{measured_hz:.3g} Hz measured, {configured_hz:.3g} Hz configured"
    if abs(measured_hz / configured_hz - 1.0) > RATE_TOLERANCE:
        means = "freshness is judged by the configured rate: the loop may hold needlessly, or too late"
        value = 1.0 / measured_hz if as_period else measured_hz
        return note(subject, found, means, f"set `{key}: {value:.4g}` in the configuration")
    return good(subject, found)


def check_frames(name: str, frames: Sequence[Frame], table: ChannelTable) -> Finding:
    """Judge the channels of frames in order."""
    saturated = int(np.any([frame.saturated for frame in frames], axis=0).sum())
    return check_channels(name, np.array([frame.channels for frame in frames]), saturated, table)


def check_channels(name: str, channels: FloatArray, saturated: int, table: ChannelTable) -> Finding:
    """Judge (n, c) channels in volts of frames in order, and the number of saturated ones."""
    subject, n = f"channels of {name}", len(channels)
    dead, at_times = dead_channels(channels, table)
    found = f"{saturated} saturated and {int(dead.sum())} dead of the channels in {counted(n, 'frame')}"
    named = table.name_dead(dead)
    if named:
        found = f"{found}: {', '.join(named)}"
    if n >= STILL_FRAMES and (channels == channels[0]).all() and not dead.all():
        means = "the board does not measure any more, or plays one line again and again"
        return trouble(subject, f"all {n} frames are the same", means, "unplug the board and plug it in again")
    if saturated:
        means = "more signal than the converter can measure: a short, or too much current; every estimate lacks them"
        cure = "look for bridges at the electrodes' connector; wet the gel; lower the injected current"
        return trouble(subject, found, means, cure)
    if dead.any():
        means = "an electrode without contact, or a broken wire; every estimate lacks these channels"
        cure = "press the connector on, wet the gel, and look for a broken wire or a bridge at the named places"
        return trouble(subject, found, means, cure if named else "press the connector on and wet the gel")
    if at_times.any():
        weak = f"{found}; {counted(int(at_times.sum()), 'channel reads', 'channels read')} 0 in some frames"
        means = "a loose contact, or channels with hardly any signal; estimates lack them in those frames"
        return note(subject, weak, means, "press the connector on and wet the gel")
    return good(subject, found)


def dead_channels(channels: FloatArray, table: ChannelTable) -> tuple[BoolArray, BoolArray]:
    """Return the dead (c,) channels of (n, c) frames, and those that read 0 in some frames only.

    Dead channels read 0 in half of the frames, or stand still with all others of their electrode or pair.
    """
    silent = (channels == 0.0).mean(axis=0)
    dead = silent >= 0.5
    if len(channels) >= STILL_FRAMES and (channels != channels[0]).any():
        dead = dead | table.still_groups(np.ptp(channels, axis=0) == 0.0)
    return dead, (silent > 0.0) & ~dead


def check_samples(samples: Sequence[LoadSample]) -> Finding:
    """Judge the load cell's signal."""
    subject, n, last = "signal of load_cell", len(samples), samples[-1]
    if saturated := sum(sample.saturated for sample in samples):
        found = f"{saturated} of {counted(n, 'reading')} are at the converter's limit"
        cure = "take the load off; check the four wires of the cell"
        return trouble(subject, found, "overload, or a loose wire of the bridge", cure)
    if n >= STUCK_SAMPLES and len({sample.raw for sample in samples}) == 1:
        found = f"all {n} readings are exactly {last.raw:.10g}"
        cure = "check that the HX711 has power and that its DT and SCK wires are on the pins named in the sketch"
        return trouble(subject, found, "a live converter is never that still", cure)
    if last.other_unit is not None:
        cause, cure = last.other_unit
        return trouble(subject, f"the last reading is {last.raw:.10g}", f"{cause}, so there is no torque", cure)
    if (spikes := sum(sample.spike for sample in samples)) > 0.5 * n:
        found = f"{spikes} of {counted(n, 'reading')} are beyond the cell's capacity, the last {last.torque_nm:.4g} N·m"
        means = "the calibration is of another cell or another sketch, or its zero has moved"
        return trouble(subject, found, means, "`shearloop command tare` at rest, or `shearloop calibrate load`")
    return good(subject, f"{counted(n, 'reading')}, the last {last.raw:.10g}")


async def _receive(
    name: str, device: SerialDevice, parser: Parser[ValueT], seconds: float, greeting: bytes = b""
) -> tuple[list[Finding], Received[ValueT] | None]:
    """Return the findings on port and lines, and the received data; None where no value came."""
    port = check_port(name, device)
    if port.state == "trouble":
        return [port], None
    nothing_read = "the daemon cannot read the board"
    try:
        received = await listen(_path_of(device), parser, seconds, greeting)
    except DriverError as error:
        return [from_error(port.subject, error, nothing_read, "`shearloop ports` lists the boards")], None
    if received.loss:
        cure = "check its cable and power"
        return [port, from_error(f"lines of {name}", received.loss, "it went while the doctor listened", cure)], None
    if received.values:
        return [port, *_check_refused(name, received)], received
    if received.refusal is not None:
        found = f"{counted(received.refused, 'line')} came, and none is of use; {received.refusal.cause}"
        return [port, trouble(f"lines of {name}", found, nothing_read, received.refusal.cure)], None
    if received.unfinished:
        found = f"bytes without a line end came: {shown(received.unfinished)}"
        cure = "see whether it is this board: `shearloop ports` lists them; let its program end each line"
        return [port, trouble(f"lines of {name}", found, nothing_read, cure)], None
    means = "the board has no power, is another one, or sends less often than once in that time"
    cure = f"check its power; unplug it and plug it in again; listen longer with `--seconds {_longer(seconds)}`"
    found = f"nothing was received in {seconds:g} s"
    return [port, trouble(f"rate of {name}", found, means, cure)], None


def _check_refused(name: str, received: Received[ValueT]) -> list[Finding]:
    if received.refusal is None:
        return []
    lines = received.refused + len(received.values)
    found = f"{counted(received.refused, 'line was', 'lines were')} left out of {lines}; {received.refusal.cause}"
    return [note(f"lines of {name}", found, "the estimates miss these lines", received.refusal.cure)]


def _check_pace(
    name: str, received: Received[ValueT], configured_hz: float, key: str, *, as_period: bool = False
) -> list[Finding]:
    if received.rate_hz is None:
        found = f"{counted(len(received.values), 'value')} came in {received.seconds:g} s"
        cure = f"listen longer: `--seconds {_longer(received.seconds)}`"
        return [note(f"rate of {name}", found, "the rate is unknown: these are too few", cure)]
    return [check_rate(f"rate of {name}", received.rate_hz, configured_hz, key, as_period=as_period)]


def _longer(seconds: float) -> str:
    return f"{min(10 * seconds, LONGEST_S):g}"


def _path_of(device: SerialDevice) -> str:
    return find_port(serial_number=device.serial_number, path=str(device.path) if device.path else None)
