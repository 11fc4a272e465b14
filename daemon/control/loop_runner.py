"""The task that runs the control loop: robot states in, commands out, 125 times a second; and its messages."""

import asyncio
from collections.abc import Awaitable, Callable, Coroutine, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, fields
from functools import partial
from typing import Any, Protocol, runtime_checkable

import structlog

from shearloop.daemon.clock import Clock
from shearloop.daemon.control.control_loop import ControlLoop, ControlOutput
from shearloop.daemon.control.experiment import Action, Experiment, ExperimentPhase
from shearloop.daemon.control.experiment_schema import (
    AdaptStep,
    ApproachStep,
    ExperimentFile,
    GripStep,
    IdentifyStep,
    TareStep,
)
from shearloop.daemon.control.fault_detection import ARM_STALE_S, LONGEST_TICK_S
from shearloop.daemon.control.gripper_task import GripperTask
from shearloop.daemon.control.loop_inputs import ArmStatus, TorqueSample, TorqueSource
from shearloop.daemon.control.safety import Fault, FaultCode
from shearloop.daemon.control.stop_timeline import StopTimeline
from shearloop.daemon.messaging.messages import LoopState, LoopStop, RobotStateMessage
from shearloop.daemon.messaging.publisher import Publisher
from shearloop.daemon.supervisor import MAX_ERROR_LENGTH
from shearloop.drivers.errors import DriverError
from shearloop.drivers.ur.client import UrRobot
from shearloop.drivers.ur.messages import (
    ARRIVED,
    STOPPED_ON_COMMAND,
    CommandReply,
    Enable,
    MoveLinear,
    RobotState,
    Stop,
    Unlock,
    WristSpeed,
    ZeroForceTorque,
    tool_axis,
)
from shearloop.drivers.ur.settings import Six
from shearloop.errors import ActionError

WRENCH = "wrench"
# Without a new state the loop decides after this time, half of the time after which the arm's state is stale.
LONGEST_SILENCE_S = 0.5 * ARM_STALE_S
# Every fifth state is published, and its wrench is a torque sample: 25 a second.
PUBLISH_EVERY = 5
# While nothing moves, a loop is late only after this.
LONGEST_REST_S = ARM_STALE_S
LOOP_STATE_PERIOD_S = 1.0
# A crashed loop waits this long for the reply to its stop.
BRAKE_S = 0.5
# The robot confirms `Enable` in one of its next states.
ENABLED_WITHIN_S = 0.5
# A release is tried for 5 s and takes up to 2 s; systemd kills a service 10 s after it asked for the end.
RELEASED_WITHIN_S = 7.0
LINEAR_ACCELERATION_M_PER_S2 = 0.3
# The arm rests within this time after a stop, unless something else moves it.
COMES_TO_REST_S = 2.0
# The paper's ten frames take 5.4 s.
LONGEST_TARE_S = 30.0
# A tare gives up this much before its step is overdue, so that the sensors' reasons are reported.
GIVES_UP_BEFORE_S = 0.1
ENDING = "the daemon ends; start it again"
STOPPED_AT_START = "it was stopped during its start"
UNLOCKING = "robot and gripper are being unlocked, or the gripper opened; wait for the end"
# The columns of `robot.state` that the robot's state has under the same name.
_SAME = {column.name for column in fields(RobotStateMessage)} - {"source", "joints_rad", "age_s"}


def wrench_source(rate_hz: float) -> TorqueSource:
    """Return the torque source of a robot's wrench, from the robot's rate of states."""
    return TorqueSource(name=WRENCH, period_s=PUBLISH_EVERY / rate_hz, from_robot=True)


class Tareable(Protocol):
    """A sensor with a zero."""

    def tare(self) -> None:
        """Take a new zero from later measurements."""

    async def tare_and_wait(self, within_s: float) -> str | None:
        """Take a new zero and wait until it is done; return None, or why it was not taken."""


@runtime_checkable
class Adaptable(Protocol):
    """A sensor whose gain can be corrected by another sensor's torque."""

    async def adapt(self, reference: str) -> None:
        """Correct the gain by this source's torque during this grip; raises ActionError."""


