"""The task that closes the loop: the robot's states in, the brain's orders out, 125 times a second."""

import asyncio
from collections.abc import Awaitable, Callable, Mapping
from contextlib import suppress
from functools import partial

import structlog

from shearloop.daemon.clock import Clock
from shearloop.daemon.control.actions import ActionExecutor
from shearloop.daemon.control.control_loop import ControlLoop, ControlOutput
from shearloop.daemon.control.experiment_schema import ExperimentFile
from shearloop.daemon.control.fault_detection import ARM_STALE_S, LONGEST_TICK_S
from shearloop.daemon.control.gripper_task import GripperTask
from shearloop.daemon.control.loop_inputs import ArmStatus, TorqueSample, TorqueSource
from shearloop.daemon.control.loop_messages import loop_state, robot_state
from shearloop.daemon.control.step_runner import Experiment
from shearloop.daemon.control.velocity_sender import VelocityCommandSender
from shearloop.daemon.control.watchdog_timer import WatchdogTimer
from shearloop.daemon.messaging.messages import Scalar
from shearloop.daemon.messaging.publisher import Publisher
from shearloop.daemon.supervisor import LONGEST_ERROR
from shearloop.drivers.ur.client import UrRobot, ignore_state
from shearloop.drivers.ur.messages import Enable, RobotState, Stop, Unlock

WRENCH = "wrench"
# Without a state it is asked after so long: half of the time after which the arm's is stale.
LONGEST_SILENCE_S = 0.5 * ARM_STALE_S
# Every fifth state is published, and speaks as the torque of the wrench: 25 a second.
PUBLISH_EVERY = 5
# While nothing can move a loop is late only after this.
LONGEST_REST_S = ARM_STALE_S
LOOP_STATE_PERIOD_S = 1.0
# A loop that died tells the arm to stop, and waits no longer than this for the answer.
BRAKE_S = 0.5
# A robot that has taken `Enable` says so in its next state.
ENABLED_WITHIN_S = 0.5
# A release is tried for five seconds and then opens the fingers; systemd ends a service ten seconds after it said so.
RELEASED_WITHIN_S = 7.0


def wrench_source(rate_hz: float) -> TorqueSource:
    """Return how often the wrench's torque comes, of a robot that tells its state so often: with those published."""
    return TorqueSource(name=WRENCH, period_s=PUBLISH_EVERY / rate_hz, from_robot=True)


