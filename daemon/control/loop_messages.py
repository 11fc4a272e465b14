"""What the loop publishes: where it stands, and the state of the robot."""

from shearloop.daemon.control.control_loop import ControlLoop
from shearloop.daemon.messaging.messages import LoopState, RobotStateMessage
from shearloop.drivers.ur.messages import RobotState


def loop_state(brain: ControlLoop, sent_rad_per_s: float, now_ns: int) -> LoopState:
    """Return where the closed loop stands at now_ns, while so much was sent to the wrist."""
    status, experiment = brain.status, brain.experiment
    progress = experiment.progress() if experiment is not None else None
    driving = experiment.file.drive if experiment is not None else ""
    latest = brain.inputs.torques.get(driving)
    controller = brain.controller
    believed = controller.state if controller is not None else None
    found = brain.tool
    return LoopState(
        source="loop",
        t_mono_ns=now_ns,
        phase=status.phase,
        experiment=experiment.file.name if experiment is not None else "",
        step=progress.step if progress else 0,
        steps=progress.steps if progress else 0,
        step_name=experiment.step.do if experiment is not None else "",
        slices=experiment.file.slices or "" if experiment is not None else "",
        hold=experiment.command.hold_number if experiment is not None else 0,
        doing=status.activity,
        progress=progress.share if progress else 0.0,
        remaining_s=progress.remaining_s if progress else 0.0,
        tool_mm=experiment.file.tool_mm if experiment is not None else None,
        driving=driving,
        torque_nm=latest.torque_nm if latest is not None else None,
        set_point_nm=believed.set_point_nm if believed else None,
        ramp_nm=believed.ramp_nm if believed else None,
        expected_nm=believed.torque_nm if believed else None,
        stiffness_nm_per_rad=found.stiffness_nm_per_rad if found is not None else None,
        delay_s=found.age_s + found.significant_lag_s if found is not None else None,
        noise_nm=found.noise_nm if found is not None else None,
        speed_wanted_rad_per_s=status.velocity.speed_rad_per_s,
        speed_sent_rad_per_s=sent_rad_per_s,
        response=status.decision.response.name.lower().replace("_", " "),
        reasons=" ".join((*status.decision.reasons, *status.velocity.reasons)),
    )


def robot_state(state: RobotState) -> RobotStateMessage:
    """Return a state of the robot's process as it is published."""
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
