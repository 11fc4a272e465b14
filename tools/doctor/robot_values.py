"""What the robot's settings leave open, and which limits are still as `shearloop init` wrote them."""

from collections.abc import Iterator
from dataclasses import asdict
from importlib import resources
from pathlib import Path

from shearloop.drivers.errors import DriverError
from shearloop.drivers.ur.settings import UrLimits, read_settings
from shearloop.tools.doctor.findings import Finding, note, trouble

_SUBJECT = "robot's settings"


def check_robot_values(path: Path) -> Iterator[Finding]:
    """Name what a real robot's settings in `path` leave open, and the limits that are still from `shearloop init`."""
    with resources.as_file(resources.files("shearloop") / "config" / "ur.yaml") as delivered:
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