class ControlLoopRunner:
    """Connects control loop, robot and gripper, and carries out the operator's commands."""

    def __init__(
        self,
        control_loop: ControlLoop,
        robot: UrRobot,
        gripper: GripperTask | None,
        sensors: Mapping[str, Tareable],
        publisher: Publisher,
        clock: Clock,
    ) -> None:
        """`sensors` are those that an experiment tares or adapts."""
        self._control_loop = control_loop
        self._robot = robot
        self._clock = clock
        self._timeline = StopTimeline()
        self._sender = CommandSender(robot, control_loop, self._timeline, clock)
        self._actions = ActionExecutor(robot, gripper, sensors, self._sender, control_loop)
        self._states = StatePublisher(publisher, control_loop)
        self._running = False
        self._stopped = True
        self._decided_ns = 0
        # Counts the stops, also while an experiment starts.
        self._stop_count = 0
        self._closed = False

    async def run(self) -> None:
        """Decide on each state until cancelled; the robot stands still afterwards.

        After an unexpected error the arm is stopped and the error is raised; the next run stops the experiment.
        """
        self._decided_ns, self._running = self._clock.now_ns(), True
        try:
            while True:
                # Without a state the loop decides all the same.
                with suppress(TimeoutError):
                    longest_s = LONGEST_REST_S if self._stopped else LONGEST_TICK_S
                    async with asyncio.timeout(max(longest_s, LONGEST_SILENCE_S)):
                        await self._robot.next_state()
                    # After a pause of this process several states arrive at once; only the newest one counts.
                    if self._robot.state is not None:
                        self._take_state(self._robot.state)
                self._decide()
        except Exception as error:
            self._running = False
            self._control_loop.on_fault(FaultCode.TASK_DIED, f"loop: {error_text(error)}")
            self._actions.abort()
            await self._brake()
            # Without this wait the gripper might not receive its final command.
            await self.halt_and_wait()
            raise
        finally:
            self._running = False
            self._states.publish_stop(self._timeline.end())
            await self._actions.close()

    def stop(self, *, also_idle: bool = False) -> str | None:
        """End the experiment, also during its start, or the unlocking; return its name, or None.

        The next start waits for `unlock`. `also_idle`: also where nothing moves.
        """
        self._stop_count += 1
        experiment, unlocking = self._control_loop.running, self.stop_unlocking()
        stopped = experiment.file.name if experiment is not None else "unlock" if unlocking else None
        if stopped is not None or also_idle:
            what = f"{stopped!r} was under way" if stopped is not None else "nothing was under way"
            self._request_stop("the operator stopped it", Fault(FaultCode.OPERATOR_STOP, what))
        return stopped

    def close(self) -> None:
        """Stop the running experiment at the daemon's end, and start nothing more."""
        self._stop_count, self._closed = self._stop_count + 1, True
        if self._control_loop.running is not None:
            ended = "the wrist is stopped, a gripped tool stays gripped"
            self._request_stop(f"the daemon ended: {ended}", Fault(FaultCode.DAEMON_ENDED, ended))
            # The loop is cancelled before the next state.
            self.decide_now()

    def _request_stop(self, reason: str, fault: Fault) -> None:
        self._timeline.request(self._clock.now_ns())
        self._control_loop.stop(reason, fault)

    def decide_now(self) -> None:
        """Decide without a new state, at the daemon's end."""
        if not self._running:
            return
        try:
            self._decide()
        except Exception:  # noqa: BLE001 - the robot's process stops the arm as it ends
            structlog.get_logger().exception("the loop crashed at its last decision")

    @property
    def stop_count(self) -> int:
        """The number of stops so far: one that comes while an experiment is read or starts ends its start."""
        return self._stop_count

    def start_refusal(self) -> str | None:
        """Return why no experiment can begin, whichever it is, or None."""
        if self._closed:
            return ENDING
        if self._actions.unlocking:
            return UNLOCKING
        return self._control_loop.start_refusal()

    async def start(self, file: ExperimentFile, stops_before: int | None = None) -> str | None:
        """Begin an experiment; return None, or why it cannot begin.

        `stops_before` is the `stop_count` at the request, if the file was read since.
        """
        if self._closed:
            return ENDING
        stops_before = self._stop_count if stops_before is None else stops_before
        refusal = None
        # The control loop refuses while an experiment runs or a stop waits for the operator; a stopped arm must not be
        # enabled on the way.
        if self._stop_count == stops_before and self._control_loop.start_refusal() is None:
            refusal = await self._enable()
        if self._stop_count != stops_before:
            if not self._closed:
                self._control_loop.stop(STOPPED_AT_START, Fault(FaultCode.OPERATOR_STOP, "a start was under way"))
            return STOPPED_AT_START
        if refusal:
            return refusal
        if self._actions.unlocking:
            return UNLOCKING
        return self._control_loop.start(file, self._clock.now_ns())

    async def _enable(self) -> str | None:
        """Let the arm move after a power-up, and take a state that shows it; return None, or why not."""
        reply = await self._robot.send(Enable())
        if not reply.accepted:
            return reply.refusal
        with suppress(TimeoutError):
            async with asyncio.timeout(ENABLED_WITHIN_S):
                while (state := await self._robot.next_state()).blocked:
                    pass
                self._take_state(state)
        return None

    async def experiment_ended(self) -> Experiment:
        """Return the present or the next experiment once its end has been published, or another one has begun."""
        while (experiment := self._control_loop.experiment) is None:
            await self._states.changed.wait()
        # An action's failure ends it between two decisions.
        while experiment is self._control_loop.experiment and (
            experiment is not self._states.ended or self._timeline.pending
        ):
            await self._states.changed.wait()
        return experiment

    async def halt_and_wait(self) -> None:
        """Halt moving fingers, and wait for the end of the last release or halt, and for the arm's standstill."""
        self.stop_unlocking()
        if self._actions.fingers_move:
            self._actions.cancel()
        await self._actions.wait_for_final_action()
        with suppress(TimeoutError):
            async with asyncio.timeout(BRAKE_S):
                while self._running and self._timeline.pending:
                    await self._states.changed.wait()

    async def unlock(self) -> str | None:
        """Enable robot and gripper after a stop, on the operator's command; return None, or why not."""
        if self._closed:
            return ENDING
        if (experiment := self._control_loop.running) is not None:
            return f"the experiment {experiment.file.name!r} is running; stop it first"
        try:
            await self._actions.unlock()
        except (ActionError, DriverError) as error:
            return str(error)
        self._control_loop.acknowledge()
        return None

    def release_refusal(self) -> str | None:
        """Return why the operator cannot open the gripper now, or None.

        The emergency stop, a torque beyond its limit and a stop that waits for `unlock` do not prevent it.
        """
        if self._closed:
            return ENDING
        if self._actions.unlocking:
            return UNLOCKING
        state = self._robot.state
        if state is not None and not (state.rests and state.motion == "idle"):
            return "the arm is moving; wait until it stands still, or stop it"
        return self._control_loop.release_refusal()

    async def release(self) -> str | None:
        """Open the gripper on the operator's confirmed command; return None, or why not."""
        if (reason := self.release_refusal()) is not None:
            return reason
        try:
            await self._actions.open_by_operator()
        except (ActionError, DriverError) as error:
            return str(error)
        self._control_loop.on_release_ended()
        return None

    def stop_unlocking(self) -> bool:
        """End an unlocking or a release, and halt the fingers that it moves; return whether one was under way."""
        stopped = self._actions.stop_unlocking()
        if stopped:
            # The robot's process ends its part.
            self._robot.send(self._sender.stop_command)
        return stopped

    def _take_state(self, state: RobotState) -> None:
        # The controller's own time: a state that is repeated becomes stale.
        t_ns = state.t_mono_ns - state.age_ns
        self._control_loop.on_arm(
            ArmStatus(
                wrist_rad=state.wrist_rad,
                t_ns=t_ns,
                protective_stop=state.protective_stop,
                emergency_stop=state.emergency_stop,
                blocked=state.blocked,
                starting=state.recovering,
                enabled_by_start=state.awaits_enable,
            )
        )
        if self._states.publish_robot(state):
            # The torque on the tool is opposite to the wrench on the wrist.
            torque = TorqueSample(WRENCH, -state.wrist_torque_nm, "", t_ns, self._clock.now_ns())
            self._control_loop.on_torque(torque)

    def _decide(self) -> None:
        now_ns = self._clock.now_ns()
        # From decision to decision, so that a slow decision is late as well.
        late_s = (now_ns - self._decided_ns) / 1e9 - (LONGEST_REST_S if self._stopped else LONGEST_TICK_S)
        self._decided_ns = now_ns
        output = self._control_loop.tick(now_ns, max(0.0, late_s))
        if output.ends_motion:
            self._stop(output, now_ns)
        else:
            self._stopped = False
            if not output.interrupts_motion:
                self._actions.may_move.set()
            elif self._actions.interrupt():
                self._sender.stop()
            if output.action is not None:
                self._actions.begin(output.action)
            self._sender.turn(output.wrist_rad_per_s, now_ns)
            self._robot.keep_moving()
        self._states.publish_loop(self._sender.sent_rad_per_s, now_ns)
        self._states.publish_stop(self._timeline.update(self._robot.state, now_ns))

    def _stop(self, output: ControlOutput, now_ns: int) -> None:
        if not self._stopped:
            self._stopped = True
            experiment, status = self._control_loop.experiment, self._control_loop.status
            if experiment is not None and experiment.phase is ExperimentPhase.STOPPED:
                self._timeline.begin(experiment.file.name, status.activity, status.decision, now_ns)
            self._actions.cancel()
            self._sender.stop()
        if output.release:
            self._actions.release()

    async def _brake(self) -> None:
        """Stop the arm, including a straight move."""
        self._stopped = False
        try:
            async with asyncio.timeout(BRAKE_S):
                await self._robot.send(self._sender.stop_command)
        except Exception:  # noqa: BLE001 - the loop's own error is raised
            structlog.get_logger().exception("the arm could not be stopped")


