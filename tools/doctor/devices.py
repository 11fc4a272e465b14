"""Checks of the devices: opened and listened to directly, or through the daemon that holds them."""

import asyncio
import contextlib
import errno
import os
import time
from collections import defaultdict
from collections.abc import AsyncIterator, Awaitable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from shearloop.cli.terminal import task_row
from shearloop.daemon.config import DaemonConfig, FingertipConfig, GripperConfig, LoadCellConfig, SerialDevice
from shearloop.errors import UserError
from shearloop.daemon.messaging.client import receive_messages, send_command
from shearloop.daemon.messaging.stop_client import send_to_stop_socket
from shearloop.daemon.rig import make_gripper_client
from shearloop.daemon.sensing.frame_estimator import fingertip_table
from shearloop.tools.serial_ports import access_error
from shearloop.drivers.connection import SerialLink, find_port
from shearloop.drivers.eit_kit import EitKit
from shearloop.drivers.errors import DriverError
from shearloop.drivers.load_cell import LoadCalibration, LoadCell
from shearloop.drivers.robotiq.messages import ActivationStatus
from shearloop.drivers.ur.control_box import query_controller, untested_sentence
from shearloop.drivers.ur.settings import read_settings

# A larger relative difference between measured and configured rate is reported.
RATE_TOLERANCE = 0.1
ROBOT_TIMEOUT_S = 2.0
DAEMON_TIMEOUT_S = 1.0
MISSING = os.strerror(errno.ENOENT)


@dataclass(frozen=True, slots=True)
class Finding:
    """One check's result. `means` and `next_step` are empty when all is well."""

    subject: str
    found: str
    means: str = ""
    next_step: str = ""
    state: Literal["good", "note", "trouble"] = "good"


# All is well; something works, but not as well as it could; something keeps the loop from working.
good, note, trouble = Finding, partial(Finding, state="note"), partial(Finding, state="trouble")


def from_error(subject: str, error: Exception | str, means: str) -> Finding:
    """Return the finding for an error; the text after its last `;` or full stop is the cure."""
    sentence = str(error)
    for mark in ("; ", ". "):
        what, found, cure = sentence.rpartition(mark)
        if found:
            return trouble(subject, what, means, cure.rstrip("."))
    return from_file(subject, sentence, means)


def from_file(subject: str, sentence: str, means: str) -> Finding:
    """Return the finding for a file; the sentence names all of its mistakes."""
    cure = "make the file, or correct its name" if MISSING in sentence else "correct the file"
    return trouble(subject, sentence, means, f"{cure}, then run `shearloop doctor CONFIG` again")


async def check_devices(config: DaemonConfig, seconds: float) -> list[Finding]:
    """Open every device, listen to all at once for `seconds`, and return findings in the configuration's order."""
    checks: list[Awaitable[list[Finding]]] = [
        _check_fingertip(name, fingertip, seconds) for name, fingertip in config.fingertips.items()
    ]
    if config.load_cell is not None:
        checks.append(_check_load_cell(config.load_cell, seconds))
    if config.skin is not None:
        daq = config.skin.daq.adc
        ports = {"skin's source": config.skin.source.serial, "skin's DAQ": None if daq is None else daq.device}
        for name, device in ports.items():
            if device is not None:
                checks.append(asyncio.to_thread(lambda *args: [check_port(*args)], name, device))
    if config.gripper is not None:
        checks.append(_check_gripper(config.gripper))
    if config.robot is not None:
        checks.append(asyncio.to_thread(lambda path: [*_check_robot(path)], config.robot))
    return [finding for findings in await asyncio.gather(*checks) for finding in findings]


def check_port(name: str, device: SerialDevice) -> Finding:
    """Check that a serial device is plugged in and may be opened; does not open it."""
    subject = f"port of {name}"
    try:
        path = find_port(serial_number=device.serial_number, path=str(device.path) if device.path else None)
    except DriverError as error:
        cure = "plug the board in, or correct its name in the configuration: `shearloop ports` lists the boards"
        return trouble(subject, str(error), "the board is not plugged in, or has another serial number", cure)
    denied = access_error(path)
    if denied:
        what, _, cure = denied.partition("; ")
        return trouble(subject, f"{path} exists, but {what}", "the daemon cannot read the board", cure)
    by = f"serial number {device.serial_number}" if device.serial_number else "its path"
    return good(subject, f"{os.path.realpath(path)}, found by {by}")


