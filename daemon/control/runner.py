"""The task that runs the control loop: robot states in, commands out, 125 times a second; and its messages."""

import asyncio
from collections.abc import Awaitable, Callable, Mapping
from contextlib import suppress
from functools import partial

import structlog

from shearloop.daemon.clock import Clock
from shearloop.daemon.control.control_loop import ControlLoop, ControlOutput
from shearloop.daemon.control.device_commands import ActionExecutor, VelocityCommandSender
from shearloop.daemon.control.experiment_schema import ExperimentFile
from shearloop.daemon.control.fault_detection import ARM_STALE_S, LONGEST_TICK_S
from shearloop.daemon.control.gripper_task import GripperTask
from shearloop.daemon.control.loop_inputs import ArmStatus, TorqueSample, TorqueSource
from shearloop.daemon.control.step_runner import Experiment
from shearloop.daemon.messaging.messages import LoopState, RobotStateMessage, Scalar
from shearloop.daemon.messaging.publisher import Publisher
from shearloop.daemon.supervisor import MAX_ERROR_LENGTH
from shearloop.drivers.ur.client import UrRobot
from shearloop.drivers.ur.messages import Enable, RobotState, Stop, Unlock

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


def wrench_source(rate_hz: float) -> TorqueSource:
    """Return the torque source of a robot's wrench, from the robot's rate of states."""
    return TorqueSource(name=WRENCH, period_s=PUBLISH_EVERY / rate_hz, from_robot=True)


