"""The daemon's end of the robot: `UrRobot` runs the worker process and replaces it when it dies.

A new worker has motion disabled. No command is sent twice, and nothing moves before the next `Enable` or `Unlock`.
"""

import asyncio
import importlib.util
import math
import sys
import time
from collections import Counter
from collections.abc import Callable, Coroutine, Sequence
from dataclasses import dataclass
from typing import Final, Literal

from shearloop.drivers.errors import DriverError, is_cancelled
from shearloop.drivers.ur import error_messages
from shearloop.drivers.ur.messages import Command, CommandReply, Failed, Message, RobotState
from shearloop.drivers.ur.settings import UrSettings
from shearloop.drivers.ur.worker_connection import Descriptor, LossKind, LostError, WorkerConnection, output_pipe

LinkStatus = Literal["starting", "up", "down"]

PAUSES_S: Final = (0.2, 0.5, 1.0, 2.0, 5.0)
# After this time without a loss the pauses start again with the shortest.
STEADY_S = 30.0
# A program found this soon after a loss counts as left behind by the lost worker.
TAKES_OVER_S = 10.0


@dataclass(frozen=True, slots=True)
class UrLinkEvent:
    """The link to the robot came up or went down; `sentence` is for the operator."""

    t_mono_ns: int
    status: LinkStatus
    sentence: str
    kind: LossKind | None = None
    losses: int = 0


