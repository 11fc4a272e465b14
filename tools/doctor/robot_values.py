"""What the robot's settings leave open, and which limits and addresses are still as `shearloop init` wrote them."""

import contextlib
from collections.abc import Iterator
from dataclasses import asdict
from importlib import resources
from pathlib import Path

from shearloop.daemon.config import DaemonConfig, load_daemon_config
from shearloop.drivers.errors import DriverError
from shearloop.drivers.ur.settings import UrLimits, read_settings
from shearloop.tools.doctor.findings import Finding, note, trouble

_SUBJECT = "robot's settings"
_DELIVERED = resources.files("shearloop") / "config"


def check_robot_values(path: Path) -> Iterator[Finding]:
    """Name what a real robot's settings in `path` leave open, and the limits that are still from `shearloop init`."""
    with resources.as_file(_DELIVERED / "ur.yaml") as delivered:
        initial = read_settings(delivered)
    try:
        settings = read_settings(path)
    except DriverError:
        # The mistakes are among the findings on files.
        return
    for part, cure in settings.left_open().items():
        means = "the daemon does not start; a rehearsal (`run --emulate`) does"
        yield trouble(_SUBJECT, f"{path}: {part} is not filled in", means, cure)
    if unchanged := unchanged_limits(settings.limits, initial.limits):
        found = f"{path}: as `init` wrote them: {', '.join(unchanged)}"
        means = "they are careful values for first motions, and were not fitted to your cell and your tool"
        yield note(
            _SUBJECT, found, means, "compare each with your cell, and raise one at a time where the task needs it"
        )


def check_example_addresses(config: DaemonConfig) -> Iterator[Finding]:
    """Name the addresses of devices that are still the examples that `shearloop init` wrote."""
    with resources.as_file(_DELIVERED) as delivered:
        examples = _addresses(load_daemon_config(delivered / "rig.yaml"))
    own = _addresses(config)
    unchanged = [f"`{key}` {own[key]}" for key, example in examples.items() if own.get(key) == example]
    if unchanged:
        found = f"as `init` wrote them: {', '.join(unchanged)}"
        means = "they are examples, and another device may have such an address"
        cure = "compare each: `shearloop ports` shows the serial numbers, and the pendant shows the robot's address"
        yield note("addresses of devices", found, means, cure)


def _addresses(config: DaemonConfig) -> dict[str, str]:
    """Return the address of each device by its key, also the robot's, if its settings can be read."""
    found = config.device_addresses
    if config.robot is not None:
        # The mistakes in the settings are among the findings on files.
        with contextlib.suppress(DriverError):
            found["robot"] = read_settings(config.robot).host
    return found


def unchanged_limits(limits: UrLimits, initial: UrLimits) -> list[str]:
    """Return the limits that are equal to the initial ones, with their values."""
    found = []
    own = asdict(limits)
    for limit, parts in asdict(initial).items():
        if not parts or not own[limit]:
            continue
        same = [part for part, value in parts.items() if own[limit][part] == value]
        if len(same) < len(parts):
            found += [f"{limit}.{part}" for part in same]
        elif "inner" in parts:
            found.append(f"{limit} {parts['inner']:g} and {parts['hard']:g}")
        else:
            found.append(limit)
    return found
