"""The devices, settings and questions that every stage of a commissioning uses."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from typing import Final

from shearloop.daemon.commissioning_report import Report
from shearloop.daemon.config import DaemonConfig
from shearloop.drivers.ur.control_box import ControllerInfo
from shearloop.drivers.ur.recovery import ENDS_ITSELF_S
from shearloop.drivers.ur.rtde import registers_in_use
from shearloop.drivers.ur.script import UPPER, ScriptRegisters
from shearloop.drivers.ur.settings import UrSettings
from shearloop.errors import UserError
from shearloop.tools.commission.arrivals import Clock
from shearloop.tools.commission.bounds import bounded
from shearloop.tools.commission.fingers import AskedGripper, Gripper
from shearloop.tools.commission.limits import TimeLimits, limits_for
from shearloop.tools.commission.mover import Mover
from shearloop.tools.commission.observer import Observer, Seen
from shearloop.tools.commission.operator import Operator
from shearloop.tools.commission.rig import Rig
from shearloop.tools.robot_use import Sign, SignKind, other_programs, program_in_words

# With fewer stops of each layer a report raises no speed.
STOPS_NEEDED: Final = 5
_STOPS_WITHIN_S: Final = 5.0
# The clock of our program changes with each cycle.
_CLOCK_S: Final = 0.25
_CLOCK_SAMPLES: Final = 5
_REPLACED: Final = (
    "Another program plays on the robot: a daemon of another user or computer, or the pendant, has replaced the "
    "commissioning's. It may hold a tool."
)
_NOT_ENDED: Final = (
    "The commissioning does not end that program, because a stop may wait there: end the other daemon, or stop the "
    "program at the teach pendant, then run it again"
)
# A joint that has moved by more between a question and its answer makes another pose.
_SAME_POSE_RAD: Final = 0.01


@dataclass(frozen=True, slots=True)
class Counts:
    """How often and how long a commissioning measures."""

    listen_s: float = 60.0
    uploads_after_s: tuple[float, ...] = (0.0, 5.0, 60.0)
    clock_s: float = 10.0
    rest_s: float = 10.0
    turns: int = 10
    stops: int = STOPS_NEEDED
    speeds_rad_per_s: tuple[float, ...] = (0.05, 0.2, 0.5)
    exchanges: int = 100
    gauges: int = 5
    objects: int = 4
    starts: int = 5
    frames: int = 20
    twists: int = 10


@dataclass(slots=True)
class Context:
    """One commissioning: configuration, settings, devices, operator, report so far, and the two ends on the robot."""

    config: DaemonConfig
    settings: UrSettings
    rig: Rig
    controller: ControllerInfo
    operator: Operator
    report: Report
    counts: Counts
    opened: ExitStack
    _observer: Observer | None = field(default=None, init=False)
    _mover: Mover | None = field(default=None, init=False)
    # Where the arm stood when the operator confirmed it.
    _confirmed: Seen | None = field(default=None, init=False)
    # The signs of other programs that the operator has accepted.
    _accepted: set[Sign] = field(default_factory=set, init=False)

    @property
    def clock(self) -> Clock:
        """The rig's time."""
        return self.rig.clock

    @property
    def limits(self) -> TimeLimits:
        """The limits on times."""
        return limits_for(self.config)

    @property
    def registers(self) -> ScriptRegisters:
        """The half of the controller's registers that the script uses."""
        return self.controller.registers or UPPER

    @property
    def observer(self) -> Observer:
        """The observer, which is started when it is first needed."""
        if self._observer is None:
            self._observer = self.opened.enter_context(self.rig.observer(self.registers))
        return self._observer

    def expect_no_other_program(self) -> None:
        """Return once nothing else commands the robot, or the operator accepts what does; raises DeclinedError.

        Raises UserError if others write all registers, or if a program may belong to another daemon. The operator is
        asked about any other program each time, because the commissioning replaces it.
        """
        if self._mover is not None:
            # The observer reads the robot's state all the time. Only our program changes this clock.
            if self._another_plays():
                if self.rig.has_other_client(self.registers):
                    raise UserError(f"{_REPLACED} Another client writes the robot's registers too. {_NOT_ENDED}")
                self.operator.accept(f"{_REPLACED} The commissioning replaces it.")
            return
        seen = self.rig.controller()
        if seen.registers is None:
            raise registers_in_use(self.settings.host)
        outputs = self.rig.outputs(self.registers)
        if program_in_words(outputs):
            # The last commissioning's may end by its watchdog.
            self.clock.sleep(ENDS_ITSELF_S)
            outputs = self.rig.outputs(self.registers)
        signs = other_programs(seen, outputs)
        kinds = {sign.kind for sign in signs}
        if SignKind.REGISTERS in kinds and SignKind.PROGRAM in kinds:
            raise UserError(f"{' '.join(sign.sentence for sign in signs)} {_NOT_ENDED}")
        for sign in signs:
            if sign not in self._accepted:
                moves = "The commissioning replaces such a program, and moves robot and gripper."
                self.operator.accept(f"{sign.sentence} {moves}")
                # A program is replaced; a client keeps its registers.
                if sign.kind is SignKind.REGISTERS:
                    self._accepted.add(sign)

    def _another_plays(self) -> bool:
        """Return whether a program plays that is not ours: the clock in our registers stands still."""
        self.observer.forget()
        latest = [seen for seen in self.observer.listen(_CLOCK_S) if seen.plays][-_CLOCK_SAMPLES:]
        return len(latest) == _CLOCK_SAMPLES and len({seen.outputs.script_ticks for seen in latest}) == 1

    @property
    def mover(self) -> Mover:
        """The process that drives the robot; it is started when it is first needed.

        The robot stays near the confirmed pose. Before the confirmation it stays near the pose of the start.
        """
        if self._mover is None:
            about = self._confirmed or self.observer.latest()
            self._mover = self.opened.enter_context(self.rig.mover(bounded(self.settings, about.wrist_rad)))
            self._mover.before_motion = self._before_motion
        return self._mover

    @contextmanager
    def gripper(self) -> Iterator[Gripper]:
        """Open the configured gripper."""
        with self.rig.gripper() as gripper:
            yield AskedGripper(gripper, self._before_motion)

    def _before_motion(self) -> None:
        # Each stage has its own operator.
        self.operator.allow_again_after_standstill()

    def confirm(self) -> Seen:
        """Have the operator confirm the pose about which motions are allowed, once; return a sample of it.

        Worker and script enforce the bounds about this pose, also where they were started in another one.
        """
        if self._confirmed is None:
            self._confirmed = self._confirmed_pose()
            if self._mover is not None:
                self._bound_about(self._confirmed.wrist_rad, self._mover)
        return self._confirmed

    def _bound_about(self, wrist_rad: float, mover: Mover) -> None:
        bounds = bounded(self.settings, wrist_rad)
        if mover.settings != bounds:
            mover.restart(settings=bounds)
            self.ready()

    def _confirmed_pose(self) -> Seen:
        """Ask until the arm stands at the answer as it did at the question; return a sample of that pose."""
        while True:
            here = self.observer.latest()
            self.operator.act(
                f"Wrist 3 stands at {here.wrist_rad:.3f} rad. Check that the arm stands free, that the tool may turn "
                "by 0.1 rad either way and move 20 mm along its axis, and that no cable wraps about the wrist"
            )
            pairs = zip(here.outputs.q_rad, self.observer.latest().outputs.q_rad, strict=True)
            if all(abs(now_rad - asked_rad) <= _SAME_POSE_RAD for asked_rad, now_rad in pairs):
                return here
            self.operator.say("The arm has moved since the question; the pose is asked for again.")

    @property
    def pose_rad(self) -> float:
        """The wrist's angle in the confirmed pose."""
        return self.confirm().wrist_rad

    def stop_program(self) -> bool:
        """Stop the program on the robot; return whether it stopped."""
        self.rig.stop_program()
        since_ns = self.clock.now_ns()
        return self.observer.wait_for(lambda seen: not seen.plays, since_ns, _STOPS_WITHIN_S) is not None

    def comes_to_rest(self, within_s: float) -> Seen:
        """Wait until the arm rests, and return a sample at rest; raises UserError where it does not come to rest."""
        seen = self.observer.comes_to_rest(self.settings.rest_rad_per_s, within_s)
        if seen is None:
            raise UserError("the arm does not come to rest: look at the teach pendant")
        return seen

    def turn_to(self, to_rad: float, rad_per_s: float) -> None:
        """Turn the wrist to an angle; raises MoveRefusedError."""
        way = 1.0 if to_rad > self.observer.latest().wrist_rad else -1.0
        self.mover.move("turn", rad_per_s=way * rad_per_s, to_rad=to_rad)

    def return_to_pose(self, rad_per_s: float) -> None:
        """Turn the wrist back to the confirmed pose, where another stage has left it elsewhere."""
        here_rad, pose_rad = self.observer.latest().wrist_rad, self.pose_rad
        if abs(here_rad - pose_rad) > _SAME_POSE_RAD:
            self.ready()
            self.operator.allow(
                f"wrist 3 turns back to the confirmed pose, from {here_rad:.3f} to {pose_rad:.3f} rad at "
                f"{rad_per_s:g} rad/s"
            )
            self.turn_to(pose_rad, rad_per_s)

    def ready(self) -> Mover:
        """Return what drives the robot once the robot is ready to move; raises UserError."""
        if refusal := self.mover.unlock():
            raise UserError(f"the robot does not get ready: {refusal}")
        return self.mover
