"""The task that runs the control loop: it takes robot states, sends commands and publishes, 125 times a second."""

from collections.abc import Mapping
from contextlib import suppress

import structlog

from shearloop.daemon.clock import Clock
from shearloop.daemon.control.action_executor import ActionExecutor, WriteState
from shearloop.daemon.control.command_sender import CommandSender
from shearloop.daemon.control.control_loop import ControlLoop, Drive, End, StandStill
from shearloop.daemon.control.experiment import Experiment, ExperimentPhase
from shearloop.daemon.control.experiment_schema import ExperimentFile
from shearloop.daemon.control.fault_detection import ARM_STALE_S, LONGEST_TICK_S
from shearloop.daemon.control.faults import Fault, FaultCode
from shearloop.daemon.control.fingers import Fingers
from shearloop.daemon.control.gripper_task import GripperTask
from shearloop.daemon.control.inputs import LONGEST_REST_S, ArmStatus
from shearloop.daemon.control.operator_action import MotionPermit, OperatorAction
from shearloop.daemon.control.state_publisher import StatePublisher
from shearloop.daemon.control.stop_timeline import StopTimeline
from shearloop.daemon.control.straight_moves import StraightMoves
from shearloop.daemon.control.wrench import WrenchMean, publish_every
from shearloop.daemon.messaging.deadlines import NO_DEADLINE, Deadline, stood_still
from shearloop.daemon.messaging.publisher import Publisher
from shearloop.daemon.supervisor import error_text
from shearloop.daemon.torques import WRENCH, Tareable, TorqueSample
from shearloop.drivers.errors import DriverError
from shearloop.drivers.ur.client import UrRobot
from shearloop.drivers.ur.messages import Enable, RobotState
from shearloop.errors import ActionError
from shearloop.timeouts import timeout

