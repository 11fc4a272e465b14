"""The daemon's end of the robot: one process that may die at any time, and one object that outlives it.

`UrRobot.run` belongs in the daemon's task group. It starts the process, keeps the latest state, ends a process that
hangs, and starts the next one with growing pauses. A new process has motion disabled: no command is ever sent twice,
and nothing moves until someone says `Enable` (or `Unlock`) anew.
"""

import asyncio
import contextlib
import importlib.util
import math
import os
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final, Literal

from drivers.errors import DeviceLostError, DriverError, ProtocolError
from drivers.ur import sentences
from drivers.ur.messages import (
    RECOVERY_HANG_S,
    Command,
    Configure,
    Disconnect,
    Ease,
    Failed,
    FailureKind,
    Heartbeat,
    Message,
    Phase,
    Reply,
    RobotState,
)
from drivers.ur.settings import UrSettings
from drivers.ur.wire import Decoder, encode

LinkStatus = Literal["starting", "up", "down"]
LossKind = FailureKind | Literal["crashed", "hung", "garbled"]

PAUSES_S: Final = (0.2, 0.5, 1.0, 2.0, 5.0)
# After so long without a loss the next one is a first one again.
STEADY_S = 30.0
# A process being told to go stops the arm (1 s) and ends the program; then it is ended.
FAREWELL_S = 3.0
# Beyond its own alarms a process gets so long: they end it at a known place, and first.
GRACE_S = 1.0
# So long after the loss of a process what runs on the robot is taken for the program that it left behind.
TAKES_OVER_S = 10.0
# What a stuck process leaves unread; some hundred commands.
MOST_UNSENT = 1 << 15
# Of what a process prints the end is kept: enough for the last lines of a traceback, and for one sentence.
LAST_WORDS_BYTES, LAST_WORDS_LINES = 1024, 8
# What a process printed before its end arrives after that at times, but no later than this.
LAST_WORDS_S = 0.5
HEARTBEAT: Final = encode(Heartbeat())


@dataclass(frozen=True, slots=True)
class LinkEvent:
    """The link to the robot came up or went down; `sentence` is for the operator."""

    t_mono_ns: int
    status: LinkStatus
    sentence: str
    kind: LossKind | None = None
    losses: int = 0


