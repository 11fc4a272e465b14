"""Checks of the devices: opened and listened to directly, or through the daemon that holds them."""

import asyncio
import contextlib
import time
from collections import defaultdict
from collections.abc import Awaitable, Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from shearloop.daemon.config import DaemonConfig, GripperConfig, SkinConfig
from shearloop.daemon.messaging.client import receive_messages, send_command
from shearloop.daemon.messaging.stop_client import send_to_stop_socket
from shearloop.daemon.motion_cap import why_not_emulated
from shearloop.daemon.report_in_use import commissioning_of
from shearloop.daemon.rig import make_gripper_client
from shearloop.daemon.running_rig import RunningRig
from shearloop.daemon.sensing.skin_task import current_source, voltage_reader
from shearloop.drivers.connection import LinkMonitor
from shearloop.drivers.errors import DriverError
from shearloop.drivers.robotiq.messages import ActivationStatus, fault_of
from shearloop.drivers.shear_skin.instruments import PolledInstrument
from shearloop.drivers.ur.control_box import ControllerInfo, check_generation, check_ports, query_controller, untested
from shearloop.drivers.ur.dashboard import REMOTE_CURE
from shearloop.drivers.ur.limits import position_beyond_limits, slowed_by, tool_difference
from shearloop.drivers.ur.messages import RobotLostError, RtdeOutputs
from shearloop.drivers.ur.ports import FIELDBUS_MENU
from shearloop.drivers.ur.primary_port import PrimaryPort
from shearloop.drivers.ur.script import UPPER
from shearloop.drivers.ur.settings import UrLimits, UrSettings, read_settings
from shearloop.errors import UserError
from shearloop.tools.arm_models import Arm, read_arm
from shearloop.tools.doctor.boards import (
    check_adc,
    check_channels,
    check_fingertip,
    check_load_cell,
    check_port,
    check_rate,
    table_of,
)
from shearloop.tools.doctor.findings import Finding, from_error, good, note, split_cure, trouble
from shearloop.tools.robot_use import ROBOT_TIMEOUT_S, Registers, read_outputs, used_registers
from shearloop.tools.task_row import task_row

DAEMON_TIMEOUT_S = 1.0
# What a daemon's rig is compared by, beside its devices, with the keys in the configuration.
_COMPARED = {"rig": "name", "emulated": "emulated", "publish": "publish"}


async def check_devices(config: DaemonConfig, seconds: float) -> list[Finding]:
    """Open every device, listen to all at once for `seconds`, and return findings in the configuration's order."""
    checks: list[Awaitable[list[Finding]]] = [
        check_fingertip(name, fingertip, seconds) for name, fingertip in config.fingertips.items()
    ]
    if config.load_cell is not None:
        checks.append(check_load_cell(config.load_cell, seconds))
    if config.skin is not None:
        checks.append(_check_source(config.skin))
        daq = voltage_reader(config.skin, LinkMonitor())
        if isinstance(daq, PolledInstrument):
            checks.append(_check_instrument("skin's scanner", daq))
        elif config.skin.daq.adc is not None:
            checks.append(check_adc("skin's DAQ", config.skin.daq.adc, config.skin.daq.rate_hz, seconds))
    if config.gripper is not None:
        checks.append(_check_gripper(config.gripper))
    if config.robot is not None:
        checks.append(asyncio.to_thread(lambda path: [*_check_robot(config, path)], config.robot))
    return [finding for findings in await asyncio.gather(*checks) for finding in findings]


async def _check_source(config: SkinConfig) -> list[Finding]:
    subject, serial = "skin's source", config.source.serial
    port = [] if serial is None else [check_port(subject, serial)]
    if any(finding.state == "trouble" for finding in port):
        return port
    return [*port, *await _check_instrument(subject, current_source(config, LinkMonitor()))]


async def _check_instrument(subject: str, instrument: PolledInstrument[Any]) -> list[Finding]:
    """Ask an instrument for its name; nothing is set, and no current flows."""
    try:
        name = await instrument.ask_name()
    except DriverError as error:
        return [from_error(subject, error, "the skin measures nothing", "check its address, cable and power")]
    return [good(subject, f"{name} answers")]


async def _check_gripper(config: GripperConfig) -> list[Finding]:
    client = make_gripper_client(config)
    try:
        await client.connect()
        state = await client.read()
    except DriverError as error:
        cure = "check its power and cable, and end other programs that use it"
        return [from_error("gripper", error, "nothing can be gripped", cure)]
    finally:
        await client.close()
    if state.flt:
        found = f"{client.name} answers, with fault {state.flt}: {fault_of(state.flt).sentence}"
        return [from_error("gripper", found, "it does not move", "`shearloop command unlock`")]
    if state.sta is not ActivationStatus.ACTIVE:
        found = f"{client.name} answers; not activated"
        cure = "keep fingers and tools away from its first grip or release"
        return [note("gripper", found, "its next motion opens and closes the fingers once before", cure)]
    return [good("gripper", f"{client.name} answers and is activated")]