class ControlLoopRunner:
    """Ties brain, robot and gripper together."""

    def __init__(
        self,
        brain: ControlLoop,
        robot: UrRobot,
        gripper: GripperTask | None,
        take_zero: Callable[[], Awaitable[str]],
        publisher: Publisher,
        clock: Clock,
        died: Callable[[], Mapping[str, str]] = dict,
        acceleration_rad_per_s2: float = 4.0,
    ) -> None:
        """Take what acts; `take_zero` tares every sensor, and `died` names the tasks that are gone, and why."""
        self._brain = brain
        self._robot = robot
        self._gripper = gripper
        self._publisher = publisher
        self._clock = clock
        self._died = died
        self._acceleration_rad_per_s2 = acceleration_rad_per_s2
        # Which of the robot's cycles, in fives, was published last.
        self._published = -1
        self._wrist = VelocityCommandSender(robot, brain, acceleration_rad_per_s2, self._died_of)
        self._actions = ActionExecutor(robot, gripper, take_zero, lambda: self._wrist.turns)
        self._action: asyncio.Task[None] | None = None
        # The last of them that a stop asks of the gripper: to open, or to move no more.
        self._last_word: asyncio.Task[None] | None = None
        # What the loop, or a command of it, died of since the brain was told last.
        self._own_death = ""
        self._stopped = True
        self._told: tuple[object, ...] = ()
        self._told_ns = self._told_hold = 0
        self._news = asyncio.Event()
        # When the brain was asked last, and how long it may take until it is asked again.
        self._decided_ns, self._longest_s = 0, 0.0
        self._silence = WatchdogTimer(self._decide)
        # What a decision has died of.
        self._over: asyncio.Future[Exception] | None = None

    async def drive(self) -> None:
        """Ask the brain and carry out what it says, until cancelled; the robot stands still afterwards.

        Where something unexpected ends it, the arm is told to stop; begun again, it stops the experiment.
        """
        # Each state is decided upon where it is read: waking a task for each would cost as much again.
        over = self._over = asyncio.get_running_loop().create_future()
        self._decided_ns = self._clock.now_ns()
        self._robot.on_state = self._decide
        try:
            self._listen()
            raise await over
        except Exception as error:
            self._own_death = _said(error)
            self._listen_no_more()
            await self._brake()
            # Broken off before the gripper has heard of it, the tool would stay gripped: nobody would ask again.
            await self.released()
            raise
        finally:
            self._listen_no_more()
            await self._end()

    def _decide(self, state: RobotState | None = None, newest: bool = True) -> None:
        """Ask the brain, with a new state or because none has come for too long; what goes wrong ends `drive`."""
        now_ns = self._clock.now_ns()
        passed_s = (now_ns - self._decided_ns) / 1e9
        try:
            if state is not None:
                self._sense(state)
                if not newest:
                    # Where this process was away they come at once. Decided upon one by one, all but the first would be
                    # in time, and a loop that is late again and again would not be late for more than a moment.
                    return
            # From one decision to the next: what a decision itself takes is late as well.
            self._brain.inputs.late_s = max(0.0, passed_s - self._longest_s)
            self._decided_ns = now_ns
            self._brain.inputs.died = self._deaths()
            self._carry_out(self._brain.tick(now_ns))
            self._tell(now_ns)
            self._listen()
        except Exception as error:  # noqa: BLE001 - raised again by `drive`, whose task it ends
            if self._action is not self._last_word:
                # First of all: it may be about to begin a straight move, which would come after the stop.
                self._break_off()
            self._listen_no_more()
            if self._over is not None and not self._over.done():
                self._over.set_result(error)

    def decide_now(self) -> None:
        """Ask the brain at once, where the loop runs: of a robot that is lost no state tells, and none comes."""
        if self._over is not None and not self._over.done():
            self._decide()

    def _listen(self) -> None:
        """Decide without a state where none comes in time."""
        self._longest_s = LONGEST_REST_S if self._stopped and not self._running() else LONGEST_TICK_S
        self._silence.heard(max(self._longest_s, LONGEST_SILENCE_S))

    def _listen_no_more(self) -> None:
        self._robot.on_state = ignore_state
        self._silence.end()

    async def start(self, file: ExperimentFile) -> str | None:
        """Begin an experiment, or return why it cannot be begun."""
        if self._running():
            # What stopped the arm of the experiment that runs is not to be forgiven by the way.
            return self._brain.start(file, self._clock.now_ns())
        reply = await self._robot.send(Enable())
        if not reply.accepted:
            return reply.refused
        # The state that says so comes one cycle later.
        with suppress(TimeoutError):
            async with asyncio.timeout(ENABLED_WITHIN_S):
                while (state := await self._robot.next_state()).blocked:
                    pass
                self._sense(state)
        return self._brain.start(file, self._clock.now_ns())

    async def ended(self) -> Experiment:
        """Return the experiment that runs, or the next to run, once it has ended; another may be running by then."""
        while (experiment := self._brain.experiment) is None:
            await self._news.wait()
        while experiment.running:
            await self._news.wait()
        return experiment

    async def released(self) -> None:
        """Wait until the gripper has opened or stopped, or could not, where it was told to; fingers that move are."""
        if self._actions.grips:
            self._break_off()
        if self._last_word is not None:
            await asyncio.wait({self._last_word}, timeout=RELEASED_WITHIN_S)

    async def unlock(self) -> str | None:
        """Let robot and gripper move again after a stop, on the operator's word; return why they would not."""
        reply = await self._robot.send(Unlock())
        if not reply.accepted:
            return reply.refused
        if self._gripper is not None and (why := await self._gripper.unlock()):
            return why
        self._brain.acknowledge()
        return None

    def facts(self) -> Mapping[str, Scalar | Mapping[str, int]]:
        """Return what health tells of the robot."""
        errors = dict(self._robot.losses)
        if self._robot.stops_in_vain:
            errors["paused program not stopped"] = self._robot.stops_in_vain
        return {
            "connected": self._robot.state is not None,
            "states": self._robot.states,
            "errors": errors,
            "trouble": "" if self._robot.link.status == "up" else self._robot.link.sentence,
        }

    def _sense(self, state: RobotState) -> None:
        self._brain.inputs.arm = ArmStatus(
            wrist_rad=state.wrist_rad,
            # The moment that the controller speaks of: one that repeats itself is as stale as one that is silent.
            t_ns=state.t_mono_ns - state.age_ns,
            protective_stop=state.protective_stop,
            emergency_stop=state.emergency_stop,
            blocked=state.blocked,
        )
        if (number := state.cycle // PUBLISH_EVERY) != self._published:
            self._published = number
            # The wrench is what the tool does to the wrist; the torque on the tool is its opposite.
            self._brain.on_torque(
                TorqueSample(WRENCH, -state.wrist_torque_nm, "", state.t_mono_ns - state.age_ns, self._clock.now_ns())
            )
            self._publisher.publish(robot_state(state))

    def _running(self) -> bool:
        experiment = self._brain.experiment
        return experiment is not None and experiment.running

    def _deaths(self) -> Mapping[str, str]:
        """Return what each dead task died of, and what the loop itself did; that, once."""
        died = self._died()
        if self._own_death:
            died = {**died, "loop": self._own_death}
            self._own_death = ""
        return died

    def _carry_out(self, orders: ControlOutput) -> None:
        if orders.stop:
            if not self._stopped:
                self._stopped = True
                self._break_off()
                self._wrist.stop()
            if orders.release and self._gripper is not None:
                self._begin(self._gripper.release, self._has_released)
                self._last_word = self._action
            return
        self._stopped = False
        if not orders.hold:
            self._actions.let_go()
        elif self._actions.hold_back():
            self._wrist.stop()
        if orders.action is not None:
            self._begin(partial(self._actions.perform, orders.action), self._brain.on_action_ended)
        self._wrist.turn(orders.wrist_rad_per_s)

    def _died_of(self, error: Exception) -> None:
        structlog.get_logger().exception("a command to the robot died")
        self._own_death = _said(error)

    def _begin(self, act: Callable[[], Awaitable[str]], tell: Callable[[str], None]) -> None:
        """Carry an action out beside the loop; `tell` hears why it went wrong, or an empty text."""
        self._cancel_action()

        async def carried_out() -> None:
            try:
                failure = await act()
            except Exception as error:  # noqa: BLE001 - the step has failed, whatever of
                structlog.get_logger().exception("an action of the devices died")
                failure = f"it died of {_said(error)}; the log has more"
            tell(failure)

        self._action = asyncio.create_task(carried_out(), name="action")

    def _has_released(self, failure: str) -> None:
        if failure:
            structlog.get_logger().error("the gripper was told to open and did not", why=failure)
        self._brain.on_release_ended(failure)

    def _break_off(self) -> None:
        """End the action that is under way; fingers that move go on by themselves, and are told not to."""
        fingers_move, self._actions.grips = self._actions.grips, False
        self._cancel_action()
        if fingers_move and self._gripper is not None:
            self._begin(self._gripper.halt, self._has_halted)
            self._last_word = self._action

    def _has_halted(self, failure: str) -> None:
        if failure:
            structlog.get_logger().error("the fingers were told to stop and did not", why=failure)
            self._brain.on_command_refused(f"the fingers were told to stop and did not: {failure}")

    def _cancel_action(self) -> None:
        if self._action is not None:
            self._action.cancel()

    def _tell(self, now_ns: int) -> None:
        status, experiment = self._brain.status, self._brain.experiment
        key = (
            status.phase,
            tuple(trouble.code for trouble in status.decision.faults),
            status.velocity.reasons,
            experiment and experiment.step_number,
        )
        held = experiment.command.hold_number if experiment is not None else 0
        if (key, held) == (self._told, self._told_hold) and now_ns - self._told_ns < LOOP_STATE_PERIOD_S * 1e9:
            return
        self._told_hold = held
        if key != self._told:
            structlog.get_logger().info(
                "loop", phase=status.phase, doing=status.activity, reasons=" ".join(status.decision.reasons)
            )
        self._told, self._told_ns = key, now_ns
        self._publisher.publish(loop_state(self._brain, self._wrist.sent_rad_per_s, now_ns))
        # Whoever waits now is woken, and whoever comes later waits for the next.
        self._news.set()
        self._news.clear()

    async def _brake(self) -> None:
        """Tell the arm to stop, whatever it does: nobody renews a wrist's speed now, but a straight move would end."""
        self._stopped = False
        try:
            async with asyncio.timeout(BRAKE_S):
                await self._robot.send(Stop(self._acceleration_rad_per_s2))
        except Exception:  # noqa: BLE001 - what the loop died of is raised again
            structlog.get_logger().exception("the arm could not be told to stop")

    async def _end(self) -> None:
        self._cancel_action()
        if self._action is not None:
            await asyncio.gather(self._action, return_exceptions=True)


def _said(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"[:LONGEST_ERROR]
