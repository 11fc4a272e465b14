"""The controller's three ports and its clock around a `Robot`, its dashboard, and faults by lines of text."""

import asyncio
import re
import socket
import struct
import time
from collections.abc import AsyncIterator, Callable, Collection
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from dataclasses import replace

from shearloop.drivers.defaults import DASHBOARD_PORT, PRIMARY_PORT, RTDE_PORT, SCRIPT_PORT
from shearloop.emulators.numbers import number_between
from shearloop.emulators.ports import Connections, accepting
from shearloop.emulators.ur_robot import MODE_IDLE, MODE_POWER_OFF, MODE_RUNNING, Robot, RobotEvent
from shearloop.emulators.ur_rtde import RtdeSession
from shearloop.emulators.urscript import translate
from shearloop.timeouts import timeout

# A control script closes its outermost block in the first column.
SCRIPT_END = b"\nend\n"
# A controller is never late. When this process was, the robot's time stands still, so that no watchdog expires on
# heartbeats that wait in the socket. Its clock goes on: its samples are of now.
MAX_CATCH_UP_S = 0.02
BANNER = "Connected: Universal Robots Dashboard Server"
_ROBOT_MODES = {MODE_POWER_OFF: "POWER_OFF", MODE_IDLE: "IDLE", MODE_RUNNING: "RUNNING"}
# What changes the robot needs remote control; UR's words differ from version to version.
# Universal_Robots_ROS_Driver, issues 125 and 262.
_LOCAL = (
    "Command is not allowed due to safety reasons, please switch robot to Remote Control mode and reconnect to port "
    "29999"
)
_CONTROLS = ("power on", "brake release", "unlock protective stop", "stop", "close popup", "close safety popup")
# By major version: the size of a state on the script port, and how many of them, and of control cycles, a second has
# (UR's page "Overview of client interfaces").
_STATE_BYTES, _STATES_HZ = {3: 1108, 5: 1220}, {3: 125.0, 5: 500.0}
# Of the Primary Client Interface: kinds of packages, of a message, and the code, argument and level of an event.
_ROBOT_STATE, _ROBOT_MESSAGE, _CODE_MESSAGE = 16, 20, 6
_ERROR_CODES = {"protective-stop": (204, 3, 3)}
# What the kernel keeps of the states for a client that does not read.
_UNREAD_BYTES = 4096
_SAFETY_MODES = {1: "NORMAL", 3: "PROTECTIVE_STOP", 7: "ROBOT_EMERGENCY_STOP"}

# Faults that last until `normal`.
_LASTING = (
    *("registers-in-use", "upper-registers-in-use", "local-control", "refuse-protocol"),
    *("mute-dashboard", "drop-scripts", "block-scripts"),
)


def _package(kind: int, content: bytes) -> bytes:
    return struct.pack(">iB", 5 + len(content), kind) + content


