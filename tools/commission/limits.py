"""The limits on times, for a real rig and for an emulated one, whose busy computer delays them."""

from dataclasses import dataclass
from typing import Final

from shearloop.daemon.config import DaemonConfig
from shearloop.daemon.patience import is_patient
from shearloop.drivers.ur.settings import UrSettings

# The longest time from the last decision until the wrist stands (docs/safety.md).
PROMISED_S: Final = 0.2


@dataclass(frozen=True, slots=True)
class TimeLimits:
    """What the lines on rates, gaps, delays and stops pass at."""

    # Of the robot's states: their fraction, and the longest time without one.
    least_rate: float
    longest_gap_s: float
    longest_exchange_s: float
    # Of the script's clock, as a fraction: one that counts a cycle too few here and there makes every deadline late.
    script_tolerance: float
    # Of a board: the difference of its rate from the configured one, as a fraction.
    rate_tolerance: float
    # The largest difference between the moments at which two devices see the same event.
    clocks_s: float
    # How much later than the settings' times the computer may be; None: the promise of docs/safety.md counts.
    late_s: float | None = None

    def reaction_s(self, settings: UrSettings) -> float:
        """Return the longest delay from a command to the motion."""
        return settings.reaction_s + (self.late_s or 0.0)

    def rest_s(self, settings: UrSettings) -> float:
        """Return the longest time to rest."""
        return PROMISED_S if self.late_s is None else settings.standstill_s + self.late_s


REAL: Final = TimeLimits(
    least_rate=0.99,
    longest_gap_s=0.04,
    longest_exchange_s=0.08,
    script_tolerance=0.005,
    rate_tolerance=0.1,
    clocks_s=0.05,
)
# Its computer plays the devices too. What the procedure shows stays the same.
EMULATED: Final = TimeLimits(
    least_rate=0.25,
    longest_gap_s=5.0,
    longest_exchange_s=5.0,
    script_tolerance=0.5,
    rate_tolerance=0.5,
    clocks_s=0.3,
    late_s=3.0,
)


def limits_for(config: DaemonConfig) -> TimeLimits:
    """Return the limits for a rig; an emulated one with `emulated_deadlines: real` has the real ones."""
    return EMULATED if is_patient(config) else REAL
