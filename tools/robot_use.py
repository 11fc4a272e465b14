"""The other programs that use a robot, as its controller reports; also programs of other users and computers."""

from contextlib import closing, suppress
from dataclasses import dataclass
from enum import Enum, auto
from typing import Final

from shearloop.drivers.errors import DriverError
from shearloop.drivers.ur.control_box import ControllerInfo, query_controller
from shearloop.drivers.ur.messages import RUNTIME_STATES, RUNTIME_STOPPED, RUNTIME_STOPPING, RtdeOutputs
from shearloop.drivers.ur.receiver import RtdeReceiver
from shearloop.drivers.ur.script import FIRST_WITH_LOWER_ALONE, LOWER, UPPER, ScriptRegisters
from shearloop.errors import UserError

# A controller that is there answers within it.
ROBOT_TIMEOUT_S: Final = 2.0
# RTDE's slowest rate that every controller has; one state is enough.
_ONE_STATE_HZ = 125.0


def read_outputs(host: str, timeout_s: float, registers: ScriptRegisters = UPPER) -> RtdeOutputs:
    """Return a controller's present outputs, without a register to write; DriverError where it does not answer."""
    with closing(RtdeReceiver(host, _ONE_STATE_HZ, timeout_s, registers, writes=False)) as receiver:
        return receiver.latest()


class Registers(Enum):
    """Which input registers other clients write, in words."""

    FREE = "free"
    UPPER_IN_USE = "those from 24 on are in use, and the lower ones free"
    ALL_IN_USE = "in use"


class SignKind(Enum):
    """What shows that another program commands the robot."""

    REGISTERS = auto()
    PROGRAM = auto()


@dataclass(frozen=True, slots=True)
class Sign:
    """A sign of another program that commands the robot, with a whole sentence."""

    kind: SignKind
    sentence: str


def used_registers(seen: ControllerInfo) -> Registers:
    """Return which input registers other clients write.

    A daemon takes those from 24 on where it can. A controller on which it uses the lower ones alone shows nothing of
    the others.
    """
    if seen.registers is None:
        return Registers.ALL_IN_USE
    major, minor, *_ = map(int, seen.version.split("."))
    if seen.registers == LOWER and (major, minor) < FIRST_WITH_LOWER_ALONE:
        return Registers.UPPER_IN_USE
    return Registers.FREE


def program_in_words(outputs: RtdeOutputs) -> str:
    """Return the state of the program on the robot, or an empty string where none runs."""
    if outputs.runtime_state in (RUNTIME_STOPPED, RUNTIME_STOPPING):
        return ""
    return RUNTIME_STATES.get(outputs.runtime_state, f"unknown state {outputs.runtime_state}")


def other_programs(seen: ControllerInfo, outputs: RtdeOutputs) -> list[Sign]:
    """Return each sign of another program that commands the robot; none of this process may run."""
    found = []
    registers = used_registers(seen)
    if registers is not Registers.FREE:
        sentence = (
            f"Another program writes the robot's registers ({registers.value}): a daemon of another user or computer, "
            "another RTDE client or a fieldbus. It may move the robot and the gripper at any moment."
        )
        found.append(Sign(SignKind.REGISTERS, sentence))
    if program := program_in_words(outputs):
        sentence = (
            f"A program is on the robot that was not started from here ({program}). It may be of a daemon of another "
            "user or computer, or of the pendant, and may hold a tool."
        )
        found.append(Sign(SignKind.PROGRAM, sentence))
    return found


def refuse_used_robot(host: str, timeout_s: float) -> None:
    """Raise UserError if another program commands the robot at an address. A silent controller shows nothing."""
    with suppress(DriverError):
        found = other_programs(query_controller(host, timeout_s), read_outputs(host, timeout_s))
        if found:
            sentences = " ".join(sign.sentence for sign in found)
            raise UserError(f"{sentences} End it first, or stop its program at the teach pendant")