class UrRobot:
    """A UR arm: `run` in a task of the daemon, `send` commands, read `state`."""

    def __init__(self, settings: UrSettings, on_link: Callable[[UrLinkEvent], None] | None = None) -> None:
        """Take the settings; `on_link` receives each loss and each return."""
        self.settings = settings
        self.link = UrLinkEvent(time.monotonic_ns(), "starting", "The robot's process has not been started.")
        self.losses: Counter[str] = Counter()
        self.pid: int | None = None
        # How many states have come, and how many times our program was paused and did not stop on request.
        self.states = 0
        self.failed_program_stops = 0
        # Receives each state, and whether it is the newest of those that were read at once.
        self.on_state: Callable[[RobotState, bool], None] = ignore_state
        self._on_link = on_link or (lambda _event: None)
        self._state: RobotState | None = None
        self._connection: WorkerConnection | None = None
        self._replies: dict[int, Callable[[CommandReply], None]] = {}
        self._number = 0
        self._lost_s = -math.inf
        self._next: asyncio.Future[RobotState] | None = None

    @property
    def takes_over(self) -> bool:
        """Whether the connection was just lost, so that a program of ours may still be on the robot."""
        return time.monotonic() - self._lost_s < TAKES_OVER_S

    @property
    def state(self) -> RobotState | None:
        """The latest state, or None while there is no connection."""
        return self._state

    async def next_state(self) -> RobotState:
        """Return the next state; waits through losses of the connection."""
        if self._next is None:
            self._next = asyncio.get_running_loop().create_future()
        return await asyncio.shield(self._next)

    async def send(self, command: Command) -> CommandReply:
        """Send a command and return its reply."""
        replied: asyncio.Future[CommandReply] = asyncio.get_running_loop().create_future()

        def on_reply(reply: CommandReply) -> None:
            if not replied.done():
                replied.set_result(reply)

        self.send_nowait(command, on_reply)
        return await replied

    def send_nowait(self, command: Command, on_reply: Callable[[CommandReply], None]) -> None:
        """Send a command and pass its reply to `on_reply`.

        A command whose worker dies first is refused and not sent again. An exception in `on_reply` ends the connection;
        where that has ended, it goes to the event loop's handler.
        """
        if self._connection is None or self._state is None:
            on_reply(CommandReply(refusal=f"The robot is not connected. {self.link.sentence}"))
            return
        self._number += 1
        self._replies[self._number] = on_reply
        self._connection.send(command, self._number)

    async def run(self) -> None:
        """Keep the robot connected until cancelled; then stop it and disconnect.

        Raises:
            DriverError: ur-rtde is not installed.
        """
        if importlib.util.find_spec("rtde_control") is None:
            raise DriverError(error_messages.NOT_INSTALLED)
        attempts = 0
        while True:
            started_s = time.monotonic()
            try:
                with output_pipe() as (stdout, its_stdout):
                    await self._run_worker(stdout, its_stdout)
            except LostError as loss:
                if loss.kind == "not-installed":
                    raise DriverError(str(loss)) from loss
                attempts = 1 if time.monotonic() - started_s > STEADY_S else attempts + 1
                self.losses[loss.kind] += 1
                self._notify_link("down", str(loss), loss.kind)
            await asyncio.sleep(PAUSES_S[min(attempts, len(PAUSES_S)) - 1])

    async def _run_worker(self, stdout: int, its_stdout: Descriptor) -> None:
        process = await asyncio.create_subprocess_exec(
            sys.executable, "-m", "shearloop.drivers.ur.worker",
            stdin=asyncio.subprocess.PIPE, stdout=its_stdout.number, stderr=asyncio.subprocess.PIPE,
        )  # fmt: skip
        # The worker alone holds it, so that it closes with the worker.
        its_stdout.close()
        self.pid = process.pid
        connection = WorkerConnection(self.settings, process, stdout, self.handle_messages, takes_over=self.takes_over)
        self._connection = connection
        loss: BaseException | None = None
        try:
            async with asyncio.TaskGroup() as tasks:
                tasks.create_task(connection.keep_alive())
                tasks.create_task(connection.collect_stderr())
                await connection.listen()
        except* LostError as group:
            loss = group.exceptions[0]
        finally:
            self._disconnect()
            await _finish(connection.end())
            self.pid = None
        if loss is not None:
            if is_cancelled():
                raise asyncio.CancelledError
            raise loss

    def _disconnect(self) -> None:
        self._connection = None
        if self._state is not None:
            # A lost network does not make a foreign program ours.
            self._lost_s = time.monotonic() if self._state.owns_program else -math.inf
        self._state = None
        replies, self._replies = self._replies, {}
        for on_reply in replies.values():
            try:
                on_reply(CommandReply(refusal="The robot's process ended before it answered; nothing is sent again."))
            except Exception as error:  # noqa: BLE001 - the others get their replies, and the worker ends, all the same
                context = {"message": "a callback for a reply of the robot's process failed", "exception": error}
                asyncio.get_running_loop().call_exception_handler(context)

    def handle_messages(self, messages: Sequence[tuple[int, Message]]) -> None:
        """Handle the messages of one read, in order."""
        newest = next((message for _, message in reversed(messages) if isinstance(message, RobotState)), None)
        for number, message in messages:
            match message:
                case RobotState():
                    self._handle_state(message, newest=message is newest)
                case CommandReply():
                    on_reply = self._replies.pop(number, None)
                    if on_reply is not None:
                        on_reply(message)
                case Failed():
                    raise LostError(message.kind, message.sentence)

    def _handle_state(self, state: RobotState, *, newest: bool) -> None:
        before, self._state = self._state, state
        # Each worker counts from zero.
        self.failed_program_stops += state.failed_program_stops
        if before is None:
            self._notify_link("up", f"The robot at {self.settings.host} is connected. {state.blocked}".strip())
        else:
            self.failed_program_stops -= before.failed_program_stops
        self.states += 1
        self.on_state(state, newest)
        if self._next is not None:
            self._next.set_result(state)
            self._next = None

    def _notify_link(self, status: LinkStatus, sentence: str, kind: LossKind | None = None) -> None:
        self.link = UrLinkEvent(time.monotonic_ns(), status, sentence, kind, self.losses.total())
        self._on_link(self.link)


async def _finish(ending: Coroutine[None, None, None]) -> None:
    """Await to the end, also when cancelled meanwhile."""
    task = asyncio.ensure_future(ending)
    try:
        await asyncio.shield(task)
    except asyncio.CancelledError:
        await task
        raise


def ignore_state(_state: RobotState, _newest: bool) -> None:
    """Do nothing with a state."""