def _check_robot(config: DaemonConfig, path: Path) -> Iterator[Finding]:
    try:
        settings = read_settings(path)
        host = settings.host
        try:
            check_ports(host, ROBOT_TIMEOUT_S)
        except RobotLostError as error:
            yield from_error("robot's ports", error, "the daemon cannot drive the robot without them")
        seen = query_controller(host, ROBOT_TIMEOUT_S)
    except DriverError as error:
        cure = "look at the teach pendant, and check the cable and `host` in the robot's settings"
        yield from_error("robot", error, "the robot cannot be driven", cure)
        return
    if config.emulated and (reason := why_not_emulated(host, seen.serial_number)):
        yield trouble("robot", reason.cause, "the daemon does not drive it", reason.cure)
        return
    with contextlib.closing(PrimaryPort(host, ROBOT_TIMEOUT_S)) as primary:
        missing = primary.missing
    if missing is not None:
        yield note("robot's error codes", missing.cause, "the log does not have the controller's codes", missing.cure)
    answers = f"{host} answers, PolyScope {seen.version}"
    if (newer := untested(seen.version)) is not None:
        yield note("robot", answers, newer.cause, newer.cure)
    else:
        yield good("robot", answers)
    yield from check_identity(config, settings, seen.version, seen.serial_number)
    if seen.remote is False:
        means = "it accepts no motion from the network"
        yield trouble("remote control", "the robot is in local control", means, REMOTE_CURE)
    else:
        yield good("remote control", "on" if seen.remote else "this controller has no such mode")
    mode = f"robot mode {seen.robot_mode}, safety mode {seen.safety_mode}"
    if seen.robot_mode == "RUNNING" and seen.safety_mode in ("NORMAL", "REDUCED"):
        yield good("robot's mode", mode)
    else:
        cure = "make the cell safe, start the daemon, then send `shearloop command unlock`"
        yield note("robot's mode", mode, "the arm does not move in this mode", cure)
    yield from _check_setting(settings, seen)
    registers, subject = used_registers(seen), "robot's registers"
    match registers:
        case Registers.FREE:
            yield good(subject, registers.value)
        case Registers.UPPER_IN_USE:
            means = "a daemon of another user or computer, another RTDE client or a fieldbus may command the robot"
            yield note(subject, registers.value, means, "end the other program if it commands the robot")
        case Registers.ALL_IN_USE:
            means = "another RTDE client, EtherNet/IP or PROFINET commands the robot"
            cure = f"close the other program, or disable the adapter ({FIELDBUS_MENU})"
            yield trouble(subject, registers.value, means, cure)


def _check_setting(settings: UrSettings, seen: ControllerInfo) -> Iterator[Finding]:
    """Judge slider, place of the arm, payload and tool, as the daemon does before each motion."""
    host, means = settings.host, "the daemon refuses every motion"
    try:
        outputs = read_outputs(host, ROBOT_TIMEOUT_S, seen.registers or UPPER)
        arm = read_arm(host, ROBOT_TIMEOUT_S, settings.facts.major)
    except DriverError as error:
        cure = "look at the teach pendant, and run the doctor again"
        yield from_error("robot's state", error, "slider, place of the arm, payload and tool are not known", cure)
        return
    slowed, differs = slowed_by(outputs), tool_difference(outputs, settings.tool)
    if slowed is not None:
        yield trouble("speed slider", slowed.cause, means, slowed.cure)
    else:
        yield good("speed slider", f"{outputs.speed_slider:.0%}")
    # The findings on the robot's settings name a workspace that is absent.
    if settings.limits.workspace is not None:
        yield check_place(outputs, settings.limits)
    if differs is not None:
        yield trouble("payload and tool", differs.cause, means, differs.cure)
        return
    unsafe = check_payload(arm, outputs.payload_kg, settings.tool.payload_kg)
    if unsafe is not None:
        yield unsafe
    elif settings.tool.absent and settings.tool.reported:
        # The findings on the robot's settings name what is absent.
        return
    else:
        yield good("payload and tool", "as in the robot's settings")


def check_place(outputs: RtdeOutputs, limits: UrLimits) -> Finding:
    """Judge whether the arm stands within the workspace and the ranges of its joints."""
    subject, place = "place of the arm", position_beyond_limits(outputs, limits)
    if place is None:
        return good(subject, "inside the workspace and the joints' ranges")
    return trouble(subject, place.cause, "the daemon refuses every motion", place.cure)