class UrRobot:
    """A UR arm: `run` in a task, `send` commands, look at `state`."""

    def __init__(self, settings: UrSettings, on_link: Callable[[LinkEvent], None] | None = None) -> None:
        """Take the settings; `on_link` hears of every loss and every return."""
        self.settings = settings
        self.link = LinkEvent(time.monotonic_ns(), "starting", "The robot's process has not been started.")
        self.losses: Counter[str] = Counter()
        self.pid: int | None = None
        self._on_link = on_link or (lambda _event: None)
        self._state: RobotState | None = None
        self._stdin: asyncio.StreamWriter | None = None
        self._waiting: dict[int, asyncio.Future[Reply]] = {}
        self._number = 0
        self._lost_s = -math.inf
        # How many states have come since the beginning.
        self.states = 0
        # Who waits for the next state; None is for those who wait no longer.
        self._awaiting: set[asyncio.Future[RobotState | None]] = set()
        # Clear while the process was told that states are needed less often.
        self._hurried = asyncio.Event()
        self._hurried.set()

    @property
    def takes_over(self) -> bool:
        """Whether the connection was lost just now, so that a program may have been left on the robot."""
        return time.monotonic() - self._lost_s < TAKES_OVER_S

    @property
    def state(self) -> RobotState | None:
        """The latest state, or None while there is no connection: an old state is no state."""
        return self._state

    async def next_state(self) -> RobotState:
        """Return the next state that arrives; waits through losses of the connection."""
        while True:
            state = await self._awaited(None)
            if state is not None:
                return state

    async def state_within(self, seconds: float) -> RobotState | None:
        """Return the next state that arrives, or None where none does within so many seconds."""
        return await self._awaited(seconds)

    @property
    def at_ease(self) -> bool:
        """Whether the process was told that states are needed less often."""
        return not self._hurried.is_set()

    def ease(self, cycles: int) -> None:
        """Have a state only every so many cycles, as long as nothing moves, until `hurry` or the next command."""
        if cycles > 1 and self._stdin is not None and not self.at_ease:
            self._hurried.clear()
            self._stdin.write(encode(Ease(cycles)))

    def hurry(self) -> None:
        """Have a state in every cycle again, the next one in the present one."""
        if self._end_ease() and self._stdin is not None:
            self._stdin.write(HEARTBEAT)

    async def hurried(self) -> None:
        """Wait until a state is needed in every cycle, and signs of life with them."""
        await self._hurried.wait()

    def _end_ease(self) -> bool:
        """Return whether the process was at ease, and will not be: whatever it hears next ends that."""
        at_ease = self.at_ease
        self._hurried.set()
        return at_ease

    async def _awaited(self, seconds: float | None) -> RobotState | None:
        # 125 times a second: a future and a timer are a third of the price of a condition and `asyncio.timeout`.
        loop = asyncio.get_running_loop()
        arrived: asyncio.Future[RobotState | None] = loop.create_future()
        self._awaiting.add(arrived)
        timer = loop.call_later(seconds, _give_up, arrived) if seconds is not None else None
        try:
            return await arrived
        finally:
            self._awaiting.discard(arrived)
            if timer is not None:
                timer.cancel()

    async def send(self, command: Command) -> Reply:
        """Return the one reply to a command: what is sent after clipping, or why nothing is.

        A command whose process dies before it replied is answered as refused, and is not sent again.
        """
        if self._stdin is None or self._state is None:
            return Reply(refused=f"The robot is not connected. {self.link.sentence}")
        self._number += 1
        number = self._number
        future: asyncio.Future[Reply] = asyncio.get_running_loop().create_future()
        self._waiting[number] = future
        self._end_ease()
        self._stdin.write(encode(command, number))
        try:
            return await future
        finally:
            self._waiting.pop(number, None)

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
            except _LostError as loss:
                if loss.kind == "not-installed":
                    raise DriverError(str(loss)) from loss
                attempts = 1 if time.monotonic() - started_s > STEADY_S else attempts + 1
                self.losses[loss.kind] += 1
                self._tell("down", str(loss), loss.kind)
            await asyncio.sleep(PAUSES_S[min(attempts, len(PAUSES_S)) - 1])

    # ---- one process ----------------------------------------------------------------------------------------------

    async def _one_process(self) -> None:
        with _output() as (stdout, its_stdout):
            await self._converse(stdout, its_stdout)

    async def _converse(self, stdout: int, its_stdout: "_Descriptor") -> None:
        process = await asyncio.create_subprocess_exec(
            sys.executable, "-m", "drivers.ur.child",
            stdin=asyncio.subprocess.PIPE, stdout=its_stdout.number, stderr=asyncio.subprocess.PIPE,
        )  # fmt: skip
        # Held by the process alone, it ends with it.
        its_stdout.close()
        self.pid = process.pid
        conversation = _Conversation(self, process, stdout)
        loss: BaseException | None = None
        try:
            async with asyncio.TaskGroup() as tasks:
                tasks.create_task(conversation.keep_alive())
                tasks.create_task(conversation.collect_stderr())
                await conversation.listen()
        except* _LostError as group:
            loss = group.exceptions[0]
        finally:
            self._disconnected()
            # Cancelled: let it stop the arm. Lost: there is nothing to wait for.
            await asyncio.shield(conversation.end())
            self.pid = None
        if loss is not None:
            raise loss

    def connected(self, stdin: asyncio.StreamWriter) -> None:
        """Send commands there from now on."""
        self._stdin = stdin

    def _disconnected(self) -> None:
        self._stdin = None
        # The next process begins with every cycle.
        self._end_ease()
        if self._state is not None:
            self._lost_s = time.monotonic()
        self._state = None
        for future in self._waiting.values():
            if not future.done():
                future.set_result(Reply(refused="The robot's process ended before it answered; nothing is sent again."))
        self._waiting.clear()

    def take(self, number: int, message: Message) -> None:
        """Act on a message of the process."""
        match message:
            case RobotState():
                first = self._state is None
                self._state = message
                if first:
                    self._tell("up", f"The robot at {self.settings.host} is connected. {message.blocked}".strip())
                self.states += 1
                for arrived in self._awaiting:
                    if not arrived.done():
                        arrived.set_result(message)
            case Reply():
                future = self._waiting.get(number)
                if future is not None and not future.done():
                    future.set_result(message)
            case Failed():
                raise _LostError(message.kind, message.sentence)

    def _tell(self, status: LinkStatus, sentence: str, kind: LossKind | None = None) -> None:
        self.link = LinkEvent(time.monotonic_ns(), status, sentence, kind, self.losses.total())
        self._on_link(self.link)


