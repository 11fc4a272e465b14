"""The controller's dashboard server: one line for each request, and one for its answer.

UR's "Dashboard Server e-Series" page.
"""

from typing import Final

from shearloop.drivers.defaults import DASHBOARD_PORT, EMULATED_ANSWER, EMULATED_SERIAL_NUMBER
from shearloop.drivers.errors import DriverError
from shearloop.drivers.ur.ports import connected

REMOTE_CURE: Final = (
    "switch it to remote control, top right on the teach pendant (enable that first under Settings → System → Remote "
    "Control; a CB3 has no such mode)"
)
# The dashboard's answer to a request that it carries out (UR's page "Dashboard Server e-Series").
_CARRIED_OUT: Final = {
    "unlock protective stop": "Protective stop releasing",
    "power on": "Powering on",
    "brake release": "Brake releasing",
    "stop": "Stopped",
    "close popup": "closing popup",
    "close safety popup": "closing safety popup",
}
# Without these the arm does not get ready.
_INDISPENSABLE: Final = ("unlock protective stop", "power on", "brake release")
# The dashboard's request for the robot's serial number.
SERIAL_NUMBER: Final = "get serial number"
_LONGEST_LINE = 1024


def serial_number_in(answer: str) -> str:
    """Return the serial number in an answer to `SERIAL_NUMBER`; empty where the request is unknown."""
    if answer == EMULATED_ANSWER:
        return EMULATED_SERIAL_NUMBER
    return answer if answer.isdigit() else ""


def ask_dashboard(host: str, timeout_s: float, requests: tuple[str, ...]) -> list[str]:
    """Return the dashboard server's answers; DriverError where it is absent or silent."""
    answers = []
    activity = f"asking its dashboard server (port {DASHBOARD_PORT})"
    with connected(host, DASHBOARD_PORT, timeout_s, activity) as connection, connection.makefile("rb") as lines:
        lines.readline(_LONGEST_LINE)  # the banner
        for request in requests:
            connection.sendall(f"{request}\n".encode())
            answer = lines.readline(_LONGEST_LINE)
            if not answer:
                raise DriverError(f"The dashboard server at {host} closed the connection at `{request}`.")
            answers.append(answer.decode(errors="replace").strip())
    return answers


def command_dashboard(host: str, timeout_s: float, requests: tuple[str, ...]) -> str:
    """Have the dashboard server carry out requests; return its refusal of one that can be done without, else nothing.

    Raises DriverError with the controller's own words where it refuses an indispensable one, or any in local control,
    and where it is absent or silent.
    """
    answers = ask_dashboard(host, timeout_s, requests)
    refused = {
        request: answer
        for request, answer in zip(requests, answers, strict=True)
        if answer.lower() != _CARRIED_OUT[request].lower()
    }
    if not refused:
        return ""
    request = next((request for request in refused if request in _INDISPENSABLE), next(iter(refused)))
    said = f"The controller answered “{refused[request]}” to `{request}`"
    (remote,) = ask_dashboard(host, timeout_s, ("is in remote control",))
    if remote.lower() == "false":
        raise DriverError(f"The robot is in local control: {REMOTE_CURE}. {said}.")
    if request in _INDISPENSABLE:
        raise DriverError(f"{said}: look at the teach pendant, then unlock again.")
    return said