@dataclass(slots=True)
class CommandSender:
    """Sends wrist velocities and stops to the robot's process, and reports the results to the control loop."""

    robot: UrRobot
    control_loop: ControlLoop
    stops: StopTimeline
    clock: Clock
    # The speed that the robot's process accepted last.
    sent_rad_per_s: float = 0.0
    # Commands that wait for their replies.
    unanswered: int = 0

    @property
    def stop_command(self) -> Stop:
        """The stop of the arm, including a straight move."""
        return Stop(self.control_loop.config.wrist_acceleration_rad_per_s2)

    def stop(self) -> None:
        """Stop the arm."""
        self._send(self.stop_command)

    def turn(self, rad_per_s: float, decided_ns: int) -> None:
        """Turn the wrist, unless it stands still already or a command waits for its reply."""
        if not self.unanswered and (rad_per_s or self.sent_rad_per_s):
            acceleration_rad_per_s2 = self.control_loop.config.wrist_acceleration_rad_per_s2
            self._send(WristSpeed(rad_per_s, acceleration_rad_per_s2, decided_ns))

    def _send(self, command: WristSpeed | Stop) -> None:
        self.unanswered += 1
        try:
            self.robot.send(command).add_done_callback(self._on_reply)
        except Exception as error:  # noqa: BLE001 - the next decision ends the experiment
            self.unanswered -= 1
            self._fail(error)

    def _on_reply(self, replied: asyncio.Future[CommandReply]) -> None:
        self.unanswered -= 1
        try:
            reply = replied.result()
            if not reply.accepted:
                unanswered = self.robot.state is None
                code = FaultCode.COMMAND_UNANSWERED if unanswered else FaultCode.COMMAND_REFUSED
                self.control_loop.on_fault(code, reply.refusal)
            if isinstance(reply.sent, Stop):
                self.stops.on_sent(self.clock.now_ns())
            self.sent_rad_per_s = reply.sent.rad_per_s if isinstance(reply.sent, WristSpeed) else 0.0
            self.control_loop.on_speed_sent(self.sent_rad_per_s)
        except Exception as error:  # noqa: BLE001 - the next decision ends the experiment
            self._fail(error)

    def _fail(self, error: Exception) -> None:
        structlog.get_logger().exception("a command to the robot failed")
        self.control_loop.on_fault(FaultCode.TASK_DIED, f"loop: {error_text(error)}")


