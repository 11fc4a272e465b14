"""The controller's three ports and its clock, around a `Robot`."""

import asyncio
import logging
import time
from collections.abc import Callable
from contextlib import AsyncExitStack, suppress

from shearloop.drivers.emulators.ur import dashboard
from shearloop.drivers.emulators.ur.robot import Robot, RobotEvent
from shearloop.drivers.emulators.ur.rtde import NotRtdeError, RtdeSession
from shearloop.drivers.emulators.ur.script import armed_hz

RTDE_PORT, SCRIPT_PORT, DASHBOARD_PORT = 30004, 30003, 29999
# A control script closes its outermost block in the first column.
SCRIPT_END = b"\nend\n"
LARGEST_SCRIPT = 1 << 20
# A controller is never late. When this process was, the robot's time stands still rather than leap: a leap would
# let a watchdog expire on kicks that are waiting in the socket. Its clock goes on: its samples are of now.
MOST_CATCH_UP_S = 0.02

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
        """Take a robot; `on_event` is told of everything that happens to it."""
        self.robot = robot
        self.protocol_refused = False
        # How many of the next requests to stop the dashboard neither answers nor carries out.
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
                self._send_data()
            self._tell()

    def silence(self, duration_s: float) -> None:
        """Send nothing on any port for a while, connections staying open; what would have been sent is lost."""
        self._silent_until_s = time.monotonic() + duration_s

    def drop_rtde(self) -> None:
        """Close all RTDE connections; the other ports live on."""
        for writer in list(self._rtde):
            writer.close()

    def _drop_all(self) -> None:
        for writer in self._writers:
            writer.close()

    def _send_data(self) -> None:
        for writer, session in self._rtde.items():
            self._send(writer, session.data())

    def _send(self, writer: asyncio.StreamWriter, data: bytes) -> None:
        if data and time.monotonic() >= self._silent_until_s and not writer.is_closing():
            writer.write(data)

    def _tell(self) -> None:
        events, self.robot.events = self.robot.events, []
        for event in events:
            self._on_event(event)

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
            self._send(writer, dashboard.BANNER.encode() + b"\n")
            while line := await reader.readline():
                if self.stop_hangs and line.strip() == b"stop":
                    self.stop_hangs -= 1
                    continue
                self._send(writer, dashboard.answer(self.robot, line.decode("utf-8", "replace")).encode() + b"\n")

    def _connection(self, writer: asyncio.StreamWriter) -> "_Connection":
        return _Connection(writer, self._writers, self._connections)


class _Connection(suppress):
    """Keeps the list of open connections; a peer that went away, however rudely, is the end of its connection."""

    def __init__(
        self,
        writer: asyncio.StreamWriter,
        writers: set[asyncio.StreamWriter],
        tasks: set[asyncio.Task[None]],
    ) -> None:
        super().__init__(ConnectionError)
        self._writer, self._writers, self._tasks = writer, writers, tasks

    def __enter__(self) -> None:
        self._writers.add(self._writer)
        task = asyncio.current_task()
        if task is not None:
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)

    def __exit__(self, *exc_info: object) -> bool:
        self._writers.discard(self._writer)
        self._writer.close()
        return bool(super().__exit__(*exc_info))  # type: ignore[arg-type]  # object is wide enough for all three
