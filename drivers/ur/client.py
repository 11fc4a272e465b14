"""The daemon's end of the robot: `UrRobot` runs the worker and replaces it when it dies.

A new worker has motion disabled. No command is sent twice, and nothing moves before the next `Enable` or `Unlock`.
"""

import asyncio
import contextlib
import math
import signal
import sys
import time
from collections import Counter, deque
from collections.abc import Callable, Coroutine
from dataclasses import replace
from typing import Any, TypeAlias, cast

from shearloop.drivers.connection import Diagnostics, LinkMonitor
from shearloop.drivers.errors import ProtocolError
from shearloop.drivers.ur import messages
from shearloop.drivers.ur.messages import RobotLostError
from shearloop.drivers.ur.settings import ENOUGH_STATES, Six, UrSettings
from shearloop.timeouts import timeout

# The settings for a controller, by its version and its serial number.
SettingsFor: TypeAlias = Callable[[str, str], UrSettings]
# A worker that disconnects stops the arm (1 s) and ends the program. After this time it is killed.
EXIT_S = 3.0
# The worker's own alarms end it at a known place. The daemon kills it this much later.
GRACE_S = 1.0
# The module of the worker.
WORKER = "shearloop.drivers.ur.worker"
# Only an update of the controller changes its version, and only another configuration changes the required one.
LASTING = ("version", "not-emulated")
# The worker's activity while it sends states.
CONTROLLING = "controlling"
# The end of the worker's error output that a message quotes.
LAST_WORDS_BYTES, LAST_WORDS_LINES = 1024, 8
# Interval of the checks for a silent worker.
WATCH_S = 0.1
_SECOND_NS = 10**9