@dataclass(slots=True)
class ActionExecutor:
    """Carries out one action at a time; a straight move that is interrupted continues to its end afterwards."""

    robot: UrRobot
    gripper: GripperTask | None
    sensors: Mapping[str, Tareable]
    sender: CommandSender
    control_loop: ControlLoop
    # The fingers may be on their way; cleared by a stop of the fingers.
    fingers_move: bool = False
    # Set while straight moves may go on.
    may_move: asyncio.Event = field(default_factory=asyncio.Event)
    _moving: bool = False
    _interrupted: bool = False
    _task: asyncio.Task[None] | None = None
    # The last action of a stop: to open the gripper, or to halt its fingers.
    _final_task: asyncio.Task[None] | None = None
    _unlocking: asyncio.Task[None] | None = None

    @property
    def unlocking(self) -> bool:
        """Whether robot and gripper are being unlocked, or the gripper is opened for the operator."""
        return self._unlocking is not None and not self._unlocking.done()

    def begin(self, action: Action) -> None:
        """Carry out an action, and report its end to the control loop."""
        self._start(action.do, partial(self._run, action), self.control_loop.on_action_ended)

    def release(self) -> None:
        """Open the gripper after a stop."""
        if self.gripper is not None:
            self._final_task = self._start("open", self.gripper.release, self.control_loop.on_release_ended)

    def cancel(self) -> None:
        """Cancel the present action; moving fingers are halted."""
        fingers_move, self.fingers_move = self.fingers_move, False
        if fingers_move and self.gripper is not None:
            self._final_task = self._start("halt", self.gripper.halt, self._on_halted)
        elif self._task is not None:
            self._task.cancel()

    async def unlock(self) -> None:
        """Enable robot and gripper while no experiment runs; raises DriverError and ActionError."""
        await self._by_operator("unlock", "unlocking", self._unlock)

    async def open_by_operator(self) -> None:
        """Open the gripper while no experiment runs; raises DriverError and ActionError."""
        await self._by_operator("release", "the release", self._open)

    async def _by_operator(self, command: str, name: str, act: Callable[[], Coroutine[Any, Any, None]]) -> None:
        if self.unlocking:
            raise ActionError(UNLOCKING)
        task = self._unlocking = asyncio.create_task(act(), name=command)
        # Nobody asks for a failure that comes after the caller was cancelled.
        task.add_done_callback(lambda done: done.cancelled() or done.exception())
        await asyncio.wait([task])
        if task.cancelled():
            raise ActionError(f"{name} was stopped; send `{command}` again")
        task.result()

    async def _open(self) -> None:
        if self.gripper is None:
            raise ActionError("no gripper is configured")
        self.fingers_move = True
        await self.gripper.open_by_operator()
        self.fingers_move = False

    async def _unlock(self) -> None:
        _accepted(await self.robot.send(Unlock()))
        if self.gripper is not None:
            # An activation opens and closes the fingers; after a failure they may still move.
            self.fingers_move = True
            await self.gripper.unlock()
            self.fingers_move = False

    def stop_unlocking(self) -> bool:
        """End an unlocking, and halt the fingers that it moves; return whether one was under way."""
        if self._unlocking is None or not self._unlocking.cancel():
            return False
        if self.fingers_move:
            self.cancel()
        return True

    def abort(self) -> None:
        """Cancel the present action unless it is the last one of a stop.

        Before the stop: the action may be about to start a straight move.
        """
        if self._task is not self._final_task:
            self.cancel()

    async def wait_for_final_action(self) -> None:
        """Wait for the end of the last release or halt."""
        if self._final_task is not None:
            await asyncio.wait({self._final_task}, timeout=RELEASED_WITHIN_S)

    async def close(self) -> None:
        """Cancel the present action and wait for its end."""
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)

    def interrupt(self) -> bool:
        """Delay straight moves until `may_move` is set; return whether one is under way and must be stopped now."""
        self.may_move.clear()
        stop = self._moving and not self._interrupted
        self._interrupted = self._interrupted or stop
        return stop

    def _start(
        self, name: str, act: Callable[[], Awaitable[None]], on_ended: Callable[[str | None], None]
    ) -> asyncio.Task[None]:
        """Run an action in a task; `on_ended` receives None, or why it failed."""
        if self._task is not None:
            self._task.cancel()

        async def run_action() -> None:
            error = None
            try:
                await act()
            except (ActionError, DriverError) as refused:
                error = str(refused)
                structlog.get_logger().error("an action of the devices failed", action=name, reason=error)
            except Exception as exception:  # noqa: BLE001 - any error fails the step
                structlog.get_logger().exception("an action of the devices crashed", action=name)
                error = f"it crashed with {error_text(exception)}; the log has more"
            on_ended(error)

        self._task = asyncio.create_task(run_action(), name="action")
        return self._task

    def _on_halted(self, error: str | None) -> None:
        if error is not None:
            detail = f"the fingers did not stop, keep clear of them: {error}"
            self.control_loop.on_fault(FaultCode.COMMAND_REFUSED, detail)

    async def _run(self, action: Action) -> None:
        """Carry out an action; raises DriverError and ActionError."""
        match action:
            case ApproachStep():
                await self._move(action)
            case GripStep():
                if self.gripper is None:
                    raise ActionError("no gripper is configured; add a `gripper` section to the configuration")
                # After a failure, such as a lost connection, the fingers may still move.
                self.fingers_move = True
                await self.gripper.grip(action)
                self.fingers_move = False
            case TareStep():
                loop, longest_s = asyncio.get_running_loop(), action.timeout_s or LONGEST_TARE_S
                until_s = loop.time() + longest_s - GIVES_UP_BEFORE_S
                await self._rest()
                _accepted(await self.robot.send(ZeroForceTorque()))
                await tare_all(self.sensors.values(), until_s - loop.time())
            case AdaptStep():
                sensor = self.sensors.get(action.fingertip)
                if not isinstance(sensor, Adaptable):
                    raise ActionError(f"{action.fingertip} is not a fingertip; name one calibrated on recordings")
                await sensor.adapt(action.reference)
            case IdentifyStep():
                raise TypeError("the control loop identifies by itself")

    async def _rest(self) -> None:
        """Wait until no motion is under way; raises ActionError.

        Resting joints are not enough: after a stop the robot's process is busy a little longer, and refuses a move.
        """
        sender = self.sender
        try:
            async with asyncio.timeout(COMES_TO_REST_S):
                state = await self.robot.next_state()
                while sender.sent_rad_per_s or sender.unanswered or state.motion != "idle" or not state.rests:
                    state = await self.robot.next_state()
        except TimeoutError:
            what = f"the arm did not come to rest within {COMES_TO_REST_S:g} s"
            raise ActionError(f"{what}; check what moves it") from None

    async def _move(self, action: ApproachStep) -> None:
        pose = action.pose_m_rad
        while True:
            await self.may_move.wait()
            await self._rest()
            # The loop may have interrupted the move during the wait.
            if not self.may_move.is_set():
                continue
            here = self.robot.state
            if here is None:
                raise ActionError("the robot is not connected")
            # The goal is fixed at the first start, so that an interruption does not lengthen the move.
            pose = pose or along_tool(here.tcp_pose, action.along_tool_m or 0.0)
            command = MoveLinear(pose, action.speed_m_per_s, LINEAR_ACCELERATION_M_PER_S2)
            self._moving, self._interrupted = True, False
            try:
                error = await self._move_once(command, here.motion_id)
            finally:
                self._moving = False
            if error is None:
                return
            if not self._interrupted:
                raise ActionError(error)

    async def _move_once(self, command: MoveLinear, previous_id: int) -> str | None:
        """Send a straight move and wait for its end; return None, or why it did not arrive."""
        reply = await self.robot.send(command)
        if not reply.accepted:
            return reply.refusal
        for reason in reply.clipped:
            structlog.get_logger().warning("the move was clipped", reason=reason)
        while True:
            state = await self.robot.next_state()
            if state.motion_id != previous_id and state.end_reason:
                if state.end_reason not in (ARRIVED, STOPPED_ON_COMMAND):
                    # It ended by itself, just before an interruption; do not repeat it.
                    self._interrupted = False
                return None if state.end_reason == ARRIVED else f"the move ended early: {state.end_reason}"


