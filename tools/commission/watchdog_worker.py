"""A worker with a long deadline for straight moves, so that only the robot's watchdog ends a move in time.

`python -m shearloop.tools.commission.watchdog_worker` runs it like the daemon's worker. The move is slow and short.
"""

from dataclasses import dataclass, fields
from typing import Final

from shearloop.drivers.ur.settings import UrSettings
from shearloop.drivers.ur.worker import main

# The longest that the settings allow; a move of 20 mm has ended by then.
_LONGEST_SILENCE_S: Final = 1.0


@dataclass(frozen=True)
class WatchdogAloneSettings(UrSettings):
    """Settings with a watchdog that does not follow from their deadlines."""

    rigs_watchdog_hz: float = 0.0

    @property
    def watchdog_hz(self) -> float:
        """The robot ends its program when it receives nothing for one period of this."""
        return self.rigs_watchdog_hz


def for_watchdog_alone(rig: UrSettings) -> WatchdogAloneSettings:
    """Return settings with which a straight move continues without daemon and worker until the watchdog ends it."""
    values = {field.name: getattr(rig, field.name) for field in fields(rig)}
    values["silence_timeout_s"] = _LONGEST_SILENCE_S
    return WatchdogAloneSettings(**values, rigs_watchdog_hz=rig.watchdog_hz)


if __name__ == "__main__":
    main(for_watchdog_alone)