class UrRobot:
    """A UR arm: a task of the daemon runs `run`; `send` sends a command; `state` is None without a connection."""

    def __init__(
        self,
        settings: UrSettings,
        monitor: LinkMonitor | None = None,
        *,
        settings_for: SettingsFor | None = None,
        holds: Callable[[], bool] = lambda: False,
        worker: str = WORKER,
    ) -> None:
        """`settings_for` returns the settings for a controller of a version and serial number; without it, these count.

        It raises RobotLostError for a controller that must not be driven. `holds` says whether a tool may load the
        wrench; then a new program keeps the zero of the wrench. `worker` is the module of the worker.
        """
        self._worker = worker
        self.settings = settings
        self._settings_for = settings_for
        self.state: messages.RobotState | None = None
        # Since when the arm stands still, by its states; None while it moves.
        self.rests_since_ns: int | None = None
        self.monitor = monitor or LinkMonitor()
        self.losses: Counter[str] = Counter()
        # The number of states that have arrived.
        self.states = 0
        # When each new state of the latest second was measured, in ns; a repeated one is not new.
        self._measured_ns: deque[int] = deque()
        self._holds = holds
        self._told_held = False
        self._wrench_zero: Six = (0.0,) * 6
        self._restored_zero: Six = (0.0,) * 6
        self._connection: WorkerConnection | None = None
        self._replies: dict[int, asyncio.Future[messages.CommandReply]] = {}
        self._number = 0
        self._warning = ""
        # Why the last worker ended, if the control program did not start, until one plays.
        self._not_starting = ""
        # Tasks that wait for the next state, in the order of their calls: who waits first decides first.
        self._waiting: list[asyncio.Future[messages.RobotState]] = []

    @property
    def wrench_zero(self) -> Six:
        """The zero of the wrench, relative to the controller's own zero; all 0 if they are the same."""
        return self._wrench_zero

    def restore_wrench_zero(self, zero: Six) -> None:
        """Set the zero that an earlier process kept; call this before the worker starts."""
        self._wrench_zero = self._restored_zero = zero

    def forget_wrench_zero(self) -> None:
        """Remove the restored zero, because the tool is another one than the zero was measured with."""
        if not any(self._restored_zero):
            return
        pairs = zip(self._wrench_zero, self._restored_zero, strict=True)
        zero = cast(Six, tuple(now - restored for now, restored in pairs))
        self._wrench_zero, self._restored_zero = zero, (0.0,) * 6
        if self._connection is not None:
            self._told_held = self._holds()
            self._connection.send(messages.Held(self._told_held, zero))

    def diagnostics(self) -> Diagnostics:
        """Return the robot's values for `health`; counts are since the process began."""
        return {
            "connected": self.state is not None,
            "states": self.states,
            "errors": dict(self.losses),
            "rate_hz": self.measured_hz if self.state is not None else None,
            "expected_hz": self.settings.rate_hz,
            "error": self._why_slow() if self.monitor.latest.up else self.monitor.latest.sentence,
        }

    @property
    def measured_hz(self) -> float | None:
        """How many new states a second came in the latest second; None before there are two."""
        if len(self._measured_ns) < 2:
            return None
        return 1e9 * (len(self._measured_ns) - 1) / (self._measured_ns[-1] - self._measured_ns[0])

    def _why_slow(self) -> str:
        """Return how much slower the states come than configured; empty where they come as planned."""
        measured_hz, rate_hz = self.measured_hz, self.settings.rate_hz
        if measured_hz is None or measured_hz >= ENOUGH_STATES * rate_hz:
            return ""
        return (
            f"the robot's states come at {measured_hz:.0f} Hz, and `rate_hz` of its settings is {rate_hz:g}: end other "
            "programs on the daemon's computer, look at the network, or lower `rate_hz`"
        )

    async def next_state(self) -> messages.RobotState:
        """Return the next state, also after a loss of the connection."""
        waiting: asyncio.Future[messages.RobotState] = asyncio.get_running_loop().create_future()
        self._waiting.append(waiting)
        try:
            return await waiting
        finally:
            # A waiter that gave up stays for no later state: a robot may be off for days.
            self._waiting.remove(waiting)

    def send(self, command: messages.Command) -> asyncio.Future[messages.CommandReply]:
        """Send a command at once and return its reply; if the worker dies first, the reply is a refusal."""
        replied: asyncio.Future[messages.CommandReply] = asyncio.get_running_loop().create_future()
        if self._connection is None or self.state is None:
            replied.set_result(messages.CommandReply(f"The robot is not connected. {self.monitor.latest.sentence}"))
        else:
            if isinstance(command, messages.Unlock):
                self._tell_held(self._connection)
            self._number += 1
            self._replies[self._number] = replied
            self._connection.send(command, self._number)
        if isinstance(command, messages.ZeroForceTorque):
            replied.add_done_callback(self._note_zeroed)
        return replied

    def _note_zeroed(self, replied: asyncio.Future[messages.CommandReply]) -> None:
        if not replied.cancelled() and not replied.result().refusal:
            # The new zero contains no part of the restored one.
            self._restored_zero = (0.0,) * 6

    def _tell_held(self, connection: "WorkerConnection") -> None:
        """Send the worker a change of what `holds` says; a program that starts keeps the wrench's zero by it."""
        held = self._holds()
        if held is not self._told_held:
            self._told_held = held
            connection.send(messages.Held(held))

    def keep_moving(self) -> None:
        """Let a running straight move continue for `silence_timeout_s`; each decision calls this."""
        if self._connection is not None and self.state is not None and self.state.motion == "linear":
            self._connection.send(messages.Heartbeat())

    async def run(self) -> None:
        """Keep the robot connected until cancelled; then stop it and disconnect."""
        while True:
            try:
                await self._run_worker()
            except RobotLostError as loss:
                self.losses[loss.kind] += 1
                if loss.kind == "script":
                    self._not_starting = str(loss)
                pause_s = self.monitor.failed(loss, time.monotonic_ns())
                await asyncio.sleep(math.inf if loss.kind in LASTING else pause_s)

    async def _run_worker(self) -> None:
        connection = WorkerConnection(self.settings, self)
        await asyncio.get_running_loop().subprocess_exec(lambda: connection, sys.executable, "-m", self._worker)
        connection.send(self.settings)
        self._told_held = self._holds()
        connection.send(messages.Held(self._told_held, self._wrench_zero))
        self._connection = connection
        reason = "The robot's worker ended before it answered; nothing is sent again."
        try:
            await connection.listen()
        except RobotLostError as loss:
            reason = f"{loss} Nothing is sent again."
            raise
        finally:
            self._disconnect(reason)
            await _finish(connection.end())

    def _disconnect(self, reason: str) -> None:
        self._connection = None
        self.state = self.rests_since_ns = None
        self._measured_ns.clear()
        for number in list(self._replies):
            self.handle_message(number, messages.CommandReply(reason))

    def handle_message(self, number: int, message: messages.Message) -> None:
        """Handle a message of the worker."""
        match message:
            case messages.RobotState():
                if not message.blocked:
                    self._not_starting = ""
                if message.recovering and self._not_starting:
                    message = replace(message, blocked=self._not_starting)
                before, self.state = self.state, message
                self.rests_since_ns = (self.rests_since_ns or message.measured_ns) if message.rests else None
                self._wrench_zero = message.wrench_zero
                if not any(message.wrench_zero):
                    # The restored zero ends with a tare, or with a program's start without a load.
                    self._restored_zero = (0.0,) * 6
                self.states += 1
                self._count(message.measured_ns)
                if self._connection is not None:
                    self._tell_held(self._connection)
                if before is None:
                    connected = f"The robot at {self.settings.host} is connected."
                    said = (connected, self._warning, message.blocked)
                    self.monitor.connected(" ".join(filter(None, said)), time.monotonic_ns())
                for waiting in self._waiting:
                    if not waiting.done():
                        waiting.set_result(message)
            case messages.CommandReply():
                replied = self._replies.pop(number, None)
                if replied is not None and not replied.done():
                    replied.set_result(message)
            case messages.WorkerPhase():
                self._warning = message.warning
                if message.controller is not None and self._settings_for is not None:
                    self._use(self._settings_for(*message.controller))
            case messages.ControllerError():
                code = f"The controller reports {message} ({message.level})"
                self.monitor.noted(f"{code}: look it up in Universal Robots' list of error codes.")
            case messages.Failed():
                raise RobotLostError(message.kind, message.sentence)

    def _count(self, measured_ns: int) -> None:
        """Count a state for the rate, once."""
        known_ns = self._measured_ns
        if not known_ns or measured_ns > known_ns[-1]:
            known_ns.append(measured_ns)
        while known_ns[0] < measured_ns - _SECOND_NS:
            known_ns.popleft()

    def _use(self, settings: UrSettings) -> None:
        """Drive with these settings; raises RobotLostError, before any program is sent, if the worker has others."""
        if settings != self.settings:
            self.settings = settings
            raise RobotLostError(
                "other-limits",
                f"The controller at {settings.host} is another one than before, or than in the rig's report: the "
                "robot's worker starts again with the limits for it.",
            )


