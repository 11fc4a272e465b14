"""The robot's process with a long deadline for straight moves, so that the robot's watchdog alone ends one in time.

`python -m shearloop.tools.commission.watchdog_worker`, as the daemon's own. The move itself is slow and short.
"""

from dataclasses import fields
from typing import Final

from shearloop.drivers.ur.settings import UrSettings
from shearloop.drivers.ur.worker import main

# The longest that the settings allow; a move of 20 mm has ended by then.
_SILENCE_S: Final = 1.0


class WatchdogAlone(UrSettings):
    """A rig's settings, whose straight moves go on without daemon and worker until the rig's watchdog ends them."""

    def __init__(self, settings: UrSettings) -> None:
        """Take all but the longest silence; the watchdog's period would follow from it."""
        values = {field.name: getattr(settings, field.name) for field in fields(settings)}
        super().__init__(**values | {"silence_timeout_s": _SILENCE_S})
        object.__setattr__(self, "_period_hz", settings.watchdog_hz)

    @property
    def watchdog_hz(self) -> float:
        """The robot ends its program when it receives nothing for one period of this."""
        period_hz: float = self.__dict__["_period_hz"]
        return period_hz


if __name__ == "__main__":
    main(WatchdogAlone)
