"""The controller's three ports and its clock around a `Robot`, its dashboard language, and faults by lines of text."""

import asyncio
import logging
import time
from collections.abc import Callable, Iterator
from contextlib import AsyncExitStack, contextmanager

from shearloop.drivers.emulators.ur.control_script import armed_hz
from shearloop.drivers.emulators.ur.robot import (
    MODE_IDLE,
    MODE_POWER_OFF,
    MODE_RUNNING,
    PAUSED,
    PLAYING,
    Robot,
    RobotEvent,
)
from shearloop.drivers.emulators.ur.rtde import NotRtdeError, RtdeSession

RTDE_PORT, SCRIPT_PORT, DASHBOARD_PORT = 30004, 30003, 29999
# A control script closes its outermost block in the first column.
SCRIPT_END = b"\nend\n"
LARGEST_SCRIPT = 1 << 20
# A controller is never late. When this process was, the robot's time stands still, so that no watchdog expires on
# heartbeats that wait in the socket. Its clock goes on: its samples are of now.
MOST_CATCH_UP_S = 0.02
BANNER = "Connected: Universal Robots Dashboard Server"

log = logging.getLogger(__name__)


class Controller:
    """A `Robot` that real clients can connect to; `async with` opens and closes the ports."""

    def __init__(
        self,
        robot: Robot,
        *,
        host: str = "127.0.0.1",
        rate_hz: float = 500.0,
        on_event: Callable[[RobotEvent], None] | None = None,
    ) -> None:
        """Take a robot; `on_event` receives each of its events."""
        self.robot = robot
        self.protocol_refused = False
        # How many of the next requests to stop the dashboard ignores.
        self.stop_hangs = 0
        self._host = host
        self._dt_s = 1.0 / rate_hz
        self._rate_hz = rate_hz
        self._on_event = on_event or (lambda _event: None)
        self._silent_until_s = 0.0
        self._rtde: dict[asyncio.StreamWriter, RtdeSession] = {}
        self._connections: set[asyncio.Task[None]] = set()
        self._writers: set[asyncio.StreamWriter] = set()
        self._stack = AsyncExitStack()

    async def __aenter__(self) -> "Controller":
        """Open the ports."""
        async with AsyncExitStack() as opened:
            for port, serve in (
                (RTDE_PORT, self._serve_rtde),
                (SCRIPT_PORT, self._serve_scripts),
                (DASHBOARD_PORT, self._serve_dashboard),
            ):
                server = await asyncio.start_server(serve, self._host, port)
                opened.push_async_callback(server.wait_closed)
                opened.callback(self._drop_all)
                opened.callback(server.close)
            self._stack = opened.pop_all()
        return self

    async def __aexit__(self, *_: object) -> None:
        """Close every port and connection."""
        await self._stack.aclose()
        if self._connections:
            await asyncio.wait(self._connections)

    async def run(self) -> None:
        """Let time pass, until cancelled."""
        last_s = time.monotonic()
        while True:
            await asyncio.sleep(max(0.0, last_s + self._dt_s - time.monotonic()))
            now_s = time.monotonic()
            missed_s = max(0.0, now_s - MOST_CATCH_UP_S - last_s)
            last_s += missed_s
            self.robot.stood_still_s += missed_s
            while last_s + self._dt_s <= now_s:
                last_s += self._dt_s
                self.robot.step(self._dt_s)
                for writer, session in self._rtde.items():
                    self._send(writer, session.data())
            events, self.robot.events = self.robot.events, []
            for event in events:
                self._on_event(event)

    def silence(self, duration_s: float) -> None:
        """Send nothing on any port for a while; the connections stay open, and the data is lost."""
        self._silent_until_s = time.monotonic() + duration_s

    def drop_rtde(self) -> None:
        """Close all RTDE connections; the other ports live on."""
        for writer in list(self._rtde):
            writer.close()

    def _drop_all(self) -> None:
        for writer in self._writers:
            writer.close()

    def _send(self, writer: asyncio.StreamWriter, data: bytes) -> None:
        if data and time.monotonic() >= self._silent_until_s and not writer.is_closing():
            writer.write(data)

    async def _serve_rtde(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with self._connection(writer):
            session = RtdeSession(self.robot, self._rate_hz, protocol_refused=self.protocol_refused)
            self._rtde[writer] = session
            try:
                while data := await reader.read(4096):
                    self._send(writer, session.receive(data))
            except NotRtdeError as error:
                log.warning("an RTDE connection was closed: %s", error)
            finally:
                del self._rtde[writer]

    async def _serve_scripts(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with self._connection(writer):
            text = bytearray()
            while data := await reader.read(65536):
                text += data
                if text.endswith(SCRIPT_END):
                    self.robot.upload(armed_hz(text))
                    text.clear()
                elif len(text) > LARGEST_SCRIPT:
                    log.warning("a script without an end was dropped after %d bytes", len(text))
                    return

    async def _serve_dashboard(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with self._connection(writer):
            self._send(writer, BANNER.encode() + b"\n")
            while line := await reader.readline():
                if self.stop_hangs and line.strip() == b"stop":
                    self.stop_hangs -= 1
                    continue
                self._send(writer, answer_dashboard(self.robot, line.decode("utf-8", "replace")).encode() + b"\n")

    @contextmanager
    def _connection(self, writer: asyncio.StreamWriter) -> Iterator[None]:
        """Register an open connection, and end quietly when the peer breaks it."""
        self._writers.add(writer)
        task = asyncio.current_task()
        if task is not None:
            self._connections.add(task)
            task.add_done_callback(self._connections.discard)
        try:
            yield
        except ConnectionError:
            pass
        finally:
            self._writers.discard(writer)
            writer.close()


# ---- the dashboard server: UR's "Dashboard Server e-Series" page -----------------------------------------------------

_ROBOT_MODES = {MODE_POWER_OFF: "POWER_OFF", MODE_IDLE: "IDLE", MODE_RUNNING: "RUNNING"}
_SAFETY_MODES = {1: "NORMAL", 3: "PROTECTIVE_STOP", 7: "ROBOT_EMERGENCY_STOP"}
_PROGRAM_STATES = {PLAYING: "PLAYING", PAUSED: "PAUSED"}


def answer_dashboard(robot: Robot, line: str) -> str:
    """Carry out one request and return the reply."""
    command = line.strip()
    for prefix, reply in (("popup ", "showing popup"), ("addToLog ", "Added log message")):
        if command.startswith(prefix):
            return reply
    answer = _DASHBOARD.get(command)
    return answer(robot) if answer is not None else f"could not understand: '{command}'"


def _after(act: Callable[[Robot], None], reply: str) -> Callable[[Robot], str]:
    def answer(robot: Robot) -> str:
        act(robot)
        return reply

    return answer


def _unlock(robot: Robot) -> str:
    if robot.unlock():
        return "Protective stop releasing"
    return (
        "Cannot unlock protective stop until 5s after occurrence. "
        "Always inspect cause of protective stop before unlocking"
    )


def _version(robot: Robot) -> str:
    major, minor, patch, build = (*robot.spec.version, 0, 0, 0)[:4]
    return f"URSoftware {major}.{minor}.{patch}.{build} (Jun 01 2024)"


_DASHBOARD: dict[str, Callable[[Robot], str]] = {
    "PolyscopeVersion": _version,
    "get serial number": lambda robot: robot.spec.serial_number,
    "get robot model": lambda _: "UR5",
    "is in remote control": lambda robot: "true" if robot.remote_control else "false",
    "robotmode": lambda robot: f"Robotmode: {_ROBOT_MODES[robot.robot_mode]}",
    "safetymode": lambda robot: f"Safetymode: {_SAFETY_MODES[robot.safety_mode]}",
    "safetystatus": lambda robot: f"Safetystatus: {_SAFETY_MODES[robot.safety_mode]}",
    "running": lambda robot: f"Program running: {'true' if robot.runtime_state == PLAYING else 'false'}",
    "programState": lambda robot: f"{_PROGRAM_STATES.get(robot.runtime_state, 'STOPPED')} control.urp",
    "stop": _after(lambda robot: robot.end_program("stopped from the dashboard"), "Stopped"),
    "unlock protective stop": _unlock,
    "power on": _after(Robot.power_on, "Powering on"),
    "brake release": _after(Robot.brake_release, "Brake releasing"),
    "close popup": lambda _: "closing popup",
    "close safety popup": lambda _: "closing safety popup",
}

# ---- faults ----------------------------------------------------------------------------------------------------------


def apply_fault(controller: Controller, line: str) -> None:
    """Carry out a fault, as `protective-stop` or `silence 2`.

    Raises:
        ValueError: the line is no fault; the message lists them.
    """
    name, *arguments = line.split()
    act = FAULTS.get(name)
    if act is None:
        raise ValueError(f"there is no fault {name!r}; there are {', '.join(FAULTS)}")
    try:
        act(controller, arguments)
    except (ValueError, IndexError):
        raise ValueError(f"{name} does not take {' '.join(arguments) or 'nothing'}") from None


def _is_on(arguments: list[str]) -> bool:
    return {"on": True, "off": False}.get(arguments[0] if arguments else "on", True)


def _clear(controller: Controller) -> None:
    controller.robot.clear_faults()
    controller.protocol_refused = False
    controller.stop_hangs = 0
    controller.silence(0.0)


FAULTS: dict[str, Callable[[Controller, list[str]], None]] = {
    "protective-stop": lambda controller, _: controller.robot.protective_stop("requested by hand"),
    "emergency-stop": lambda controller, _: controller.robot.emergency_stop(),
    "release": lambda controller, _: controller.robot.release(),
    "drop-rtde": lambda controller, _: controller.drop_rtde(),
    "silence": lambda controller, arguments: controller.silence(float(arguments[0])),
    "stop-hangs": lambda controller, arguments: setattr(controller, "stop_hangs", int(arguments[0])),
    "registers-in-use": lambda controller, arguments: setattr(controller.robot, "registers_taken", _is_on(arguments)),
    "local-control": lambda controller, arguments: setattr(controller.robot, "remote_control", not _is_on(arguments)),
    "refuse-protocol": lambda controller, arguments: setattr(controller, "protocol_refused", _is_on(arguments)),
    "normal": lambda controller, _: _clear(controller),
}