# Without a new state the loop decides after this time, half of the time after which the arm's state is stale, while
# something may move.
LONGEST_SILENCE_S = 0.5 * ARM_STALE_S
# A crashed loop waits this long for the reply to its stop.
BRAKE_S = 0.5
# The robot confirms `Enable` in one of its next states.
ENABLED_WITHIN_S = 0.5
ENDING = "the daemon ends; start it again"
UNLOCKING = "robot and gripper are being unlocked, or the gripper opened; wait for the end"
STOPPED_AT_START = "it was stopped during its start"
# An operator who sends a stop may not have seen yet that the experiment has ended by itself.
UNSEEN_S = 5.0


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
        write_state: WriteState,
    ) -> None:
        """`sensors` are those that an experiment tares or adapts; `write_state` is as in `ActionExecutor`."""
        self._control_loop = control_loop
        self._robot = robot
        self._clock = clock
        self._timeline = StopTimeline()
        self._sender = CommandSender(robot, control_loop, self._timeline, clock)
        self.fingers = Fingers(gripper)
        self.straight_moves = StraightMoves(robot, self._sender)
        self.operator_action = OperatorAction(robot, self.fingers)
        self.actions = ActionExecutor(
            robot, self.fingers, sensors, self._sender, self.straight_moves, control_loop, write_state
        )
        self.states = StatePublisher(publisher, control_loop, publish_every(robot.settings.rate_hz))
        self._wrench = WrenchMean(robot.settings.rate_hz)
        self._running = False
        # Whether something may be moving: each decision but `End` lets it, and after a crash it is not known.
        self._may_be_moving = False
        # The latest experiment whose stop has a timeline.
        self._timed: Experiment | None = None
        # When something that may have been moving ended.
        self._ended_ns: int | None = None
        self._decided_ns = 0
        # A longer time between two decisions is a standstill; how long the latest one was, and when it ended.
        self._longest_pause_s = LONGEST_REST_S + control_loop.longest_hang_s
        self._stood_s, self._returned_ns = 0.0, 0
        # Counts the stops, also while an experiment starts.
        self._stop_count = 0
        self._closed = False

    async def run(self) -> None:
        """Decide on each state until cancelled; the robot stands still afterwards.

        After an unexpected error the arm is stopped and the error is raised; the next run stops the experiment.
        """
        # After a crash the loop may have been away for long.
        self._note_pause(self._clock.now_ns())
        self._running = True
        try:
            while True:
                # Without a state the loop decides all the same.
                with suppress(TimeoutError):
                    async with timeout(LONGEST_SILENCE_S if self._may_be_moving else LONGEST_REST_S):
                        await self._robot.next_state()
                    # After a pause of this process several states arrive at once; only the newest one counts.
                    if self._robot.state is not None:
                        self._take_state(self._robot.state)
                self._decide()
        except Exception as error:
            self._running = False
            self._control_loop.on_fault(FaultCode.TASK_DIED, f"loop: {error_text(error)}")
            # Before the stop: the action may be about to start a straight move.
            self.actions.cancel()
            await self._brake()
            # Without this wait the gripper might not receive its final command.
            await self.halt_and_wait()
            raise
        finally:
            self._running = False
            self.states.publish_stop(self._timeline.end())
            await self.actions.close()

    def stop(self, *, also_idle: bool = False) -> str | None:
        """End the experiment, also during its start, or the unlocking or the release; return its name, or None.

        The next start waits for `unlock`. `also_idle`: also where nothing moves.
        """
        self._stop_count += 1
        experiment, stopped = self._control_loop.running_experiment, self._stop_operator_action()
        if experiment is not None:
            stopped = experiment.file.name
        else:
            # Fingers may still move after a motion that failed.
            self.actions.halt_fingers()
        if stopped is not None or also_idle:
            what = f"{stopped!r} was under way" if stopped is not None else "nothing was under way"
            self._request_stop(Fault(FaultCode.OPERATOR_STOP, what))
        return stopped

    def just_ended(self) -> dict[str, str]:
        """Return the experiment that ended so lately that a person may not have seen it, for the reply to a stop.

        It is `stopped_before`, by a person, or `ended_by_itself`; `because` is the fault that stopped it, if one did.
        Empty without one.
        """
        experiment, ended_ns = self._control_loop.experiment, self._ended_ns
        if experiment is None or ended_ns is None or self._clock.now_ns() - ended_ns > UNSEEN_S * 1e9:
            return {}
        safety, name = self._control_loop.safety, experiment.file.name
        stop = safety.waiting or safety.acknowledged
        if experiment.phase is not ExperimentPhase.STOPPED or stop is None:
            return {"ended_by_itself": name}
        asked = any(fault.code is FaultCode.OPERATOR_STOP for fault in stop.faults)
        ended = {"stopped_before" if asked else "ended_by_itself": name}
        first = stop.faults[0]
        return ended if first.code is FaultCode.OPERATOR_STOP else {**ended, "because": first.cause}

    def close(self) -> None:
        """Stop the running experiment at the daemon's end, and start nothing more."""
        self._stop_count, self._closed = self._stop_count + 1, True
        if self._control_loop.running_experiment is not None:
            ended = "the wrist is stopped, a gripped tool stays gripped"
            self._request_stop(Fault(FaultCode.DAEMON_ENDED, ended))
            # The loop is cancelled before the next state.
            self.decide_now()

    def _request_stop(self, fault: Fault) -> None:
        self._timeline.request(self._clock.now_ns())
        self._control_loop.stop(fault)

    def decide_now(self) -> None:
        """Decide without a new state: at the daemon's end, and before a stop is acknowledged."""
        if not self._running:
            return
        try:
            self._decide()
        except Exception:  # noqa: BLE001 - the worker stops the arm as it ends
            structlog.get_logger().exception("the loop crashed at a decision without a new state")

    @property
    def stop_count(self) -> int:
        """The number of stops so far: one that comes while an experiment is read or starts ends its start."""
        return self._stop_count

    def stood_s(self) -> float:
        """Return how long the daemon has just stood still; 0 where it did not."""
        return self._control_loop.inputs.stood_s(self._clock.now_ns())

    def start_refusal(self) -> str | None:
        """Return why no experiment at all can begin, or None."""
        return self.busy() or self._control_loop.start_refusal() or self._taring()

    def refusal_of(self, file: ExperimentFile, *, confirmed: bool = False) -> str | None:
        """Return why an experiment cannot begin once the arm is enabled, or None; `confirmed`: a tool may drop."""
        if (reason := self.busy() or self._taring()) is not None:
            return reason
        return self._control_loop.refusal_of(file, self._clock.now_ns(), confirmed=confirmed, is_enabled=False)

    def busy(self) -> str | None:
        """Return what is under way and refuses every command but `stop`, or None."""
        if self._closed:
            return ENDING
        return UNLOCKING if self.operator_action.under_way else None

    def _taring(self) -> str | None:
        """Return why no experiment can begin with the zeros of now, or None."""
        taring = [name for name, sensor in self.actions.sensors.items() if sensor.taring]
        if taring:
            return f"a zero is being taken ({', '.join(taring)}), with nothing gripped; start again when it is done"
        return None

    def motion(self) -> str | None:
        """Return what moves or may move now, in words, or None."""
        if (experiment := self._control_loop.running_experiment) is not None:
            return f"the experiment {experiment.file.name!r} is running"
        if self.operator_action.under_way or self.actions.finishing:
            return "the gripper or the robot is being moved"
        state = self._robot.state
        if self._timeline.pending or (state is not None and state.motion != "idle"):
            return "the arm is moving"
        return None

    async def start(
        self,
        file: ExperimentFile,
        stops_before: int | None = None,
        deadline: Deadline = NO_DEADLINE,
        *,
        confirmed: bool = False,
    ) -> str | None:
        """Begin an experiment; return None, or why it cannot begin; `confirmed` is as in `ControlLoop.start`.

        `stops_before` is the `stop_count` at the request, if the file was read since. `deadline` is checked once the
        arm is enabled.
        """
        if self._closed:
            return ENDING
        stops_before = self._stop_count if stops_before is None else stops_before
        # An arm is not enabled for an experiment that cannot begin. What refuses it may also come until it is enabled.
        refusal = self.refusal_of(file, confirmed=confirmed)
        if self._stop_count == stops_before and refusal is None:
            refusal = await self._enable() or deadline.why_passed("enabling the arm", stood_s=self.stood_s())
        if self._stop_count != stops_before:
            if not self._closed:
                self._control_loop.stop(Fault(FaultCode.OPERATOR_STOP, "a start was under way"))
            return STOPPED_AT_START
        if (refusal := refusal or self.busy() or self._taring()) is not None:
            return refusal
        now_ns = self._clock.now_ns()
        refusal = self._control_loop.start(file, now_ns, confirmed=confirmed)
        if refusal is None:
            # A step that cannot be done ends it within the first decision: every listener sees it begin.
            self.states.publish_loop(self._sender.sent_rad_per_s, now_ns)
        return refusal

    async def _enable(self) -> str | None:
        """Let the arm move after a power-up, and take a state that shows it; return None, or why not."""
        reply = await self._robot.send(Enable())
        if not reply.accepted:
            return reply.refusal
        with suppress(TimeoutError):
            async with timeout(ENABLED_WITHIN_S):
                while (state := await self._robot.next_state()).blocked:
                    pass
                self._take_state(state)
        return None

    async def experiment_ended(self) -> Experiment:
        """Return the present or the next experiment once its end has been published, or another one has begun."""
        while (experiment := self._control_loop.experiment) is None:
            await self.states.changed.wait()
        # An action's failure ends it between two decisions.
        while experiment is self._control_loop.experiment and (
            experiment is not self.states.ended or self._timeline.pending
        ):
            await self.states.changed.wait()
        return experiment

    async def halt_and_wait(self) -> None:
        """Halt moving fingers, and wait for the end of the last release or halt, and for the arm's standstill."""
        self._stop_operator_action()
        self.actions.halt_fingers()
        await self.actions.wait_for_final_action()
        with suppress(TimeoutError):
            async with timeout(BRAKE_S):
                while self._running and self._timeline.pending:
                    await self.states.changed.wait()

    def unlock_refusal(self) -> str | None:
        """Return why robot and gripper cannot be unlocked now, or None."""
        return self.busy() or self._control_loop.operator.running_refusal()

    async def unlock(self, deadline: Deadline = NO_DEADLINE, *, confirmed: bool = False) -> str | None:
        """Enable robot and gripper after a stop, on the operator's command; return None, or why not.

        `confirmed`: the operator says that a tool may drop, where the gripper is activated again. `deadline` is checked
        as the arm or the fingers begin to move.
        """
        if (reason := self.unlock_refusal()) is not None:
            return reason
        permit = self.permit(deadline)
        # A stop since the latest state is carried out and published as the stop that it is.
        self.decide_now()
        number = self._control_loop.safety.stop_number
        try:
            await self.operator_action.unlock(permit, confirmed=confirmed)
        except (ActionError, DriverError) as error:
            return str(error)
        if another := self._control_loop.operator.why_another_stop(number):
            return f"robot and gripper are unlocked, but there was another stop; {another}; unlock it again"
        self._control_loop.acknowledge()
        return None

    def permit(self, deadline: Deadline) -> MotionPermit:
        """Return the permission of a motion that a person asks for now."""
        given_ns, suspended_ns = self._clock.now_ns(), self._clock.suspended_ns()
        return MotionPermit(deadline, lambda: self._why_stood_still(given_ns, suspended_ns))

    def _why_stood_still(self, since_ns: int, suspended_ns: int) -> str | None:
        """Return why a person who asked for a motion at `since_ns` may be at the robot by now, or None.

        `suspended_ns` is how long the computer had been suspended then.
        """
        suspended_s = (self._clock.suspended_ns() - suspended_ns) / 1e9
        stands_s = (self._clock.now_ns() - self._decided_ns) / 1e9
        if suspended_s > self._longest_pause_s:
            stood_s = suspended_s
        elif self._running and stands_s > self._longest_pause_s:
            stood_s = stands_s
        elif self._returned_ns > since_ns:
            stood_s = self._stood_s
        else:
            return None
        return stood_still(stood_s)

    def release_refusal(self) -> str | None:
        """Return why the operator cannot open the gripper now, or None.

        The emergency stop, a torque beyond its limit and a stop that waits for `unlock` do not prevent it.
        """
        if (reason := self.busy()) is not None:
            return reason
        state = self._robot.state
        if state is not None and not (state.rests and state.motion == "idle"):
            return "the arm is moving; wait until it stands still, or stop it"
        return self._control_loop.operator.release_refusal()

    async def release(self, deadline: Deadline = NO_DEADLINE) -> str | None:
        """Open the gripper on the operator's confirmed command; return None, or why not.

        `deadline` is checked as the fingers begin to move.
        """
        if (reason := self.release_refusal()) is not None:
            return reason
        try:
            await self.operator_action.release(self.permit(deadline))
        except (ActionError, DriverError) as error:
            return str(error)
        self._control_loop.tool.on_release_ended()
        return None

    def _stop_operator_action(self) -> str | None:
        """End an unlocking or a release, but not the fingers that it moves; return the command's name, or None."""
        stopped = self.operator_action.stop()
        if stopped is not None:
            # The worker ends its part.
            self._robot.send(self._sender.stop_command)
        return stopped

    def _take_state(self, state: RobotState) -> None:
        wrench = self._wrench
        wrench.add(state)
        self._control_loop.on_arm(
            ArmStatus(
                wrist_rad=state.wrist_rad,
                # The controller's own time: a state that is repeated becomes stale.
                t_ns=state.measured_ns,
                protective_stop=state.protective_stop,
                emergency_stop=state.emergency_stop,
                blocked=state.blocked,
                starting=state.recovering,
                late=state.late,
                enabled_by_start=state.awaits_enable,
                no_torque=wrench.why_unknown,
                slowed_by=state.clipped,
            )
        )
        if self.states.publish_robot(state, wrench) and wrench.known:
            # The torque on the tool is opposite to the wrench on the wrist.
            torque = TorqueSample(WRENCH, -wrench.torque_nm, "", wrench.t_mid_ns, self._clock.now_ns())
            self._control_loop.on_torque(torque)

    def _note_pause(self, now_ns: int) -> float:
        """Note a standstill since the latest decision; return the time since then in s."""
        pause_s = (now_ns - self._decided_ns) / 1e9
        if pause_s > self._longest_pause_s:
            self._stood_s, self._returned_ns = pause_s, now_ns
        self._decided_ns = now_ns
        return pause_s

    def _decide(self) -> None:
        now_ns = self._clock.now_ns()
        # From decision to decision, so that a slow decision is late as well.
        late_s = self._note_pause(now_ns) - (LONGEST_TICK_S if self._may_be_moving else LONGEST_REST_S)
        sent_rad_per_s = None if self._sender.unanswered else self._sender.sent_rad_per_s
        output = self._control_loop.tick(now_ns, max(0.0, late_s), sent_rad_per_s)
        match output:
            case Drive(rad_per_s, action):
                self._may_be_moving = True
                self.straight_moves.go_on()
                if action is not None:
                    self.actions.begin(action, self.permit(NO_DEADLINE).begin)
                self._sender.turn(rad_per_s, now_ns)
            case StandStill():
                self._may_be_moving = True
                if self.straight_moves.interrupt():
                    self._sender.stop()
                self._sender.turn(0.0, now_ns)
            case End(release):
                self._end(now_ns)
                if release:
                    self.actions.release()
        self.states.publish_loop(self._sender.sent_rad_per_s, now_ns)
        self.states.publish_stop(self._timeline.update(self._robot.state, now_ns))

    def _end(self, now_ns: int) -> None:
        """Stop what may move, once, and begin the timeline of an experiment that was stopped."""
        experiment, status = self._control_loop.experiment, self._control_loop.status
        is_new = (
            experiment is not None and experiment is not self._timed and experiment.phase is ExperimentPhase.STOPPED
        )
        if experiment is not None and is_new:
            self._timed = experiment
            # The stop before may still wait for its standstill.
            self.states.publish_stop(self._timeline.end())
            run, name = self._control_loop.runs, experiment.file.name
            rests_since_ns = self._robot.rests_since_ns
            self._timeline.begin(run, name, status.activity, status.decision, now_ns, rests_since_ns)
        if is_new or self._may_be_moving:
            self._may_be_moving, self._ended_ns = False, now_ns
            self.actions.cancel()
            self._sender.stop()

    async def _brake(self) -> None:
        """Stop the arm, including a straight move."""
        # The stop may not arrive, so the next run sends one with its first `End`.
        self._may_be_moving = True
        try:
            async with timeout(BRAKE_S):
                await self._robot.send(self._sender.stop_command)
        except Exception:  # noqa: BLE001 - the loop's own error is raised
            structlog.get_logger().exception("the arm could not be stopped")