def check_payload(arm: Arm, *payloads_kg: float | None) -> Finding | None:
    """Return the finding on a payload that no arm of this model is rated for, or else only some are; None without."""
    beyond_kg = next(filter(arm.is_beyond, payloads_kg), None)
    if beyond_kg is not None:
        found = f"{beyond_kg:g} kg is above the rated payload of this {arm.model}, {arm.rated}"
        cure = "mount less, and correct `tool.payload_kg` and the pendant"
        return trouble("payload", found, "the arm cannot hold it safely", cure)
    unsure_kg = next(filter(arm.may_be_beyond, payloads_kg), None)
    if unsure_kg is not None:
        found = f"{unsure_kg:g} kg is mounted, and a {arm.model} is rated for {arm.rated}"
        cure = "read the arm's type plate, and mount less if it says less"
        return note("payload", found, "an arm of an earlier year cannot hold it safely", cure)
    return None


def check_identity(config: DaemonConfig, settings: UrSettings, version: str, serial_number: str) -> Iterator[Finding]:
    """Compare a controller with the generation in the settings, and with the one of the commissioning's report."""
    try:
        check_generation(settings, version)
    except RobotLostError as error:
        yield from_error("robot's generation", error, "the daemon does not drive it")
    try:
        commissioning = commissioning_of(config, settings)
    except UserError:
        # The mistake is among the findings on files.
        return
    if not commissioning.counts:
        return
    commissioning.on_controller(version, serial_number)
    if not commissioning.counts and (cap := commissioning.cap) is not None:
        yield note("commissioned robot", cap.cause, "an experiment that asks for more is refused", cap.cure)


def ask_status(address: str) -> Mapping[str, Any] | None:
    """Return the reply of a running daemon to `status`: None without a daemon, empty from one that does not answer."""
    request = {"command": "status"}
    try:
        reply = send_to_stop_socket(address, request, DAEMON_TIMEOUT_S)
    except TimeoutError:
        return {}
    except UserError:
        # Another user's program has the name of its stop socket.
        reply = None
    with contextlib.suppress(UserError):
        return reply or send_command(address, request, DAEMON_TIMEOUT_S)
    return None


def differing_keys(config: DaemonConfig, reply: Mapping[str, Any]) -> list[str]:
    """Return the configuration's keys in which the daemon that gave this reply to `status` has another rig."""
    host = None
    if config.robot is not None:
        # The mistakes in the settings are among the findings on files.
        with contextlib.suppress(DriverError):
            host = read_settings(config.robot).host
    own, theirs = asdict(RunningRig.of(config, host)), dict(reply.get("daemon", {}))
    keys = [key for fact, key in _COMPARED.items() if own[fact] != theirs.get(fact)]
    devices, others = own["devices"], theirs.get("devices") or {}
    keys += [key for key in sorted({*devices, *others}) if devices.get(key) != others.get(key)]
    return keys


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
    for name, fingertip in config.fingertips.items():
        if frames := received.get(name):
            # The daemon opens a silent board again; such a pause is no period of the board.
            period_s = _usual_period_s(frames)
            if period_s:
                measured_hz = 1.0 / period_s
                key = f"fingertips.{name}.frame_period_s"
                yield check_rate(f"rate of {name}", measured_hz, 1.0 / fingertip.frame_period_s, key, as_period=True)
            saturated = max(int(frame.get("saturated") or 0) for frame in frames)
            channels = np.array([frame["channels"] for frame in frames], dtype=np.float64)
            yield check_channels(name, channels, saturated, table_of(fingertip))


def _usual_period_s(frames: Sequence[Mapping[str, Any]]) -> float:
    """Return the median distance of the frames' times; 0 for a single frame."""
    steps_ns = np.diff([int(frame["t_mono_ns"]) for frame in frames])
    return float(np.median(steps_ns)) / 1e9 if len(steps_ns) else 0.0


def check_task(name: str, status: Mapping[str, Any]) -> Finding:
    """Judge one task by its report."""
    subject, (_, state, _, notes) = f"task {name}", task_row(name, status)
    found = f"{state}, {notes}" if notes else state
    if state == "DEAD" or status.get("restarts"):
        judge = trouble if state == "DEAD" else note
        means = "an error ended it, and it starts again by itself"
        return judge(subject, found, means, "read the daemon's log; report it if it comes back")
    if state == "not connected":
        return from_error(subject, found, "nothing comes from its device", "check its port, cable and power")
    if notes:
        what, cure = split_cure(found)
        return note(subject, what, "what is refused or dead is not used", cure or "see docs/troubleshooting.md")
    return good(subject, found)
