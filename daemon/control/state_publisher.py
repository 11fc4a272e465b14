"""Publishes the states of robot and loop: `robot.state`, `loop.state` and `loop.stop`."""

import asyncio
from dataclasses import dataclass, field, fields
from typing import Any, NamedTuple

import structlog

from shearloop.daemon.control.control_loop import ControlLoop
from shearloop.daemon.control.experiment import Experiment
from shearloop.daemon.control.faults import FaultCode, Response
from shearloop.daemon.control.identification import ToolModel
from shearloop.daemon.control.torque_controller import TorqueController
from shearloop.daemon.control.wrench import WrenchMean
from shearloop.daemon.messaging.messages import LoopState, LoopStop, RobotStateMessage, cause_of
from shearloop.daemon.messaging.publisher import Publisher
from shearloop.daemon.torques import WRENCH
from shearloop.drivers.ur.messages import RobotState

LOOP_STATE_PERIOD_S = 1.0
UNTARED = "no zero of {} is known: none was taken, the last tare failed, or the link was lost; a step `tare` takes one"
# The columns of `robot.state` that are not in the robot's state under the same name, and those that are.
_TORQUE = {"wrist_torque_nm", "wrist_torque_valid", "wrist_torque_reason"}
_OWN = {"source", "t_mono_ns", "joints_rad", "age_s", *_TORQUE}
_SAME = {column.name for column in fields(RobotStateMessage)} - _OWN