class WorkerConnection(asyncio.SubprocessProtocol):
    """The pipes to one worker, its end, and the reason why it ended."""

    def __init__(self, settings: UrSettings, robot: UrRobot) -> None:
        self._settings = settings
        self._robot = robot
        self._decoder = messages.MessageDecoder()
        self._received_s = time.monotonic()
        # Set when the worker has ended and all of its output was read.
        self._ended = asyncio.Event()
        # Set at the worker's end too, or earlier if an error ends the connection.
        self._closed = asyncio.Event()
        self._error: Exception | None = None
        self._stderr_tail = b""
        self._activity = "starting"
        # A worker that is silent for longer than this hangs.
        self._timeout_s = settings.connect_timeout_s + GRACE_S

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Keep the process and its input."""
        self._process = cast(asyncio.SubprocessTransport, transport)
        self._stdin = cast(asyncio.WriteTransport, self._process.get_pipe_transport(0))

    def send(self, message: messages.Message, number: int = 0) -> None:
        """Send a message to the worker."""
        self._stdin.write(messages.encode(message, number))

    def pipe_data_received(self, fd: int, data: bytes) -> None:
        """Handle output at once, because a task that wakes for each of 125 states a second would double the cost."""
        if fd == 2:
            # After a crash the end of the error output is the only trace.
            self._stderr_tail = (self._stderr_tail + data)[-LAST_WORDS_BYTES:]
            return
        if self._closed.is_set():
            return
        self._received_s = time.monotonic()
        try:
            for number, message in self._decoder.feed(data):
                if isinstance(message, messages.WorkerPhase):
                    self._activity = message.activity
                elif isinstance(message, messages.RobotState):
                    self._activity = CONTROLLING
                    longest_s = messages.RECOVERY_HANG_S if message.recovering else self._settings.hang_timeout_s
                    self._timeout_s = longest_s + GRACE_S
                self._robot.handle_message(number, message)
        except ProtocolError as error:
            self._kill()
            self._error = RobotLostError("garbled", str(error))
            self._closed.set()
        except Exception as error:  # noqa: BLE001 - raised again by `listen`
            self._error = error
            self._closed.set()

    def connection_lost(self, _error: Exception | None) -> None:
        """Note the end of the worker and of its output."""
        self._ended.set()
        self._closed.set()

    async def listen(self) -> None:
        """Wait for the end of the connection; kill a worker that is silent.

        Raises:
            RobotLostError: always, in the end.
        """
        looked_s = time.monotonic()
        while not self._closed.is_set():
            now_s = time.monotonic()
            late_s, looked_s = now_s - looked_s - WATCH_S, now_s
            if late_s > 0.0:
                # This process stood still, and did not read meanwhile.
                self._received_s = min(now_s, self._received_s + late_s)
            if now_s - self._received_s > self._timeout_s:
                self._kill()
                raise RobotLostError("hung", self._hung_sentence(self._timeout_s))
            with contextlib.suppress(TimeoutError):
                async with timeout(WATCH_S):
                    await self._closed.wait()
        raise self._error or self._died()

    async def end(self) -> None:
        """Disconnect the worker, and kill it after `EXIT_S`."""
        # The worker's last states do not count as a connection.
        self._closed.set()
        if self._process.get_returncode() is None:
            self.send(messages.Disconnect())
        # The end of the worker's input disconnects it too.
        self._stdin.close()
        try:
            async with timeout(EXIT_S):
                await self._ended.wait()
        except TimeoutError:
            self._kill()
            await self._ended.wait()
        self._process.close()

    def _kill(self) -> None:
        with contextlib.suppress(ProcessLookupError):
            self._process.kill()

    def _died(self) -> RobotLostError:
        status = self._process.get_returncode() or 0
        if status == -signal.SIGALRM:
            return RobotLostError("hung", self._hung_sentence(self._settings.hang_timeout_s))
        end = f"died of {signal.Signals(-status).name}" if status < 0 else f"ended with status {status}"
        # ur-rtde crashes like this when it loses the controller.
        cause = ": it lost the controller" if -status in (signal.SIGSEGV, signal.SIGABRT) else ""
        return RobotLostError(
            "crashed",
            f"The robot's worker {end} while {self._activity}{cause}. The script on the robot stops the arm; the "
            f"process is started again with motion disabled.{self._last_words()}",
        )

    def _hung_sentence(self, seconds: float) -> str:
        if self._activity != CONTROLLING:
            sentence = messages.silent_sentence(self._settings.host, self._settings.connect_timeout_s, self._activity)
        else:
            sentence = (
                f"The robot's worker did not answer for {seconds:.1f} s and was ended. The script on the robot stops "
                "the arm; the process is started again with motion disabled."
            )
        return sentence + self._last_words()

    def _last_words(self) -> str:
        lines = [line.strip() for line in self._stderr_tail.decode("utf-8", "replace").splitlines()]
        words = " / ".join([line for line in lines if line][-LAST_WORDS_LINES:])
        return f" Its last words: {words}." if words else ""


async def _finish(ending: Coroutine[Any, Any, None]) -> None:
    """Wait for the end, even if this task is cancelled."""
    task = asyncio.ensure_future(ending)
    try:
        await asyncio.shield(task)
    except asyncio.CancelledError:
        await task
        raise
