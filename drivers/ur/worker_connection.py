"""The pipe to one process of the robot: its beginning, what it says, how it ends and what is told of that."""

import asyncio
import contextlib
import os
import signal
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final, Literal, Protocol

from shearloop.drivers.errors import DeviceLostError, DriverError, ProtocolError
from shearloop.drivers.ur import error_messages as sentences
from shearloop.drivers.ur.messages import (
    RECOVERY_HANG_S,
    Configure,
    Disconnect,
    FailureKind,
    Heartbeat,
    Message,
    RobotPhase,
    RobotState,
)
from shearloop.drivers.ur.settings import UrSettings
from shearloop.drivers.ur.wire import Decoder, encode

LossKind = FailureKind | Literal["crashed", "hung", "garbled"]

# A process being told to go stops the arm (1 s) and ends the program; then it is ended.
FAREWELL_S = 3.0
# Beyond its own alarms a process gets so long: they end it at a known place, and first.
GRACE_S = 1.0
# What a stuck process leaves unread; some hundred commands.
MOST_UNSENT = 1 << 15
# Of what a process prints the end is kept: enough for the last lines of a traceback, and for one sentence.
LAST_WORDS_BYTES, LAST_WORDS_LINES = 1024, 8
# What a process printed before its end arrives after that at times, but no later than this.
LAST_WORDS_S = 0.5
HEARTBEAT: Final = encode(Heartbeat())


class LostError(DeviceLostError):
    """The process is of no more use."""

    def __init__(self, kind: LossKind, sentence: str) -> None:
        super().__init__(sentence)
        self.kind: LossKind = kind


class Outliving(Protocol):
    """Who holds conversations one after the other, and outlives each."""

    # When the process was told anything last, by time.monotonic.
    told_s: float

    @property
    def settings(self) -> UrSettings:
        """The robot's settings, as a process is given them at its beginning."""

    @property
    def takes_over(self) -> bool:
        """Whether the process before this one may have left a program of ours on the robot."""

    @property
    def state(self) -> RobotState | None:
        """The latest state of this process, None before its first."""

    def connected(self, stdin: asyncio.StreamWriter) -> None:
        """Take the pipe for commands: the process controls the robot from now on."""

    def take_all(self, messages: Sequence[tuple[int, Message]]) -> None:
        """Act on what was read of the process at once, in order."""


class WorkerConnection:
    """The pipe to one process."""

    def __init__(self, robot: Outliving, process: asyncio.subprocess.Process, stdout: int) -> None:
        if process.stdin is None or process.stderr is None:
            raise DriverError("The robot's process was started without pipes.")
        self._robot = robot
        self._settings = robot.settings
        self._process = process
        self._stdin, self._stdout, self._stderr = process.stdin, stdout, process.stderr
        self._decoder = Decoder()
        self._heard_s = time.monotonic()
        # Done when the process has no more to say, or has said what ends the conversation: then with the error, as its
        # result, for asyncio complains of an exception where nobody listens any more.
        self._over: asyncio.Future[Exception | None] = asyncio.get_running_loop().create_future()
        self._said = b""
        self._said_all = asyncio.Event()
        self._doing = "starting"
        self._controls = False
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
                    raise LostError("hung", self._hung(patience_s))
                await asyncio.wait([self._over], timeout=min(patience_s - silent_s, self._settings.hang_timeout_s))
        finally:
            self._turn_away()
        wrong = self._over.result()
        raise wrong if wrong is not None else await self._died()

    def _hear(self) -> None:
        """Take what the process has said, as it arrives: up to 125 times a second, so that no task is woken for it."""
        try:
            data = os.read(self._stdout, 1 << 16)
            self._heard_s = time.monotonic()
            messages = self._decoder.feed(data)
            if not self._controls:
                self._begin_with(messages)
            self._robot.take_all(messages)
        except BlockingIOError:
            return
        except ProtocolError as error:
            self._kill()
            self._end_with(LostError("garbled", str(error)))
        except Exception as error:  # noqa: BLE001 - raised again by `listen`, whose task it ends
            self._end_with(error)
        else:
            if not data:
                self._end_with(None)

    def _begin_with(self, messages: list[tuple[int, Message]]) -> None:
        """Follow how far the process has come; from its first state on it controls the robot, and takes commands."""
        for _, message in messages:
            if isinstance(message, RobotState):
                self._controls = True
                self._doing = "controlling"
                self._robot.connected(self._stdin)
            elif isinstance(message, RobotPhase):
                self._doing = message.doing

    def _turn_away(self) -> None:
        asyncio.get_running_loop().remove_reader(self._stdout)

    def _end_with(self, error: Exception | None) -> None:
        self._turn_away()
        if not self._over.done():
            self._over.set_result(error)

    async def keep_alive(self) -> None:
        """Give signs of life four times in the time after which motion would be stopped.

        A command is one too, and as long as they come there is no need of others: each wakes the process once more.
        """
        longest_s = self._settings.silence_timeout_s / 4
        while True:
            left_s = longest_s - (time.monotonic() - self._robot.told_s)
            if left_s <= 0:
                self._robot.told_s, left_s = time.monotonic(), longest_s
                self._stdin.write(HEARTBEAT)
            await asyncio.sleep(left_s)
            if self._stdin.transport.get_write_buffer_size() > MOST_UNSENT:
                self._kill()
                raise LostError("hung", self._hung(self._settings.silence_timeout_s))

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

    async def _died(self) -> LostError:
        status = await self._process.wait()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(LAST_WORDS_S):
                await self._said_all.wait()
        if status == -signal.SIGALRM:
            return LostError("hung", self._hung(self._settings.hang_timeout_s))
        died_of = f"died of {signal.Signals(-status).name}" if status < 0 else f"ended with status {status}"
        # What ur-rtde does when it loses the controller.
        why = ": it lost the controller" if -status in (signal.SIGSEGV, signal.SIGABRT) else ""
        return LostError(
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


@dataclass(slots=True)
class Descriptor:
    """An open file, closed once."""

    number: int
    is_open: bool = True

    def close(self) -> None:
        """Close it, unless it is closed already."""
        if self.is_open:
            self.is_open = False
            os.close(self.number)


@contextlib.contextmanager
def output() -> Iterator[tuple[int, Descriptor]]:
    """Give the end of a pipe that is read here without waiting, and the end that is written by a process."""
    reading, writing = os.pipe()
    its_end = Descriptor(writing)
    os.set_blocking(reading, False)
    try:
        yield reading, its_end
    finally:
        its_end.close()
        os.close(reading)