@dataclass(slots=True)
class StatePublisher:
    """Publishes the states of robot and loop, and wakes those who wait for a change of the loop's."""

    publisher: Publisher
    control_loop: ControlLoop
    # Of how many of the robot's states one is published.
    every: int
    changed: asyncio.Event = field(default_factory=asyncio.Event)
    # The experiment of the last published end.
    ended: Experiment | None = None
    _block: int = -1
    _key: tuple[object, ...] = ()
    _logged: "_LogKey | None" = None
    _published_ns: int = 0

    def publish_robot(self, state: RobotState, wrench: WrenchMean) -> bool:
        """Publish each `every`th state, with the mean torque of the latest ones; return whether it was this one."""
        if (block := state.cycle // self.every) == self._block:
            return False
        self._block = block
        reason = wrench.why_unknown or ("" if self.control_loop.has_zero(WRENCH) else UNTARED.format("the wrench"))
        same: dict[str, Any] = {name: getattr(state, name) for name in _SAME}
        message = RobotStateMessage(
            source="robot",
            t_mono_ns=state.measured_ns,
            joints_rad=state.q_rad,
            age_s=state.age_ns / 1e9,
            wrist_torque_nm=wrench.torque_nm if wrench.known else None,
            wrist_torque_valid=not reason,
            wrist_torque_reason=reason,
            **same,
        )
        self.publisher.publish(message)
        return True

    def publish_loop(self, sent_rad_per_s: float, now_ns: int) -> None:
        """Publish the loop's state at a change and once a second."""
        status, experiment = self.control_loop.status, self.control_loop.experiment
        key = (
            status.phase,
            self.control_loop.runs,
            self.control_loop.safety.stop_number,
            tuple(fault.code for fault in status.decision.faults),
            status.velocity.reasons,
            experiment and experiment.step_number,
            experiment and experiment.command.hold_number,
        )
        if key == self._key and now_ns - self._published_ns < LOOP_STATE_PERIOD_S * 1e9:
            return
        message = loop_state(self.control_loop, sent_rad_per_s, now_ns)
        said = _LogKey.of(self.control_loop)
        if said != self._logged:
            _log(message, said, self._logged)
        self._key, self._logged, self._published_ns = key, said, now_ns
        self.publisher.publish(message)
        if experiment is not None and not experiment.running:
            self.ended = experiment
        self.notify()

    def publish_stop(self, stop: LoopStop | None) -> None:
        """Publish the times of a stop, if there is one."""
        if stop is not None:
            self.publisher.publish(stop)
            self.notify()

    def notify(self) -> None:
        """Wake those who wait for a change at present."""
        self.changed.set()
        self.changed.clear()


class _LogKey(NamedTuple):
    """The facts of a line in the log: a change of them makes a new line, a changed number in a sentence does not."""

    phase: str
    run: int
    step: int
    faults: tuple[FaultCode, ...]

    @classmethod
    def of(cls, control_loop: ControlLoop) -> "_LogKey":
        """Return the key of the present state."""
        status, experiment = control_loop.status, control_loop.experiment
        moves = control_loop.running_experiment is not None
        # At rest, a fault that would only hold the wrist holds nothing, and comes and goes on a busy computer.
        shown = (one for one in status.decision.reported if moves or one.rule.response is not Response.HOLD)
        step = experiment.step_number if experiment is not None else 0
        return cls(status.phase, control_loop.runs, step, tuple(fault.code for fault in shown))


def _log(message: LoopState, now: _LogKey, before: _LogKey | None) -> None:
    """Log a change of the loop: the cause of a hold or a stop comes first, and once."""
    log = structlog.get_logger().bind(phase=message.phase)
    if before is not None and now[:3] == before[:3] and now.faults[:1] in (before.faults[:1], ()):
        # The cause is known from an earlier line, or has gone.
        log.info("loop", faults=", ".join(code.text for code in now.faults) or "none")
        return
    cause = cause_of({"cause": message.cause, "faults": message.faults})
    # After a stop the activity is its reasons.
    activity = "" if message.phase == "stopped" and cause else message.activity
    said = {"cause": cause, "activity": activity}
    log.info("loop", **{key: text for key, text in said.items() if text})


def loop_state(control_loop: ControlLoop, sent_rad_per_s: float, now_ns: int) -> LoopState:
    """Return the `loop.state` message at now_ns."""
    status, experiment, wrist = control_loop.status, control_loop.experiment, control_loop.wrist
    driving = wrist.source.name if experiment is not None else ""
    latest = control_loop.inputs.torques.get(driving)
    untared = latest is not None and wrist.source.needs_zero and not control_loop.has_zero(driving)
    if latest is not None and (untared or now_ns - latest.t_ns > 1e9 * wrist.source.fresh_s):
        latest = None
    note = latest.note if latest is not None else ""
    if untared:
        note = UNTARED.format(driving)
    arm = control_loop.inputs.arm if "robot" not in control_loop.inputs.lost else None
    slowed = arm.slowed_by if arm is not None else ()
    return LoopState(
        source="loop",
        t_mono_ns=now_ns,
        phase=status.phase,
        run=control_loop.runs,
        activity=status.activity,
        torque_source=driving,
        torque_note="; ".join(filter(None, (note, control_loop.stated_tool_note))),
        torque_nm=latest.torque_nm if latest is not None else None,
        speed_command_rad_per_s=status.velocity.speed_rad_per_s,
        speed_sent_rad_per_s=sent_rad_per_s,
        response=status.decision.response.name.lower().replace("_", " "),
        held_s=control_loop.safety.held_ns / 1e9,
        stop=control_loop.safety.stop_number,
        cause=next(iter(status.decision.reasons), ""),
        faults=status.decision.codes,
        reasons=" ".join((*status.decision.reasons, *status.velocity.reasons, *slowed)),
        **_of_experiment(experiment),
        **_of_controller(wrist.controller),
        **_of_tool(wrist.tool),
    )


def _of_experiment(experiment: Experiment | None) -> dict[str, Any]:
    """Return the keys of `loop.state` that an experiment has."""
    if experiment is None:
        nowhere = {"step": 0, "steps": 0, "step_name": "", "hold": 0, "progress": 0.0, "remaining_s": 0.0}
        return {"experiment": "", "slices": "", "tool_mm": None, "torque_limit_nm": None, **nowhere}
    file = experiment.file
    return {
        "experiment": file.name,
        "slices": file.slices or "",
        "tool_mm": file.tool_mm,
        "torque_limit_nm": experiment.limits.torque_nm,
        "step": experiment.step_number,
        "steps": len(file.steps),
        "step_name": experiment.step.do,
        "hold": experiment.command.hold_number,
        "progress": experiment.progress,
        "remaining_s": experiment.remaining_s,
    }


def _of_controller(controller: TorqueController | None) -> dict[str, Any]:
    """Return the keys of `loop.state` that a closed loop has."""
    if controller is None:
        return dict.fromkeys(("set_point_nm", "ramp_nm", "filtered_torque_nm", "filtered_torque_std_nm"))
    return {
        "set_point_nm": controller.set_point_nm,
        "ramp_nm": controller.ramp_nm,
        "filtered_torque_nm": controller.torque_nm,
        "filtered_torque_std_nm": controller.torque_std_nm,
    }


def _of_tool(tool: ToolModel | None) -> dict[str, Any]:
    """Return the keys of `loop.state` that an identified tool has."""
    if tool is None:
        return dict.fromkeys(("stiffness_nm_per_rad", "delay_s", "noise_nm"))
    return {
        "stiffness_nm_per_rad": tool.stiffness_nm_per_rad,
        "delay_s": tool.age_s + tool.significant_lag_s,
        "noise_nm": tool.noise_nm,
    }
