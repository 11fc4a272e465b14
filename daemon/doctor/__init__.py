"""`shearloop doctor`: checks the computer, files and devices, and names the next step for each fault."""

import asyncio
from collections.abc import Iterator
from pathlib import Path

from shearloop.daemon.config import load_daemon_config
from shearloop.daemon.doctor.checks import (
    Finding,
    check_computer,
    check_disk,
    check_files,
    check_ports,
    from_file,
    good,
    note,
)
from shearloop.daemon.doctor.devices import check_daemon, check_devices, daemon_tasks, listen
from shearloop.daemon.errors import UserError
from shearloop.daemon.messaging.addresses import stop_address

__all__ = ["Finding", "examine"]


def examine(config_path: Path | None, seconds: float, geometry: Path | None = None) -> Iterator[Finding]:
    """Yield one finding after another; listen to all devices at once for `seconds`."""
    yield from check_computer()
    yield check_ports()
    if config_path is None:
        yield check_disk(Path())
        yield note("configuration", "not given", "files and devices were not checked", "`shearloop doctor CONFIG`")
        return
    try:
        config = load_daemon_config(config_path)
    except UserError as error:
        yield from_file("configuration", str(error), "the daemon does not start")
        return
    yield good("configuration", f"{config_path} is in order")
    yield check_disk(Path() if config.recording is None else config.recording.folder)
    yield from check_files(config, geometry)
    on_network = "commands" in config.network_addresses
    tasks = daemon_tasks(stop_address(config.commands) if on_network else config.commands)
    if tasks is not None:
        yield good("daemon", f"answers at {config.commands}; it holds the devices and reports on them")
        received = {} if "publish" in config.network_addresses else listen(config.publish, seconds)
        yield from check_daemon(config, tasks, received)
    elif config.emulators:
        yield note(
            "devices",
            "the configuration emulates them",
            "they exist only while the daemon runs",
            f"`shearloop run {config_path}`, then run the doctor again",
        )
    else:
        yield good("daemon", "not running with this configuration: the devices are free")
        yield from asyncio.run(check_devices(config, seconds))
