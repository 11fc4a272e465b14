"""The limits on rates and times, for a real rig and for an emulated one, which a busy computer delays."""

from dataclasses import dataclass
from typing import Final

from shearloop.daemon.config import DaemonConfig
from shearloop.daemon.patience import is_patient
from shearloop.drivers.ur.settings import PROMISED_S, UrSettings

# The longest time until the arm rests after a stop, and until the safety mode that follows it has come.
RESTS_WITHIN_S: Final = 5.0
MODE_AFTER_S: Final = 0.5


@dataclass(frozen=True, slots=True)
class TimeLimits:
    """The limits of the report's lines on rates, gaps, delays and stops."""

    # The least fraction of the robot's states that must arrive, and the longest time without a state.
    least_rate: float
    longest_gap_s: float
    longest_exchange_s: float
    # The largest error of the script's clock, as a fraction. If the clock misses cycles, every deadline is late.
    script_tolerance: float
    # The largest difference of a board's rate from the configured rate, as a fraction.
    rate_tolerance: float
    # The largest difference of two devices' times of the same event.
    clocks_s: float
    # How much later than the settings' times the computer may be. None: the limit is the promise of docs/safety.md.
    late_s: float | None = None

    def reaction_s(self, settings: UrSettings) -> float:
        """Return the longest delay from a command to the motion."""
        return settings.reaction_s + (self.late_s or 0.0)

    @property
    def rehearsed(self) -> bool:
        """Whether no stop is measured: the arm ends its way before the long deadlines stop it."""
        return self.late_s is not None

    def rest_s(self, settings: UrSettings) -> float:
        """Return the longest time to rest."""
        return PROMISED_S if self.late_s is None else settings.standstill_s + self.late_s


# The value of a line that a rehearsal does not measure.
REHEARSED: Final = "rehearsed: not measured, because the deadlines of emulated devices are longer than real deadlines"
REAL: Final = TimeLimits(
    least_rate=0.99,
    longest_gap_s=0.04,
    longest_exchange_s=0.08,
    script_tolerance=0.005,
    rate_tolerance=0.1,
    clocks_s=0.05,
)
# The same computer plays the devices too. The stages and their lines stay the same.
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
