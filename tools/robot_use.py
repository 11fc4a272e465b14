"""What other programs have of a robot, by the controller's own word: also those of other users and other computers."""

from contextlib import closing, suppress

from shearloop.drivers.errors import DriverError
from shearloop.drivers.ur.control_box import ControllerInfo, query_controller
from shearloop.drivers.ur.messages import RUNTIME_STATES, RUNTIME_STOPPED, RUNTIME_STOPPING, RtdeOutputs
from shearloop.drivers.ur.receiver import RtdeReceiver
from shearloop.drivers.ur.script import FIRST_WITH_LOWER_ALONE, LOWER, UPPER, ScriptRegisters
from shearloop.errors import UserError

FREE = "free"
# RTDE's slowest rate that every controller has; one state is enough.
_ONE_STATE_HZ = 125.0


def read_outputs(host: str, timeout_s: float, registers: ScriptRegisters = UPPER) -> RtdeOutputs:
    """Return a controller's present outputs, without a register to write; DriverError where it does not answer."""
    with closing(RtdeReceiver(host, _ONE_STATE_HZ, timeout_s, registers, writes=False)) as receiver:
        return receiver.latest()


def registers_in_words(seen: ControllerInfo) -> str:
    """Return which input registers other clients write, or `FREE`.

    A daemon takes those from 24 on where it can. A controller on which it uses the lower ones alone shows nothing of
    the others.
    """
    if seen.registers is None:
        return "in use"
    major, minor, *_ = map(int, seen.version.split("."))
    if seen.registers == LOWER and (major, minor) < FIRST_WITH_LOWER_ALONE:
        return "those from 24 on are in use, and the lower ones free"
    return FREE


def program_in_words(outputs: RtdeOutputs) -> str:
    """Return the state of the program on the robot, or an empty string where none runs."""
    if outputs.runtime_state in (RUNTIME_STOPPED, RUNTIME_STOPPING):
        return ""
    return RUNTIME_STATES.get(outputs.runtime_state, f"unknown state {outputs.runtime_state}")


def other_programs(seen: ControllerInfo, outputs: RtdeOutputs) -> list[str]:
    """Return a sentence on each sign of another program that commands the robot; none of this process may run."""
    found = []
    if (registers := registers_in_words(seen)) != FREE:
        found.append(
            f"Another program writes the robot's registers ({registers}): a daemon of another user or computer, "
            "another RTDE client or a fieldbus. It may move the robot and the gripper at any moment."
        )
    if program := program_in_words(outputs):
        found.append(
            f"A program is on the robot that was not started from here ({program}). It may be of a daemon of another "
            "user or computer, or of the pendant, and may hold a tool."
        )
    return found


def refuse_used_robot(host: str, timeout_s: float) -> None:
    """Raise UserError if another program commands the robot at an address. A silent controller shows nothing."""
    with suppress(DriverError):
        found = other_programs(query_controller(host, timeout_s), read_outputs(host, timeout_s))
        if found:
            raise UserError(f"{' '.join(found)} End it first, or stop its program at the teach pendant")
