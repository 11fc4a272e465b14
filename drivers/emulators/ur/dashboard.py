"""The dashboard server's language, a line in and a line out (UR's "Dashboard Server e-Series" page)."""

from collections.abc import Callable

from shearloop.drivers.emulators.ur.robot import MODE_IDLE, MODE_POWER_OFF, MODE_RUNNING, PAUSED, PLAYING, Robot

BANNER = "Connected: Universal Robots Dashboard Server"

_ROBOT_MODES = {MODE_POWER_OFF: "POWER_OFF", MODE_IDLE: "IDLE", MODE_RUNNING: "RUNNING"}
_SAFETY_MODES = {1: "NORMAL", 3: "PROTECTIVE_STOP", 7: "ROBOT_EMERGENCY_STOP"}
_PROGRAM_STATES = {PLAYING: "PLAYING", PAUSED: "PAUSED"}


def answer(robot: Robot, line: str) -> str:
    """Return the reply to one request, carrying it out."""
    command = line.strip()
    act = _COMMANDS.get(command)
    if act is not None:
        return act(robot)
    for prefix, reply in (("popup ", "showing popup"), ("addToLog ", "Added log message")):
        if command.startswith(prefix):
            return reply
    return f"could not understand: '{command}'"


def _stop(robot: Robot) -> str:
    robot.end_program("stopped from the dashboard")
    return "Stopped"


def _unlock(robot: Robot) -> str:
    if robot.unlock():
        return "Protective stop releasing"
    return (
        "Cannot unlock protective stop until 5s after occurrence. "
        "Always inspect cause of protective stop before unlocking"
    )


def _power_on(robot: Robot) -> str:
    robot.power_on()
    return "Powering on"


def _brake_release(robot: Robot) -> str:
    robot.brake_release()
    return "Brake releasing"


def _version(robot: Robot) -> str:
    major, minor, patch, build = (*robot.make.version, 0, 0, 0)[:4]
    return f"URSoftware {major}.{minor}.{patch}.{build} (Jun 01 2024)"


_COMMANDS: dict[str, Callable[[Robot], str]] = {
    "PolyscopeVersion": _version,
    "get serial number": lambda robot: robot.make.serial_number,
    "get robot model": lambda _: "UR5",
    "is in remote control": lambda robot: "true" if robot.remote_control else "false",
    "robotmode": lambda robot: f"Robotmode: {_ROBOT_MODES[robot.robot_mode]}",
    "safetymode": lambda robot: f"Safetymode: {_SAFETY_MODES[robot.safety_mode]}",
    "safetystatus": lambda robot: f"Safetystatus: {_SAFETY_MODES[robot.safety_mode]}",
    "running": lambda robot: f"Program running: {'true' if robot.runtime_state == PLAYING else 'false'}",
    "programState": lambda robot: f"{_PROGRAM_STATES.get(robot.runtime_state, 'STOPPED')} control.urp",
    "stop": _stop,
    "unlock protective stop": _unlock,
    "power on": _power_on,
    "brake release": _brake_release,
    "close popup": lambda _: "closing popup",
    "close safety popup": lambda _: "closing safety popup",
}