class ControlLoopRunner:
    """Connects control loop, robot and gripper."""

    def __init__(
        self,
        control_loop: ControlLoop,
        robot: UrRobot,
        gripper: GripperTask | None,
        tare: Callable[[], Awaitable[str]],
        publisher: Publisher,
        clock: Clock,
        dead_tasks: Callable[[], Mapping[str, str]],
        acceleration_rad_per_s2: float,
    ) -> None:
        """`tare` zeroes every sensor; `dead_tasks` returns the error of each dead task."""
        self._control_loop = control_loop
        self._robot = robot
        self._gripper = gripper
        self._publisher = publisher
        self._clock = clock
        self._dead_tasks = dead_tasks
        self._acceleration_rad_per_s2 = acceleration_rad_per_s2
        self._velocity = VelocityCommandSender(robot, control_loop, acceleration_rad_per_s2, self._on_command_error)
        self._actions = ActionExecutor(robot, gripper, tare, self._velocity)
        self._action: asyncio.Task[None] | None = None
        # The last action of a stop: to open the gripper, or to halt its fingers.
        self._final_action: asyncio.Task[None] | None = None
        # An error of the loop or of its commands, until the control loop has judged it.
        self._own_error = ""
        self._crash: Exception | None = None
        self._running = False
        self._stopped = True
        self._published_block = -1
        self._published_key: tuple[object, ...] = ()
        self._published_hold = self._published_ns = 0
        self._status_changed = asyncio.Event()
        self._decided_ns = 0

    async def run(self) -> None:
        """Decide on each state until cancelled; the robot stands still afterwards.

        After an unexpected error the arm is stopped and the error is raised; the next run stops the experiment.
        """
        self._decided_ns, self._crash, self._running = self._clock.now_ns(), None, True
        try:
            while True:
                state = await self._next_state()
                if self._crash is not None:
                    raise self._crash
                if state is not None:
                    self._take_state(state)
                self._decide()
        except Exception as error:
            self._running = False
            self._own_error = _text(error)
            if self._action is not self._final_action:
                # Before the stop: the action may be about to start a straight move.
                self._cancel_motion()
            await self._brake()
            # Without this wait the gripper might not receive its final command.
            await self.released()
            raise
        finally:
            self._running = False
            if self._action is not None:
                self._action.cancel()
                await asyncio.gather(self._action, return_exceptions=True)

    def decide_now(self) -> None:
        """Decide without a new state, after a loss of a device or for the daemon's end; `run` raises its errors."""
        if not self._running or self._crash is not None:
            return
        try:
            self._decide()
        except Exception as error:  # noqa: BLE001 - raised by `run`
            self._crash = error

    async def start(self, file: ExperimentFile) -> str | None:
        """Begin an experiment; return None, or why it cannot begin."""
        if self._experiment_runs:
            # The control loop refuses it; a stopped arm must not be enabled on the way.
            return self._control_loop.start(file, self._clock.now_ns())
        reply = await self._robot.send(Enable())
        if not reply.accepted:
            return reply.refusal
        with suppress(TimeoutError):
            async with asyncio.timeout(ENABLED_WITHIN_S):
                while (state := await self._robot.next_state()).blocked:
                    pass
                self._take_state(state)
        return self._control_loop.start(file, self._clock.now_ns())

    async def experiment_ended(self) -> Experiment:
        """Return the present or the next experiment once it has ended."""
        while (experiment := self._control_loop.experiment) is None:
            await self._status_changed.wait()
        while experiment.running:
            await self._status_changed.wait()
        return experiment

    async def released(self) -> None:
        """Halt moving fingers, and wait for the end of the last release or halt."""
        if self._actions.fingers_move:
            self._cancel_motion()
        if self._final_action is not None:
            await asyncio.wait({self._final_action}, timeout=RELEASED_WITHIN_S)

    async def unlock(self) -> str | None:
        """Enable robot and gripper after a stop, on the operator's command; return None, or why not."""
        reply = await self._robot.send(Unlock())
        if not reply.accepted:
            return reply.refusal
        if self._gripper is not None and (error := await self._gripper.unlock()):
            return error
        self._control_loop.acknowledge()
        return None

    def diagnostics(self) -> Mapping[str, Scalar | Mapping[str, int]]:
        """Return the robot's part of `health`."""
        errors = dict(self._robot.losses)
        if self._robot.failed_program_stops:
            errors["paused program not stopped"] = self._robot.failed_program_stops
        return {
            "connected": self._robot.state is not None,
            "states": self._robot.states,
            "errors": errors,
            "error": "" if self._robot.link.latest.up else self._robot.link.latest.sentence,
        }

    @property
    def _experiment_runs(self) -> bool:
        experiment = self._control_loop.experiment
        return experiment is not None and experiment.running

    @property
    def _longest_interval_s(self) -> float:
        return LONGEST_REST_S if self._stopped and not self._experiment_runs else LONGEST_TICK_S

    async def _next_state(self) -> RobotState | None:
        """Return the newest state once one arrives, or None if none arrives in time."""
        try:
            async with asyncio.timeout(max(self._longest_interval_s, LONGEST_SILENCE_S)):
                await self._robot.next_state()
        except TimeoutError:
            return None
        # After a pause of this process several states arrive at once; only the newest one counts.
        return self._robot.state

    def _take_state(self, state: RobotState) -> None:
        # The controller's own time: a state that is repeated becomes stale.
        t_ns = state.t_mono_ns - state.age_ns
        self._control_loop.inputs.arm = ArmStatus(
            wrist_rad=state.wrist_rad,
            t_ns=t_ns,
            protective_stop=state.protective_stop,
            emergency_stop=state.emergency_stop,
            blocked=state.blocked,
        )
        if (block := state.cycle // PUBLISH_EVERY) != self._published_block:
            self._published_block = block
            # The torque on the tool is opposite to the wrench on the wrist.
            torque = TorqueSample(WRENCH, -state.wrist_torque_nm, "", t_ns, self._clock.now_ns())
            self._control_loop.on_torque(torque)
            self._publisher.publish(robot_state(state))

    def _decide(self) -> None:
        now_ns = self._clock.now_ns()
        # From decision to decision, so that a slow decision is late as well.
        interval_s = (now_ns - self._decided_ns) / 1e9
        inputs = self._control_loop.inputs
        inputs.late_s = max(0.0, interval_s - self._longest_interval_s)
        inputs.died = {**self._dead_tasks(), **({"loop": self._own_error} if self._own_error else {})}
        self._own_error = ""
        self._decided_ns = now_ns
        self._execute(self._control_loop.tick(now_ns))
        self._publish_status(now_ns)

    def _execute(self, output: ControlOutput) -> None:
        if output.stop:
            if not self._stopped:
                self._stopped = True
                self._cancel_motion()
                self._velocity.stop()
            if output.release and self._gripper is not None:
                self._start_action(self._gripper.release, self._on_released)
                self._final_action = self._action
            return
        self._stopped = False
        if not output.hold:
            self._actions.resume()
        elif self._actions.interrupt():
            self._velocity.stop()
        if output.action is not None:
            self._start_action(partial(self._actions.run, output.action), self._control_loop.on_action_ended)
        self._velocity.turn(output.wrist_rad_per_s)

    def _on_command_error(self, error: Exception) -> None:
        structlog.get_logger().exception("a command to the robot failed")
        self._own_error = _text(error)

    def _start_action(self, act: Callable[[], Awaitable[str]], on_ended: Callable[[str], None]) -> None:
        """Run an action in a task; `on_ended` receives its error, or an empty string."""
        if self._action is not None:
            self._action.cancel()

        async def run_action() -> None:
            try:
                error = await act()
            except Exception as exception:  # noqa: BLE001 - any error fails the step
                structlog.get_logger().exception("an action of the devices crashed")
                error = f"it crashed with {_text(exception)}; the log has more"
            on_ended(error)

        self._action = asyncio.create_task(run_action(), name="action")

    def _on_released(self, error: str) -> None:
        if error:
            structlog.get_logger().error("the gripper did not open", reason=error)
        self._control_loop.on_release_ended(error)

    def _cancel_motion(self) -> None:
        """Cancel the present action; moving fingers are halted."""
        fingers_move, self._actions.fingers_move = self._actions.fingers_move, False
        if fingers_move and self._gripper is not None:
            self._start_action(self._gripper.halt, self._on_halted)
            self._final_action = self._action
        elif self._action is not None:
            self._action.cancel()

    def _on_halted(self, error: str) -> None:
        if error:
            structlog.get_logger().error("the fingers did not stop", reason=error)
            self._control_loop.on_command_refused(f"the fingers did not stop: {error}")

    async def _brake(self) -> None:
        """Stop the arm, including a straight move."""
        self._stopped = False
        try:
            async with asyncio.timeout(BRAKE_S):
                await self._robot.send(Stop(self._acceleration_rad_per_s2))
        except Exception:  # noqa: BLE001 - the loop's own error is raised
            structlog.get_logger().exception("the arm could not be stopped")

    def _publish_status(self, now_ns: int) -> None:
        status, experiment = self._control_loop.status, self._control_loop.experiment
        key = (
            status.phase,
            tuple(fault.code for fault in status.decision.faults),
            status.velocity.reasons,
            experiment and experiment.step_number,
        )
        hold = experiment.command.hold_number if experiment is not None else 0
        unchanged = (key, hold) == (self._published_key, self._published_hold)
        if unchanged and now_ns - self._published_ns < LOOP_STATE_PERIOD_S * 1e9:
            return
        if key != self._published_key:
            structlog.get_logger().info(
                "loop", phase=status.phase, activity=status.activity, reasons=" ".join(status.decision.reasons)
            )
        self._published_key, self._published_hold, self._published_ns = key, hold, now_ns
        self._publisher.publish(loop_state(self._control_loop, self._velocity.sent_rad_per_s, now_ns))
        # Wake the present waiters only.
        self._status_changed.set()
        self._status_changed.clear()


def loop_state(control_loop: ControlLoop, sent_rad_per_s: float, now_ns: int) -> LoopState:
    """Return the `loop.state` message at now_ns."""
    status, experiment = control_loop.status, control_loop.experiment
    driving = experiment.file.torque_source if experiment is not None else ""
    latest = control_loop.inputs.torques.get(driving)
    controller = control_loop.controller
    estimates = controller.state if controller is not None else None
    tool = control_loop.tool
    return LoopState(
        source="loop",
        t_mono_ns=now_ns,
        phase=status.phase,
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
        set_point_nm=estimates.set_point_nm if estimates else None,
        ramp_nm=estimates.ramp_nm if estimates else None,
        expected_nm=estimates.torque_nm if estimates else None,
        stiffness_nm_per_rad=tool.stiffness_nm_per_rad if tool is not None else None,
        delay_s=tool.age_s + tool.significant_lag_s if tool is not None else None,
        noise_nm=tool.noise_nm if tool is not None else None,
        speed_command_rad_per_s=status.velocity.speed_rad_per_s,
        speed_sent_rad_per_s=sent_rad_per_s,
        response=status.decision.response.name.lower().replace("_", " "),
        reasons=" ".join((*status.decision.reasons, *status.velocity.reasons)),
    )


def robot_state(state: RobotState) -> RobotStateMessage:
    """Return the `robot.state` message of a state."""
    return RobotStateMessage(
        source="robot",
        t_mono_ns=state.t_mono_ns,
        joints_rad=state.q_rad,
        tcp_pose=state.tcp_pose,
        wrench=state.wrench,
        wrist_rad=state.wrist_rad,
        wrist_speed_rad_per_s=state.qd_rad_per_s[5],
        wrist_torque_nm=state.wrist_torque_nm,
        robot_mode=state.robot_mode,
        safety_mode=state.safety_mode,
        speed_scaling=state.speed_scaling,
        protective_stop=state.protective_stop,
        emergency_stop=state.emergency_stop,
        blocked=state.blocked,
        age_s=state.age_ns / 1e9,
    )


def _text(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"[:MAX_ERROR_LENGTH]