async def tare_all(sensors: Iterable[Tareable], within_s: float = LONGEST_TARE_S) -> None:
    """Zero every sensor at the same time; raises ActionError with the reason of each one that was not zeroed."""
    reasons = await asyncio.gather(*(sensor.tare_and_wait(within_s) for sensor in sensors))
    if any(reasons):
        raise ActionError(" ".join(filter(None, reasons)))


def _accepted(reply: CommandReply) -> None:
    """Raise ActionError for a command that the robot's process refused."""
    if not reply.accepted:
        raise ActionError(reply.refusal)


def along_tool(pose: Six, distance_m: float) -> Six:
    """Return the pose (x, y, z in m, rotation vector in rad) at a distance along the tool's axis."""
    x, y, z, rx, ry, rz = pose
    dx, dy, dz = tool_axis(pose)
    return x + dx * distance_m, y + dy * distance_m, z + dz * distance_m, rx, ry, rz


@dataclass(slots=True)
class StatePublisher:
    """Publishes the states of robot and loop, and wakes those who wait for a change of the loop's."""

    publisher: Publisher
    control_loop: ControlLoop
    changed: asyncio.Event = field(default_factory=asyncio.Event)
    # The experiment whose end was published last.
    ended: Experiment | None = None
    _block: int = -1
    _key: tuple[object, ...] = ()
    _hold: int = 0
    _published_ns: int = 0

    def publish_robot(self, state: RobotState) -> bool:
        """Publish every fifth state; return whether it was this one."""
        if (block := state.cycle // PUBLISH_EVERY) == self._block:
            return False
        self._block = block
        same: dict[str, Any] = {name: getattr(state, name) for name in _SAME}
        age_s = state.age_ns / 1e9
        self.publisher.publish(RobotStateMessage(source="robot", joints_rad=state.q_rad, age_s=age_s, **same))
        return True

    def publish_loop(self, sent_rad_per_s: float, now_ns: int) -> None:
        """Publish the loop's state at a change and once a second."""
        status, experiment = self.control_loop.status, self.control_loop.experiment
        key = (
            status.phase,
            tuple(fault.code for fault in status.decision.faults),
            status.velocity.reasons,
            experiment and experiment.step_number,
        )
        hold = experiment.command.hold_number if experiment is not None else 0
        unchanged = (key, hold) == (self._key, self._hold)
        if unchanged and now_ns - self._published_ns < LOOP_STATE_PERIOD_S * 1e9:
            return
        if key != self._key:
            structlog.get_logger().info(
                "loop", phase=status.phase, activity=status.activity, reasons=" ".join(status.decision.reasons)
            )
        self._key, self._hold, self._published_ns = key, hold, now_ns
        self.publisher.publish(loop_state(self.control_loop, sent_rad_per_s, now_ns))
        if experiment is not None and not experiment.running:
            self.ended = experiment
        self._notify()

    def publish_stop(self, stop: LoopStop | None) -> None:
        """Publish the times of a stop, if there is one."""
        if stop is not None:
            self.publisher.publish(stop)
            self._notify()

    def _notify(self) -> None:
        # Wake the present waiters only.
        self.changed.set()
        self.changed.clear()


def loop_state(control_loop: ControlLoop, sent_rad_per_s: float, now_ns: int) -> LoopState:
    """Return the `loop.state` message at now_ns."""
    status, experiment = control_loop.status, control_loop.experiment
    driving = experiment.file.torque_source if experiment is not None else ""
    latest = control_loop.inputs.torques.get(driving)
    controller = control_loop.wrist.controller
    tool = control_loop.wrist.tool
    return LoopState(
        source="loop",
        t_mono_ns=now_ns,
        phase=status.phase,
        run=control_loop.runs,
        experiment=experiment.file.name if experiment is not None else "",
        step=experiment.step_number if experiment is not None else 0,
        steps=len(experiment.file.steps) if experiment is not None else 0,
        step_name=experiment.step.do if experiment is not None else "",
        slices=experiment.file.slices or "" if experiment is not None else "",
        hold=experiment.command.hold_number if experiment is not None else 0,
        activity=status.activity,
        progress=experiment.progress if experiment is not None else 0.0,
        remaining_s=experiment.remaining_s if experiment is not None else 0.0,
        tool_mm=experiment.file.tool_mm if experiment is not None else None,
        torque_source=driving,
        torque_nm=latest.torque_nm if latest is not None else None,
        torque_limit_nm=experiment.limits.torque_nm if experiment is not None else None,
        set_point_nm=controller.set_point_nm if controller is not None else None,
        ramp_nm=controller.ramp_nm if controller is not None else None,
        filtered_torque_nm=controller.torque_nm if controller is not None else None,
        filtered_torque_std_nm=controller.torque_std_nm if controller is not None else None,
        stiffness_nm_per_rad=tool.stiffness_nm_per_rad if tool is not None else None,
        delay_s=tool.age_s + tool.significant_lag_s if tool is not None else None,
        noise_nm=tool.noise_nm if tool is not None else None,
        speed_command_rad_per_s=status.velocity.speed_rad_per_s,
        speed_sent_rad_per_s=sent_rad_per_s,
        response=status.decision.response.name.lower().replace("_", " "),
        cause=next(iter(status.decision.reasons), ""),
        faults=status.decision.codes,
        reasons=" ".join((*status.decision.reasons, *status.velocity.reasons)),
    )


def error_text(error: Exception) -> str:
    """Return an error's type and message, shortened for messages."""
    return f"{type(error).__name__}: {error}"[:MAX_ERROR_LENGTH]