def check_rate(subject: str, measured_hz: float | None, configured_hz: float) -> Finding:
    """Compare a measured rate with the configured one; None means that nothing came."""
    if measured_hz is None:
        means = "the device is silent: no power, another program's port, or another board"
        cure = "check its power; unplug it and plug it in again"
        return trouble(subject, "nothing was received", means, cure)
    found = f"{measured_hz:.3g} Hz measured, {configured_hz:.3g} Hz configured"
    if abs(measured_hz / configured_hz - 1.0) > RATE_TOLERANCE:
        means = "freshness is judged by the configured rate: the loop may hold needlessly, or too late"
        cure = f"configure {measured_hz:.3g} Hz (frame_period_s {1.0 / measured_hz:.4f})"
        return note(subject, found, means, cure)
    return good(subject, found)


def check_channels(name: str, saturated: int, dead: int, frames: int) -> Finding:
    """Judge the numbers of saturated and dead channels."""
    subject = f"channels of {name}"
    found = f"{saturated} saturated and {dead} dead of the channels in {frames} frames"
    if saturated:
        means = "more signal than the converter can measure: a short, or too much current; every estimate lacks them"
        cure = "look for bridges at the electrodes' connector; wet the gel; lower the injected current"
        return trouble(subject, found, means, cure)
    if dead:
        means = "an electrode without contact, or a broken wire; every estimate lacks these channels"
        cure = "press the connector on; 28 or 56 dead channels that belong together point to one electrode"
        return trouble(subject, found, means, cure)
    return good(subject, found)


async def _received(source: AsyncIterator[Any], seconds: float) -> list[Any]:
    found = []
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(seconds), contextlib.aclosing(source) as items:  # type: ignore[type-var]
            async for item in items:
                found.append(item)  # noqa: PERF401 - a timeout keeps what came before
    return found


async def _check_fingertip(name: str, config: FingertipConfig, seconds: float) -> list[Finding]:
    port = check_port(name, config.device)
    if port.state == "trouble":
        return [port]
    link = SerialLink(**config.device.model_dump())
    board = EitKit(link, fingertip_table(config).zero_slots, config.frame_period_s)
    frames = await _received(board.readings(), seconds)
    facts = board.diagnostics()
    if not frames and facts["last_loss"]:
        return [port, from_error(f"rate of {name}", str(facts["last_loss"]), "no frame came")]
    measured_hz = _rate_hz([frame.t_arrival_ns for frame in frames])
    findings = [port, check_rate(f"rate of {name}", measured_hz, 1 / config.frame_period_s)]
    refused = facts["errors"]
    if isinstance(refused, dict) and sum(refused.values()):
        found = f"{sum(refused.values())} refused; {facts['last_frame_error']}"
        means = "a bad cable, or another program on the same board"
        findings.append(note(f"lines of {name}", found, means, "replace the USB cable"))
    if frames:
        channels = np.array([frame.channels for frame in frames])
        saturated = np.array([frame.saturated for frame in frames]).any(axis=0)
        dead = (channels == 0).all(axis=0)
        findings.append(check_channels(name, int(saturated.sum()), int(dead.sum()), len(frames)))
    return findings


async def _check_load_cell(config: LoadCellConfig, seconds: float) -> list[Finding]:
    port = check_port("load_cell", config.device)
    if port.state == "trouble":
        return [port]
    cell = LoadCell(SerialLink(**config.device.model_dump()), LoadCalibration.of_torque_lines(), config.rate_hz)
    samples = await _received(cell.readings(), seconds)
    measured_hz = _rate_hz([sample.t_arrival_ns for sample in samples])
    findings = [port, check_rate("rate of load_cell", measured_hz, config.rate_hz)]
    if saturated := sum(sample.saturated for sample in samples):
        found = f"{saturated} of {len(samples)} readings are at the converter's limit"
        cure = "take the load off; check the four wires of the cell"
        findings.append(trouble("signal of load_cell", found, "overload, or a loose wire of the bridge", cure))
    return findings


async def _check_gripper(config: GripperConfig) -> list[Finding]:
    client = make_gripper_client(config)
    try:
        await client.connect()
        state = await client.read()
    except DriverError as error:
        return [from_error("gripper", error, "nothing can be gripped")]
    finally:
        await client.close()
    if state.flt:
        found = f"{client.name} answers, with fault {state.flt}"
        cure = "clear the fault, then `shearloop command unlock`"
        return [trouble("gripper", found, "it does not move", cure)]
    if state.sta is not ActivationStatus.ACTIVE:
        cure = "keep fingers and tools away when the daemon starts"
        return [note("gripper", f"{client.name} answers; not activated", "it opens and closes once at the start", cure)]
    return [good("gripper", f"{client.name} answers and is activated")]