class Controller:
    """A `Robot` that real clients can connect to."""

    def __init__(
        self, robot: Robot, *, host: str = "127.0.0.1", rate_hz: float = 500.0, closed_ports: Collection[int] = ()
    ) -> None:
        """Take a robot; nothing is opened yet. `closed_ports` are of services that are not enabled."""
        self.robot = robot
        self._first_spec = robot.spec
        # What the controller refuses or ignores.
        self.faults: set[str] = set()
        self._host = host
        self._closed_ports = closed_ports
        self._rate_hz = rate_hz
        self._silent_until_s = self._held_until_s = 0.0
        # The data that is held back for each client.
        self._held: dict[asyncio.StreamWriter, bytes] = {}
        self._rtde: dict[asyncio.StreamWriter, RtdeSession] = {}
        self._connections: Connections = {}
        self._primary_clients: set[asyncio.StreamWriter] = set()

    @asynccontextmanager
    async def open(self) -> AsyncIterator[None]:
        """Open the ports, and close them and every connection at the end."""
        async with AsyncExitStack() as stack:
            for port, serve in (
                (RTDE_PORT, self._serve_rtde),
                (SCRIPT_PORT, self._serve_scripts),
                (DASHBOARD_PORT, self._serve_dashboard),
                (PRIMARY_PORT, self._serve_primary),
            ):
                if port in self._closed_ports:
                    continue
                server = await asyncio.start_server(accepting(serve, self._connections), self._host, port)
                stack.push_async_callback(server.wait_closed)
                stack.callback(self._drop_all)
                stack.callback(server.close)
            yield
        if self._connections:
            await asyncio.wait(self._connections)

    async def run(self) -> AsyncIterator[RobotEvent]:
        """Let time pass, and yield the robot's events, until cancelled."""
        last_s = time.monotonic()
        while True:
            dt_s = 1.0 / min(self._rate_hz, _STATES_HZ[5 if self.robot.is_e_series else 3])
            await asyncio.sleep(max(0.0, last_s + dt_s - time.monotonic()))
            now_s = time.monotonic()
            missed_s = max(0.0, now_s - MAX_CATCH_UP_S - last_s)
            last_s += missed_s
            self.robot.stand_still(missed_s)
            while last_s + dt_s <= now_s:
                last_s += dt_s
                self.robot.step(dt_s)
                for writer, session in self._rtde.items():
                    self._send(writer, session.data())
            for event in self.robot.take_events():
                if event.name in _ERROR_CODES:
                    self.report_error(*_ERROR_CODES[event.name])
                yield event

    def command(self, line: str) -> None:
        """Carry out a fault, as `protective-stop` or `silence 2`; ValueError for another line."""
        match line.split():
            case [name] if name in _LASTING:
                self.faults.add(name)
            case [name, text] if name in _WITH_NUMBER:
                low, high, otherwise, begin = _WITH_NUMBER[name]
                begin(self, number_between(text, low, high, otherwise))
            case [name] if name in _WITHOUT_NUMBER:
                _WITHOUT_NUMBER[name](self)
            case ["version", numbers]:
                if re.fullmatch(r"\d{1,4}(\.\d{1,4}){3}", numbers) is None:
                    raise ValueError(f"{numbers!r} is not a version such as 5.4.0.0")
                major, minor, bugfix, build = map(int, numbers.split("."))
                self.robot.change(replace(self.robot.spec, version=(major, minor, bugfix, build)))
            case ["normal"]:
                self.robot.clear_faults()
                self.robot.change(self._first_spec)
                self.faults.clear()
                self.silence(0.0)
                self.hold_back(0.0)
            case [name, *arguments] if name in FAULTS:
                raise ValueError(f"{name} does not take {' '.join(arguments) or 'nothing'}")
            case _:
                raise ValueError(f"there is no fault {line!r}; there are {', '.join(FAULTS)}")

    def drop_rtde(self) -> None:
        """Close the RTDE connections; the other ports live on."""
        for writer in list(self._rtde):
            writer.close()

    def weigh(self, payload_kg: float) -> None:
        """Have this payload set at the pendant."""
        self.robot.change(replace(self.robot.spec, payload_kg=payload_kg))

    def silence(self, duration_s: float) -> None:
        """Send nothing on any port for a while; the connections stay open, and the data is lost."""
        self._silent_until_s = time.monotonic() + duration_s

    def hold_back(self, duration_s: float) -> None:
        """Send nothing on any port for a while, and then all of it, as after a short pull of the cable."""
        self._held_until_s = time.monotonic() + duration_s

    def _drop_all(self) -> None:
        for writer in self._connections.values():
            # Closing waits until everything is sent, and the client may not read.
            if writer.transport.get_write_buffer_size():
                writer.transport.abort()
            else:
                writer.close()

    def _send(self, writer: asyncio.StreamWriter, data: bytes) -> None:
        now_s = time.monotonic()
        if not data or now_s < self._silent_until_s or writer.is_closing():
            return
        data = self._held.pop(writer, b"") + data
        if now_s < self._held_until_s:
            self._held[writer] = data
        else:
            writer.write(data)

    async def _serve_rtde(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        session = RtdeSession(self.robot, self._rate_hz, self.faults, self._rtde.values())
        self._rtde[writer] = session
        try:
            while data := await reader.read(4096):
                self._send(writer, session.receive(data))
        finally:
            del self._rtde[writer]

    async def _serve_scripts(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        text = bytearray()
        async for data in self._stream_states(reader, writer):
            text += data
            if text.endswith(SCRIPT_END):
                script = text.decode("utf-8", "replace")
                with suppress(SyntaxError):  # which `upload` reports
                    # In a thread: it takes 40 ms, and the controller is never late.
                    await asyncio.to_thread(translate, script)
                if "drop-scripts" not in self.faults:
                    self.robot.upload(script)
                text.clear()

    async def _stream_states(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> AsyncIterator[bytes]:
        """Yield what a client sends, and send it a state in each cycle.

        One thread does both: a client that does not read is not read from once its buffers are full.
        """
        writer.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _UNREAD_BYTES)
        writer.transport.set_write_buffer_limits(0)
        major = 5 if self.robot.is_e_series else 3
        # Its size, then values that no client of ours reads.
        state = struct.pack(">I", _STATE_BYTES[major]).ljust(_STATE_BYTES[major], b"\x00")
        while True:
            self._send(writer, state)
            await writer.drain()
            if "block-scripts" in self.faults:
                # It neither reads nor sends.
                await asyncio.sleep(1.0 / _STATES_HZ[major])
                continue
            try:
                async with timeout(1.0 / _STATES_HZ[major]):
                    data = await reader.read(65536)
            except TimeoutError:
                continue
            if not data:
                return
            yield data

    async def _serve_primary(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._primary_clients.add(writer)
        try:
            # The version comes first, and states ten times a second, which no client of ours reads.
            self._send(writer, _package(_ROBOT_STATE, bytes(8)))
            while await reader.read(4096):
                pass
        finally:
            self._primary_clients.discard(writer)

    def report_error(self, code: int, argument: int = 0, level: int = 2) -> None:
        """Send an error code to the clients of the Primary Client Interface."""
        content = struct.pack(
            ">QbBiiiII", round(self.robot.clock_s * 1e6), -2, _CODE_MESSAGE, code, argument, level, 0, 0
        )
        for writer in self._primary_clients:
            self._send(writer, _package(_ROBOT_MESSAGE, content))

    async def _serve_dashboard(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if "mute-dashboard" not in self.faults:
            self._send(writer, BANNER.encode() + b"\n")
        while line := await reader.readline():
            if "mute-dashboard" in self.faults:
                continue
            request = line.decode("utf-8", "replace").strip()
            self._send(writer, f"{self._answer_dashboard(request)}\n".encode())

    def _answer_dashboard(self, request: str) -> str:
        """Carry out a request as UR's page "Dashboard Server e-Series" describes it, and return the reply."""
        robot = self.robot
        if "local-control" in self.faults and request in _CONTROLS:
            return _LOCAL
        match request:
            case "PolyscopeVersion":
                return f"URSoftware {'.'.join(map(str, robot.spec.version))} (Jun 01 2024)"
            case "get serial number":
                return robot.spec.serial_number
            case "is in remote control" if robot.is_e_series:
                return "false" if "local-control" in self.faults else "true"
            case "robotmode":
                return f"Robotmode: {_ROBOT_MODES[robot.robot_mode]}"
            case "safetymode":
                return f"Safetymode: {_SAFETY_MODES[robot.safety_mode]}"
            case "stop":
                robot.end_program("stopped from the dashboard")
                return "Stopped"
            case "unlock protective stop":
                cause = "Always inspect cause of protective stop before unlocking"
                refusal = f"Cannot unlock protective stop until 5s after occurrence. {cause}"
                return "Protective stop releasing" if robot.unlock() else refusal
            case "power on":
                robot.begin_power_step(MODE_POWER_OFF)
                return "Powering on"
            case "brake release":
                robot.begin_power_step(MODE_IDLE)
                return "Brake releasing"
            case "close popup" | "close safety popup":
                return request.replace("close", "closing")
        return f"could not understand: '{request}'"


def _set_bias(controller: Controller, force_n: float) -> None:
    controller.robot.arm.bias_n[0] = force_n


_WITHOUT_NUMBER: dict[str, Callable[[Controller], None]] = {
    "protective-stop": lambda one: one.robot.protective_stop("requested by hand"),
    "emergency-stop": lambda one: one.robot.emergency_stop(),
    "release": lambda one: one.robot.release(),
    "stop": lambda one: one.robot.end_program("stopped at the pendant"),
    "drop-rtde": Controller.drop_rtde,
    "protect-abrupt-ends": lambda one: setattr(one.robot, "protects_abrupt_ends", True),
    "protect-ends": lambda one: setattr(one.robot, "protects_ends", True),
    "float-clock": lambda one: setattr(one.robot.registers, "counts_as_float", True),
    "watchdog-waits": lambda one: setattr(one.robot.registers, "watchdog_waits", True),
}
# The range of each fault's number, what another number is, and how it begins.
_WITH_NUMBER: dict[str, tuple[float, float, str, Callable[[Controller, float], None]]] = {
    "silence": (0.0, 86400.0, "not a time in seconds from 0 to 86400", Controller.silence),
    "hold-back": (0.0, 60.0, "not a time in seconds from 0 to 60", Controller.hold_back),
    "payload": (0.0, 100.0, "not a mass in kg from 0 to 100", Controller.weigh),
    "slider": (0.01, 1.0, "not a fraction from 0.01 to 1", lambda one, x: setattr(one.robot.arm, "speed_slider", x)),
    "wrench-error": (
        0.0,
        10.0,
        "not a factor from 0 to 10",
        lambda one, x: setattr(one.robot.arm, "wrench_error_factor", x),
    ),
    "scaling": (
        0.01,
        1.0,
        "not a fraction from 0.01 to 1",
        lambda one, x: setattr(one.robot.arm, "limiter_scaling", x),
    ),
    "velocity-noise": (
        *(0.0, 1.0, "not a speed in rad/s from 0 to 1"),
        lambda one, x: setattr(one.robot.arm, "noise_rad_per_s", x),
    ),
    "slow-braking": (
        *(0.01, 100.0, "not a deceleration in rad/s² from 0.01 to 100"),
        lambda one, x: one.robot.arm.brake(x),
    ),
    "slow-arm": (
        *(0.01, 100.0, "not a deceleration in rad/s² from 0.01 to 100"),
        lambda one, x: one.robot.arm.brake(x, wrist=False),
    ),
    "bias": (-100.0, 100.0, "not a force in N from -100 to 100", _set_bias),
    "error-code": (1, 9999, "not a code from 1 to 9999", lambda one, code: one.report_error(int(code))),
    "hang": (0.0, 20.0, "not a mass in kg from 0 to 20", lambda one, x: setattr(one.robot.arm, "hung_kg", x)),
}
FAULTS = (*_WITHOUT_NUMBER, "version", *_WITH_NUMBER, *_LASTING, "normal")
