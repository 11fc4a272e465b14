"""Messages for the operator: why motion is not possible, and what to do about it. Format those with {fields}."""

from shearloop.drivers.ur import messages

NOT_INSTALLED = (
    "The robot needs the package ur-rtde, which is not installed here. It has wheels for CPython up to 3.12 on x86-64 "
    "Linux and none for 3.13 or later: run shearloop with Python 3.11 or 3.12, then `pip install 'ur-rtde>=1.6'`."
)
NOT_ENABLED = "Motion has not been enabled since the robot's process was started: enable it when the arm may move."
BEING_MADE_READY = "The robot is being made ready (safety, power, control program): ask again in a second."
LEAVING = "The daemon disconnects from the robot: start it again to go on."
NOT_OURS = (
    "A program runs on the robot that someone else started or resumed: unlock to start the control program instead."
)
NOT_STOPPING = "The arm did not come to rest in time after a stop: keep clear of it, look at the teach pendant."
PAUSED = (
    "A program on the robot is paused, and goes on with what it did when it is resumed: stop it at the teach pendant, "
    "or unlock, which stops it and starts the control program."
)
UNREACHABLE = (
    "No UR controller at {host}: {reason}. Check that it is switched on and that this computer is in its network "
    "(Settings → System → Network at the teach pendant)."
)
SILENT = (
    "The UR controller at {host} said nothing for {seconds:.1f} s while {activity}: it is starting, hangs, or "
    "something else listens on its ports. Look at the teach pendant."
)
VERSION_REFUSED = (
    "The UR controller at {host} ({version}) refuses protocol 2 of RTDE: it needs PolyScope 3.10 or 5.4, or newer."
)
REGISTERS_IN_USE = (
    "The input registers of the robot at {host} are already in use by another RTDE client, EtherNet/IP or "
    "PROFINET: end the other program, or disable the adapter under Installation → Fieldbus."
)
LOCAL_CONTROL = "The robot at {host} is in local control: switch it to remote control, top right on the teach pendant."
REFUSED_BY_CLIENT = "The connection to the robot at {host} failed: ur-rtde says “{text}”."
NOT_TAKEN = "The robot did not take the {command}: its control program does not answer."
LEFT_TO_WATCHDOG = (
    "{reason} The control program was left to the robot's watchdog, which ends it: unlock to start it again."
)
STILL_PAUSED = "The paused program could not be stopped ({reason}): stop it at the teach pendant, do not resume it."
ASTRAY = "The arm moved without a command: check whether a person or another program moves it."

_SAFETY = {
    4: "The robot is in recovery mode: move it back within its safety limits at the teach pendant.",
    5: "A safeguard stop holds the robot: close the safeguard, then unlock.",
    8: "The robot's safety system reports a violation: restart it at the teach pendant.",
    9: "The robot's safety system reports a fault: restart the controller.",
}


def why_unfit(sample: messages.RtdeSample, host: str, state_timeout_s: float) -> str:
    """Return why the controller cannot take motion commands, or the empty string."""
    if not sample.connected:
        return f"The connection to the robot at {host} is lost."
    if sample.age_ns > state_timeout_s * 1e9:
        return (
            f"The latest state from the controller at {host} is {sample.age_ns / 1e9:.2f} s old: check its cable, "
            "other traffic on the network, and with a simulator whether its clock is slower than real time."
        )
    if sample.safety_mode == messages.SAFETY_PROTECTIVE_STOP:
        return "Protective stop: look for its cause, clear the workspace, then unlock (not in the first 5 s)."
    if sample.safety_mode in messages.SAFETY_EMERGENCY_STOPS:
        return "Emergency stop: make the cell safe, release the button, then unlock."
    if sample.safety_mode not in (messages.SAFETY_NORMAL, messages.SAFETY_REDUCED):
        return _SAFETY.get(sample.safety_mode, f"The robot's safety system is in mode {sample.safety_mode}.")
    if sample.robot_mode != messages.ROBOT_MODE_RUNNING:
        return f"The arm is not powered and released (robot mode {sample.robot_mode}): unlock to power it."
    if sample.program_paused:
        return PAUSED
    if not sample.program_running:
        return (
            "The control program on the robot does not run: it was stopped at the pendant, or by the watchdog when "
            "commands came late. Unlock to start it again."
        )
    return ""