def _check_robot(settings: Path) -> Iterator[Finding]:
    try:
        host = read_settings(settings).host
        seen = query_controller(host, ROBOT_TIMEOUT_S)
    except DriverError as error:
        yield from_error("robot", error, "the robot cannot be driven")
        return
    answers = f"{host} answers, PolyScope {seen.version}"
    if untested := untested_sentence(seen.version):
        what, _, cure = untested.rpartition(": ")
        yield note("robot", answers, what, cure.rstrip("."))
    else:
        yield good("robot", answers)
    if seen.remote is False:
        means = "it accepts no motion from the network"
        cure = "switch it to remote control, top right on the teach pendant"
        yield trouble("remote control", "the robot is in local control", means, cure)
    else:
        yield good("remote control", "on" if seen.remote else "this controller has no such mode")
    mode = f"robot mode {seen.robot_mode}, safety mode {seen.safety_mode}"
    if seen.robot_mode == "RUNNING" and seen.safety_mode in ("NORMAL", "REDUCED"):
        yield good("robot's mode", mode)
    else:
        cure = "make the cell safe, start the daemon, then `shearloop command unlock`"
        yield note("robot's mode", mode, "the arm does not move in this mode", cure)
    if seen.registers_free:
        yield good("robot's registers", "free")
    else:
        means = "another RTDE client, EtherNet/IP or PROFINET commands the robot"
        cure = "close the other program, or disable the adapter under Installation → Fieldbus"
        yield trouble("robot's registers", "in use", means, cure)


def _rate_hz(times_ns: list[int]) -> float | None:
    if len(times_ns) < 2 or times_ns[-1] == times_ns[0]:
        return None
    return (len(times_ns) - 1) * 1e9 / (times_ns[-1] - times_ns[0])


def daemon_tasks(address: str) -> Mapping[str, Mapping[str, Any]] | None:
    """Return the status of a running daemon's tasks; None when no daemon answers."""
    try:
        request = {"command": "status"}
        reply = send_to_stop_socket(address, request, DAEMON_TIMEOUT_S)
        tasks = (reply or send_command(address, request, DAEMON_TIMEOUT_S)).get("tasks")
    except (UserError, TimeoutError):
        return None
    return tasks if isinstance(tasks, dict) else {}


def listen_for_frames(address: str, seconds: float) -> dict[str, list[Mapping[str, Any]]]:
    """Collect the frames of a local daemon's fingertips for `seconds`, by their names."""
    received: dict[str, list[Mapping[str, Any]]] = defaultdict(list)
    end_s = time.monotonic() + seconds
    with contextlib.suppress(UserError):
        # `health` comes every second.
        for topic, content in receive_messages(address, ("eit.frame", "health"), seconds):
            if topic == "eit.frame":
                received[str(content["source"])].append(content)
            if time.monotonic() > end_s:
                break
    return received


def check_daemon(
    config: DaemonConfig, tasks: Mapping[str, Mapping[str, Any]], received: Mapping[str, list[Mapping[str, Any]]]
) -> Iterator[Finding]:
    """Judge a running daemon by its tasks and by the frames of its fingertips."""
    for name, status in tasks.items():
        yield check_task(name, status)
    for name, own in config.fingertips.items():
        if frames := received.get(name):
            measured_hz = _rate_hz([int(frame["t_mono_ns"]) for frame in frames])
            yield check_rate(f"rate of {name}", measured_hz, 1.0 / own.frame_period_s)
            saturated, dead = (max(int(frame.get(key) or 0) for frame in frames) for key in ("saturated", "dead"))
            yield check_channels(name, saturated, dead, len(frames))


def check_task(name: str, status: Mapping[str, Any]) -> Finding:
    """Judge one task by what it reports."""
    subject, (_, state, _, notes) = f"task {name}", task_row(name, status)
    found = f"{state}, {notes}" if notes else state
    if state == "DEAD" or status.get("restarts"):
        judge = trouble if state == "DEAD" else note
        means = "an error ended it, and it starts again by itself"
        return judge(subject, found, means, "read the daemon's log; report it if it comes back")
    if state == "not connected":
        return trouble(subject, found, "nothing comes from its device", "check its port, cable and power")
    if notes:
        return note(subject, found, "refused data is not used", "see docs/troubleshooting.md")
    return good(subject, found)
