"""The robot's state from the last program: a commissioning shows it, and begins after the operator acknowledges it."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Self

from shearloop.daemon.config import DaemonConfig
from shearloop.daemon.rig import keeps_memory
from shearloop.daemon.rig_memory import Remembered, read_memories, write_memory
from shearloop.daemon.robot_files import RobotFiles
from shearloop.errors import UserError
from shearloop.tools.commission import boards, gripper, identity, tool
from shearloop.tools.commission.operator import Operator, Played
from shearloop.tools.left_tool import left_tool

# Stages that open the fingers.
_OPENING: Final = (gripper.STAGE, boards.STAGE, tool.STAGE)
_PLAYED: Final = Played("nothing is left to clear")


@dataclass(frozen=True, slots=True)
class HoldingOperator(Operator):
    """Asks about motions while a tool may be in the fingers: each question says so."""

    held: str = ""

    def allow(self, motion: str) -> None:
        """Show a motion with the held object, and return after the operator types the word; raises DeclinedError."""
        Operator.allow(self, f"{motion}; {self.held}")


@dataclass(slots=True)
class LeftRobot:
    """The state of a robot that another program has left, after its acknowledgement, and who is asked from there on."""

    files: RobotFiles
    operator: Operator
    # Whether the configuration has a gripper, which stages open.
    opens: bool
    # Whether the robot outlives this process.
    keeps: bool
    state: Remembered

    @classmethod
    def acknowledged(cls, config: DaemonConfig, files: RobotFiles, operator: Operator) -> Self:
        """Show the stored state, and return after the operator acknowledges it; nothing may move before.

        A stored grip stays stored. Raises DeclinedError, and UserError if the state cannot be written.
        """
        left = cls(files, operator, config.gripper is not None, keeps_memory(config), Remembered())
        if not left.keeps:
            return left
        state = read_memories(files)
        held = left_tool(state)
        shown = [*(fault.cause for fault in state.faults), *([held] if held else [])]
        if not shown:
            return left
        operator.say(f"The robot at {files.host} was left like this:")
        for sentence in shown:
            operator.say(f"- {sentence}.")
        operator.act(
            "Look at the rig, and clear what stopped it. The commissioning makes the robot ready to move again", _PLAYED
        )
        left._keep(replace(state, stop=(), stopped_s=None, running=""))
        return left

    @contextmanager
    def during(self, stage: str) -> Iterator[Operator]:
        """Yield who is asked in a stage; a process that is killed meanwhile leaves a stop, as with an experiment.

        A stage that opens the fingers begins once a tool that may be in them is secured. Raises DeclinedError, and
        UserError where the state cannot be written.
        """
        operator = self._secured(stage)
        if stage == identity.STAGE or not self.keeps:
            yield operator
            return
        # Each program that a stage starts lets the controller zero its wrench, under the load of a held tool.
        wrench_zero = None if self.state.wrench_zero is None else (0.0,) * 6
        self._keep(
            replace(self.state, running=f"commissioning, stage {stage}", wrench_zero=wrench_zero, wrench_tared=False)
        )
        try:
            yield operator
        finally:
            self._keep(replace(self.state, running=""))

    def _secured(self, stage: str) -> Operator:
        held = left_tool(self.state)
        if held and self.opens and stage in _OPENING:
            self.operator.act(f"{held[0].upper()}{held[1:]}. Stage {stage} opens the fingers, and it drops: secure it")
            self._keep(Remembered())
            held = ""
        if not held:
            return self.operator
        asked = self.operator
        return HoldingOperator(asked.answer, asked.say, asked.play, asked.allows, asked.word, held)

    def _keep(self, state: Remembered) -> None:
        try:
            write_memory(self.files.state, state)
        except OSError as error:
            at: Path = self.files.state
            raise UserError(
                f"the robot's state cannot be kept in {at} ({error.strerror}), and a stop would be forgotten with this "
                "process: make room, or make the folder writable"
            ) from error
        self.state = state
