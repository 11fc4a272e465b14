"""The daemon's end of the robot: one process that may die at any time, and one object that outlives it.

`UrRobot.run` belongs in the daemon's task group. It starts the process, keeps the latest state, ends a process that
hangs, and starts the next one with growing pauses. A new process has motion disabled: no command is ever sent twice,
and nothing moves until someone says `Enable` (or `Unlock`) anew.
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

from shearloop.drivers.cancelled import is_cancelled
from shearloop.drivers.errors import DriverError
from shearloop.drivers.ur import error_messages as sentences
from shearloop.drivers.ur.messages import Command, CommandReply, Failed, Message, RobotState
from shearloop.drivers.ur.settings import UrSettings
from shearloop.drivers.ur.wire import encode
from shearloop.drivers.ur.worker_connection import Descriptor, LossKind, LostError, WorkerConnection, output

LinkStatus = Literal["starting", "up", "down"]

PAUSES_S: Final = (0.2, 0.5, 1.0, 2.0, 5.0)
# After so long without a loss the next one is a first one again.
STEADY_S = 30.0
# So long after the loss of a process what runs on the robot is taken for the program that it left behind.
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
    """A UR arm: `run` in a task, `send` commands, look at `state`."""

    def __init__(self, settings: UrSettings, on_link: Callable[[UrLinkEvent], None] | None = None) -> None:
        """Take the settings; `on_link` hears of every loss and every return."""
        self.settings = settings
        self.link = UrLinkEvent(time.monotonic_ns(), "starting", "The robot's process has not been started.")
        self.losses: Counter[str] = Counter()
        self.pid: int | None = None
        self._on_link = on_link or (lambda _event: None)
        # Called with each state where it is read, and with whether no newer one was read along with it.
        self.on_state: Callable[[RobotState, bool], None] = ignore_state
        self._state: RobotState | None = None
        self._stdin: asyncio.StreamWriter | None = None
        # When the process was told anything last: whatever it hears is a sign of life.
        self.told_s = -math.inf
        self._waiting: dict[int, Callable[[CommandReply], None]] = {}
        self._number = 0
        self._lost_s = -math.inf
        # How many times our program was paused, asked to stop, and did not.
        self.stops_in_vain = 0
        # How many states have come since the beginning.
        self.states = 0
        # Done with the next state; made when somebody waits for it.
        self._next: asyncio.Future[RobotState] | None = None

    @property
    def takes_over(self) -> bool:
        """Whether the connection was lost just now, so that a program of ours may have been left on the robot."""
        return time.monotonic() - self._lost_s < TAKES_OVER_S

    @property
    def state(self) -> RobotState | None:
        """The latest state, or None while there is no connection: an old state is no state."""
        return self._state

    async def next_state(self) -> RobotState:
        """Return the next state that arrives; waits through losses of the connection."""
        if self._next is None:
            self._next = asyncio.get_running_loop().create_future()
        return await asyncio.shield(self._next)

    async def send(self, command: Command) -> CommandReply:
        """Return the one reply to a command; `tell` says which."""
        replied: asyncio.Future[CommandReply] = asyncio.get_running_loop().create_future()

        def answered(reply: CommandReply) -> None:
            if not replied.done():
                replied.set_result(reply)

        self.tell(command, answered)
        return await replied

    def tell(self, command: Command, answered: Callable[[CommandReply], None]) -> None:
        """Send a command; `answered` hears the one reply: what is sent after clipping, or why nothing is.

        A command whose process dies before it replied is answered as refused, and is not sent again. What `answered`
        raises ends the conversation with the process; where that is over already, the event loop's handler hears of it.
        """
        if self._stdin is None or self._state is None:
            answered(CommandReply(refused=f"The robot is not connected. {self.link.sentence}"))
            return
        self._number += 1
        self._waiting[self._number] = answered
        self._write(self._stdin, encode(command, self._number))

    def _write(self, stdin: asyncio.StreamWriter, data: bytes) -> None:
        self.told_s = time.monotonic()
        stdin.write(data)

    async def run(self) -> None:
        """Keep the robot connected until cancelled; then stop it and let it go.

        Raises:
            DriverError: ur-rtde is not installed, which no attempt would change.
        """
        if importlib.util.find_spec("rtde_control") is None:
            raise DriverError(sentences.NOT_INSTALLED)
        attempts = 0
        while True:
            started_s = time.monotonic()
            try:
                await self._one_process()
            except LostError as loss:
                if loss.kind == "not-installed":
                    raise DriverError(str(loss)) from loss
                attempts = 1 if time.monotonic() - started_s > STEADY_S else attempts + 1
                self.losses[loss.kind] += 1
                self._tell("down", str(loss), loss.kind)
            await asyncio.sleep(PAUSES_S[min(attempts, len(PAUSES_S)) - 1])

    # ---- one process ----------------------------------------------------------------------------------------------

    async def _one_process(self) -> None:
        with output() as (stdout, its_stdout):
            await self._converse(stdout, its_stdout)

    async def _converse(self, stdout: int, its_stdout: Descriptor) -> None:
        process = await asyncio.create_subprocess_exec(
            sys.executable, "-m", "shearloop.drivers.ur.worker",
            stdin=asyncio.subprocess.PIPE, stdout=its_stdout.number, stderr=asyncio.subprocess.PIPE,
        )  # fmt: skip
        # Held by the process alone, it ends with it.
        its_stdout.close()
        self.pid = process.pid
        conversation = WorkerConnection(self, process, stdout)
        loss: BaseException | None = None
        try:
            async with asyncio.TaskGroup() as tasks:
                tasks.create_task(conversation.keep_alive())
                tasks.create_task(conversation.collect_stderr())
                await conversation.listen()
        except* LostError as group:
            loss = group.exceptions[0]
        finally:
            self._disconnected()
            # Cancelled: let it stop the arm. Lost: there is nothing to wait for.
            await _in_any_case(conversation.end())
            self.pid = None
        if loss is not None:
            if is_cancelled():
                raise asyncio.CancelledError
            raise loss

    def connected(self, stdin: asyncio.StreamWriter) -> None:
        """Send commands there from now on."""
        self._stdin = stdin

    def _disconnected(self) -> None:
        self._stdin = None
        if self._state is not None:
            # A network that failed makes no program ours.
            self._lost_s = time.monotonic() if self._state.ours else -math.inf
        self._state = None
        waiting, self._waiting = self._waiting, {}
        for answered in waiting.values():
            try:
                answered(CommandReply(refused="The robot's process ended before it answered; nothing is sent again."))
            except Exception as error:  # noqa: BLE001 - the others are told all the same, and the process is ended
                said = {"message": "who waited for a reply of the robot's process died of its end", "exception": error}
                asyncio.get_running_loop().call_exception_handler(said)

    def take_all(self, messages: Sequence[tuple[int, Message]]) -> None:
        """Act on what was read of the process at once, in order."""
        newest = next((message for _, message in reversed(messages) if isinstance(message, RobotState)), None)
        for number, message in messages:
            self.take(number, message, newest=message is newest)

    def take(self, number: int, message: Message, *, newest: bool = True) -> None:
        """Act on a message of the process; `newest`: no later state was read along with it."""
        match message:
            case RobotState():
                before = self._state
                self._state = message
                # Each process counts from zero.
                self.stops_in_vain += message.stops_in_vain - (before.stops_in_vain if before is not None else 0)
                if before is None:
                    self._tell("up", f"The robot at {self.settings.host} is connected. {message.blocked}".strip())
                self.states += 1
                self.on_state(message, newest)
                if self._next is not None:
                    self._next.set_result(message)
                    self._next = None
            case CommandReply():
                answered = self._waiting.pop(number, None)
                if answered is not None:
                    answered(message)
            case Failed():
                raise LostError(message.kind, message.sentence)

    def _tell(self, status: LinkStatus, sentence: str, kind: LossKind | None = None) -> None:
        self.link = UrLinkEvent(time.monotonic_ns(), status, sentence, kind, self.losses.total())
        self._on_link(self.link)


async def _in_any_case(ending: Coroutine[None, None, None]) -> None:
    """Await it to its end, also where we are cancelled only meanwhile: nobody else would wait for it."""
    task = asyncio.ensure_future(ending)
    try:
        await asyncio.shield(task)
    except asyncio.CancelledError:
        await task
        raise


def ignore_state(_state: RobotState, _newest: bool) -> None:
    """Do nothing with a state."""
