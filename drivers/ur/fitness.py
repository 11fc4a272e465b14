"""Whether the controller can take motion commands, judged by its latest sample."""

from shearloop.drivers.ur.messages import ROBOT_MODE_RUNNING, SAFETY_NORMAL, SAFETY_REDUCED, RtdeSample
from shearloop.drivers.ur.settings import UrSettings

# What the operator has to do, by safety mode.
_SAFETY = {
    4: "The robot is in recovery mode: move it back within its safety limits at the teach pendant.",
    5: "A safeguard stop holds the robot: close the safeguard, then unlock.",
    8: "The robot's safety system reports a violation: restart it at the teach pendant.",
    9: "The robot's safety system reports a fault: restart the controller.",
    10: "The robot validates a joint: follow the teach pendant, and restart the robot.",
    12: "A safeguard stop of the automatic mode holds the robot: close the safeguard, reset it, then unlock.",
    13: (
        "The three-position enabling device holds the robot: hold it in its middle position, or select the automatic "
        "mode, then unlock."
    ),
}


def is_recent(sample: RtdeSample, settings: UrSettings) -> bool:
    """Return whether the connection is up and the sample is young enough to act on."""
    return sample.connected and sample.age_ns <= settings.state_timeout_s * 1e9


def why_unfit(sample: RtdeSample, settings: UrSettings) -> str:
    """Return why the controller cannot take motion commands, or the empty string."""
    if not sample.connected:
        return f"The connection to the robot at {settings.host} is lost."
    if not is_recent(sample, settings):
        return (
            f"The latest state from the controller at {settings.host} is {sample.age_ns / 1e9:.2f} s old: check its "
            "cable, other traffic on the network, and with a simulator whether its clock is slower than real time."
        )
    if sample.protective_stop:
        return "Protective stop: look for its cause, clear the workspace, then unlock (not in the first 5 s)."
    if sample.emergency_stop:
        return (
            "Emergency stop: make the cell safe, release the button, then unlock. Keep hands out of the gripper: where "
            "it lost its power, the next release opens and closes its fingers once before it opens them."
        )
    if sample.safety_mode not in (SAFETY_NORMAL, SAFETY_REDUCED):
        other = f"The robot's safety system is in the mode “{sample.safety_mode_name}”: look at the teach pendant."
        return _SAFETY.get(sample.safety_mode, other)
    if sample.robot_mode != ROBOT_MODE_RUNNING:
        return f"The arm is not powered and released (robot mode: {sample.robot_mode_name}): unlock to power it."
    if sample.program_paused:
        return (
            "A program on the robot is paused, and continues its motion if a person resumes it: stop it at the teach "
            "pendant, or unlock, which stops it and starts the control program."
        )
    if not sample.program_running:
        return (
            "The control program on the robot does not run: it was stopped at the pendant, or by the watchdog when "
            "commands came late. Unlock to start it again."
        )
    return ""


def may_be_late(sample: RtdeSample, settings: UrSettings) -> bool:
    """Return whether messages that came late can be why a sample is unfit; not where the robot says another reason."""
    if not sample.connected or not is_recent(sample, settings):
        return True
    is_ready = sample.safety_mode in (SAFETY_NORMAL, SAFETY_REDUCED) and sample.robot_mode == ROBOT_MODE_RUNNING
    # The watchdog ends the program when commands come late.
    return is_ready and not sample.program_paused and not sample.program_running