class _LostError(DeviceLostError):
    """The process is of no more use."""

    def __init__(self, kind: LossKind, sentence: str) -> None:
        super().__init__(sentence)
        self.kind: LossKind = kind


class _Conversation:
    """The pipe to one process."""

    def __init__(self, robot: UrRobot, process: asyncio.subprocess.Process, stdout: int) -> None:
        if process.stdin is None or process.stderr is None:
            raise DriverError("The robot's process was started without pipes.")
        self._robot = robot
        self._settings = robot.settings
        self._process = process
        self._stdin, self._stdout, self._stderr = process.stdin, stdout, process.stderr
        self._decoder = Decoder()
        self._heard_s = time.monotonic()
        # Done when the process has no more to say, or has said what ends the conversation.
        self._over: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._said = b""
        self._said_all = asyncio.Event()
        self._doing = "starting"
        self._stdin.write(encode(Configure(robot.settings, robot.takes_over)))

    async def listen(self) -> None:
        """Take messages until the process has no more; a silent process is ended."""
        asyncio.get_running_loop().add_reader(self._stdout, self._hear)
        try:
            while not self._over.done():
                patience_s = self._patience_s()
                silent_s = time.monotonic() - self._heard_s
                if silent_s >= patience_s:
                    self._kill()
                    raise _LostError("hung", self._hung(patience_s))
                await asyncio.wait([self._over], timeout=min(patience_s - silent_s, self._settings.hang_timeout_s))
        finally:
            self._turn_away()
        # What was wrong with a message is raised here.
        self._over.result()
        raise await self._died()

    def _hear(self) -> None:
        """Take what the process has said, as it arrives: 125 times a second, so that no task is woken for it."""
        try:
            data = os.read(self._stdout, 1 << 16)
            self._heard_s = time.monotonic()
            for number, message in self._decoder.feed(data):
                self._take(number, message)
        except BlockingIOError:
            return
        except ProtocolError as error:
            self._kill()
            self._end_with(_LostError("garbled", str(error)))
        except Exception as error:  # noqa: BLE001 - raised again by `listen`, whose task it ends
            self._end_with(error)
        else:
            if not data:
                self._end_with(None)

    def _take(self, number: int, message: Message) -> None:
        if isinstance(message, RobotState):
            self._doing = "controlling"
            self._robot.connected(self._stdin)
        elif isinstance(message, Phase):
            self._doing = message.doing
        self._robot.take(number, message)

    def _turn_away(self) -> None:
        asyncio.get_running_loop().remove_reader(self._stdout)

    def _end_with(self, error: Exception | None) -> None:
        self._turn_away()
        if self._over.done():
            return
        if error is None:
            self._over.set_result(None)
        else:
            self._over.set_exception(error)

    async def keep_alive(self) -> None:
        """Give signs of life four times in the time after which motion would be stopped; at ease nothing moves."""
        while True:
            await self._robot.hurried()
            await asyncio.sleep(self._settings.silence_timeout_s / 4)
            if self._stdin.transport.get_write_buffer_size() > MOST_UNSENT:
                self._kill()
                raise _LostError("hung", self._hung(self._settings.silence_timeout_s))
            if not self._robot.at_ease:
                self._stdin.write(HEARTBEAT)

    async def collect_stderr(self) -> None:
        """Keep the end of what the process printed: after a crash it is all there is."""
        while data := await self._stderr.read(1 << 16):
            self._said = (self._said + data)[-LAST_WORDS_BYTES:]
        self._said_all.set()

    async def end(self) -> None:
        """End the process: in good order while it listens, and in any case within `FAREWELL_S`."""
        if self._process.returncode is None:
            with contextlib.suppress(ConnectionError):
                self._stdin.write(encode(Disconnect()))
            # The end of its input is its second word to go.
            self._stdin.close()
            try:
                async with asyncio.timeout(FAREWELL_S), asyncio.TaskGroup() as tasks:
                    tasks.create_task(_drain(self._stderr))
                    tasks.create_task(self._process.wait())
            except TimeoutError:
                self._kill()
        await self._process.communicate()

    def _kill(self) -> None:
        with contextlib.suppress(ProcessLookupError):
            self._process.kill()

    def _patience_s(self) -> float:
        state = self._robot.state
        if state is None:
            return self._settings.connect_timeout_s + GRACE_S
        return (RECOVERY_HANG_S if state.recovering else self._settings.hang_timeout_s) + GRACE_S

    async def _died(self) -> "_LostError":
        status = await self._process.wait()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(LAST_WORDS_S):
                await self._said_all.wait()
        if status == -signal.SIGALRM:
            return _LostError("hung", self._hung(self._settings.hang_timeout_s))
        died_of = f"died of {signal.Signals(-status).name}" if status < 0 else f"ended with status {status}"
        # What ur-rtde does when it loses the controller.
        why = ": it lost the controller" if -status in (signal.SIGSEGV, signal.SIGABRT) else ""
        return _LostError(
            "crashed",
            f"The robot's process {died_of} while {self._doing}{why}. The robot's watchdog ends the motion; the "
            f"process is started again with motion disabled.{self._last_words()}",
        )

    def _hung(self, seconds: float) -> str:
        if self._robot.state is None:
            sentence = sentences.silent(self._settings.host, self._settings.connect_timeout_s, self._doing)
        else:
            sentence = (
                f"The robot's process did not answer for {seconds:.1f} s and was ended. The robot's watchdog ends the "
                "motion; the process is started again with motion disabled."
            )
        return sentence + self._last_words()

    def _last_words(self) -> str:
        lines = [line.strip() for line in self._said.decode("utf-8", "replace").splitlines()]
        said = " / ".join([line for line in lines if line][-LAST_WORDS_LINES:])
        return f" Its last words: {said}." if said else ""


async def _drain(stream: asyncio.StreamReader) -> None:
    while await stream.read(1 << 16):
        pass


def _give_up(arrived: "asyncio.Future[RobotState | None]") -> None:
    if not arrived.done():
        arrived.set_result(None)


@dataclass(slots=True)
class _Descriptor:
    """An open file, closed once."""

    number: int
    is_open: bool = True

    def close(self) -> None:
        """Close it, unless it is closed already."""
        if self.is_open:
            self.is_open = False
            os.close(self.number)


@contextlib.contextmanager
def _output() -> Iterator[tuple[int, _Descriptor]]:
    """Give the end of a pipe that is read here without waiting, and the end that is written by a process."""
    reading, writing = os.pipe()
    its_end = _Descriptor(writing)
    os.set_blocking(reading, False)
    try:
        yield reading, its_end
    finally:
        its_end.close()
        os.close(reading)
