"""The whole examination, in the order in which a person would go about it."""

import asyncio
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from shearloop.daemon.config import DaemonConfig, load_daemon_config
from shearloop.daemon.doctor.devices import examine_devices
from shearloop.daemon.doctor.files import examine_files
from shearloop.daemon.doctor.finding import Finding, from_file, good, note
from shearloop.daemon.doctor.live import examine_daemon, listen, tasks_of_daemon
from shearloop.daemon.doctor.machine import disk_finding, examine_machine
from shearloop.daemon.errors import UserError
from shearloop.daemon.messaging.addresses import stop_address
from shearloop.daemon.ports import ports_there


def examine(config_path: Path | None, seconds: float, geometry: Path | None = None) -> Iterator[Finding]:
    """Yield one finding after another; the devices are listened to for some seconds each, all at once."""
    yield from examine_machine()
    yield ports_finding()
    if config_path is None:
        yield disk_finding(Path())
        yield note(
            "configuration", "none was given", "files and devices were not examined", "`shearloop doctor CONFIG`"
        )
        return
    try:
        config = load_daemon_config(config_path)
    except UserError as error:
        yield from_file("configuration", str(error), "the daemon will not start")
        return
    yield good("configuration", f"{config_path} is in order")
    yield disk_finding(Path() if config.recording is None else config.recording.folder)
    yield from examine_files(config, geometry)
    tasks = _running(config)
    if tasks is not None:
        yield good("daemon", f"one answers at {config.commands}; it holds the devices, and is asked about them")
        heard = {} if "publish" in config.network_addresses else listen(config.publish, seconds)
        yield from examine_daemon(config, tasks, heard)
    elif config.emulators:
        yield note(
            "devices",
            "the configuration's are emulated",
            "they are there only while the daemon runs",
            f"`shearloop run {config_path}`, and ask again meanwhile",
        )
    else:
        yield good("daemon", "none runs with this configuration: the devices are free")
        yield from asyncio.run(_devices(config, seconds))


def ports_finding() -> Finding:
    """Say which serial numbers are seen."""
    ports = ports_there()
    if not ports:
        return note(
            "USB serial ports",
            "there are none",
            "no board is plugged in, or the system has not noticed it",
            "plug the boards in; look at `sudo dmesg | tail`",
        )
    shown = ", ".join(f"{port.path} ({port.serial_number or 'without a serial number'})" for port in ports)
    denied = "; ".join(f"{port.path}: {port.trouble}" for port in ports if port.trouble)
    if denied:
        return note("USB serial ports", shown, denied, "see `shearloop ports`")
    return good("USB serial ports", shown)


def _running(config: DaemonConfig) -> Mapping[str, Mapping[str, Any]] | None:
    on_network = "commands" in config.network_addresses
    return tasks_of_daemon(stop_address(config.commands) if on_network else config.commands)


async def _devices(config: DaemonConfig, seconds: float) -> list[Finding]:
    return [finding async for finding in examine_devices(config, seconds)]
