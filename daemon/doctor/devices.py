"""The devices, as long as no daemon holds them: found, opened, heard for some seconds, and let go."""

import asyncio
import contextlib
import os
from collections.abc import AsyncIterator, Awaitable
from pathlib import Path

import numpy as np

from shearloop.bank.eit.channels import ZERO_SLOTS
from shearloop.daemon.config import DaemonConfig, FingertipConfig, GripperConfig, LoadCellConfig, SerialDevice
from shearloop.daemon.doctor.finding import Finding, from_sentence, good, note, trouble
from shearloop.daemon.ports import access_trouble
from shearloop.daemon.rig import make_gripper_client
from shearloop.drivers.connection import find_port
from shearloop.drivers.eit_kit import EitKit, Frame
from shearloop.drivers.errors import DriverError
from shearloop.drivers.load_cell import LoadCalibration, LoadCell
from shearloop.drivers.robotiq.messages import ActivationStatus
from shearloop.drivers.ur.controller_query import look
from shearloop.drivers.ur.settings import read_settings

# A measured rate that is further from the configured one is told.
RATE_TOLERANCE = 0.1
LOOK_TIMEOUT_S = 2.0


async def examine_devices(config: DaemonConfig, seconds: float) -> AsyncIterator[Finding]:
    """Open every device at once, listen for some seconds, and yield what was found, in the configuration's order."""
    looks: list[Awaitable[list[Finding]]] = []
    for name, fingertip in config.fingertips.items():
        looks.append(_fingertip(name, fingertip, seconds))
    if config.load_cell is not None:
        looks.append(_load_cell(config.load_cell, seconds))
    if config.skin is not None:
        for name, serial in (
            ("skin's source", config.skin.source.serial),
            ("skin's DAQ", config.skin.daq.adc.device if config.skin.daq.adc is not None else None),
        ):
            if serial is not None:
                looks.append(_only_port(name, serial))
    if config.gripper is not None:
        looks.append(_gripper(config.gripper))
    if config.robot is not None:
        looks.append(asyncio.to_thread(robot_findings, config.robot))
    for findings in await asyncio.gather(*looks):
        for finding in findings:
            yield finding


def port_finding(name: str, device: SerialDevice) -> Finding:
    """Say whether a serial device is plugged in and may be opened; nothing is opened."""
    subject = f"port of {name}"
    try:
        path = find_port(serial_number=device.serial_number, path=str(device.path) if device.path else None)
    except DriverError as error:
        return from_sentence(subject, str(error), "the board is not plugged in, or has another serial number")
    denied = access_trouble(path)
    if denied:
        what, _, cure = denied.partition("; ")
        return trouble(subject, f"{path} is there, but {what}", "the daemon cannot read the board", cure)
    by = f"serial number {device.serial_number}" if device.serial_number else "its path"
    return good(subject, f"{os.path.realpath(path)} is there, found by {by}")


def rate_finding(subject: str, measured_hz: float | None, configured_hz: float) -> Finding:
    """Hold a measured rate against the configured one."""
    if measured_hz is None:
        return trouble(
            subject,
            "nothing was heard",
            "it is silent: no power, another program's port, or another board",
            "see that it has power; unplug it and plug it in again",
        )
    found = f"{measured_hz:.3g} a second, {configured_hz:.3g} configured"
    if abs(measured_hz / configured_hz - 1.0) > RATE_TOLERANCE:
        return note(
            subject,
            found,
            "freshness is judged by the configured rate: the loop may hold though all is well, or too late",
            f"set the configured rate to {measured_hz:.3g} a second (frame_period_s {1.0 / measured_hz:.4f})",
        )
    return good(subject, found)


def channels_finding(name: str, saturated: int, dead: int, frames: int) -> Finding:
    """Say how many channels tell nothing."""
    subject = f"channels of {name}"
    found = f"{saturated} saturated and {dead} dead of 896 in {frames} frames"
    if not saturated and not dead:
        return good(subject, found)
    means = "what they would tell is missing from every estimate"
    if saturated:
        return trouble(
            subject,
            found,
            f"more signal than the converter can follow: a short, or too much current; {means}",
            "look at the electrodes' connector for bridges; wet the gel; lower the injected current",
        )
    return trouble(
        subject,
        found,
        f"an electrode without contact, or a broken wire; {means}",
        "press the connector on; 28 or 56 dead channels that belong together point to one electrode",
    )


