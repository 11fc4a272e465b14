"""Makes the program for the robot: our control script after the values of one rig's settings.

`control.script` is the program's text. It answers the commands that `arm` sends through ur-rtde's client. Each version
of the client has its own protocol of registers. The client gives each motion a deadline by the script's clock, in a
register that ur-rtde does not use, and extends it. The script stops the wrist at the deadline, at the end of its range,
and beyond the largest force and torque. It stops a straight move that its client does not stop, and ends. The watchdog
is slower than these stops, because a program that ends while the arm moves may end in a protective stop.
"""

import hashlib
import math
from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from shearloop.drivers.ur.settings import GENERATIONS, MOVE_GRACE_S, GenerationFacts, Six, UrSettings


@dataclass(frozen=True, slots=True)
class ScriptRegisters:
    """One half of the controller's registers: commands are in the first ones, deadlines in the last.

    RTDE guide: registers from 24 on are for RTDE clients; fieldbuses and their URCaps use the lower half.
    """

    first: int

    @property
    def last(self) -> int:
        """The number of our registers; ur-rtde 1.6.5 uses the first eighteen."""
        return self.first + 23

    @property
    def command(self) -> str:
        """The input with the number of ur-rtde's command."""
        return f"input_int_register_{self.first}"

    @property
    def state(self) -> str:
        """The output with the state of the script."""
        return f"output_int_register_{self.first}"

    @property
    def deadline(self) -> str:
        """The input with the deadline of a motion, in ticks."""
        return f"input_int_register_{self.last}"

    @property
    def clock(self) -> str:
        """The output with the script's ticks."""
        return f"output_int_register_{self.last}"

    @property
    def step(self) -> str:
        """The output with the time of one tick, in s."""
        return f"output_double_register_{self.last}"

    @property
    def inputs(self) -> tuple[str, ...]:
        """All inputs that ur-rtde and we write."""
        return (
            *(f"input_int_register_{self.first + number}" for number in range(8)),
            *(f"input_double_register_{self.first + number}" for number in range(18)),
            self.deadline,
        )


UPPER, LOWER = ScriptRegisters(24), ScriptRegisters(0)
# From this PolyScope on, ur-rtde 1.6.5 uses the lower half alone.
FIRST_WITH_LOWER_ALONE: Final = (5, 23)
# The clock starts at 0, so with this deadline no motion begins or continues.
NO_MOTION_TICKS = -1
# The largest further distance of a deadline: a cycle of the slowest controller, for rounding.
_SLACK_S = 0.008

_CONTROL_SCRIPT: Final = Path(__file__).with_name("control.script")
# The text has parts, because a program with a name that a controller does not know does not start.
_ZEROES = "  global can_zero_wrench = True\n  def zero_wrench():\n    zero_ftsensor()\n  end\n"
_CANNOT_ZERO = "  global can_zero_wrench = False\n  def zero_wrench():\n    sync()\n  end\n"

# The text before the script. Its first statement starts the watchdog.
_HEAD: Final = """\
def shearloop_control():
  rtde_set_watchdog("{command_register}", {watchdog_hz}, "stop")
  global first = {first}
  global keeps_load = {keeps_load}
  global load_before = {load_before}
"""

# The values that the script takes from the settings, by its names for them.
_FROM_SETTINGS: Final[Mapping[str, Callable[[UrSettings], float]]] = {
    "longest_turn_s": lambda settings: settings.command_timeout_s + _SLACK_S,
    "longest_line_s": lambda settings: settings.silence_timeout_s + _SLACK_S,
    "grace_s": lambda _: MOVE_GRACE_S,
    "margin_rad": lambda settings: settings.limits.joints.margin_rad,
    "lowest_rad": lambda settings: settings.limits.joints.lower_rad[5] + settings.limits.joints.margin_rad,
    "highest_rad": lambda settings: settings.limits.joints.upper_rad[5] - settings.limits.joints.margin_rad,
    "rest_rad_per_s": lambda settings: settings.rest_rad_per_s,
    "inner_rad_per_s": lambda settings: settings.limits.wrist_speed_rad_per_s.inner,
    "hard_rad_per_s": lambda settings: settings.limits.wrist_speed_rad_per_s.hard,
    "inner_rad_per_s2": lambda settings: settings.limits.wrist_acceleration_rad_per_s2.inner,
    "hard_rad_per_s2": lambda settings: settings.limits.wrist_acceleration_rad_per_s2.hard,
    "inner_m_per_s": lambda settings: settings.limits.linear_speed_m_per_s.inner,
    "inner_m_per_s2": lambda settings: settings.limits.linear_acceleration_m_per_s2.inner,
    "hard_n": lambda settings: settings.limits.force_n.hard,
    "hard_nm": lambda settings: settings.limits.torque_nm.hard,
}
# Replaces each value of a rig in the hashed text.
_NO_VALUE: Final = "?"


def own_script_hash() -> str:
    """Return the SHA-256 of the programs for both generations without the values of a rig, in hex digits."""
    head = _HEAD.format_map(defaultdict(lambda: _NO_VALUE))
    settings = dict.fromkeys(_FROM_SETTINGS, _NO_VALUE)
    texts = [_program(head, settings, facts) for facts in GENERATIONS.values()]
    return hashlib.sha256("".join(texts).encode()).hexdigest()


def control_program(settings: UrSettings, registers: ScriptRegisters = UPPER, load: Six | None = None) -> str:
    """Return the program that a controller runs for these settings.

    Its first statement starts the watchdog on the register that the client writes, so the program ends if its client
    dies later. URScript manual, `rtde_set_watchdog`: a program's watchdogs end with it.

    `load` is given if a tool may load the wrench and the controller zeroes its wrench at the start. It is the wrench
    before the start, in N and N·m in the base's frame. Turns about the tool's axis do not change its part along that
    axis.
    """
    head = _HEAD.format(
        command_register=registers.command,
        watchdog_hz=f"{settings.watchdog_hz:g}",
        first=registers.first,
        keeps_load=load is not None,
        load_before=f"[{', '.join(map(_float, load or (0.0,) * 6))}]",
    )
    values = {name: _float(value(settings)) for name, value in _FROM_SETTINGS.items()}
    return _program(head, values, settings.facts)


def _program(head: str, values: Mapping[str, str], facts: GenerationFacts) -> str:
    """Return a program with these values of a rig, as literals by their names."""
    named = "".join(f"  global {name} = {value}\n" for name, value in values.items())
    body = _CONTROL_SCRIPT.read_text(encoding="ascii")
    return f"{head}{named}{_generation(facts)}{body}end\n"


def _generation(facts: GenerationFacts) -> str:
    """Return the statements that differ between generations of controllers."""
    return f"  global cycle_s = {facts.step}\n{_ZEROES if facts.zeroes_wrench else _CANNOT_ZERO}"


def _float(value: float) -> str:
    """Return a literal of URScript without an exponent; a whole number has a point too, so it is not an integer."""
    if not math.isfinite(value):
        raise ValueError(f"{value} is no number for the robot's script")
    return f"{value:.6f}"