async def _fingertip(name: str, config: FingertipConfig, seconds: float) -> list[Finding]:
    port = port_finding(name, config.device)
    if port.state == "trouble":
        return [port]
    board = EitKit(
        zero_slots=ZERO_SLOTS,
        serial_number=config.device.serial_number,
        path=config.device.path,
        frame_period_s=config.frame_period_s,
    )
    frames: list[Frame] = []
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(seconds), contextlib.aclosing(board.frames()) as heard:
            async for frame in heard:
                frames.append(frame)  # noqa: PERF401 - what came before the time is up is kept
    facts = board.diagnostics()
    if not frames and facts["last_loss"]:
        return [port, from_sentence(f"rate of {name}", str(facts["last_loss"]), "no frame came")]
    findings = [
        port,
        rate_finding(f"rate of {name}", _rate_hz([f.t_arrival_ns for f in frames]), 1 / config.frame_period_s),
    ]
    refused = facts["errors"]
    if isinstance(refused, dict) and sum(refused.values()):
        findings.append(
            note(
                f"lines of {name}",
                f"{sum(refused.values())} refused; {facts['last_frame_error']}",
                "a bad cable, or another program on the same board",
                "exchange the USB cable",
            )
        )
    if frames:
        channels = np.array([frame.channels for frame in frames])
        saturated = np.array([frame.saturated for frame in frames]).any(axis=0)
        findings.append(
            channels_finding(name, int(saturated.sum()), int((channels == 0).all(axis=0).sum()), len(frames))
        )
    return findings


async def _load_cell(config: LoadCellConfig, seconds: float) -> list[Finding]:
    port = port_finding("load_cell", config.device)
    if port.state == "trouble":
        return [port]
    cell = LoadCell(
        LoadCalibration.of_torque_lines(),
        serial_number=config.device.serial_number,
        path=config.device.path,
        rate_hz=config.rate_hz,
    )
    times, saturated = [], 0
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(seconds), contextlib.aclosing(cell.samples()) as heard:
            async for sample in heard:
                times.append(sample.t_arrival_ns)
                saturated += sample.saturated
    findings = [port, rate_finding("rate of load_cell", _rate_hz(times), config.rate_hz)]
    if saturated:
        findings.append(
            trouble(
                "signal of load_cell",
                f"{saturated} of {len(times)} readings are at the converter's end",
                "overloaded, or a wire of the bridge is off",
                "take the load off; look at the four wires of the cell",
            )
        )
    return findings


async def _only_port(name: str, device: SerialDevice) -> list[Finding]:
    return [port_finding(name, device)]


async def _gripper(config: GripperConfig) -> list[Finding]:
    client = make_gripper_client(config)
    try:
        await client.connect()
        state = await client.read()
    except DriverError as error:
        return [from_sentence("gripper", str(error), "nothing can be gripped")]
    finally:
        await client.close()
    if state.flt:
        return [
            trouble(
                "gripper",
                f"{client.name} answers, with fault {state.flt}",
                "it does not move",
                "clear what the fault names, then `shearloop command unlock`",
            )
        ]
    if state.sta is not ActivationStatus.ACTIVE:
        return [
            note(
                "gripper",
                f"{client.name} answers and is not activated",
                "it opens and closes once at the start",
                "keep fingers and tools away when the daemon starts",
            )
        ]
    return [good("gripper", f"{client.name} answers and is activated")]


def robot_findings(settings: Path) -> list[Finding]:
    """Look at the robot's controller: there, in remote control, in a mode to move, registers free."""
    try:
        host = read_settings(settings).host
        seen = look(host, LOOK_TIMEOUT_S)
    except DriverError as error:
        return [from_sentence("robot", str(error), "the robot cannot be driven")]
    findings = [good("robot", f"{host} answers, PolyScope {seen.version}")]
    if seen.remote is False:
        findings.append(
            trouble(
                "remote control",
                "the robot is in local control",
                "it takes no motion from the network",
                "switch it to remote control, top right on the teach pendant",
            )
        )
    else:
        findings.append(good("remote control", "on" if seen.remote else "this controller knows no such mode"))
    mode = f"robot mode {seen.robot_mode}, safety mode {seen.safety_mode}"
    if (seen.robot_mode, seen.safety_mode) in (("RUNNING", "NORMAL"), ("RUNNING", "REDUCED")):
        findings.append(good("robot's mode", mode))
    else:
        findings.append(
            note(
                "robot's mode",
                mode,
                "the arm does not move as it is",
                "make the cell safe, start the daemon, then `shearloop command unlock`",
            )
        )
    if seen.registers_free:
        findings.append(good("robot's registers", "free"))
    else:
        findings.append(
            trouble(
                "robot's registers",
                "in use",
                "another RTDE client, EtherNet/IP or PROFINET commands the robot",
                "end the other program, or disable the adapter under Installation → Fieldbus",
            )
        )
    return findings


def _rate_hz(times_ns: list[int]) -> float | None:
    if len(times_ns) < 2 or times_ns[-1] == times_ns[0]:
        return None
    return (len(times_ns) - 1) * 1e9 / (times_ns[-1] - times_ns[0])
